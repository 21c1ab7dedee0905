"""Residuals of many candidates at a time by the vector kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, Array2, Array3, bare_kernel, kernel, merged
from ehadiag.compile.vector import (
    VECTOR_WIDTH,
    absolute,
    any_lane,
    load,
    maximum,
    minimum,
    packed,
    store,
    where,
)
from ehadiag.model.batch import POSITION_ROW, PRESSURE_ROW, SPOOL_ROW, Batch
from ehadiag.model.laws import plant_of
from ehadiag.model.plant import PLANT_FIELDS
from ehadiag.model.sensors import read_pressure, read_spool
from ehadiag.model.simd_jack import (
    anchor_jack_lanes,
    jack_lanes,
    land_opening_lanes,
    orifice_level,
    orifice_tick,
    rest_jack_lanes,
    sampled_positions,
    sampled_pressures,
    sensed_jack_lanes,
    sensed_orifice_tick,
)
from ehadiag.model.simd_jack_pieces import LANE_PIECES_SIZE, jack_events
from ehadiag.model.simd_layout import (
    COEFFICIENTS,
    LANE_PATH_ROWS,
    LANE_STATE_ROWS,
    LANES,
    MATRIX_SCRATCH_SIZE,
    MOVING_SIZE,
    RINGS_SIZE,
    ROWS,
    SLIDES_SIZE,
    STUCK_SIZE,
    sensor_laws,
    tabulate_coefficients,
)
from ehadiag.model.simd_spool import (
    anchor_spool_lanes,
    creep_lanes,
    deflect_lanes,
    drive_lanes,
    rest_spool_lanes,
    sample_spool_lanes,
    spool_lanes,
)
from ehadiag.model.simd_spool_events import EVENT_SCRATCH_SIZE, event_ticks
from ehadiag.model.simd_spool_halving import halved_lanes


class JackLevelRules(NamedTuple):
    """Rules for the number of steps of the jack in a tick."""

    bow: float = 0.008e-6
    """Distance of the spool's path from its chord for two steps, m, where the orifice is almost
    closed; elsewhere in proportion to its opening."""
    bow_ratio: float = 6.0
    """Ratio of that distance for four steps to that for two, 1."""
    opening: float = 10.0e-6
    """Opening below which the orifice is almost closed, m."""
    travel_share: float = 0.15
    """Travel for two steps, as a share of the opening, 1."""
    crossing: float = 5.0e-6
    """Travel past the closed orifice for eight steps, m; four times that: sixteen."""


JACK_LEVELS = JackLevelRules()


CACHE_LINE_BYTES = 64
"""Size of a line of the cache, bytes: that of a vector of lanes."""


class LaneScratch(NamedTuple):
    """Scratch of the kernels below, one for each thread."""

    levels: NDArray[np.int64]
    """How often the jack's ticks are halved, 0 … 4. The same for every candidate, so that no answer
    depends on the others in its block. Of no meaning where no pressure counts: there the jack is
    left out. Shape (N,)."""
    state: Array
    path: Array
    coefficients: Array
    """See `ehadiag.model.simd_layout`."""
    moving: Array
    loose: Array
    stuck: Array
    slides: Array
    free_slides: Array
    rings: Array
    """See `ehadiag.model.simd_layout`."""
    pieces: Array
    """See `ehadiag.model.simd_jack_pieces`."""
    rows: Array2
    """Candidates of a block, in the test of the span at hand; shape (LANES, PLANT_FIELDS)."""
    scratch: Array
    """Matrices, see `ehadiag.model.simd_layout`."""
    sums: Array
    sample: Array
    """Costs, and residuals of one sample; shape (LANES,)."""
    no_costs: Array
    uncounted: NDArray[np.int64]
    no_residuals: Array3
    """What is not wanted, of no candidate."""


def jack_levels(batch: Batch, scattered: Array) -> NDArray[np.int64]:
    """Halvings of the jack's ticks, shape (N,), by a run of candidates all over the space.

    scattered: their constants, shape (LANES or less, tests, PLANT_FIELDS).
    """
    levels = np.full(batch.weight.shape[1], -1, dtype=np.int64)
    if batch.weight[PRESSURE_ROW:].any():
        # Without weights the jack is left out, and the spool's path is all that is looked at.
        spool_only = batch._replace(weight=np.zeros_like(batch.weight))
        block_costs(spool_only, scattered, 1.0, lane_scratch(levels), np.empty(len(scattered)))
    return levels


def lane_scratch(levels: NDArray[np.int64]) -> LaneScratch:
    """Scratch with the jack's steps; those below 0 are found by the first block that is run."""
    return LaneScratch(
        levels=levels,
        state=_aligned(LANE_STATE_ROWS * LANES),
        path=_aligned(LANE_PATH_ROWS * LANES + EVENT_SCRATCH_SIZE),
        coefficients=_aligned(COEFFICIENTS.end * LANES),
        moving=_aligned(MOVING_SIZE),
        loose=_aligned(MOVING_SIZE),
        stuck=_aligned(STUCK_SIZE),
        slides=_aligned(SLIDES_SIZE),
        free_slides=_aligned(SLIDES_SIZE),
        rings=_aligned(RINGS_SIZE),
        pieces=_aligned(LANE_PIECES_SIZE),
        rows=np.zeros((LANES, PLANT_FIELDS)),
        scratch=_aligned(MATRIX_SCRATCH_SIZE),
        sums=_aligned(LANES),
        sample=_aligned(LANES),
        no_costs=np.zeros(0),
        uncounted=np.zeros(0, dtype=np.int64),
        no_residuals=np.zeros((0, 0, 0)),
    )


