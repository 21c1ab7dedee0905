"""Kernels of the objective for many candidates at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel, merged
from ehadiag.compile.vector import (
    WIDTH,
    anywhere,
    least,
    load,
    magnitude,
    most,
    packed,
    store,
    where,
)
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.residuals import Batch, constants_of
from ehadiag.model.simd.coefficients import MOVING_SIZE, STUCK_SIZE, tabulate
from ehadiag.model.simd.jack import jack_lanes, pressures
from ehadiag.model.simd.jack_events import jack_events
from ehadiag.model.simd.layout import (
    ANCHORED,
    COEFFICIENT_ROWS,
    LANES,
    PATH_ROWS,
    PRESSURE,
    PRESSURE_OFFSET,
    SPOOL,
    SPOOL_OFFSET,
    STATE_ROWS,
)
from ehadiag.model.simd.spool import anchor_lanes, rest, spool_lanes
from ehadiag.model.simd.spool_events import SCRATCH_SIZE, event_ticks

__all__ = ["LaneWork", "lane_costs", "lane_residuals", "lane_work", "run_blocks", "work_beside"]

BOW = 0.008e-6
"""Distance (m) of the spool's path from its chord from which the jack takes two steps a tick, where
the orifice is almost closed; elsewhere in proportion to its opening."""
BOW_RATIO = 6.0
"""The same, of four steps."""
OPENING = 10.0e-6
TRAVEL = 0.15
"""Travel as a share of the opening, likewise."""
CROSSING = 5.0e-6
"""Travel (m) past the closed orifice from which the jack takes eight steps, four times that:
sixteen."""


class LaneWork(NamedTuple):
    """Scratch of the kernels below, one for each thread.

    levels: how often the jack's ticks are halved, 0 … 4, shape (N,). The same for every
        candidate, so that none's answer hangs on the others in its block. Of no meaning where no
        pressure counts: there the jack is left out.
    state, path, coefficients, moving, stuck: see `ehadiag.model.simd.layout`.
    rows: candidates of a block, shape (LANES, 5).
    sums: shape (LANES,).
    gaps: shape (LANES,).
    no_costs, uncounted, no_gaps: what is not wanted, of no candidate.
    """

    levels: NDArray[np.int64]
    state: NDArray[np.float64]
    path: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    moving: NDArray[np.float64]
    stuck: NDArray[np.float64]
    rows: NDArray[np.float64]
    sums: NDArray[np.float64]
    gaps: NDArray[np.float64]
    no_costs: NDArray[np.float64]
    uncounted: NDArray[np.int64]
    no_gaps: NDArray[np.float64]


def lane_work(batch: Batch) -> LaneWork:
    """Scratch for a batch, the jack's steps found by a run of candidates all over the cube."""
    work = LaneWork(
        levels=np.full(len(batch.current), -1, dtype=np.int64),
        state=np.zeros(STATE_ROWS * LANES),
        path=np.zeros(PATH_ROWS * LANES + SCRATCH_SIZE),
        coefficients=np.zeros(COEFFICIENT_ROWS * LANES),
        moving=np.zeros(MOVING_SIZE),
        stuck=np.zeros(STUCK_SIZE),
        rows=np.zeros((LANES, 5)),
        sums=np.zeros(LANES),
        gaps=np.zeros(LANES),
        no_costs=np.zeros(0),
        uncounted=np.zeros(0, dtype=np.int64),
        no_gaps=np.zeros((0, 2, 0)),
    )
    if batch.weight[1].any():
        scattered = np.zeros((LANES, 5))
        scattered[:, 0] = np.linspace(0.0, 1.0, LANES)
        scattered[:, 1] = scattered[:, 0] * 7.0 % 1.0
        # Without weights the jack is left out, and the spool's path is all that is looked at.
        spool_only = batch._replace(weight=np.zeros_like(batch.weight))
        lane_costs(spool_only, scattered, 1.0, work, np.empty(LANES))
    return work


def work_beside(work: LaneWork) -> LaneWork:
    """Scratch of another thread, with the same steps of the jack."""
    return LaneWork._make(part.copy() for part in work)


@packed
def _level(path: NDArray[np.float64]) -> int:
    """Halvings of this tick for the jack of the most exacting lane."""
    level = 0
    for o in range(0, LANES, WIDTH):
        x0, x4 = load(path, o), load(path, 4 * LANES + o)
        x1, x2, x3 = load(path, LANES + o), load(path, 2 * LANES + o), load(path, 3 * LANES + o)
        near = where(x0 * x4 > 0.0, least(magnitude(x0), magnitude(x4)), 0.0)
        near = most(near, OPENING)
        bow = most(magnitude(x1 - 0.75 * x0 - 0.25 * x4), magnitude(x3 - 0.25 * x0 - 0.75 * x4))
        bow = most(bow, magnitude(x2 - 0.5 * (x0 + x4)))
        need = most(bow * (OPENING / BOW), magnitude(x4 - x0) / TRAVEL)
        crosses = where(near <= OPENING, magnitude(x4 - x0), 0.0)
        if anywhere(crosses > 4.0 * CROSSING):
            level = max(level, 4)
        elif anywhere(crosses > CROSSING):
            level = max(level, 3)
        if anywhere(need > BOW_RATIO * near):
            level = max(level, 2)
        elif anywhere(need > near):
            level = max(level, 1)
    return level


