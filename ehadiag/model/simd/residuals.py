"""Residuals of many candidates at a time by the vector kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, kernel, merged
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
from ehadiag.model.batch import POSITION_ROW, PRESSURE_ROW, SPOOL_ROW, Batch
from ehadiag.model.plant import FIELDS, plant_of
from ehadiag.model.simd.coefficients import MOVING_SIZE, STUCK_SIZE, tabulate
from ehadiag.model.simd.jack import (
    follow_lanes,
    jack_lanes,
    positions,
    pressures,
    rest_jacks,
    sensed_jack_lanes,
)
from ehadiag.model.simd.jack_events import jack_events
from ehadiag.model.simd.layout import (
    ANCHORED,
    COEFFICIENT_ROWS,
    LANES,
    PATH_ROWS,
    PLAYS,
    POSITION,
    PRESSURE_SEEN,
    SEEN,
    STATE_ROWS,
    sensor_laws,
)
from ehadiag.model.simd.orifice import orifice_level, orifice_tick, sensed_orifice_tick
from ehadiag.model.simd.spool import (
    anchor_lanes,
    deflect_lanes,
    drive_lanes,
    rest_lanes,
    see_lanes,
    spool_lanes,
)
from ehadiag.model.simd.spool_events import SCRATCH_SIZE, event_ticks

__all__ = ["Scratch", "block_costs", "block_residuals", "scratch_beside", "scratch_for"]

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


class Scratch(NamedTuple):
    """Scratch of the kernels below, one for each thread.

    Attributes
    ----------
    levels : shape (N,)
        How often the jack's ticks are halved, 0 … 4. The same for every candidate, so that no
        answer depends on the others in its block. Of no meaning where no pressure counts: there
        the jack is left out.
    state, path, coefficients, moving, loose, stuck
        See `ehadiag.model.simd.layout`.
    rows : shape (LANES, FIELDS)
        Candidates of a block, in the test of the span at hand.
    sums, sample : shape (LANES,)
        Costs, and residuals of one sample.
    no_costs, uncounted, no_residuals
        What is not wanted, of no candidate.
    """

    levels: NDArray[np.int64]
    state: NDArray[np.float64]
    path: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    moving: NDArray[np.float64]
    loose: NDArray[np.float64]
    stuck: NDArray[np.float64]
    rows: NDArray[np.float64]
    sums: NDArray[np.float64]
    sample: NDArray[np.float64]
    no_costs: NDArray[np.float64]
    uncounted: NDArray[np.int64]
    no_residuals: NDArray[np.float64]


def scratch_for(batch: Batch, scattered: NDArray[np.float64]) -> Scratch:
    """Scratch for a batch, the jack's steps found by a run of candidates all over the space.

    `scattered`: their constants, shape (LANES, tests, FIELDS).
    """
    work = Scratch(
        levels=np.full(batch.weight.shape[1], -1, dtype=np.int64),
        state=np.zeros(STATE_ROWS * LANES),
        path=np.zeros(PATH_ROWS * LANES + SCRATCH_SIZE),
        coefficients=np.zeros(COEFFICIENT_ROWS * LANES),
        moving=np.zeros(MOVING_SIZE),
        loose=np.zeros(MOVING_SIZE),
        stuck=np.zeros(STUCK_SIZE),
        rows=np.zeros((LANES, FIELDS)),
        sums=np.zeros(LANES),
        sample=np.zeros(LANES),
        no_costs=np.zeros(0),
        uncounted=np.zeros(0, dtype=np.int64),
        no_residuals=np.zeros((0, 0, 0)),
    )
    if batch.weight[PRESSURE_ROW:].any():
        # Without weights the jack is left out, and the spool's path is all that is looked at.
        spool_only = batch._replace(weight=np.zeros_like(batch.weight))
        block_costs(spool_only, scattered, 1.0, work, np.empty(LANES))
    return work


def scratch_beside(work: Scratch) -> Scratch:
    """Scratch of another thread, with the same steps of the jack."""
    return Scratch._make(part.copy() for part in work)


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
def _hold_against(
    measured: float, weight: float, cap: float, row: int, signal: int,
    state: NDArray[np.float64], coefficients: NDArray[np.float64],
    sample: NDArray[np.float64], sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Weighted residual of one sample in every lane, its capped square added to the sums.

    row: of the state; signal: row of the residuals.
    """
    for o in range(0, LANES, WIDTH):
        law = sensor_laws(coefficients, o)
        if signal == SPOOL_ROW:
            offset, gain = law.spool_offset, law.spool_gain
        elif signal == PRESSURE_ROW:
            offset, gain = law.pressure_offset, law.pressure_gain
        else:
            offset, gain = law.position_offset, law.position_gain
        residual = (measured - offset - gain * load(state, row * LANES + o)) * weight
        store(sample, o, residual)
        store(sums, o, load(sums, o) + least(residual * residual, cap))


