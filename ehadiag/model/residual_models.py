"""Models of recordings: scalar kernels for one candidate at a time, vector kernels for many.

`ScalarModel` is what the target computer runs and the reference for `SimdModel`, which uses all
processors. `model_response` runs the scalar model alone: current in; spool, pressure and jack
position out.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, Array2, inlined, kernel
from ehadiag.compile.vector import VECTOR_WIDTH
from ehadiag.model.batch import (
    NO_ANCHOR,
    POSITION_ROW,
    PRESSURE_ROW,
    SPOOL_ROW,
    Anchor,
    Batch,
    longest_span,
)
from ehadiag.model.laws import PATH_BENDS, jack_law, plant_of
from ehadiag.model.plant import PlantConstants
from ehadiag.model.registry import Unknowns
from ehadiag.model.scalar_spool import SPOOL_GRID, SpoolScratch, spool_response, spool_scratch
from ehadiag.model.second_stage import jack_rest, jack_tick
from ehadiag.model.sensors import JackState, read_pressure, read_spool, sensor_law
from ehadiag.model.simd_layout import LANES
from ehadiag.model.simd_residuals import (
    LaneScratch,
    block_costs,
    block_residuals,
    jack_levels,
    lane_scratch,
    thread_scratch,
)


@kernel
def jack_response(
    constants: PlantConstants,
    tick: float,
    origin: float,
    place: float,
    follow: float,
    measured: Array,
    nodes: Array2,
    node_end: NDArray[np.int64],
    pressure: Array,
    position: Array,
) -> None:
    """Differential pressure and jack position of every tick, as they are sampled, from rest.

    tick: s; origin, place: spool and jack position before the first tick, m; follow: see `Anchor`;
    measured: jack position to re-anchor on, m, NaN where missing; nodes, node_end: the spool's
    path, see `spool_response`. Writes pressure, Pa, and position, m, before any re-anchoring of the
    tick.
    """
    law, sensor = jack_law(constants), sensor_law(constants)
    jack = jack_rest(law, place, origin)
    spool, first = origin, 0
    for k in range(node_end.shape[0]):
        end = node_end[k]
        pressure[k], jack, spool = jack_tick(law, sensor, tick, nodes, first, end, jack, spool)
        position[k] = jack.place - sensor.lead * jack.velocity
        move = follow * (measured[k] - sensor.position_offset - sensor.position_gain * position[k])
        if math.isfinite(move):
            jack = JackState(
                min(max(jack.place + move, -law.stroke), law.stroke),
                jack.velocity, jack.direction, jack.fresh,
                jack.pressure, jack.lagged, jack.seen,
            )  # fmt: skip
        spool += nodes[end - 1, 4]
        first = end


@dataclass(frozen=True, slots=True, eq=False)
class ModelResponse:
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
    n = len(current)
    spool, pressure, position = np.empty(n), np.empty(n), np.empty(n)
    nodes = np.empty((n * SPOOL_GRID.nodes, SPOOL_GRID.columns))
    node_end = np.empty(n, dtype=np.int64)
    plant = PlantConstants(*(float(value) for value in constants))
    reference = np.full(n, np.nan) if measured is None else measured
    spool_response(
        plant,
        PATH_BENDS.monitor,
        spool_scratch(),
        current,
        tick,
        origin,
        np.zeros(0) if history is None else history,
        reference,
        anchor.as_array(),
        spool,
        nodes,
        node_end,
    )
    unseen = np.full(n, np.nan)
    jack_response(plant, tick, origin, place, 0.0, unseen, nodes, node_end, pressure, position)
    return ModelResponse(spool, pressure, position, np.flatnonzero(nodes[node_end - 1, 4]))


class _Workspace(NamedTuple):
    """Scratch arrays, so that no evaluation allocates; one for each thread."""

    spool: Array
    pressure: Array
    position: Array
    nodes: Array2
    node_end: NDArray[np.int64]
    tables: SpoolScratch


def _workspace(batch: Batch) -> _Workspace:
    longest = longest_span(batch)
    return _Workspace(
        spool=np.empty(longest),
        pressure=np.empty(longest),
        position=np.empty(longest),
        nodes=np.empty((longest * SPOOL_GRID.nodes, SPOOL_GRID.columns)),
        node_end=np.empty(longest, dtype=np.int64),
        tables=spool_scratch(),
    )


@inlined
def _weighted(error: float, weight: float) -> float:
    """Residual of a sample, 0 where it is missing."""
    residual = error * weight
    return residual if math.isfinite(residual) else 0.0


@kernel
def _residuals(batch: Batch, candidate: Array2, bend: float, work: _Workspace, out: Array2) -> int:
    """Weighted residuals of one candidate, rows of constants of shape (tests, PLANT_FIELDS)."""
    anchored, signals = 0, batch.weight.shape[0]
    for index in range(batch.tick.shape[0]):
        a, b = batch.start[index], batch.start[index + 1]
        n = b - a
        constants, tick = plant_of(candidate[batch.test[index]]), batch.tick[index]
        anchored += spool_response(
            constants,
            bend,
            work.tables,
            batch.current[batch.since[index] : batch.since[index] + n],
            tick,
            batch.origin[index],
            batch.current[batch.since[index] - batch.history[index] : batch.since[index]],
            batch.spool[a:b],
            batch.anchor[index],
            work.spool[:n],
            work.nodes,
            work.node_end[:n],
        )
        follow = batch.anchor[index, 3] if signals > POSITION_ROW else 0.0
        jack_response(
            constants,
            tick,
            batch.origin[index],
            batch.place[index],
            follow,
            batch.position[a:b],
            work.nodes,
            work.node_end[:n],
            work.pressure[:n],
            work.position[:n],
        )
        law = sensor_law(constants)
        for k in range(n):
            spool = batch.spool[a + k] - read_spool(law, work.spool[k])
            out[SPOOL_ROW, a + k] = _weighted(spool, batch.weight[SPOOL_ROW, a + k])
            pressure = batch.pressure[a + k] - read_pressure(law, work.pressure[k])
            out[PRESSURE_ROW, a + k] = _weighted(pressure, batch.weight[PRESSURE_ROW, a + k])
            if signals > POSITION_ROW:
                position = batch.position[a + k] - law.position_offset
                position -= law.position_gain * work.position[k]
                out[POSITION_ROW, a + k] = _weighted(position, batch.weight[POSITION_ROW, a + k])
    return anchored


class ScalarModel:
    """A `ehadiag.model.registry.ResidualModel` of scalar kernels.

    bend: of the spool's path that a linear second stage does not feel, m.
    """

    def __init__(self, batch: Batch, unknowns: Unknowns, bend: float = PATH_BENDS.monitor) -> None:
        self.batch = batch
        self.unknowns = unknowns
        self._bend = bend
        self.evaluations = 0
        self._work = _workspace(batch)

    def residuals(self, points: Array) -> tuple[Array, NDArray[np.int64]]:
        """See the protocol."""
        out = np.empty((len(points), *self.batch.weight.shape))
        anchored = np.empty(len(points), dtype=np.int64)
        for i, candidate in enumerate(self.unknowns.candidates(points)):
            anchored[i] = _residuals(self.batch, candidate, self._bend, self._work, out[i])
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
        self._work = lane_scratch(levels)

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

        def evaluate(part: slice, scratch: LaneScratch) -> None:
            block_residuals(self.batch, candidates[part], scratch, out[part], anchored[part])

        if others:
            with ThreadPoolExecutor(len(others)) as pool:
                waiting = [
                    pool.submit(evaluate, part, thread_scratch(self._work)) for part in others
                ]
                evaluate(first, self._work)
                for item in waiting:
                    item.result()
        else:
            evaluate(first, self._work)
        self.evaluations += count
        return out, anchored

    def costs(self, points: Array, cap: float) -> Array:
        """See the protocol."""
        out = np.empty(len(points))
        block_costs(self.batch, self.unknowns.candidates(points), cap, self._work, out)
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
