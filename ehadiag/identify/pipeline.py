"""The identification as a whole: first approximation, genetic search, refinement, uncertainty."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment, judge_noise, make_batch
from ehadiag.identify.first import FirstApproximation, first_approximation
from ehadiag.identify.objective import Objective
from ehadiag.identify.refine import CAP, Refinement, median_offsets, refine
from ehadiag.identify.solvers import CompactGa, SearchResult, Solver
from ehadiag.identify.uncertainty import covariance, interval95
from ehadiag.parameters import FAULTS

__all__ = ["Estimate", "Fit", "Identification", "Timing", "identify"]

SEARCH_DEVIATION = 0.02
"""Deviation of the genetic search about the first approximation."""
SEARCH_LEAD_S = 0.1
RESCUE_DEVIATION = 0.4
RESCUE_BUDGET = 2000
ANCHOR_LSB = (1.3, 6.0)
"""Re-anchoring of the refinement: filtered and single innovations beyond, LSB."""
POOR_FIT = 0.05
"""Share of gaps beyond three deviations that sends the search back to the whole cube."""
JUDGEMENTS = 3
"""How often at most the noise is judged anew."""
NOISE_SETTLED = 0.15
NOT_SHOWN_STD = 0.1
BOUND = 1e-6

Progress = Callable[[str, float], None]
"""Called with the stage and its share done, 0 … 1."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """One fault constant as each stage left it."""

    name: str
    first: float
    """After the first approximation."""
    search: float
    """After the genetic search."""
    value: float
    """After the refinement: the estimate."""
    std: float
    interval95: tuple[float, float]
    at_bound: bool
    """The estimate stands at 0 or 1."""
    shown: bool
    """Whether the test shows this constant at all."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How well the model explains the recording.

    Attributes
    ----------
    spool_rms, pressure_rms: rms gap in units of the channel's own noise, squares capped at nine;
        about 1 where the model explains all.
    outliers: share of gaps beyond three deviations, both channels (0.003 for noise alone).
    spool_noise, pressure_noise: noise of the channels, m and Pa.
    spool_offset, pressure_offset: constant errors of the channels, m and Pa.
    anchored: how often the model had to be put back on the measured spool.
    """

    spool_rms: float
    pressure_rms: float
    outliers: float
    spool_noise: float
    pressure_noise: float
    spool_offset: float
    pressure_offset: float
    anchored: int


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds spent."""

    first: float
    search: float
    refine: float


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """What the recordings say about the actuator's faults."""

    estimates: tuple[Estimate, ...]
    covariance: NDArray[np.float64]
    """Of the three constants, shape (3, 3)."""
    fit: Fit
    solver: str
    seed: int
    evaluations: int
    """Runs of the model in all stages."""
    generations: int
    search_cost: float
    cost: float
    converged: bool
    rescued: bool
    """Whether the search had to go back to the whole cube."""
    timing: Timing


