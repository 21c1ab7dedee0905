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
from ehadiag.model.sensors import read_pressure, read_spool
from ehadiag.model.simd.coefficients import (
    MOVING_SIZE,
    RINGS_SIZE,
    SLIDES_SIZE,
    STUCK_SIZE,
    tabulate,
)
from ehadiag.model.simd.jack import (
    follow_lanes,
    jack_lanes,
    open_lanes,
    positions,
    pressures,
    rest_jacks,
    sensed_jack_lanes,
)
from ehadiag.model.simd.jack_events import jack_events
from ehadiag.model.simd.jack_pieces import PIECES_SIZE
from ehadiag.model.simd.layout import (
    ANCHORED,
    COEFFICIENT_ROWS,
    FLOWING,
    IDLE,
    LANES,
    PATH_ROWS,
    POSITION,
    PRESSURE_SEEN,
    SEEN,
    SPOOL,
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
from ehadiag.model.simd.spool_creep import creeping_lanes
from ehadiag.model.simd.spool_events import SCRATCH_SIZE, event_ticks
from ehadiag.model.simd.spool_halving import halved_lanes

__all__ = [
    "Scratch",
    "block_costs",
    "block_residuals",
    "levels_for",
    "scratch_beside",
    "scratch_for",
]

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
CACHE_LINE = 64
"""Bytes; as many as a vector of lanes has."""


class Scratch(NamedTuple):
    """Scratch of the kernels below, one for each thread.

    Attributes
    ----------
    levels : shape (N,)
        How often the jack's ticks are halved, 0 … 4. The same for every candidate, so that no
        answer depends on the others in its block. Of no meaning where no pressure counts: there
        the jack is left out.
    state, path, coefficients
        See `ehadiag.model.simd.layout`.
    moving, loose, stuck, slides, free_slides, rings
        See `ehadiag.model.simd.coefficients`.
    pieces
        See `ehadiag.model.simd.jack_pieces`.
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
    slides: NDArray[np.float64]
    free_slides: NDArray[np.float64]
    rings: NDArray[np.float64]
    pieces: NDArray[np.float64]
    rows: NDArray[np.float64]
    sums: NDArray[np.float64]
    sample: NDArray[np.float64]
    no_costs: NDArray[np.float64]
    uncounted: NDArray[np.int64]
    no_residuals: NDArray[np.float64]


def levels_for(batch: Batch, scattered: NDArray[np.float64]) -> NDArray[np.int64]:
    """How often the jack's ticks are to be halved, by a run of candidates all over the space.

    Parameters
    ----------
    scattered : shape (LANES or less, tests, FIELDS)
        Their constants.

    Returns
    -------
    Shape (N,), see `Scratch.levels`.
    """
    levels = np.full(batch.weight.shape[1], -1, dtype=np.int64)
    if batch.weight[PRESSURE_ROW:].any():
        # Without weights the jack is left out, and the spool's path is all that is looked at.
        spool_only = batch._replace(weight=np.zeros_like(batch.weight))
        block_costs(spool_only, scattered, 1.0, scratch_for(levels), np.empty(len(scattered)))
    return levels


def scratch_for(levels: NDArray[np.int64]) -> Scratch:
    """Scratch with the jack's steps; those below 0 are found by the first block that is run."""
    return Scratch(
        levels=levels,
        state=_aligned(STATE_ROWS * LANES),
        path=_aligned(PATH_ROWS * LANES + SCRATCH_SIZE),
        coefficients=_aligned(COEFFICIENT_ROWS * LANES),
        moving=_aligned(MOVING_SIZE),
        loose=_aligned(MOVING_SIZE),
        stuck=_aligned(STUCK_SIZE),
        slides=_aligned(SLIDES_SIZE),
        free_slides=_aligned(SLIDES_SIZE),
        rings=_aligned(RINGS_SIZE),
        pieces=_aligned(PIECES_SIZE),
        rows=np.zeros((LANES, FIELDS)),
        sums=_aligned(LANES),
        sample=_aligned(LANES),
        no_costs=np.zeros(0),
        uncounted=np.zeros(0, dtype=np.int64),
        no_residuals=np.zeros((0, 0, 0)),
    )


def _aligned(size: int) -> NDArray[np.float64]:
    """Zeros that begin where a line of the cache does: a vector that straddles two takes longer."""
    raw = np.zeros(size + WIDTH)
    first = -raw.ctypes.data % CACHE_LINE // raw.itemsize
    return raw[first : first + size]


def scratch_beside(work: Scratch) -> Scratch:
    """Scratch of another thread, with the same steps of the jack."""
    return scratch_for(work.levels.copy())


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
    end: int, measured: float, weight: float, cap: float, row: int, signal: int,
    state: NDArray[np.float64], coefficients: NDArray[np.float64],
    sample: NDArray[np.float64], sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Weighted residual of one sample in every lane, its capped square added to the sums.

    row: of the state; signal: row of the residuals.
    """
    for o in range(0, end, WIDTH):
        law = sensor_laws(coefficients, o)
        value = load(state, row * LANES + o)
        if signal == SPOOL_ROW:
            shown = read_spool(law, value)
        elif signal == PRESSURE_ROW:
            shown = read_pressure(law, value)
        else:
            shown = law.position_offset + law.position_gain * value
        residual = (measured - shown) * weight
        store(sample, o, residual)
        store(sums, o, load(sums, o) + least(residual * residual, cap))


@packed
def _jack_tick(
    count: int,
    end: int,
    tick: float,
    level: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of all lanes over a tick cut into 2^level steps."""
    for step in range(1 << level):
        if jack_lanes(end, level, step, tick, state, path, coefficients):
            jack_events(count, level, step, tick, state, path, coefficients)


@bare_kernel
def _other_jack_tick(
    count: int,
    end: int,
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
        sensed_orifice_tick(count, end, tick, level, state, path, coefficients)
    elif orifice:
        orifice_tick(count, end, tick, level, state, path, coefficients)
    else:
        for step in range(1 << level):
            if sensed_jack_lanes(end, level, step, tick, state, path, coefficients):
                jack_events(count, level, step, tick, state, path, coefficients)


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
    slides, free_slides, rings = work.slides, work.free_slides, work.rings
    pieces = work.pieces
    sums, sample = work.sums, work.sample
    current, spool, pressure = batch.current, batch.spool, batch.pressure
    position, weight, levels, start = batch.position, batch.weight, work.levels, batch.start
    located = weight.shape[0] > POSITION_ROW
    count, wanted = candidates.shape[0], out.shape[0]
    # Lanes that hold no candidate repeat the last one up to its first event; a half of none is left
    # out.
    end = WIDTH if count <= WIDTH else LANES
    backlash = creeps = shaped = senses = False
    sums[:] = 0.0
    state[:] = 0.0
    for index in range(batch.tick.shape[0]):
        tick, test = batch.tick[index], batch.test[index]
        gain, small, large, follow = batch.anchor[index]
        anchored = math.isfinite(small) or math.isfinite(large)
        if index == 0 or test != batch.test[index - 1] or tick != batch.tick[index - 1]:
            for i in range(LANES):
                for field in range(FIELDS):
                    rows[i, field] = candidates[min(i, count - 1), test, field]
            backlash, creeps, shaped, senses = tabulate(
                rows, tick, coefficients, moving, loose, stuck, slides, free_slides, rings
            )
            for i in range(LANES):
                coefficients[IDLE * LANES + i] = 1.0 if i >= count else 0.0
        # Most candidates are read at the end of the tick, where the spool is at hand.
        read = SEEN if senses else SPOOL
        plays, since = int(plant_of(rows[0]).NPL), batch.since[index]
        orifice = plant_of(rows[0]).OIL > 0.0
        state[FLOWING * LANES :] = 0.0
        for k in range(since - batch.history[index], since):
            drive_lanes(end, current[k], plays, state, coefficients)
        deflect_lanes(end, plays, state, coefficients)
        rest_lanes(end, batch.origin[index], state, coefficients)
        rest_jacks(end, batch.origin[index], batch.place[index], state, coefficients)
        last = start[index + 1] - 1
        while last >= start[index] and not weight[PRESSURE_ROW:, last].any():
            last -= 1
        for k in range(start[index], start[index + 1]):
            drive_lanes(end, current[since + k - start[index]], plays, state, coefficients)
            busy = spool_lanes(end, tick, backlash, state, path, coefficients)
            if busy and creeps:
                busy = creeping_lanes(end, tick, state, path, coefficients)
            # Nothing depends on the jack but pressure and position.
            with_jack = k <= last
            if busy:
                busy = halved_lanes(
                    end, tick, backlash, with_jack, state, path, coefficients,
                    slides, free_slides, rings, pieces,
                )  # fmt: skip
            if busy:
                event_ticks(count, tick, with_jack, state, path, coefficients, moving, loose, stuck)
            seen = math.isfinite(spool[k])
            if senses:
                see_lanes(end, tick, state, path, coefficients)
            if weight[SPOOL_ROW, k] != 0.0 and seen:
                _hold_against(
                    end, spool[k], weight[SPOOL_ROW, k], cap, read, SPOOL_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, SPOOL_ROW, k] = sample[i]
            if shaped:
                open_lanes(end, path, coefficients)
            if levels[k] < 0:
                levels[k] = orifice_level(tick, coefficients) if orifice else _level(path)
            if with_jack:
                if senses or orifice:
                    _other_jack_tick(
                        count, end, orifice, senses, tick, levels[k], state, path, coefficients
                    )
                else:
                    _jack_tick(count, end, tick, levels[k], state, path, coefficients)
            if weight[PRESSURE_ROW, k] != 0.0 and math.isfinite(pressure[k]):
                pressures(end, senses or orifice, state, path, coefficients)
                _hold_against(
                    end, pressure[k], weight[PRESSURE_ROW, k], cap, PRESSURE_SEEN, PRESSURE_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, PRESSURE_ROW, k] = sample[i]
            if located and math.isfinite(position[k]):
                positions(end, state, coefficients)
                if weight[POSITION_ROW, k] != 0.0:
                    _hold_against(
                        end, position[k], weight[POSITION_ROW, k], cap, POSITION, POSITION_ROW,
                        state, coefficients, sample, sums,
                    )  # fmt: skip
                    for i in range(wanted):
                        out[i, POSITION_ROW, k] = sample[i]
                if follow != 0.0:
                    follow_lanes(end, position[k], follow, state, coefficients)
            if anchored and seen:
                anchor_lanes(end, read, spool[k], gain, small, large, state, coefficients)


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

    `candidates` has shape (n, tests, FIELDS). Blocks of LANES candidates run at once.
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
