"""An identification from first approximation to uncertainty, fed while the test still runs."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.estimates import identification, outliers
from ehadiag.identify.experiment import Experiment, share_offsets
from ehadiag.identify.nuisance.estimate import Estimated
from ehadiag.identify.nuisance.explained import excess, is_of_the_pressure
from ehadiag.identify.nuisance.freed import Freeing
from ehadiag.identify.nuisance.knowledge import NOTHING, Knowledge
from ehadiag.identify.nuisance.prior import nuisances_of
from ehadiag.identify.refine.first_part import (
    FirstPart,
    Look,
    first_spans,
    look_at,
    refine_first_part,
)
from ehadiag.identify.refine.least_squares import Refinement
from ehadiag.identify.refine.posterior import nothing
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
    GUESSED_STD,
    HOPELESS,
    Attempt,
    attempt,
    explains,
    first_ticks,
    is_guessed,
    named,
    rescued,
    searched_whole,
)
from ehadiag.identify.uncertainty import covariance, independent
from ehadiag.model.parameters import FAULTS, REGISTRY

__all__ = ["Nuisances", "Session", "SoFar", "identify"]


BEYOND_RESCUE = 0.05
"""Share of residuals beyond three deviations after a refinement from which on no further search is
made: 0.04 at most on a textbook's actuator after the search before."""
LASTING = 1.2
"""Excess of residuals over noise (`ehadiag.identify.nuisance.explained`) that asks for nuisances:
1.15 at most in 80 recordings of units without any."""


class Nuisances(Enum):
    """Which effects of the installation are estimated beside the severities and the offsets."""

    AUTO = "auto"
    """Those that are needed: none where the severities alone explain the recording."""
    NONE = "none"
    ALL = "all"
    """From the start."""