def identify(
    experiments: Sequence[Experiment],
    *,
    solver: Solver | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Identification:
    """Estimate the fault constants from one or more recordings of one actuator.

    The same seed gives the same answer on the same machine.
    """
    solver = solver or CompactGa()
    tell = progress or (lambda _stage, _share: None)
    begin = time.perf_counter()
    tell("first approximation", 0.0)
    first = first_approximation(experiments)
    searched_at = time.perf_counter()
    windows = [experiment.test.windows.refinement for experiment in experiments]
    offsets = median_offsets(make_batch(experiments), np.array(first.values))
    objective = Objective(make_batch(experiments, windows, lead=SEARCH_LEAD_S), offsets)
    found = _search(solver, objective, np.array(first.values), SEARCH_DEVIATION, seed, tell)
    refined_at = time.perf_counter()
    tell("refinement", 0.0)
    candidates = [found.best, np.array(first.values)]
    refined, experiments, evaluations = _best_refinement(experiments, candidates, offsets)
    evaluations += first.evaluations + found.evaluations
    rescued = _outliers(refined) > POOR_FIT
    if rescued:
        wide = solver.with_budget(RESCUE_BUDGET)
        again = Objective(make_batch(experiments), offsets)
        second = _search(wide, again, found.best, RESCUE_DEVIATION, seed + 1, tell)
        other, others, spent = _best_refinement(experiments, [second.best], offsets)
        evaluations += second.evaluations + spent
        if other.cost < refined.cost:
            refined, experiments, found = other, others, second
    end = time.perf_counter()
    spread = covariance(refined)
    return Identification(
        estimates=_estimates(first, found, refined, spread),
        covariance=spread,
        fit=_fit(refined, experiments),
        solver=solver.name,
        seed=seed,
        evaluations=evaluations,
        generations=found.generations,
        search_cost=found.cost,
        cost=refined.cost,
        converged=refined.converged,
        rescued=rescued,
        timing=Timing(searched_at - begin, refined_at - searched_at, end - refined_at),
    )


def _search(
    solver: Solver,
    objective: Objective,
    start: NDArray[np.float64],
    deviation: float,
    seed: int,
    tell: Progress,
) -> SearchResult:
    return solver.minimise(
        objective, start, deviation, seed, lambda done, budget: tell("search", done / budget)
    )


def _best_refinement(
    experiments: Sequence[Experiment],
    starts: Sequence[NDArray[np.float64]],
    offsets: NDArray[np.float64],
) -> tuple[Refinement, Sequence[Experiment], int]:
    """Refine from each start until one explains the recording, then weigh by the noise it leaves.

    Returns the refinement, the experiments with their noise as judged, and evaluations.
    """
    best = _refine(experiments, starts[0], offsets)
    evaluations = best.evaluations
    for start in starts[1:]:
        if _outliers(best) <= POOR_FIT:
            break
        other = _refine(experiments, start, offsets)
        evaluations += other.evaluations
        best = min(best, other, key=lambda item: item.cost)
    for _ in range(JUDGEMENTS):
        before = [(item.spool_noise, item.pressure_noise) for item in experiments]
        experiments = [
            judge_noise(experiment, best.gaps[:, a:b])
            for experiment, (a, b) in zip(experiments, _bounds(experiments), strict=True)
        ]
        best = _refine(experiments, best.values, best.offsets)
        evaluations += best.evaluations
        after = [(item.spool_noise, item.pressure_noise) for item in experiments]
        if np.allclose(before, after, rtol=NOISE_SETTLED, atol=0.0):
            break
    return best, experiments, evaluations


def _refine(
    experiments: Sequence[Experiment], start: NDArray[np.float64], offsets: NDArray[np.float64]
) -> Refinement:
    batch = make_batch(experiments, anchor_lsb=ANCHOR_LSB)
    noise = experiments[0].spool_noise, experiments[0].pressure_noise
    return refine(batch, start, offsets, noise)


def _bounds(experiments: Sequence[Experiment]) -> list[tuple[int, int]]:
    """Where each experiment stands in a batch of whole tests."""
    ends = np.cumsum([0] + [experiment.ticks for experiment in experiments])
    return [(int(a), int(b)) for a, b in itertools.pairwise(ends)]


def _outliers(refinement: Refinement) -> float:
    """Share of gaps beyond three deviations."""
    present = refinement.weighted
    return float(np.mean(refinement.gaps[present] ** 2 >= CAP)) if present.any() else 1.0


def _estimates(
    first: FirstApproximation,
    found: SearchResult,
    refined: Refinement,
    spread: NDArray[np.float64],
) -> tuple[Estimate, ...]:
    out = []
    for j, parameter in enumerate(FAULTS):
        value, std = float(refined.values[j]), float(np.sqrt(spread[j, j]))
        out.append(
            Estimate(
                name=parameter.name,
                first=float(first.values[j]),
                search=float(found.best[j]),
                value=value,
                std=std,
                interval95=interval95(value, std),
                at_bound=value <= parameter.lower + BOUND or value >= parameter.upper - BOUND,
                shown=std < NOT_SHOWN_STD,
            )
        )
    return tuple(out)


def _fit(refined: Refinement, experiments: Sequence[Experiment]) -> Fit:
    rms = []
    for channel in range(2):
        gaps = refined.gaps[channel, refined.weighted[channel]]
        rms.append(float(np.sqrt(np.mean(np.minimum(gaps**2, CAP)))) if gaps.size else np.nan)
    return Fit(
        spool_rms=rms[0],
        pressure_rms=rms[1],
        outliers=_outliers(refined),
        spool_noise=experiments[0].spool_noise,
        pressure_noise=experiments[0].pressure_noise,
        spool_offset=experiments[0].spool_offset + float(refined.offsets[0]),
        pressure_offset=experiments[0].pressure_offset + float(refined.offsets[1]),
        anchored=refined.anchored,
    )
