"""An identification from first approximation to uncertainty, fed while the test still runs."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.estimates import identification
from ehadiag.identify.experiment import Experiment, share_offsets
from ehadiag.identify.nuisance.estimate import estimate
from ehadiag.identify.nuisance.prior import nuisances_of
from ehadiag.identify.refine.first_part import (
    CONSIDERED,
    FirstPart,
    first_spans,
    refine_first_part,
)
from ehadiag.identify.result import Identification, Timing
from ehadiag.identify.search.first_approximation import FirstApproximation
from ehadiag.identify.search.solvers import CompactGa, SearchResult, Solver
from ehadiag.identify.search.stages import (
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
from ehadiag.identify.spans import lay_out
from ehadiag.identify.textbook import (
    Attempt,
    attempt,
    explains,
    first_ticks,
    named,
    rescued,
    resembles,
)
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import FAULTS, OFFSETS, REGISTRY

__all__ = ["Nuisances", "Session", "identify"]


class Nuisances(Enum):
    """Which effects of the installation are estimated beside the severities and the offsets."""

    AUTO = "auto"
    """Those that are needed: none where the severities alone explain the recording."""
    NONE = "none"
    ALL = "all"
    """From the start."""


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
    nuisances : Nuisances
        Which effects of the installation are estimated beside the severities.
    """

    def __init__(
        self,
        solver: Solver | None = None,
        seed: int = 0,
        nuisances: Nuisances = Nuisances.AUTO,
    ) -> None:
        self.solver = solver or CompactGa()
        self.seed = seed
        self.nuisances = nuisances
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
        key = digest(f"identify {self.seed} {self.solver!r} {self.nuisances} {windows}", arrays)
        tell = progress or (lambda _stage, _share: None)
        return self._memory.recall(key, Identification, lambda: self._identify(experiments, tell))

    def _identify(self, experiments: Sequence[Experiment], tell: Progress) -> Identification:
        begin = time.perf_counter()
        tell("first approximation", 0.0)
        experiments = share_offsets(experiments)
        first, start = self._first(experiments)
        searched_at = time.perf_counter()
        best: Attempt | None = None
        search_s = 0.0
        if self.nuisances is not Nuisances.ALL:
            found = staged_search(self._stages(experiments, start), tell)
            search_s = time.perf_counter() - searched_at
            tell("refinement", 0.0)
            if self.nuisances is Nuisances.NONE or resembles(experiments, found.best):
                best = attempt(experiments, found, self._first_part)
                best = replace(best, evaluations=best.evaluations + found.evaluations)
        if best is not None and self.nuisances is Nuisances.NONE:
            best = rescued(
                experiments, best, self._first_part, self.solver, self.seed, tell,
                time.perf_counter,
            )  # fmt: skip
            search_s += best.search_s
        if best is not None and (self.nuisances is Nuisances.NONE or explains(best.refined)):
            spent = Timing(searched_at - begin, search_s, 0.0)
            return self._textbook(first, best, spent, begin)
        return self._with_nuisances(experiments, first, best, searched_at - begin, begin, tell)

    def _textbook(
        self, first: FirstApproximation, best: Attempt, spent: Timing, begin: float
    ) -> Identification:
        """Put together what three severities alone explain."""
        spread = covariance(best.refined)
        return identification(
            first,
            best.found,
            best.refined,
            spread,
            best.experiments,
            solver=self.solver.name,
            seed=self.seed,
            evaluations=first.evaluations + best.evaluations,
            attempts=best.count,
            timing=replace(spent, refine=time.perf_counter() - begin - spent.first - spent.search),
        )

    def _with_nuisances(
        self,
        experiments: Sequence[Experiment],
        first: FirstApproximation,
        before: Attempt | None,
        first_s: float,
        begin: float,
        tell: Progress,
    ) -> Identification:
        """Free the nuisances too."""
        searched_at = time.perf_counter()
        free = (*FAULTS, *OFFSETS, *nuisances_of(REGISTRY))
        tell("nuisances", 0.0)
        done = estimate(
            experiments,
            free,
            considered=CONSIDERED,
            seed=self.seed,
            tell=lambda share: tell("nuisances", share),
        )
        values = done.refined.values
        found = SearchResult(
            best=np.array([values[item.name] for item in FAULTS]),
            cost=done.refined.cost,
            evaluations=done.evaluations,
            generations=0,
            history=np.zeros(0),
        )
        evaluations = first.evaluations + done.evaluations + (before.evaluations if before else 0)
        now = time.perf_counter()
        return identification(
            first,
            found,
            done.refined,
            covariance(done.refined) + done.covariance,
            done.experiments,
            solver=self.solver.name,
            seed=self.seed,
            evaluations=evaluations,
            attempts=done.starts + (1 if before else 0),
            timing=Timing(first_s, now - searched_at, searched_at - begin - first_s),
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
            lambda: refine_first_part(experiments, until, named(start)),
        )


def identify(
    experiments: Sequence[Experiment],
    *,
    solver: Solver | None = None,
    seed: int = 0,
    nuisances: Nuisances = Nuisances.AUTO,
    progress: Progress | None = None,
) -> Identification:
    """Estimate the severities from one or more recordings of one actuator, fed once."""
    return Session(solver, seed, nuisances).finish(experiments, progress)


def _stages_ready(experiment: Experiment) -> int:
    """Stages of the genetic search that the samples so far suffice for, -1: not even the first."""
    test, seconds = experiment.test, experiment.ticks * experiment.tick
    if seconds < first_ends_at(test):
        return -1
    return sum(seconds >= stage_ends_at(test, stage) for stage in range(len(STAGES)))
