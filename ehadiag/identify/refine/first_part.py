"""Refinement on the first part of a test, which all stages before have seen: ready before the end.

What is left for the whole test is one step (`ehadiag.identify.refine.update`), where that suffices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.stored_test import Window
from ehadiag.identify.experiment import ANCHOR_LSB, Experiment, judge_noise, make_batch
from ehadiag.identify.refine.least_squares import (
    Refinement,
    describe,
    gaps_of,
    median_offsets,
    refine,
)
from ehadiag.identify.refine.residual_model import CAP, FAULT_COUNT
from ehadiag.identify.search.objective import Objective
from ehadiag.identify.search.solvers import CompactGa
from ehadiag.identify.search.stages import STAGES, Memory, digest, first_ends_at, stage_ends_at
from ehadiag.model.scalar.residuals import Batch

__all__ = ["Prefix", "anchored", "prefix_ticks", "refine_prefix", "refine_whole"]

Spans = Sequence[Sequence[Window]]
"""Of each test, s."""

POLISH = CompactGa(budget=800, virtual_population=70.0, tolerance=1e-7)
POLISH_REACH = 6.0
"""Deviations, of each constant, over which the polish begins to draw."""
POLISH_SPREAD = (2e-4, 2e-3)
"""Fault constants: out of a narrow basin, which looks well known, and not further than is shown."""
JUDGEMENTS = 3
"""How often at most the noise is judged anew."""
NOISE_SETTLED = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Prefix:
    """Optimum on the first part of one or more tests.

    noise: of spool (m) and pressure (Pa) of each test, as the gaps show it.
    evaluations: runs of the model, all told.
    """

    refined: Refinement
    noise: tuple[tuple[float, float], ...]
    evaluations: int

    def judged(self, experiments: Sequence[Experiment]) -> list[Experiment]:
        """Return the experiments with the noise that was found."""
        return [
            replace(item, spool_noise=spool, pressure_noise=pressure)
            for item, (spool, pressure) in zip(experiments, self.noise, strict=True)
        ]


def prefix_ticks(experiment: Experiment) -> int:
    """Ticks that some stage before has seen the end of: windows of the test, in any order."""
    test = experiment.test
    seconds = max(first_ends_at(test), stage_ends_at(test, len(STAGES) - 1))
    return min(round(seconds / experiment.tick), experiment.ticks)


def refine_prefix(
    experiments: Sequence[Experiment], start: NDArray[np.float64], memory: Memory
) -> Prefix:
    """Refine the optimum of a search on the first parts of the tests.

    `start`: fault constants, shape (3,). The same inputs are answered from memory.
    """
    until = [prefix_ticks(item) for item in experiments]
    free = make_batch(experiments, _spans(experiments, until))
    return memory.recall(
        digest("prefix", [*free, start]),
        Prefix,
        lambda: _refine_first(experiments, until, start),
    )


def refine_whole(experiments: Sequence[Experiment], start: NDArray[np.float64]) -> Prefix:
    """Refine on all of the tests, as if they were their own first parts."""
    return _refine_first(experiments, [item.ticks for item in experiments], start)


def _refine_first(
    experiments: Sequence[Experiment], until: Sequence[int], start: NDArray[np.float64]
) -> Prefix:
    """Refine on the first `until` ticks of each test, weighing by the noise that the gaps show."""
    spans = _spans(experiments, until)
    free = make_batch(experiments, spans)
    gaps = gaps_of(free, start)
    offsets = median_offsets(free, gaps)
    experiments = _judged(experiments, until, gaps)
    best = _refine(experiments, spans, start, offsets)
    evaluations = 1 + best.evaluations
    for _ in range(JUDGEMENTS):
        before = [(item.spool_noise, item.pressure_noise) for item in experiments]
        judged = _judged(experiments, until, best.gaps)
        after = [(item.spool_noise, item.pressure_noise) for item in judged]
        if np.allclose(before, after, rtol=NOISE_SETTLED, atol=0.0):
            break
        experiments = judged
        best = _refine(experiments, spans, best.values, best.offsets)
        evaluations += best.evaluations
    if best.jagged:
        best = _polish(experiments, spans, best)
        evaluations += best.evaluations
    noise = tuple((item.spool_noise, item.pressure_noise) for item in experiments)
    return Prefix(best, noise, evaluations)


def _polish(experiments: Sequence[Experiment], spans: Spans, best: Refinement) -> Refinement:
    """Search the neighbourhood where steps in the cost may have held up the descent.

    The seed is fixed: the answer depends on the recording, not on the search before.
    """
    batch, noise = anchored(experiments, spans)
    objective = Objective(batch, best.offsets, cap=CAP)
    normal = best.jacobian[:, best.used] @ best.jacobian[:, best.used].T
    deviation = np.sqrt(np.diag(np.linalg.pinv(normal, hermitian=True)))[:FAULT_COUNT]
    spread = np.clip(POLISH_REACH * deviation, *POLISH_SPREAD)
    found = POLISH.minimise(objective, best.values, spread, seed=0)
    start = found.best if found.cost < best.cost else best.values
    other = describe(batch, start, best.offsets, noise, converged=best.converged)
    return replace(other, evaluations=other.evaluations + found.evaluations)


def _refine(
    experiments: Sequence[Experiment],
    spans: Spans,
    start: NDArray[np.float64],
    offsets: NDArray[np.float64],
) -> Refinement:
    batch, noise = anchored(experiments, spans)
    return refine(batch, start, offsets, noise)


def anchored(
    experiments: Sequence[Experiment],
    spans: Spans | None = None,
    lead: float = 0.0,
) -> tuple[Batch, tuple[float, float]]:
    """Spans of the tests, re-anchored on the spool, and the noise in which offsets are sought."""
    batch = make_batch(experiments, spans, lead=lead, anchor_lsb=ANCHOR_LSB)
    return batch, (experiments[0].spool_noise, experiments[0].pressure_noise)


def _spans(experiments: Sequence[Experiment], until: Sequence[int]) -> Spans:
    return [[(0.0, ticks * item.tick)] for item, ticks in zip(experiments, until, strict=True)]


def _judged(
    experiments: Sequence[Experiment], until: Sequence[int], gaps: NDArray[np.float64]
) -> list[Experiment]:
    """Weigh all experiments by the noise that their gaps show, shape (2, sum of `until`)."""
    parts = np.split(gaps, np.cumsum(until)[:-1], axis=1)
    return [judge_noise(item, part) for item, part in zip(experiments, parts, strict=True)]