@dataclass(frozen=True, slots=True)
class SoFar:
    """Severities as a test that still runs shows them.

    Attributes
    ----------
    stage : str
        What was done last, in words.
    values : Mapping[str, float]
        Severities by name.
    std : Mapping[str, float] | None
        Their standard deviations by name; None before a refinement.
    """

    stage: str
    values: Mapping[str, float]
    std: Mapping[str, float] | None = None


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
    knowledge : Knowledge
        What is known of the unit; where its data are in doubt they are estimated too, always.
    """

    def __init__(
        self,
        solver: Solver | None = None,
        seed: int = 0,
        nuisances: Nuisances = Nuisances.AUTO,
        knowledge: Knowledge = NOTHING,
    ) -> None:
        self.solver = solver or CompactGa()
        self.seed = seed
        self.nuisances = nuisances
        self.knowledge = knowledge
        self._memory = Memory()
        self._looked: tuple[bytes, Look] | None = None
        self._printed: tuple[tuple[Experiment, ...], bytes] = (), b""
        self.so_far: SoFar | None = None
        """What the latest `feed` showed; None before the first. Another thread may look."""

    @property
    def reused(self) -> int:
        """Stages that did not have to run again."""
        return self._memory.reused

    def feed(self, experiments: Sequence[Experiment]) -> None:
        """Run the stages for which the samples so far suffice: of tests that have begun."""
        ready = min(_stages_ready(item) for item in experiments)
        if ready < 0:
            return
        experiments, self._printed = share_offsets(experiments), ((), b"")
        best = self._first(experiments)[1]
        self.so_far = SoFar("first approximation", named(best))
        for stage, result in enumerate(
            itertools.islice(self._stages(experiments, best, lambda _share: None), ready)
        ):
            best = result.best
            self.so_far = SoFar(f"search, stage {stage + 1} of {len(STAGES)}", named(best))
        if ready == len(STAGES) and self._look(experiments, best).unlikeness <= HOPELESS:
            self.so_far = _refined(self._first_part(experiments, best, nothing).refined)

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
        experiments, self._printed = share_offsets(experiments), ((), b"")
        first, start = self._first(experiments)
        searched_at = time.perf_counter()
        found = staged_search(self._stages(experiments, start, partial(tell, "search")), tell)
        search_s = time.perf_counter() - searched_at
        tell("refinement", 0.0)
        doubts = self.knowledge.doubts
        alone = self.nuisances is Nuisances.NONE and not doubts
        found, near = self._nearer(experiments, found, start)
        best: Attempt | None = None
        if alone or (near and self.nuisances is Nuisances.AUTO and not doubts):
            best = attempt(experiments, found, self._first_part, partial(tell, "refinement", 0.0))
            best = replace(best, evaluations=best.evaluations + found.evaluations)
        freed: Estimated | None = None
        if not alone and (best is None or not _leaves_nothing(best.refined)):
            hint = best.refined.values if best else named(found.best)
            alone_left = excess(best.refined.residuals) if best else np.inf
            tell("nuisances", 0.0)
            freeing = Freeing(
                self.knowledge,
                () if self.nuisances is Nuisances.NONE else nuisances_of(REGISTRY),
                self.seed,
                partial(tell, "nuisances"),
            )
            freed = freeing.estimated(experiments, hint if near else None, alone_left)
        if best is not None and (freed is None or _is_poorer(freed, best)):
            if near and outliers(best.refined) <= BEYOND_RESCUE and not _is_elsewhere(freed, best):
                best = rescued(
                    experiments, best, self._first_part, self.solver, self.seed, tell,
                    time.perf_counter,
                )  # fmt: skip
            return self._said(
                first,
                best.found,
                best.refined,
                covariance(best.refined) + _guessed(best.refined),
                best.experiments,
                first.evaluations + best.evaluations + (freed.evaluations if freed else 0),
                best.count + (freed.starts if freed else 0),
                _timing(begin, searched_at, search_s + best.search_s),
            )
        assert freed is not None
        values = freed.refined.values
        severities = np.array([values[item.name] for item in FAULTS])
        before = best.evaluations if best else found.evaluations
        return self._said(
            first,
            replace(found, best=severities, cost=freed.refined.cost),
            freed.refined,
            covariance(freed.refined)
            + freed.covariance
            + self.knowledge.spread(freed.refined.parameters, values, experiments[0].constants),
            freed.experiments,
            first.evaluations + before + freed.evaluations,
            freed.starts + (1 if best else 0),
            _timing(begin, searched_at, search_s),
        )

    def _nearer(
        self, experiments: Sequence[Experiment], found: SearchResult, start: NDArray[np.float64]
    ) -> tuple[SearchResult, bool]:
        """Return what a refinement begins from, and whether it may explain the recordings: the
        optimum of the search, unless only what the search began from resembles them, or a search
        over the whole window where currents were guessed."""
        if self._look(experiments, found.best).unlikeness <= HOPELESS:
            return found, True
        if self._look(experiments, start).unlikeness <= HOPELESS:
            return replace(found, best=start), True
        if not any(item.trace.guessed for item in experiments):
            return found, False
        other = searched_whole(experiments, found, self.solver, self.seed + len(STAGES))
        other = replace(other, evaluations=found.evaluations + other.evaluations)
        near = self._look(experiments, other.best).unlikeness <= HOPELESS
        return (other if near else replace(found, evaluations=other.evaluations)), near

    def _said(
        self,
        first: FirstApproximation,
        found: SearchResult,
        refined: Refinement,
        spread: NDArray[np.float64],
        experiments: Sequence[Experiment],
        evaluations: int,
        attempts: int,
        timing: Timing,
    ) -> Identification:
        return identification(
            first,
            found,
            refined,
            spread,
            experiments,
            solver=self.solver.name,
            seed=self.seed,
            evaluations=evaluations,
            attempts=attempts,
            timing=timing,
            about=self.knowledge.about,
        )

    def _first(
        self, experiments: Sequence[Experiment]
    ) -> tuple[FirstApproximation, NDArray[np.float64]]:
        """First approximation, and the same as a point among the severities."""
        first = first_stage(experiments, self._memory)
        return first, np.array([first.values[item.name] for item in FAULTS])

    def _stages(
        self,
        experiments: Sequence[Experiment],
        start: NDArray[np.float64],
        tell: Callable[[float], None],
    ) -> Iterator[SearchResult]:
        return search_stages(experiments, start, self.solver, self.seed, self._memory, tell)

    def _first_part(
        self,
        experiments: Sequence[Experiment],
        start: NDArray[np.float64],
        between: Callable[[], None],
    ) -> FirstPart:
        """Refinement on the first parts of the tests, from memory if the inputs are the same."""
        until = [first_ticks(item) for item in experiments]
        return self._memory.recall(
            self._of_first_parts(experiments, until, start),
            FirstPart,
            lambda: refine_first_part(
                experiments, until, named(start), between, self._look(experiments, start)
            ),
        )

    def _look(self, experiments: Sequence[Experiment], start: NDArray[np.float64]) -> Look:
        """Look at the first parts of the tests; the latest one is kept."""
        until = [first_ticks(item) for item in experiments]
        key = self._of_first_parts(experiments, until, start)
        if self._looked is None or self._looked[0] != key:
            self._looked = key, look_at(experiments, until, named(start))
        return self._looked[1]

    def _of_first_parts(
        self, experiments: Sequence[Experiment], until: Sequence[int], start: NDArray[np.float64]
    ) -> bytes:
        """Fingerprint of the first parts of the tests and a start among the severities.

        That of the parts is worked out once in a call for the same experiments.
        """
        if self._printed[0] != tuple(experiments):
            free = lay_out(experiments, first_spans(experiments, until))
            base = [np.array(item.constants) for item in experiments]
            self._printed = tuple(experiments), digest("first part", [*free, *base])
        return digest("start", [np.frombuffer(self._printed[1], dtype=np.uint8), start])


def identify(
    experiments: Sequence[Experiment],
    *,
    solver: Solver | None = None,
    seed: int = 0,
    nuisances: Nuisances = Nuisances.AUTO,
    knowledge: Knowledge = NOTHING,
    progress: Progress | None = None,
) -> Identification:
    """Estimate the severities from one or more recordings of one actuator, fed once."""
    return Session(solver, seed, nuisances, knowledge).finish(experiments, progress)


def _guessed(refinement: Refinement) -> NDArray[np.float64]:
    """Covariance that a guessed current adds to the severities'."""
    std = GUESSED_STD if is_guessed(refinement) else 0.0
    return independent(refinement.parameters, dict.fromkeys((item.name for item in FAULTS), std))


