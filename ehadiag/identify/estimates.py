"""Judgement of an optimum: standard deviations, intervals, quality of fit, noise test.

The covariance is the larger of the inverse curvature and a sandwich estimate with correlated
residuals (Newey and West, Econometrica 55(3), 1987).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import MAX_NOISE_EXCESS, FitQuality
from ehadiag.core.conventions import EXPONENT_NAME, FRICTION_NAME
from ehadiag.core.criteria import ESTIMATION, FIT, GIVE_UP, NORMAL_HALF_WIDTH_95, NUMERICAL_ZERO
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.identification_result import (
    Estimate,
    Fit,
    Identification,
    IdentificationTiming,
    Nuisance,
)
from ehadiag.identify.least_squares import Refinement, products
from ehadiag.identify.signals import relative_noise
from ehadiag.identify.solvers import SearchResult
from ehadiag.identify.staged_search import FirstApproximation
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.parameter import Parameter, ParameterKind
from ehadiag.model.plant import PlantConstants
from ehadiag.model.registry import FAULTS
from ehadiag.model.severities import FAULT_LAWS


def estimate_covariance(refinement: Refinement) -> Array:
    """Covariance of the estimates, SI, shape (k, k), in the order of the refinement's parameters.

    The larger of two, parameter by parameter: the inverse curvature times the reduced sum of
    squares (never below 1), and the sandwich estimate with residuals correlated over some ticks
    (Newey and West, Econometrica 55(3), 1987), which grows with what the model does not explain.
    A severity that the test does not show has the variance of a uniform density, or of what was
    known beforehand. Oil and supply of the day are unknowns, too, with a density of unit width. On
    top comes what the considered parameters do: where one of them is off by a deviation the
    estimate moves in proportion (Schmidt, Advances in Control Systems 3, 1966);
    `ESTIMATION.discrepancy_std`, for what either side's integration is off; and the last step of a
    search that did not come to rest, as between break-aways it does not.
    """
    count, used = len(refinement.x), refinement.used
    information = refinement.information
    known = information is not None
    if information is None:
        # A weak prior keeps a severity that nothing shows finite: uniform on its range.
        severities = np.array([item.kind is ParameterKind.FAULT for item in refinement.parameters])
        information = np.diag(np.where(severities, 1.0 / ESTIMATION.uniform_std**2, 0.0))
    slopes = refinement.jacobian
    if len(refinement.daily):
        slopes = np.concatenate([slopes, np.where(used, refinement.daily, 0.0)])
    rows = slopes.reshape(len(slopes), -1)
    prior = np.eye(len(slopes))
    prior[:count, :count] = information
    inverse = np.linalg.pinv(products(rows) + prior, hermitian=True)
    squares = float((refinement.residuals[used] ** 2).sum())
    reduced = squares / max(int(used.sum()) - count, 1)
    curved = inverse * max(reduced / ESTIMATION.capped_variance, 1.0)
    # What was known is like one more sample of each parameter.
    prior[:count, :count] *= float(known)
    meat = _meat(slopes, np.where(used, refinement.residuals, 0.0))
    sandwich = inverse @ (meat + prior) @ inverse
    factor = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(curved), 1e-300), 1.0))
    out = curved * np.outer(factor, factor)
    for change in refinement.considered:
        shift = inverse @ (rows @ np.where(used, change, 0.0).ravel())
        out += np.outer(shift, shift)
    out = out[:count, :count]
    out += ESTIMATION.discrepancy_std**2 * np.eye(count)
    if not refinement.converged:
        out += np.outer(refinement.step, refinement.step)
    return np.asarray(out * np.outer(refinement.scale, refinement.scale))


def _meat(slopes: Array, residuals: Array) -> Array:
    """Covariance of the gradient, residuals of all signals taken together at each tick.

    slopes: shape (k, signals, N); residuals: 0 in rows left out, shape (signals, N).
    """
    # Bartlett's weights of lags are those of sums over as many ticks.
    count = ESTIMATION.correlation_lags + 1
    score = np.einsum("ksn,sn->kn", slopes, residuals)
    total = np.pad(score.cumsum(axis=1), ((0, 0), (0, count - 1)), mode="edge")
    total[:, count:] -= total[:, :-count].copy()
    return products(total) / count


def independent_covariance(parameters: Sequence[Parameter], std: Mapping[str, float]) -> Array:
    """Covariance of independent deviations by name, shape (k, k).

    std: in the parameters' units; 0 of those that are not named.
    """
    return np.diag([std.get(item.name, 0.0) ** 2 for item in parameters])


def interval95(value: float, std: float) -> tuple[float, float]:
    """Central 95 % interval of a normal density, cut at the bounds 0 and 1.

    For an estimate at a bound the interval begins there: the density beyond it does not count.
    """
    half = NORMAL_HALF_WIDTH_95 * std
    return max(0.0, value - half), min(1.0, value + half)


ExplanationTest = Callable[[Array], bool]
"""Of weighted residuals, shape (signals, N): whether no better optimum is to be searched for."""


def excess_cost(residuals: Array) -> float:
    """Cost of residuals over that of noise alone, of the signal where the ratio is the larger.

    The noise is that of second differences, which do not contain what a model leaves out.
    residuals: weighted, 0 where no sample counts, shape (signals, N).
    """
    return max(signal_excess_costs(residuals), default=0.0)


def signal_excess_costs(residuals: Array) -> list[float]:
    """Return the excess cost of each signal, see `excess_cost`; 0 of one without samples."""
    out = []
    for row in residuals:
        present = row != 0.0
        share = (
            row[present] / (ESTIMATION.cauchy_scale * relative_noise(row))
            if present.any()
            else np.zeros(1)
        )
        out.append(
            float(ESTIMATION.cauchy_scale**2 * np.log1p(share**2).mean() / FIT.expected_cauchy_cost)
        )
    return out


def explains_far_more(excess: float, before: float) -> bool:
    """Whether an estimate leaves at most half of what another one leaves beside the noise."""
    return before > 1.0 and excess - 1.0 < GIVE_UP.max_trial_share * (before - 1.0)


def likelihood_ratio_cost(residuals: Array, others: Array) -> float:
    """Twice the logarithm of how much likelier other residuals are, by Cauchy's cost over that of
    noise, on the samples that count in both; shape (signals, N).
    """
    both = (residuals != 0.0) & (others != 0.0)
    ours, theirs = (signal_excess_costs(np.where(both, rows, 0.0)) for rows in (residuals, others))
    return float(np.dot(np.subtract(ours, theirs), both.sum(axis=1)))


def is_noise(residuals: Array) -> bool:
    """Whether the residuals are those of noise."""
    return (
        residual_outlier_share(residuals) <= FIT.max_outliers_of_noise
        and excess_cost(residuals) <= MAX_NOISE_EXCESS
    )


def calibrated_explanation_test(fit: FitQuality) -> ExplanationTest:
    """Test whether residuals are no larger than those of a unit's calibration."""
    if not fit.left:
        return is_noise
    most_outliers = FIT.max_outliers_of_noise + FIT.wear_excess_factor * fit.outliers
    return lambda residuals: (
        residual_outlier_share(residuals) <= most_outliers
        and excess_cost(residuals) <= fit.most_excess
    )