def _aligned(size: int) -> Array:
    """Zeros that begin where a line of the cache does: a vector that straddles two takes longer."""
    raw = np.zeros(size + VECTOR_WIDTH)
    first = -raw.ctypes.data % CACHE_LINE_BYTES // raw.itemsize
    return raw[first : first + size]


def thread_scratch(work: LaneScratch) -> LaneScratch:
    """Scratch of another thread, with the same steps of the jack."""
    return lane_scratch(work.levels.copy())


@packed
def _jack_level(path: Array) -> int:
    """Halvings of this tick for the jack of the most exacting lane."""
    level = 0
    for o in range(0, LANES, VECTOR_WIDTH):
        x0, x4 = load(path, o), load(path, 4 * LANES + o)
        x1, x2, x3 = load(path, LANES + o), load(path, 2 * LANES + o), load(path, 3 * LANES + o)
        near = where(x0 * x4 > 0.0, minimum(absolute(x0), absolute(x4)), 0.0)
        near = maximum(near, JACK_LEVELS.opening)
        bow = maximum(absolute(x1 - 0.75 * x0 - 0.25 * x4), absolute(x3 - 0.25 * x0 - 0.75 * x4))
        bow = maximum(bow, absolute(x2 - 0.5 * (x0 + x4)))
        need = maximum(
            bow * (JACK_LEVELS.opening / JACK_LEVELS.bow),
            absolute(x4 - x0) / JACK_LEVELS.travel_share,
        )
        crosses = where(near <= JACK_LEVELS.opening, absolute(x4 - x0), 0.0)
        if any_lane(crosses > 4.0 * JACK_LEVELS.crossing):
            level = max(level, 4)
        elif any_lane(crosses > JACK_LEVELS.crossing):
            level = max(level, 3)
        if any_lane(need > JACK_LEVELS.bow_ratio * near):
            level = max(level, 2)
        elif any_lane(need > near):
            level = max(level, 1)
    return level


@packed
def _add_residual(
    end: int, measured: float, weight: float, cap: float, row: int, signal: int,
    state: Array, coefficients: Array,
    sample: Array, sums: Array,
) -> None:  # fmt: skip
    """Weighted residual of one sample in every lane, its capped square added to the sums.

    row: of the state; signal: row of the residuals.
    """
    for o in range(0, end, VECTOR_WIDTH):
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
        store(sums, o, load(sums, o) + minimum(residual * residual, cap))


