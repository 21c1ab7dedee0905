"""Models of recordings, by one source: one candidate at a time, or a block of them side by side.

`SimdModel` uses all processors. `model_response` runs one candidate alone: current in; spool,
pressure and jack position out.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.compile.vector import LANES, VECTOR_WIDTH
from ehadiag.model.batch import NO_ANCHOR, SIGNAL_ROWS, Anchor, Batch
from ehadiag.model.plant import PlantConstants
from ehadiag.model.registry import Unknowns
from ehadiag.model.simd_residuals import (
    BlockRuns,
    block_scratch,
    jack_levels,
    respond,
    run_single,
)

KEPT_NUMBERS = 4_000_000
"""Numbers of an array that is freed at once, 1: 32 MB, from then on the largest memory that glibc
keeps when it is freed. Else each array of residuals is of new pages, a tenth of an estimate."""
np.empty(KEPT_NUMBERS)


class ModelResponse(msgspec.Struct, frozen=True, eq=False):
    """Modelled response of each tick when it is sampled, arrays of shape (n,)."""

    spool: Array
    """m, before any re-anchoring of the tick."""
    pressure: Array
    """Pa."""
    position: Array
    """m."""
    anchored: NDArray[np.intp]
    """Ascending ticks at whose end the model was put back on the measured spool, shape (m,)."""


def model_response(
    constants: PlantConstants,
    current: Array,
    tick: float,
    *,
    origin: float = 0.0,
    place: float = 0.0,
    history: Array | None = None,
    measured: Array | None = None,
    anchor: Anchor = NO_ANCHOR,
) -> ModelResponse:
    """Run the monitoring model from rest.

    constants: of the candidate, offsets and gains of its sensors are not in the response; current:
    of each tick, A, shape (n,); tick: s; origin, place: spool and jack position before the first
    tick, m; history: current before the first tick, A, None: the hysteresis is unloaded; measured:
    spool position to re-anchor on, m, NaN where missing.
    """
    response = np.empty((SIGNAL_ROWS + 1, len(current)))
    work = block_scratch(np.zeros(0, dtype=np.int64), 1)
    respond(
        PlantConstants(*(float(value) for value in constants)),
        work.memory.ctypes.data,
        work.rows,
        current,
        tick,
        origin,
        place,
        np.zeros(0) if history is None else history,
        np.full(len(current), np.nan) if measured is None else measured,
        anchor.as_array(),
        response,
    )
    spool, pressure, position, counts = response
    return ModelResponse(spool, pressure, position, np.flatnonzero(np.diff(counts, prepend=0.0)))


class ScalarModel:
    """A `ehadiag.model.registry.ResidualModel` of one candidate at a time.

    Its jack's steps are those that its own path asks for.
    """

    def __init__(self, batch: Batch, unknowns: Unknowns) -> None:
        self.batch = batch
        self.unknowns = unknowns
        self.evaluations = 0
        self._work = block_scratch(np.empty(batch.weight.shape[1], dtype=np.int64), 1)

    def residuals(self, points: Array) -> tuple[Array, NDArray[np.int64]]:
        """See the protocol."""
        out = np.zeros((len(points), *self.batch.weight.shape))
        anchored = np.empty(len(points), dtype=np.int64)
        candidates, address = self.unknowns.candidates(points), self._work.memory.ctypes.data
        for i in range(len(points)):
            one = slice(i, i + 1)
            anchored[i] = run_single(self.batch, candidates[one], self._work, address, out[one])
        self.evaluations += len(points)
        return out, anchored

    def costs(self, points: Array, cap: float) -> Array:
        """See the protocol."""
        return np.asarray(np.minimum(self.residuals(points)[0] ** 2, cap).sum(axis=(1, 2)))


def processor_count() -> int:
    """Processors that this process may use; at most `EHADIAG_THREADS`, where that is set."""
    setting = os.environ.get("EHADIAG_THREADS", "")
    if setting.isascii() and setting.isdigit() and int(setting) > 0:
        return min(_available_processors(), int(setting))
    return _available_processors()


def _available_processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class SimdModel:
    """A `ehadiag.model.registry.ResidualModel` of vector kernels.

    Residuals of more than one block are computed on several processors, with the same digits on any
    number of them; costs on one. threads: at most so many, all processors unless given; levels: of
    a model of the same spans, else computed.
    """

    def __init__(
        self,
        batch: Batch,
        unknowns: Unknowns,
        *,
        threads: int | None = None,
        levels: NDArray[np.int64] | None = None,
    ) -> None:
        self.batch = batch
        self.unknowns = unknowns
        self.evaluations = 0
        self._threads = processor_count() if threads is None else threads
        if levels is None:
            levels = jack_levels(batch, unknowns.candidates(_lattice_points(unknowns)))
        self.levels: NDArray[np.int64] = levels
        """How the jack's ticks are cut; to find that takes half as long as to run a block."""
        self._runs = BlockRuns(batch, block_scratch(levels))

    def residuals(self, points: Array) -> tuple[Array, NDArray[np.int64]]:
        """See the protocol."""
        count = len(points)
        candidates = self.unknowns.candidates(points)
        out = np.empty((count, *self.batch.weight.shape))
        anchored = np.empty(count, dtype=np.int64)
        blocks = -(-count // LANES)
        threads = max(1, min(self._threads, blocks))
        edges = [min(count, blocks * i // threads * LANES) for i in range(threads)] + [count]
        first, *others = [slice(a, b) for a, b in pairwise(edges)]

        def evaluate(part: slice, runs: BlockRuns) -> None:
            runs.residuals(candidates[part], out[part], anchored[part])

        if others:
            with ThreadPoolExecutor(len(others)) as pool:
                waiting = [pool.submit(evaluate, part, self._runs.of_thread()) for part in others]
                evaluate(first, self._runs)
                for item in waiting:
                    item.result()
        else:
            evaluate(first, self._runs)
        self.evaluations += count
        return out, anchored

    def costs(self, points: Array, cap: float) -> Array:
        """See the protocol."""
        out = np.empty(len(points))
        self._runs.costs(self.unknowns.candidates(points), cap, out)
        self.evaluations += len(points)
        return out


def _lattice_points(unknowns: Unknowns) -> Array:
    """Points all over the space, shape (n, k): a lattice; 0 where a bound is infinite."""
    lower, upper = unknowns.lower, unknowns.upper
    bounded = np.isfinite(lower) & np.isfinite(upper)
    count = VECTOR_WIDTH if len(lower) <= VECTOR_WIDTH else LANES
    shares = (
        np.linspace(0.0, 1.0, count)[:, None]
        * LATTICE_RATIO ** np.arange(len(lower))
        % LATTICE_PERIOD
    )
    width = np.where(bounded, upper - lower, 0.0)
    return np.where(bounded, lower, 0.0) + shares * width


LATTICE_RATIO, LATTICE_PERIOD = 7.0, 1.0 + 1e-9
"""Of the lattice: ratio of the shares of neighbouring coordinates; the upper bound is kept."""