def is_unexplainable(residuals: Array) -> bool:
    """Whether a search has left what no further start will explain.

    Half of all samples are beyond three deviations, or the pressure alone is far off: where a
    search ends between break-aways it is the spool that jumps.
    """
    return residual_outlier_share(residuals) > GIVE_UP.outliers or is_pressure_misfit(residuals)


def misses_only_pressure(residuals: Array) -> bool:
    """Whether the spool is explained, and the pressure is not."""
    return explains_spool(residuals) and excess_cost(residuals) > FIT.max_explained_excess


def explains_spool(residuals: Array) -> bool:
    """Whether the spool is explained, so that break-aways come at the right ticks."""
    return signal_excess_costs(residuals)[SPOOL_ROW] <= FIT.max_explained_excess


def is_near(residuals: Array) -> bool:
    """Whether so little is left that it may be of break-aways at wrong ticks."""
    return residual_outlier_share(residuals) <= GIVE_UP.near_outliers


def is_pressure_misfit(residuals: Array) -> bool:
    """Whether the spool, where break-aways happen, is explained and the pressure is far from it."""
    return explains_spool(residuals) and not is_near(residuals)


def residual_outlier_share(residuals: Array) -> float:
    """Share of residuals beyond three deviations."""
    present = residuals != 0.0
    return (
        float(np.mean(residuals[present] ** 2 >= ESTIMATION.cauchy_scale**2))
        if present.any()
        else 1.0
    )