def _timing(begin: float, searched_at: float, search_s: float) -> Timing:
    """Time spent so far, s: on the first approximation, on searches, and on the rest."""
    return Timing(searched_at - begin, search_s, time.perf_counter() - searched_at - search_s)


def _refined(refined: Refinement) -> SoFar:
    """Severities of a refinement on the first part of a test."""
    std = dict(
        zip(
            (item.name for item in refined.parameters),
            np.sqrt(np.diag(covariance(refined))).tolist(),
            strict=True,
        )
    )
    values = {item.name: refined.values[item.name] for item in FAULTS}
    return SoFar("refinement of its first part", values, std)


def _leaves_nothing(refinement: Refinement) -> bool:
    """Whether the severities alone explain a recording, and nothing that lasts is left, of which
    small nuisances would be the cause."""
    return explains(refinement) and excess(refinement.residuals) <= LASTING


def _is_poorer(freed: Estimated, alone: Attempt) -> bool:
    """Whether nuisances explain a recording no better than the severities alone do: what is left
    is none of theirs, as where guessed positions stand in for lost ones."""
    return not freed.explained and freed.excess >= excess(alone.refined.residuals)


def _is_elsewhere(freed: Estimated | None, alone: Attempt) -> bool:
    """Whether what the severities alone leave is not for want of a search: of the pressure, or left
    where all effects at once were found to end again and again."""
    if freed is None:
        return False
    confirmed = freed.confirmed and not is_guessed(alone.refined)
    return confirmed or is_of_the_pressure(freed.refined.residuals)


def _stages_ready(experiment: Experiment) -> int:
    """Stages of the genetic search that the samples so far suffice for, -1: not even the first."""
    test, seconds = experiment.test, experiment.ticks * experiment.tick
    if seconds < first_ends_at(test):
        return -1
    return sum(seconds >= stage_ends_at(test, stage) for stage in range(len(STAGES)))