@packed
def _jack_tick(
    tick: float,
    level: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of all lanes over a tick cut into 2^level steps."""
    for step in range(1 << level):
        if jack_lanes(level, step, tick, state, path, coefficients):
            jack_events(level, step, tick, state, path, coefficients)


@bare_kernel
def _other_jack_tick(
    orifice: bool,
    senses: bool,
    tick: float,
    level: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """The same of an orifice stage, or with the pressure as the filter before its converter has it.

    Apart from the plain one, so that this stays as it is.
    """
    if orifice and senses:
        sensed_orifice_tick(tick, level, state, path, coefficients)
    elif orifice:
        orifice_tick(tick, level, state, path, coefficients)
    else:
        for step in range(1 << level):
            if sensed_jack_lanes(level, step, tick, state, path, coefficients):
                jack_events(level, step, tick, state, path, coefficients)


@merged
def _block(
    batch: Batch, candidates: NDArray[np.float64], cap: float, work: Scratch,
    out: NDArray[np.float64],
) -> None:  # fmt: skip
    """Costs of up to LANES candidates into `work.sums`, residuals of the first ones into `out`.

    out: shape (LANES or less, signals, N), or of no candidate.
    """
    state, path, coefficients = work.state, work.path, work.coefficients
    moving, loose, stuck, rows = work.moving, work.loose, work.stuck, work.rows
    sums, sample = work.sums, work.sample
    current, spool, pressure = batch.current, batch.spool, batch.pressure
    position, weight, levels, start = batch.position, batch.weight, work.levels, batch.start
    located = weight.shape[0] > POSITION_ROW
    wanted, last_candidate = out.shape[0], candidates.shape[0] - 1
    sums[:] = 0.0
    state[:] = 0.0
    for index in range(batch.tick.shape[0]):
        tick, test = batch.tick[index], batch.test[index]
        gain, small, large, follow = batch.anchor[index]
        anchored = math.isfinite(small) or math.isfinite(large)
        for i in range(LANES):
            for field in range(FIELDS):
                rows[i, field] = candidates[min(i, last_candidate), test, field]
        backlash, senses = tabulate(rows, tick, coefficients, moving, loose, stuck)
        plays, since = int(plant_of(rows[0]).NPL), batch.since[index]
        orifice = plant_of(rows[0]).OIL > 0.0
        state[PLAYS * LANES :] = 0.0
        for k in range(since - batch.history[index], since):
            drive_lanes(current[k], plays, state, coefficients)
        deflect_lanes(plays, state, coefficients)
        rest_lanes(batch.origin[index], state, coefficients)
        rest_jacks(batch.origin[index], batch.place[index], state, coefficients)
        last = start[index + 1] - 1
        while last >= start[index] and not weight[PRESSURE_ROW:, last].any():
            last -= 1
        for k in range(start[index], start[index + 1]):
            drive_lanes(current[since + k - start[index]], plays, state, coefficients)
            if spool_lanes(tick, backlash, state, path, coefficients):
                event_ticks(tick, state, path, coefficients, moving, loose, stuck)
            seen = math.isfinite(spool[k])
            if seen or senses:
                see_lanes(tick, senses, state, path, coefficients)
            if weight[SPOOL_ROW, k] != 0.0 and seen:
                _hold_against(
                    spool[k], weight[SPOOL_ROW, k], cap, SEEN, SPOOL_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, SPOOL_ROW, k] = sample[i]
            if levels[k] < 0:
                levels[k] = orifice_level(tick, coefficients) if orifice else _level(path)
            if k <= last:  # nothing depends on the jack but pressure and position
                if senses or orifice:
                    _other_jack_tick(orifice, senses, tick, levels[k], state, path, coefficients)
                else:
                    _jack_tick(tick, levels[k], state, path, coefficients)
            if weight[PRESSURE_ROW, k] != 0.0 and math.isfinite(pressure[k]):
                pressures(senses or orifice, state, path, coefficients)
                _hold_against(
                    pressure[k], weight[PRESSURE_ROW, k], cap, PRESSURE_SEEN, PRESSURE_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, PRESSURE_ROW, k] = sample[i]
            if located and math.isfinite(position[k]):
                positions(state, coefficients)
                if weight[POSITION_ROW, k] != 0.0:
                    _hold_against(
                        position[k], weight[POSITION_ROW, k], cap, POSITION, POSITION_ROW,
                        state, coefficients, sample, sums,
                    )  # fmt: skip
                    for i in range(wanted):
                        out[i, POSITION_ROW, k] = sample[i]
                if follow != 0.0:
                    follow_lanes(position[k], follow, state, coefficients)
            if anchored and seen:
                anchor_lanes(spool[k], gain, small, large, state, coefficients)


@kernel
def _run_blocks(
    batch: Batch,
    candidates: NDArray[np.float64],
    cap: float,
    work: Scratch,
    costs: NDArray[np.float64],
    anchored: NDArray[np.int64],
    residuals: NDArray[np.float64],
) -> None:
    """Run the candidates LANES at a time; out are costs, counts and residuals of all or of none."""
    n = candidates.shape[0]
    for first in range(0, n, LANES):
        here = min(LANES, n - first)
        _block(batch, candidates[first : first + here], cap, work, residuals[first : first + here])
        for i in range(min(here, costs.shape[0] - first)):
            costs[first + i] = work.sums[i]
        for i in range(min(here, anchored.shape[0] - first)):
            anchored[first + i] = int(work.state[ANCHORED * LANES + i])


def block_costs(
    batch: Batch,
    candidates: NDArray[np.float64],
    cap: float,
    work: Scratch,
    out: NDArray[np.float64],
) -> None:
    """Summed squared weighted residuals of each candidate, each square at most `cap`: out, (n,).

    `candidates` has shape (n, tests, FIELDS). Blocks of LANES candidates run at once; a last block
    that is not full takes as long as a full one.
    """
    _run_blocks(batch, candidates, cap, work, out, work.uncounted, work.no_residuals)


def block_residuals(
    batch: Batch,
    candidates: NDArray[np.float64],
    work: Scratch,
    out: NDArray[np.float64],
    anchored: NDArray[np.int64],
) -> None:
    """Weighted residuals, measured less modelled, of every candidate: out, shape (n, signals, N).

    `candidates` has shape (n, tests, FIELDS). A missing sample gives 0.
    anchored: out, how often the model was re-anchored, shape (n,).
    """
    out[:] = 0.0
    _run_blocks(batch, candidates, math.inf, work, work.no_costs, anchored, out)