def identification_result(
    first: FirstApproximation,
    found: SearchResult,
    refined: Refinement,
    spread: Array,
    experiments: Sequence[Experiment],
    *,
    solver: str,
    seed: int,
    evaluations: int,
    attempts: int,
    timing: IdentificationTiming,
    about: Mapping[str, float],
    discrepancy: Mapping[str, float],
    doubt: Array,
) -> Identification:
    """Put together what an identification says.

    spread: covariance of all that was refined, SI, if the faults' laws hold; about: effects that
    the constants already have; discrepancy: of the faults' laws, by name, over the severity, 1;
    doubt: covariance by that discrepancy, SI.
    """
    shown = _shown_severities(refined, spread)
    spread = spread + doubt
    deviations = np.sqrt(np.diag(spread)).tolist()
    nuisances = {
        item.name: Nuisance(
            value=refined.values[item.name] + about.get(item.name, 0.0),
            std=std,
            at_bound=not item.lower < refined.values[item.name] < item.upper,
        )
        for item, std in zip(refined.parameters, deviations, strict=True)
        if item.kind is not ParameterKind.FAULT
    }
    return Identification(
        estimates=severity_estimates(first, found, refined, spread, shown),
        nuisances=nuisances,
        about=about,
        covariance=fault_covariance(refined, spread),
        fit=fit_quality(refined, experiments, discrepancy),
        solver=solver,
        seed=seed,
        evaluations=evaluations,
        generations=found.generations,
        cost=refined.cost,
        residuals=refined.residuals,
        converged=refined.converged,
        attempts=attempts,
        timing=timing,
    )


def fault_covariance(refined: Refinement, spread: Array) -> Array:
    """Part of a covariance that is of the severities, in the order of `FAULTS`."""
    names = [item.name for item in refined.parameters]
    places = [names.index(item.name) for item in FAULTS]
    return spread[np.ix_(places, places)]


def _shown_severities(refined: Refinement, spread: Array) -> list[bool]:
    """Whether the test shows each severity: doubt about a law of wear is none about the test."""
    std = np.sqrt(np.diag(fault_covariance(refined, spread)))
    return (std < FIT.max_shown_std).tolist()


def severity_estimates(
    first: FirstApproximation,
    found: SearchResult,
    refined: Refinement,
    spread: Array,
    shown: Sequence[bool],
) -> tuple[Estimate, ...]:
    """Severities as each stage left them.

    spread: covariance of all that was refined, SI; shown: whether the test shows each.
    """
    values = refined.values
    deviations = np.sqrt(np.diag(fault_covariance(refined, spread))).tolist()
    out = []
    for item, searched, std, seen in zip(FAULTS, found.best, deviations, shown, strict=True):
        value = _bounded_severity(item, values[item.name])
        out.append(
            Estimate(
                name=item.name,
                first=float(first.values[item.name]),
                search=_bounded_severity(item, float(searched)),
                value=value,
                std=std,
                interval95=interval95(value, std),
                at_bound=value <= item.lower + NUMERICAL_ZERO
                or value >= item.upper - NUMERICAL_ZERO,
                shown=seen,
            )
        )
    return tuple(out)


def _bounded_severity(item: Parameter, value: float) -> float:
    """Severity within its bounds: the search goes beyond them where data are inexact."""
    return min(max(value, item.lower), item.upper)


