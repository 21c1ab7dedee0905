"""Turns the refined optimum into severities with confidence intervals and a measure of fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.refine.derivatives import CAP
from ehadiag.identify.refine.least_squares import Refinement
from ehadiag.identify.result import Estimate, Fit, Identification, Nuisance, Timing
from ehadiag.identify.search.first_approximation import FirstApproximation
from ehadiag.identify.search.solvers import SearchResult
from ehadiag.identify.uncertainty import interval95
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.parameters import FAULTS, Kind, Parameter

__all__ = ["NOT_SHOWN_STD", "estimates_of", "fit_of", "identification", "of_faults", "outliers"]

NOT_SHOWN_STD = 0.1
BOUND = 1e-6


def identification(
    first: FirstApproximation,
    found: SearchResult,
    refined: Refinement,
    spread: NDArray[np.float64],
    experiments: Sequence[Experiment],
    *,
    solver: str,
    seed: int,
    evaluations: int,
    attempts: int,
    timing: Timing,
    about: Mapping[str, float],
) -> Identification:
    """Put together what an identification says.

    spread: covariance of all that was refined, SI; about: effects that the constants already have.
    """
    deviations = np.sqrt(np.diag(spread)).tolist()
    nuisances = {
        item.name: Nuisance(
            value=refined.values[item.name] + about.get(item.name, 0.0),
            std=std,
            at_bound=not item.lower < refined.values[item.name] < item.upper,
        )
        for item, std in zip(refined.parameters, deviations, strict=True)
        if item.kind is not Kind.FAULT
    }
    return Identification(
        estimates=estimates_of(first, found, refined, spread),
        nuisances=nuisances,
        about=about,
        covariance=of_faults(refined, spread),
        fit=fit_of(refined, experiments),
        solver=solver,
        seed=seed,
        evaluations=evaluations,
        generations=found.generations,
        cost=refined.cost,
        converged=refined.converged,
        attempts=attempts,
        timing=timing,
    )


def of_faults(refined: Refinement, spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Part of a covariance that is of the severities, in the order of `FAULTS`."""
    names = [item.name for item in refined.parameters]
    places = [names.index(item.name) for item in FAULTS]
    return spread[np.ix_(places, places)]


def estimates_of(
    first: FirstApproximation,
    found: SearchResult,
    refined: Refinement,
    spread: NDArray[np.float64],
) -> tuple[Estimate, ...]:
    """Severities as each stage left them.

    spread: covariance of all that was refined, SI.
    """
    values = refined.values
    deviations = np.sqrt(np.diag(of_faults(refined, spread)))
    out = []
    for item, searched, std in zip(FAULTS, found.best, deviations.tolist(), strict=True):
        value = _within(item, values[item.name])
        out.append(
            Estimate(
                name=item.name,
                first=float(first.values[item.name]),
                search=_within(item, float(searched)),
                value=value,
                std=std,
                interval95=interval95(value, std),
                at_bound=value <= item.lower + BOUND or value >= item.upper - BOUND,
                shown=std < NOT_SHOWN_STD,
            )
        )
    return tuple(out)


def _within(item: Parameter, value: float) -> float:
    """Severity as it is told: it is looked for beyond where data that pass for it may be off."""
    return min(max(value, item.lower), item.upper)


def fit_of(refined: Refinement, experiments: Sequence[Experiment]) -> Fit:
    """How well the optimum explains the recordings; noise and offsets are of the first one."""
    first, values = experiments[0], refined.values
    return Fit(
        spool_rms=_rms(refined, SPOOL_ROW),
        pressure_rms=_rms(refined, PRESSURE_ROW),
        outliers=outliers(refined),
        spool_noise=first.spool_noise,
        pressure_noise=first.pressure_noise,
        spool_offset=first.spool_offset + values["spool_offset"],
        pressure_offset=first.pressure_offset + values["pressure_offset"],
        anchored=refined.anchored,
        spool_rms_uncapped=_rms(refined, SPOOL_ROW, np.inf),
        pressure_rms_uncapped=_rms(refined, PRESSURE_ROW, np.inf),
    )


def outliers(refined: Refinement) -> float:
    """Share of residuals beyond three deviations."""
    present = refined.weighted
    return float(np.mean(refined.residuals[present] ** 2 >= CAP)) if present.any() else 1.0


def _rms(refined: Refinement, row: int, cap: float = CAP) -> float:
    """Rms residual of a signal, squares capped; NaN without a sample."""
    residuals = refined.residuals[row, refined.weighted[row]]
    return float(np.sqrt(np.mean(np.minimum(residuals**2, cap)))) if residuals.size else np.nan