@packed
def _gaps(
    measured: float,
    weight: float,
    cap: float,
    row: int,
    offset: int,
    state: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    gaps: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Weighted gap of one sample in every lane, its capped square added to the sums."""
    for o in range(0, LANES, WIDTH):
        seen = measured - load(coefficients, offset * LANES + o)
        gap = (seen - load(state, row * LANES + o)) * weight
        store(gaps, o, gap)
        store(sums, o, load(sums, o) + least(gap * gap, cap))


@packed
def _jack_tick(
    c: PlantConstants,
    tick: float,
    level: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of all lanes over a tick cut into 2^level steps."""
    for step in range(1 << level):
        if jack_lanes(c, level, step, tick, state, path, coefficients):
            jack_events(c, level, step, tick, state, path, coefficients)


@merged
def _block(batch: Batch, cap: float, work: LaneWork, out: NDArray[np.float64]) -> None:
    """Costs of the candidates in `work.rows` into `work.sums`, gaps of the first ones into `out`.

    out: shape (LANES or less, 2, N), or of no candidate.
    """
    state, path, coefficients = work.state, work.path, work.coefficients
    moving, stuck, rows, sums, gaps = work.moving, work.stuck, work.rows, work.sums, work.gaps
    current, spool, pressure = batch.current, batch.spool, batch.pressure
    weight, levels, start = batch.weight, work.levels, batch.start
    wanted = out.shape[0]
    sums[:] = 0.0
    state[:] = 0.0
    for index in range(batch.tick.shape[0]):
        c, tick = constants_of(batch.constants[index]), batch.tick[index]
        gain, small, large = batch.anchor[index]
        anchored = math.isfinite(small) or math.isfinite(large)
        tabulate(c, tick, rows, coefficients, moving, stuck)
        rest(c, batch.current_before[index], batch.origin[index], coefficients, state)
        damping = 0.5 * c.CF / c.JF
        square = c.KF / c.JF - damping * damping
        # A flapper that does not ring is never taken to rest: slower, not wrong.
        ring_time = 1.0 / math.sqrt(square) if square > 0.0 else 1e30
        last = start[index + 1] - 1
        while last >= start[index] and weight[1, last] == 0.0:
            last -= 1
        for k in range(start[index], start[index + 1]):
            torque = c.GM * current[k]
            if spool_lanes(c, torque, tick, damping, ring_time, state, path, coefficients):
                event_ticks(c, torque, tick, state, path, coefficients, moving, stuck)
            seen = math.isfinite(spool[k])
            if weight[0, k] != 0.0 and seen:
                _gaps(
                    spool[k], weight[0, k], cap, SPOOL, SPOOL_OFFSET,
                    state, coefficients, gaps, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, 0, k] = gaps[i]
            if levels[k] < 0:
                levels[k] = _level(path)
            if k <= last:  # nothing hangs on the jack but the pressure
                _jack_tick(c, tick, levels[k], state, path, coefficients)
            if weight[1, k] != 0.0 and math.isfinite(pressure[k]):
                pressures(c, state, path)
                _gaps(
                    pressure[k], weight[1, k], cap, PRESSURE, PRESSURE_OFFSET,
                    state, coefficients, gaps, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, 1, k] = gaps[i]
            if anchored and seen:
                anchor_lanes(c, spool[k], gain, small, large, state, coefficients)


@kernel
def run_blocks(
    batch: Batch,
    candidates: NDArray[np.float64],
    cap: float,
    work: LaneWork,
    costs: NDArray[np.float64],
    anchored: NDArray[np.int64],
    gaps: NDArray[np.float64],
) -> None:
    """Run the candidates LANES at a time; out are costs, counts and gaps of all or of none."""
    n = candidates.shape[0]
    for first in range(0, n, LANES):
        here = min(LANES, n - first)
        for i in range(LANES):
            for j in range(5):
                work.rows[i, j] = candidates[min(first + i, n - 1), j]
        _block(batch, cap, work, gaps[first : first + here])
        for i in range(min(here, costs.shape[0] - first)):
            costs[first + i] = work.sums[i]
        for i in range(min(here, anchored.shape[0] - first)):
            anchored[first + i] = int(work.state[ANCHORED * LANES + i])


def lane_costs(
    batch: Batch,
    candidates: NDArray[np.float64],
    cap: float,
    work: LaneWork,
    out: NDArray[np.float64],
) -> None:
    """Summed squared weighted gap of each candidate, each square at most `cap`: out, shape (n,).

    As `ehadiag.model.scalar.residuals.costs`; `candidates` has shape (n, 5). Blocks of LANES
    candidates run at once; a last block that is not full takes as long as a full one.
    """
    run_blocks(batch, candidates, cap, work, out, work.uncounted, work.no_gaps)


def lane_residuals(
    batch: Batch,
    candidates: NDArray[np.float64],
    work: LaneWork,
    out: NDArray[np.float64],
    anchored: NDArray[np.int64],
) -> None:
    """Weighted gaps, measured less modelled, of every candidate: out, shape (n, 2, N).

    As `ehadiag.model.scalar.residuals.residuals`; `candidates` has shape (n, 5). A
    missing sample gives 0.
    anchored: out, how often the model was re-anchored, shape (n,).
    """
    out[:] = 0.0
    run_blocks(batch, candidates, math.inf, work, work.no_costs, anchored, out)
