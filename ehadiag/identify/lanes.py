"""Kernels of the objective for a population: as `ehadiag.identify.batch`, many at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch, constants_of
from ehadiag.jit import kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.laneevents import event_ticks
from ehadiag.model.lanejack import jack_lanes, pressures
from ehadiag.model.lanelayout import (
    ANCHORED,
    COEFFICIENT_ROWS,
    LANES,
    NODES,
    PATH_ROWS,
    PRESSURE,
    PRESSURE_OFFSET,
    SPOOL,
    SPOOL_OFFSET,
    STATE_ROWS,
    packed,
)
from ehadiag.model.lanespool import anchor_lanes, midpoints, rest, spool_lanes
from ehadiag.model.lanestops import jack_events
from ehadiag.model.lanetables import MOVING_SIZE, STUCK_SIZE, tabulate

__all__ = ["LaneWork", "lane_costs", "lane_residuals", "lane_work"]

TRAVEL = 1.0e-6
RATIO = 0.1
BOW = 0.05e-6
"""A tick is cut for the jack until the spool's travel in a part (m, or share of its distance from
the middle) and its distance from the chord (m) are about this small."""


class LaneWork(NamedTuple):
    """Scratch of the kernels below, one for each thread.

    parts: into how many parts the jack's ticks are cut, 1, 2, 4 or 8, shape (N,). The same for
        every candidate, so that none's answer hangs on the others in its block.
    state, path, coefficients, moving, stuck: see `ehadiag.model.lanelayout`.
    rows: candidates of a block, shape (LANES, 5).
    sums: shape (LANES,).
    gaps: shape (LANES,).
    no_costs, uncounted, no_gaps: what is not wanted, of no candidate.
    """

    parts: NDArray[np.int64]
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
    """Scratch for a batch, the jack's parts found by a run of candidates all over the cube."""
    work = LaneWork(
        parts=np.zeros(len(batch.current), dtype=np.int64),
        state=np.zeros(STATE_ROWS * LANES),
        path=np.zeros(PATH_ROWS * LANES),
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
    scattered = np.zeros((LANES, 5))
    scattered[:, 0] = np.linspace(0.0, 1.0, LANES)
    scattered[:, 1] = scattered[:, 0] * 7.0 % 1.0
    lane_costs(batch, scattered, 1.0, work, np.empty(LANES))
    return work


@packed
def _parts(path: NDArray[np.float64]) -> int:
    """Into how many parts this tick must be cut for the jack of the most exacting lane."""
    two, four, eight = 0, 0, 0
    middle, last = NODES // 2 * LANES, NODES * LANES
    for i in range(LANES):
        x0, x1, x2 = path[i], path[middle + i], path[last + i]
        travel = abs(x2 - x0)
        near = min(abs(x0), abs(x2)) if x0 * x2 > 0.0 else 0.0
        most = max(TRAVEL, RATIO * near)
        bow = abs(x1 - 0.5 * (x0 + x2))
        two += int((travel > most) | (bow > BOW))
        four += int((travel > 2.0 * most) | (bow > 4.0 * BOW))
        eight += int((travel > 4.0 * most) | (bow > 16.0 * BOW))
    return 8 if eight > 0 else (4 if four > 0 else (2 if two > 0 else 1))


@packed
def _gaps(
    measured: float,
    weight: float,
    row: int,
    offset: int,
    state: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    gaps: NDArray[np.float64],
) -> None:
    """Weighted gap of one sample in every lane: gaps, shape (LANES,)."""
    for i in range(LANES):
        modelled = state[row * LANES + i]
        gaps[i] = (measured - coefficients[offset * LANES + i] - modelled) * weight


@packed
def _add(gaps: NDArray[np.float64], cap: float, sums: NDArray[np.float64]) -> None:
    """Add the capped squares to the sum of every lane."""
    for i in range(LANES):
        sums[i] += min(gaps[i] * gaps[i], cap)


@kernel
def _jack_tick(
    c: PlantConstants,
    tick: float,
    parts: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of all lanes over a tick cut into so many parts."""
    if parts == NODES:
        midpoints(path, 0.25 * tick)
    step = NODES // parts
    span = tick / parts
    for begin in range(0, NODES, step):
        if jack_lanes(c, begin, begin + step, span, state, path, coefficients) > 0:
            jack_events(c, begin, begin + step, span, state, path, coefficients)


@kernel
def _block(batch: Batch, cap: float, work: LaneWork, out: NDArray[np.float64]) -> None:
    """Costs of the candidates in `work.rows` into `work.sums`, gaps of the first ones into `out`.

    out: shape (LANES or less, 2, N), or of no candidate.
    """
    state, path, coefficients = work.state, work.path, work.coefficients
    moving, stuck, rows, sums, gaps = work.moving, work.stuck, work.rows, work.sums, work.gaps
    current, spool, pressure = batch.current, batch.spool, batch.pressure
    weight, parts, start = batch.weight, work.parts, batch.start
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
        for k in range(start[index], start[index + 1]):
            torque = c.GM * current[k]
            if spool_lanes(
                state, path, coefficients, torque, tick / 16.0,
                c.KF, c.KSF, c.XFM, c.XSM, damping, ring_time,
            ) > 0:  # fmt: skip
                event_ticks(c, torque, tick, state, path, coefficients, moving, stuck)
            seen = math.isfinite(spool[k])
            if weight[0, k] != 0.0 and seen:
                _gaps(spool[k], weight[0, k], SPOOL, SPOOL_OFFSET, state, coefficients, gaps)
                _add(gaps, cap, sums)
                for i in range(wanted):
                    out[i, 0, k] = gaps[i]
            if parts[k] == 0:
                parts[k] = _parts(path)
            _jack_tick(c, tick, parts[k], state, path, coefficients)
            if weight[1, k] != 0.0 and math.isfinite(pressure[k]):
                pressures(c, state, path)
                _gaps(
                    pressure[k], weight[1, k], PRESSURE, PRESSURE_OFFSET, state, coefficients, gaps
                )
                _add(gaps, cap, sums)
                for i in range(wanted):
                    out[i, 1, k] = gaps[i]
            if anchored and seen:
                anchor_lanes(c, spool[k], gain, small, large, state, coefficients)


@kernel
def _blocks(
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
            work.rows[i] = candidates[min(first + i, n - 1)]
        _block(batch, cap, work, gaps[first : first + here])
        for i in range(min(here, costs.shape[0] - first)):
            costs[first + i] = work.sums[i]
        for i in range(min(here, anchored.shape[0] - first)):
            anchored[first + i] = int(work.state[ANCHORED * LANES + i])


@kernel
def lane_costs(
    batch: Batch,
    candidates: NDArray[np.float64],
    cap: float,
    work: LaneWork,
    out: NDArray[np.float64],
) -> None:
    """Summed squared weighted gap of each candidate, each square at most `cap`: out, shape (n,).

    As `ehadiag.identify.batch.costs`; `candidates` has shape (n, 5). Blocks of LANES candidates
    run at once; a last block that is not full takes as long as a full one.
    """
    _blocks(batch, candidates, cap, work, out, work.uncounted, work.no_gaps)


@kernel
def lane_residuals(
    batch: Batch,
    candidates: NDArray[np.float64],
    work: LaneWork,
    out: NDArray[np.float64],
    anchored: NDArray[np.int64],
) -> None:
    """Weighted gaps, measured less modelled, of every candidate: out, shape (n, 2, N).

    As `ehadiag.identify.batch.residuals`; `candidates` has shape (n, 5). A missing sample gives 0.
    anchored: out, how often the model was re-anchored, shape (n,).
    """
    out[:] = 0.0
    _blocks(batch, candidates, math.inf, work, work.no_costs, anchored, out)
