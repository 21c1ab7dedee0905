"""Kernel of the objective for a population: as `ehadiag.identify.batch.costs`, many at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch, _constants
from ehadiag.jit import kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.lanes import (
    BUSY,
    COEFFICIENT_ROWS,
    LANES,
    NODES,
    PATH_ROWS,
    PRESSURE,
    SPOOL,
    STATE_ROWS,
    event_tick,
    jack_event,
    jack_part,
    midpoints,
    packed,
    pressures,
    rest,
    spool_tick,
    tabulate,
)
from ehadiag.model.transition import FINEST

__all__ = ["LaneWork", "lane_costs", "lane_work", "runs_free"]

TRAVEL = 1.0e-6
RATIO = 0.1
BOW = 0.05e-6
"""A tick is cut for the jack until the spool's travel in a part (m, or share of its distance from
the middle) and its distance from the chord (m) are about this small."""


class LaneWork(NamedTuple):
    """Scratch of `lane_costs`, one for each thread.

    parts: into how many parts the jack's ticks are cut, 1, 2, 4 or 8, shape (N,). The same for
        every candidate, so that none's cost hangs on the others in its block.
    state, path, coefficients, moving, stuck: see `ehadiag.model.lanes`.
    rows: candidates of a block, shape (LANES, 5).
    sums: shape (LANES,).
    """

    parts: NDArray[np.int64]
    state: NDArray[np.float64]
    path: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    moving: NDArray[np.float64]
    stuck: NDArray[np.float64]
    rows: NDArray[np.float64]
    sums: NDArray[np.float64]


def runs_free(batch: Batch) -> bool:
    """Whether no span re-anchors the model: only then do lanes serve."""
    return bool(np.isinf(batch.anchor[:, 1:]).all())


def lane_work(batch: Batch) -> LaneWork:
    """Scratch for a batch, the jack's parts found by a run of candidates all over the cube.

    Raises
    ------
    ValueError: a span re-anchors the model.
    """
    if not runs_free(batch):
        raise ValueError("lanes run free: the batch must not re-anchor the model")
    work = LaneWork(
        parts=np.zeros(len(batch.current), dtype=np.int64),
        state=np.zeros(STATE_ROWS * LANES),
        path=np.zeros(PATH_ROWS * LANES),
        coefficients=np.zeros(COEFFICIENT_ROWS * LANES),
        moving=np.zeros(LANES * ((1 << FINEST >> 3) + 1) * 16),
        stuck=np.zeros(((1 << FINEST >> 3) + 1) * 4),
        rows=np.zeros((LANES, 5)),
        sums=np.zeros(LANES),
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
def _add(
    measured: float,
    weight: float,
    cap: float,
    row: int,
    offset: int,
    state: NDArray[np.float64],
    rows: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add the squared weighted gap of one sample to the sum of every lane."""
    for i in range(LANES):
        gap = (measured - rows[i, offset] - state[row * LANES + i]) * weight
        sums[i] += min(gap * gap, cap)


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
        if jack_part(c, begin, begin + step, span, state, path, coefficients) > 0:
            for i in range(LANES):
                if state[BUSY * LANES + i] != 0.0:
                    jack_event(c, i, begin, begin + step, span, state, path, coefficients)


@kernel
def _block(batch: Batch, cap: float, work: LaneWork) -> None:
    """Costs of the candidates in `work.rows` into `work.sums`."""
    state, path, coefficients = work.state, work.path, work.coefficients
    moving, stuck, rows, sums = work.moving, work.stuck, work.rows, work.sums
    current, spool, pressure = batch.current, batch.spool, batch.pressure
    weight, parts, start = batch.weight, work.parts, batch.start
    sums[:] = 0.0
    for index in range(batch.tick.shape[0]):
        c, tick = _constants(batch.constants[index]), batch.tick[index]
        tabulate(c, tick, rows, coefficients, moving, stuck)
        rest(c, batch.current_before[index], batch.origin[index], coefficients, state)
        damping = 0.5 * c.CF / c.JF
        square = c.KF / c.JF - damping * damping
        # A flapper that does not ring is never taken to rest: slower, not wrong.
        ring_time = 1.0 / math.sqrt(square) if square > 0.0 else 1e30
        for k in range(start[index], start[index + 1]):
            torque = c.GM * current[k]
            if spool_tick(
                state, path, coefficients, torque, tick / 16.0,
                c.KF, c.KSF, c.XFM, c.XSM, damping, ring_time,
            ) > 0:  # fmt: skip
                for i in range(LANES):
                    if state[BUSY * LANES + i] != 0.0:
                        event_tick(c, i, torque, tick, state, path, coefficients, moving, stuck)
            if weight[0, k] != 0.0 and math.isfinite(spool[k]):
                _add(spool[k], weight[0, k], cap, SPOOL, 3, state, rows, sums)
            if parts[k] == 0:
                parts[k] = _parts(path)
            _jack_tick(c, tick, parts[k], state, path, coefficients)
            if weight[1, k] != 0.0 and math.isfinite(pressure[k]):
                pressures(c, state, path)
                _add(pressure[k], weight[1, k], cap, PRESSURE, 4, state, rows, sums)


@kernel
def lane_costs(
    batch: Batch,
    candidates: NDArray[np.float64],
    cap: float,
    work: LaneWork,
    out: NDArray[np.float64],
) -> None:
    """Summed squared weighted gap of each candidate, each square at most `cap`: out, shape (n,).

    As `ehadiag.identify.batch.costs` of a batch that runs free; `candidates` has shape (n, 5).
    Blocks of LANES candidates run at once; a last block that is not full takes as long as a full
    one.
    """
    n = candidates.shape[0]
    for first in range(0, n, LANES):
        for i in range(LANES):
            work.rows[i] = candidates[min(first + i, n - 1)]
        _block(batch, cap, work)
        for i in range(min(LANES, n - first)):
            out[first + i] = work.sums[i]