def fit_quality(
    refined: Refinement,
    experiments: Sequence[Experiment],
    discrepancy: Mapping[str, float] = MappingProxyType({}),
) -> Fit:
    """How well the optimum explains the recordings; noise and offsets are of the first one.

    discrepancy: of the faults' laws, by name, over the severity, 1.
    """
    first, values = experiments[0], refined.values
    outliers = refinement_outlier_share(refined)
    rms = [_rms(refined, row) for row in (SPOOL_ROW, PRESSURE_ROW)]
    unexplained = outliers, max(rms)
    if any(discrepancy.values()):
        share = refined.residuals / explained_deviations(refined, discrepancy)
        within = replace(refined, residuals=share)
        unexplained = (
            refinement_outlier_share(within),
            max(_rms(within, row) for row in (SPOOL_ROW, PRESSURE_ROW)),
        )
    return Fit(
        spool_rms=rms[0],
        pressure_rms=rms[1],
        outliers=outliers,
        spool_noise=first.spool_noise,
        pressure_noise=first.pressure_noise,
        spool_offset=first.spool_offset + values["spool_offset"],
        pressure_offset=first.pressure_offset + values["pressure_offset"],
        anchored=refined.anchored,
        spool_rms_uncapped=_rms(refined, SPOOL_ROW, np.inf),
        pressure_rms_uncapped=_rms(refined, PRESSURE_ROW, np.inf),
        unexplained_outliers=unexplained[0],
        unexplained_rms=unexplained[1],
    )


def explained_deviations(refined: Refinement, discrepancy: Mapping[str, float]) -> Array:
    """Deviation of each residual by noise and by laws of the faults that are off, over the noise.

    A law that is off by a share of the severity, at one instant otherwise than at another, moves a
    sample by its sensitivity to the severity times that share: a model discrepancy whose size
    follows the sensitivities (Kennedy and O'Hagan 2001). Rows that took no part in the fit have no
    sensitivity: they have that of their neighbours. Shape (signals, N), from 1 up.
    """
    variance = np.ones_like(refined.residuals)
    for item, x, row in zip(refined.parameters, refined.x, refined.jacobian, strict=True):
        variance += (discrepancy.get(item.name, 0.0) * x * row) ** 2
    ticks = np.arange(variance.shape[1])
    for own, used in zip(variance, refined.used, strict=True):
        if used.any():
            own[~used] = np.interp(ticks[~used], ticks[used], own[used])
    return np.asarray(np.sqrt(variance))


def refinement_outlier_share(refined: Refinement) -> float:
    """Share of residuals beyond three deviations."""
    present = refined.weighted
    return (
        float(np.mean(refined.residuals[present] ** 2 >= ESTIMATION.residual_cap))
        if present.any()
        else 1.0
    )


def _rms(refined: Refinement, row: int, cap: float = ESTIMATION.residual_cap) -> float:
    """Rms residual of a signal, squares capped; NaN without a sample."""
    residuals = refined.residuals[row][refined.weighted[row]]
    return float(np.sqrt(np.mean(np.minimum(residuals**2, cap)))) if residuals.size else np.nan


EXPONENTS = 41
"""Number of exponents of a range, its ends among them, 1: steps of 0.05."""
FIRST_STAGE_STD = 0.02
"""Deviation of the clogging over the friction with the least exponent, 1, by the first stage's law
that goes with an exponent: 0.018 to 0.032 on units of exponent 0 that were identified with 2."""


def friction_by_exponent(
    values: Mapping[str, float], constants: PlantConstants, change: float
) -> float:
    """`FSS` that a larger exponent of clogging makes of one that was found (PHY-45), 1.

    values: severities, by name; constants: of the unit as new; change: of the exponent.
    """
    share, new = _clogging_terms(values, constants)
    return float((values[FRICTION_NAME] + new) * share**change - new)


