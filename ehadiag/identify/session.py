"""An identification from first approximation to uncertainty, fed while the test still runs."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.estimates import estimates_of, fit_of, of_faults, outliers
from ehadiag.identify.experiment import Experiment, share_offsets
from ehadiag.identify.refine.first_part import (
    FirstPart,
    first_spans,
    refine_first_part,
    residuals_at,
)
from ehadiag.identify.refine.least_squares import Refinement, median_offsets
from ehadiag.identify.refine.update import add_last_part
from ehadiag.identify.result import Identification, Timing
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
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import FAULTS, OFFSETS
from ehadiag.model.simd.model import SimdModel

__all__ = ["Session", "first_ticks", "identify"]


@dataclass(frozen=True, slots=True)
class Plan:
    """How a further attempt searches.

    deviation: of the genetic search about its start, severities.
    budget: in budgets of the solver.
    median_offsets: take the median residual at the start for constant errors of the sensors; else
        take only what the actuator at rest showed.
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
"""Share of residuals beyond three deviations that asks for another attempt."""
MOST_ANCHORED = 4
"""Times that the model may be put back on the measured spool. Away from the optimum break-aways
come at other ticks; at it the model stays on the spool in all but one of 200 tests."""


class Session:
    """An identification that is fed recordings as they grow, and is asked to finish.

    A finished recording is the same path, fed once: what was worked out of its beginning is used
    where the samples are the same to the last bit, so the answer is that of the recording alone,
    only sooner. One thread at a time.

    Parameters
    ----------
    solver : Solver, optional
        Global search; the compact genetic algorithm unless given.
    seed : int
        The same seed gives the same answer on the same machine.
    """

    def __init__(self, solver: Solver | None = None, seed: int = 0) -> None:
        self.solver = solver or CompactGa()
        self.seed = seed
        self._memory = Memory()

    @property
    def reused(self) -> int:
        """Stages that did not have to run again."""
        return self._memory.reused

    def feed(self, experiments: Sequence[Experiment]) -> None:
        """Run the stages for which the samples so far suffice: of tests that have begun."""
        ready = min(_stages_ready(item) for item in experiments)
        if ready < 0:
            return
        experiments = share_offsets(experiments)
        best = self._first(experiments)[1]
        for result in itertools.islice(self._stages(experiments, best), ready):
            best = result.best
        if ready == len(STAGES):
            self._first_part(experiments, best)

    def finish(
        self, experiments: Sequence[Experiment], progress: Progress | None = None
    ) -> Identification:
        """Estimate the severities from one or more complete recordings of one actuator."""
        windows = [repr(item.test.windows) for item in experiments]
        arrays = [array for item in experiments for array in experiment_arrays(item)]
        key = digest(f"identify {self.seed} {self.solver!r} {windows}", arrays)
        tell = progress or (lambda _stage, _share: None)
        return self._memory.recall(key, Identification, lambda: self._identify(experiments, tell))

    def _identify(self, experiments: Sequence[Experiment], tell: Progress) -> Identification:
        begin = time.perf_counter()
        tell("first approximation", 0.0)
        experiments = share_offsets(experiments)
        first, start = self._first(experiments)
        searched_at = time.perf_counter()
        found = staged_search(self._stages(experiments, start), tell)
        search_s = time.perf_counter() - searched_at
        tell("refinement", 0.0)
        best = self._attempt(experiments, found)
        evaluations, attempts = first.evaluations + found.evaluations + best.evaluations, 1
        for plan in RESCUES:
            if _explains(best.refined):
                break
            before = time.perf_counter()
            seed = self.seed + len(STAGES) + attempts
            found = _rescue(experiments, best.refined.values, self.solver, seed, plan, tell)
            search_s += time.perf_counter() - before
            tell("refinement", 0.0)
            attempt = self._attempt(experiments, found)
            evaluations += found.evaluations + attempt.evaluations
            attempts += 1
            if attempt.score < best.score:
                best = attempt
        end = time.perf_counter()
        spread = covariance(best.refined)
        return Identification(
            estimates=estimates_of(first, best.found, best.refined, spread),
            nuisances={item.name: best.refined.values[item.name] for item in OFFSETS},
            covariance=of_faults(best.refined, spread),
            fit=fit_of(best.refined, best.experiments),
            solver=self.solver.name,
            seed=self.seed,
            evaluations=evaluations,
            generations=best.found.generations,
            cost=best.refined.cost,
            converged=best.refined.converged,
            attempts=attempts,
            timing=Timing(searched_at - begin, search_s, end - searched_at - search_s),
        )

    def _first(
        self, experiments: Sequence[Experiment]
    ) -> tuple[FirstApproximation, NDArray[np.float64]]:
        """First approximation, and the same as a point among the severities."""
        first = first_stage(experiments, self._memory)
        return first, np.array([first.values[item.name] for item in FAULTS])

    def _stages(
        self, experiments: Sequence[Experiment], start: NDArray[np.float64]
    ) -> Iterator[SearchResult]:
        return search_stages(experiments, start, self.solver, self.seed, self._memory)

    def _first_part(
        self, experiments: Sequence[Experiment], start: NDArray[np.float64]
    ) -> FirstPart:
        """Refinement on the first parts of the tests, from memory if the inputs are the same."""
        until = [first_ticks(item) for item in experiments]
        free = lay_out(experiments, first_spans(experiments, until))
        base = [np.array(item.constants) for item in experiments]
        return self._memory.recall(
            digest("first part", [*free, *base, start]),
            FirstPart,
            lambda: refine_first_part(experiments, until, _named(start)),
        )

    def _attempt(self, experiments: Sequence[Experiment], found: SearchResult) -> _Attempt:
        """Refine the optimum of a search."""
        until = [first_ticks(item) for item in experiments]
        first = self._first_part(experiments, found.best)
        judged = first.judged(experiments)
        best = add_last_part(judged, until, first)
        if best is None:
            ends = [item.ticks for item in experiments]
            whole = refine_first_part(experiments, ends, first.refined.values)
            judged, best = whole.judged(experiments), whole.refined
            best = replace(best, evaluations=whole.evaluations)
        evaluations = first.evaluations + best.evaluations
        weight = lay_out(judged).weight
        score = best.cost - 2.0 * float(np.log(weight[weight > 0.0]).sum())
        return _Attempt(found, best, judged, evaluations, score)


