"""The identification as a whole: first approximation, genetic search, refinement, uncertainty."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import (
    Experiment,
    make_batch,
    share_offsets,
)
from ehadiag.identify.refine.first_part import refine_prefix, refine_whole
from ehadiag.identify.refine.least_squares import Refinement, gaps_of, median_offsets
from ehadiag.identify.refine.residual_model import CAP
from ehadiag.identify.refine.update import add_last_part
from ehadiag.identify.result import Estimate, Fit, Identification, Timing
from ehadiag.identify.search.first_approximation import FirstApproximation
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import CompactGa, SearchResult, Solver
from ehadiag.identify.search.stages import (
    DEVIATION_SHARE,
    LEAD_S,
    STAGES,
    Memory,
    Progress,
    digest,
    experiment_arrays,
    first_ends_at,
    first_stage,
    search_stages,
    stage_ends_at,
    staged_search,
)
from ehadiag.identify.uncertainty import covariance, interval95
from ehadiag.model.parameters import FAULTS

__all__ = ["identify", "run_ahead"]


@dataclass(frozen=True, slots=True)
class Plan:
    """How a further attempt searches.

    deviation: of the genetic search about its start, fault constants.
    budget: in budgets of the solver.
    median_offsets: take the median gap at the start for constant errors of the sensors; else take
        only what the actuator at rest showed.
    """

    deviation: float
    budget: float = 1.0
    median_offsets: bool = False


RESCUES = (
    Plan(0.02, median_offsets=True),
    Plan(0.1, budget=2.0),
    Plan(0.1, budget=2.0, median_offsets=True),
    Plan(0.4, budget=3.0),
)
"""One after the other where the staged search does not explain the recording."""
POOR_FIT = 0.01
"""Share of gaps beyond three deviations that asks for another attempt."""
MOST_ANCHORED = 4
"""Times that the model may be put back on the measured spool. Away from the optimum break-aways
come at other ticks; at it the model stays on the spool in all but one of 200 tests."""
NOT_SHOWN_STD = 0.1
BOUND = 1e-6


def identify(
    experiments: Sequence[Experiment],
    *,
    solver: Solver | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    memory: Memory | None = None,
) -> Identification:
    """Estimate the fault constants from one or more recordings of one actuator.

    The same seed gives the same answer on the same machine, with results of `memory` (see
    `ehadiag.identify.search.stages`) or without.
    """
    solver = solver or CompactGa()
    tell = progress or (lambda _stage, _share: None)
    memory = Memory() if memory is None else memory
    windows = [repr(item.test.windows) for item in experiments]
    arrays = [array for item in experiments for array in experiment_arrays(item)]
    key = digest(f"identify {seed} {solver!r} {windows}", arrays)
    return memory.recall(
        key, Identification, lambda: _identify(experiments, solver, seed, tell, memory)
    )


def _identify(
    experiments: Sequence[Experiment], solver: Solver, seed: int, tell: Progress, memory: Memory
) -> Identification:
    begin = time.perf_counter()
    tell("first approximation", 0.0)
    experiments = share_offsets(experiments)
    first = first_stage(experiments, memory)
    start = np.array(first.values)
    searched_at = time.perf_counter()
    found = staged_search(experiments, start, solver, seed, memory, tell)
    search_s = time.perf_counter() - searched_at
    tell("refinement", 0.0)
    best = _attempt(experiments, found, memory)
    evaluations, attempts = first.evaluations + found.evaluations + best.evaluations, 1
    for plan in RESCUES:
        if _explains(best.refined):
            break
        before = time.perf_counter()
        found = _rescue(
            experiments, best.refined.values, solver, seed + len(STAGES) + attempts, plan, tell
        )
        search_s += time.perf_counter() - before
        tell("refinement", 0.0)
        attempt = _attempt(experiments, found, memory)
        evaluations += found.evaluations + attempt.evaluations
        attempts += 1
        if attempt.score < best.score:
            best = attempt
    end = time.perf_counter()
    spread = covariance(best.refined)
    return Identification(
        estimates=_estimates(first, best.found, best.refined, spread),
        covariance=spread,
        fit=_fit(best.refined, best.experiments),
        solver=solver.name,
        seed=seed,
        evaluations=evaluations,
        generations=best.found.generations,
        cost=best.refined.cost,
        converged=best.refined.converged,
        attempts=attempts,
        timing=Timing(searched_at - begin, search_s, end - searched_at - search_s),
    )


def run_ahead(experiment: Experiment, solver: Solver, seed: int, memory: Memory) -> None:
    """Run the stages for which the samples of a running test suffice, into memory."""
    test = experiment.test
    seconds = experiment.ticks * experiment.tick
    if seconds < first_ends_at(test):
        return
    ready = sum(seconds >= stage_ends_at(test, stage) for stage in range(len(STAGES)))
    experiments = share_offsets([experiment])
    best = np.array(first_stage(experiments, memory).values)
    for result in itertools.islice(search_stages(experiments, best, solver, seed, memory), ready):
        best = result.best
    if ready == len(STAGES):
        refine_prefix(experiments, best, memory)


def _rescue(
    experiments: Sequence[Experiment],
    start: NDArray[np.float64],
    solver: Solver,
    seed: int,
    plan: Plan,
    tell: Progress,
) -> SearchResult:
    """Search the whole window anew, wider than before."""
    offsets = np.zeros(2)
    if plan.median_offsets:
        free = make_batch(experiments)
        offsets = median_offsets(free, gaps_of(free, start))
    windows = [experiment.test.windows.refinement for experiment in experiments]
    return solver.with_budget(round(solver.budget * plan.budget)).minimise(
        Objective(make_batch(experiments, windows, lead=LEAD_S), offsets),
        start,
        plan.deviation * DEVIATION_SHARE,
        seed,
        lambda done, budget: tell("search", done / budget),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Attempt:
    """One search and its refinement."""

    found: SearchResult
    refined: Refinement
    experiments: Sequence[Experiment]
    """With their noise as judged."""
    evaluations: int
    """Of the refinement."""
    score: float
    """Twice the negative logarithm of the likelihood: comparable where the noise differs."""


def _attempt(experiments: Sequence[Experiment], found: SearchResult, memory: Memory) -> _Attempt:
    """Refine the optimum of a search."""
    prefix = refine_prefix(experiments, found.best, memory)
    judged = prefix.judged(experiments)
    best = add_last_part(judged, prefix)
    if best is None:
        whole = refine_whole(experiments, prefix.refined.values)
        judged, best = whole.judged(experiments), whole.refined
        best = replace(best, evaluations=whole.evaluations)
    experiments, evaluations = judged, prefix.evaluations + best.evaluations
    weight = make_batch(experiments).weight
    score = best.cost - 2.0 * float(np.log(weight[weight > 0.0]).sum())
    return _Attempt(found, best, experiments, evaluations, score)


def _explains(refinement: Refinement) -> bool:
    """Whether the optimum explains the recording, so that there is none better to look for."""
    return _outliers(refinement) <= POOR_FIT and refinement.anchored <= MOST_ANCHORED


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