def _clogging_terms(values: Mapping[str, float], constants: PlantConstants) -> tuple[float, float]:
    """Flow that clogging leaves, over that as new, and the spool's friction as new, a severity."""
    share = 1.0 + FAULT_LAWS["Kintas"].change * values["Kintas"]
    return share, float(constants.FSS / (constants.FSS1 - constants.FSS))


class FrictionRange(NamedTuple):
    """Spool friction that exponents of clogging make of one that was found with one of them."""

    frictions: tuple[float, ...]
    """With each exponent, the largest first."""
    value: float
    """Middle of the interval that holds all of them with their own."""
    std: float
    """Deviation that goes with the interval."""
    exponent: float
    """The exponent that goes with the middle."""


def friction_range(
    values: Mapping[str, float],
    std: float,
    constants: PlantConstants,
    exponents: tuple[float, float],
    *,
    with_exponent: float,
) -> FrictionRange:
    """Return what exponents of clogging make of a friction, see `over_exponents`.

    values: severities by name, found with one exponent; std: of the friction; constants: of the
    unit as new; exponents: least and largest one.
    """
    low, high = exponents
    share, new = _clogging_terms(values, constants)
    shown = max(values[FRICTION_NAME] + new, 1e-9)
    ratios = share ** (np.linspace(high, low, EXPONENTS) - with_exponent)
    frictions = np.clip(shown * ratios - new, 0.0, 1.0).tolist()
    half = NORMAL_HALF_WIDTH_95 * std * ratios
    bottom = frictions[0] - float(half[0])
    top = min(frictions[-1] + float(half[-1]), max(frictions[0] + float(half[0]), 1.0))
    value = (bottom + top) / 2.0
    power = math.log((value + new) / shown) / math.log(share) if share < 1.0 else 0.0
    return FrictionRange(
        tuple(frictions),
        value,
        (top - bottom) / 2.0 / NORMAL_HALF_WIDTH_95,
        min(max(with_exponent + power, low), high),
    )


def over_exponents(
    found: Identification,
    constants: PlantConstants,
    exponents: tuple[float, float],
    *,
    with_exponent: float,
) -> Identification:
    """Return an identification with the friction that any exponent of a range makes of it.

    The spool breaks away and creeps by the ratio of its friction and the first stage's pressure
    gain, GPF k^m (PHY-45). So a recording shows FSS / k^m, and hardly m: with each exponent there
    is a friction that explains it as well. The interval holds that of each, the estimate is its
    middle.

    Parameters
    ----------
    found : Identification
        With one exponent.
    constants : PlantConstants
        Of the unit as new.
    exponents : tuple[float, float]
        Least and largest exponent.
    with_exponent : float
        The one with which it was identified.

    Returns
    -------
    Identification
        The same where the range is a number.
    """
    low, high = exponents
    if low == high:
        return found
    friction = found.named(FRICTION_NAME)
    values = {item.name: item.value for item in found.estimates}
    frictions, value, std, exponent = friction_range(
        values, friction.std, constants, exponents, with_exponent=with_exponent
    )
    estimate = replace(
        friction,
        value=value,
        std=std,
        interval95=interval95(value, std),
        at_bound=not 0.0 < value < 1.0,
    )
    clogging = found.named("Kintas")
    wider = math.hypot(clogging.std, FIRST_STAGE_STD * frictions[-1])
    clogged = replace(clogging, std=wider, interval95=interval95(clogging.value, wider))
    changed = {FRICTION_NAME: estimate, "Kintas": clogged}
    ratio = np.array([changed.get(item.name, item).std / item.std for item in found.estimates])
    covariance = found.covariance * np.outer(ratio, ratio)
    std_of_exponent = (high - low) / math.sqrt(12.0)
    nuisance = Nuisance(exponent - constants.CLE, std_of_exponent, at_bound=False)
    return replace(
        found,
        estimates=tuple(changed.get(item.name, item) for item in found.estimates),
        nuisances={**found.nuisances, EXPONENT_NAME: nuisance},
        covariance=covariance,
        frictions=frictions,
        response={FRICTION_NAME: friction.value, EXPONENT_NAME: with_exponent - constants.CLE},
    )