def identify(
    experiments: Sequence[Experiment],
    *,
    solver: Solver | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Identification:
    """Estimate the severities from one or more recordings of one actuator, fed once."""
    return Session(solver, seed).finish(experiments, progress)


def _named(point: NDArray[np.float64]) -> dict[str, float]:
    """Severities by name, of a point among them."""
    return {item.name: float(value) for item, value in zip(FAULTS, point, strict=True)}


def _stages_ready(experiment: Experiment) -> int:
    """Stages of the genetic search that the samples so far suffice for, -1: not even the first."""
    test, seconds = experiment.test, experiment.ticks * experiment.tick
    if seconds < first_ends_at(test):
        return -1
    return sum(seconds >= stage_ends_at(test, stage) for stage in range(len(STAGES)))


def first_ticks(experiment: Experiment) -> int:
    """Ticks that some stage before has seen the end of: windows of the test, in any order."""
    test = experiment.test
    seconds = max(first_ends_at(test), stage_ends_at(test, len(STAGES) - 1))
    return min(round(seconds / experiment.tick), experiment.ticks)


def _rescue(
    experiments: Sequence[Experiment],
    start: Mapping[str, float],
    solver: Solver,
    seed: int,
    plan: Plan,
    tell: Progress,
) -> SearchResult:
    """Search the whole window anew, wider than before."""
    offsets = {item.name: 0.0 for item in OFFSETS}
    if plan.median_offsets:
        severities = {item.name: start[item.name] for item in FAULTS}
        offsets = median_offsets(*residuals_at(experiments, None, severities))
    windows = [experiment.test.windows.refinement for experiment in experiments]
    unknowns = unknowns_of(experiments, FAULTS).holding(offsets)
    return solver.with_budget(round(solver.budget * plan.budget)).minimise(
        Objective(SimdModel(lay_out(experiments, windows, lead=LEAD_S), unknowns)),
        np.array([start[item.name] for item in FAULTS]),
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


def _explains(refinement: Refinement) -> bool:
    """Whether the optimum explains the recording, so that there is none better to look for."""
    return outliers(refinement) <= POOR_FIT and refinement.anchored <= MOST_ANCHORED
