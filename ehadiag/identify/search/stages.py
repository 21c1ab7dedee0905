"""Staged search on a growing part of the test, so that most of it runs before the test ends.

The first approximation needs the parts of the test before the sines; the genetic search then runs
on a window that grows over the second part, each stage from the best of the one before. So most of
the work can be done while the test still runs, and a `Memory` hands its results to the
identification of the finished recording. A result is taken only where every input is the same to
the last bit; else the stage runs again. The answer is therefore that of the recording alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.stored_test import StoredTest, Window
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.search.first_approximation import (
    PRECISION,
    FirstApproximation,
    first_approximation,
    first_inputs,
)
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import SearchResult, Solver
from ehadiag.identify.spans import even_levels, lay_out, unknowns_of
from ehadiag.model.parameters import FAULTS
from ehadiag.model.simd.model import SimdModel

__all__ = [
    "DEVIATION",
    "DEVIATION_SHARE",
    "LEAD_S",
    "STAGES",
    "Memory",
    "Progress",
    "digest",
    "experiment_arrays",
    "first_ends_at",
    "first_stage",
    "search_stages",
    "stage_ends_at",
    "staged_search",
]

T = TypeVar("T")
Progress = Callable[[str, float], None]
"""Called with the stage and its share done, 0 … 1."""

STAGES = (0.25, 0.5, 0.75)
"""Shares of the window of the genetic search that its stages see.

What comes later is for the last step of the refinement, so that all else is done before the end.
"""
BUDGET = 1.0 / 12.0
"""Budgets of the solver, for all stages together."""
DEVIATION = 0.004
"""Of the first stage about the first approximation, severities."""
NARROWING = 0.5
"""Ratio of the deviations of two stages."""
DEVIATION_SHARE = np.array([PRECISION[item.name] for item in FAULTS])
"""Of each severity, as the first approximation knows them."""
LEAD_S = 0.1
"""Run-in before a window, s."""


def _untold(_share: float) -> None:
    """Tell nobody."""


class Memory:
    """Results of stages by a digest of their inputs; a handful, a few kilobytes in all.

    Written and read by one thread at a time.
    """

    def __init__(self) -> None:
        self._results: dict[bytes, object] = {}
        self.reused = 0
        """Stages that did not have to run again."""

    def __len__(self) -> int:
        return len(self._results)

    def recall(self, key: bytes, kind: type[T], compute: Callable[[], T]) -> T:
        """Return what was computed from the same inputs, else compute and keep it."""
        found = self._results.get(key)
        if isinstance(found, kind):
            self.reused += 1
            return found
        result = compute()
        self._results[key] = result
        return result


def first_ends_at(test: StoredTest) -> float:
    """Instant of a test from which its first approximation can run, s.

    That of its last window, and not before the genetic search's window begins: until then the
    noise is judged.
    """
    windows = test.windows
    spans = [*windows.FDJ, *windows.Kintas, *windows.FSS]
    begins = min(start for start, _ in windows.refinement)
    return max(begins, *(end for _, end in spans))


def stage_ends_at(test: StoredTest, stage: int) -> float:
    """Instant of a test from which a stage of the genetic search can run, s."""
    return max(end for _, end in _grown(test.windows.refinement, STAGES[stage]))


def first_stage(experiments: Sequence[Experiment], memory: Memory) -> FirstApproximation:
    """First approximation, from memory if the inputs are the same."""
    inputs = first_inputs(experiments)
    return memory.recall(
        digest("first", inputs.arrays()), FirstApproximation, lambda: first_approximation(inputs)
    )


def staged_search(stages: Iterator[SearchResult], tell: Progress) -> SearchResult:
    """Run the stages of a search to the end, as one result."""
    tell("search", 0.0)
    results = []
    for result in stages:
        results.append(result)
        tell("search", len(results) / len(STAGES))
    return SearchResult(
        best=results[-1].best,
        cost=results[-1].cost,
        evaluations=sum(result.evaluations for result in results),
        generations=sum(result.generations for result in results),
        history=np.concatenate([result.history for result in results]),
    )


def search_stages(
    experiments: Sequence[Experiment],
    start: NDArray[np.float64],
    solver: Solver,
    seed: int,
    memory: Memory,
    tell: Callable[[float], None] = _untold,
) -> Iterator[SearchResult]:
    """Results of all stages, each from the best of the one before; run as they are asked for.

    tell: called after every generation with the share of the search that is done; what it raises
    ends it.
    """
    best = start
    for stage in range(len(STAGES)):
        result = _search_stage(experiments, best, solver, seed, stage, memory, tell)
        best = result.best
        yield result


def _search_stage(
    experiments: Sequence[Experiment],
    start: NDArray[np.float64],
    solver: Solver,
    seed: int,
    stage: int,
    memory: Memory,
    tell: Callable[[float], None],
) -> SearchResult:
    """One stage of the genetic search, from memory if the inputs are the same."""
    windows = [_grown(item.test.windows.refinement, STAGES[stage]) for item in experiments]
    batch = lay_out(experiments, windows, lead=LEAD_S)
    unknowns = unknowns_of(experiments, FAULTS)
    spread = DEVIATION * NARROWING**stage * DEVIATION_SHARE
    part = solver.with_budget(round(solver.budget * BUDGET / len(STAGES)))
    return memory.recall(
        digest(f"search {seed} {part!r}", [*batch, np.array(unknowns.base), start, spread]),
        SearchResult,
        lambda: part.minimise(
            Objective(SimdModel(batch, unknowns, levels=even_levels(batch))),
            start,
            spread,
            seed + stage,
            lambda used, budget: tell((stage + used / budget) / len(STAGES)),
        ),
    )


def _grown(windows: Iterable[Window], share: float) -> list[Window]:
    """First part of windows that follow each other, by their whole length."""
    ordered = sorted(windows)
    left = share * sum(end - start for start, end in ordered)
    out = []
    for start, end in ordered:
        if left > 1e-9:
            out.append((start, min(end, start + left)))
        left -= end - start
    return out


def experiment_arrays(experiment: Experiment) -> Iterable[NDArray[np.generic]]:
    """Return all numbers that an identification of a whole test works on."""
    item = experiment
    yield np.array([*item.constants, item.tick, item.origin, float(item.rested)])
    yield np.array([*item.noise, item.spool_offset, item.pressure_offset, item.position_offset])
    yield item.trace.current
    yield item.spool
    yield item.pressure
    yield item.position


def digest(label: str, arrays: Iterable[NDArray[np.generic]]) -> bytes:
    """Fingerprint of the inputs of a stage."""
    digest = hashlib.blake2b(label.encode(), digest_size=16)
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()