@packed
def _jack_tick(
    count: int, end: int, tick: float, level: int, state: Array, path: Array, coefficients: Array
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
    state: Array,
    path: Array,
    coefficients: Array,
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
    batch: Batch, candidates: Array, cap: float, work: LaneScratch,
    out: Array,
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
    end = VECTOR_WIDTH if count <= VECTOR_WIDTH else LANES
    backlash = creeps = shaped = senses = False
    sums[:] = 0.0
    state[:] = 0.0
    for index in range(batch.tick.shape[0]):
        tick, test = batch.tick[index], batch.test[index]
        gain, small, large, follow = batch.anchor[index]
        anchored = math.isfinite(small) or math.isfinite(large)
        if index == 0 or test != batch.test[index - 1] or tick != batch.tick[index - 1]:
            for i in range(LANES):
                for field in range(PLANT_FIELDS):
                    rows[i, field] = candidates[min(i, count - 1), test, field]
            backlash, creeps, shaped, senses = tabulate_coefficients(
                rows,
                tick,
                coefficients,
                moving,
                loose,
                stuck,
                slides,
                free_slides,
                rings,
                work.scratch,
            )
            for i in range(LANES):
                coefficients[COEFFICIENTS.idle * LANES + i] = 1.0 if i >= count else 0.0
        # Most candidates are read at the end of the tick, where the spool is at hand.
        read = ROWS.spool_sampled if senses else ROWS.spool
        plays, since = int(plant_of(rows[0]).NPL), batch.since[index]
        orifice = plant_of(rows[0]).OIL > 0.0
        state[ROWS.current * LANES :] = 0.0
        for k in range(since - batch.history[index], since):
            drive_lanes(end, current[k], plays, state, coefficients)
        deflect_lanes(end, plays, state, coefficients)
        rest_spool_lanes(end, batch.origin[index], state, coefficients)
        rest_jack_lanes(end, batch.origin[index], batch.place[index], state, coefficients)
        last = start[index + 1] - 1
        while last >= start[index] and not weight[PRESSURE_ROW:, last].any():
            last -= 1
        for k in range(start[index], start[index + 1]):
            drive_lanes(end, current[since + k - start[index]], plays, state, coefficients)
            busy = spool_lanes(end, tick, backlash, state, path, coefficients)
            if busy and creeps:
                busy = creep_lanes(end, tick, state, path, coefficients)
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
                sample_spool_lanes(end, tick, state, path, coefficients)
            if weight[SPOOL_ROW, k] != 0.0 and seen:
                _add_residual(
                    end, spool[k], weight[SPOOL_ROW, k], cap, read, SPOOL_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, SPOOL_ROW, k] = sample[i]
            if shaped:
                land_opening_lanes(end, path, coefficients)
            if levels[k] < 0:
                levels[k] = orifice_level(tick, coefficients) if orifice else _jack_level(path)
            if with_jack:
                if senses or orifice:
                    _other_jack_tick(
                        count, end, orifice, senses, tick, levels[k], state, path, coefficients
                    )
                else:
                    _jack_tick(count, end, tick, levels[k], state, path, coefficients)
            if weight[PRESSURE_ROW, k] != 0.0 and math.isfinite(pressure[k]):
                sampled_pressures(end, senses or orifice, state, path, coefficients)
                _add_residual(
                    end, pressure[k], weight[PRESSURE_ROW, k], cap, ROWS.pressure_sampled,
                    PRESSURE_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, PRESSURE_ROW, k] = sample[i]
            if located and math.isfinite(position[k]):
                sampled_positions(end, state, coefficients)
                if weight[POSITION_ROW, k] != 0.0:
                    _add_residual(
                        end, position[k], weight[POSITION_ROW, k], cap, ROWS.position_sampled,
                        POSITION_ROW,
                        state, coefficients, sample, sums,
                    )  # fmt: skip
                    for i in range(wanted):
                        out[i, POSITION_ROW, k] = sample[i]
                if follow != 0.0:
                    anchor_jack_lanes(end, position[k], follow, state, coefficients)
            if anchored and seen:
                anchor_spool_lanes(end, read, spool[k], gain, small, large, state, coefficients)


@kernel
def _run_blocks(
    batch: Batch,
    candidates: Array3,
    cap: float,
    work: LaneScratch,
    costs: Array,
    anchored: NDArray[np.int64],
    residuals: Array3,
) -> None:
    """Run the candidates LANES at a time; out are costs, counts and residuals of all or of none."""
    n = candidates.shape[0]
    for first in range(0, n, LANES):
        here = min(LANES, n - first)
        _block(batch, candidates[first : first + here], cap, work, residuals[first : first + here])
        for i in range(min(here, costs.shape[0] - first)):
            costs[first + i] = work.sums[i]
        for i in range(min(here, anchored.shape[0] - first)):
            anchored[first + i] = int(work.state[ROWS.anchor_count * LANES + i])


def block_costs(batch: Batch, candidates: Array, cap: float, work: LaneScratch, out: Array) -> None:
    """Summed squared weighted residuals of each candidate, each square at most `cap`: out, (n,).

    `candidates` has shape (n, tests, PLANT_FIELDS). Blocks of LANES candidates run at once.
    """
    _run_blocks(batch, candidates, cap, work, out, work.uncounted, work.no_residuals)


def block_residuals(
    batch: Batch, candidates: Array, work: LaneScratch, out: Array, anchored: NDArray[np.int64]
) -> None:
    """Weighted residuals, measured less modelled, of every candidate: out, shape (n, signals, N).

    `candidates` has shape (n, tests, PLANT_FIELDS). A missing sample gives 0.
    anchored: out, how often the model was re-anchored, shape (n,).
    """
    out[:] = 0.0
    _run_blocks(batch, candidates, math.inf, work, work.no_costs, anchored, out)
