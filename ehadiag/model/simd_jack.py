"""Second stage and jack of a block of candidates over a step, one lane each.

One step of the linear second stage or of the one of orifices for all lanes; those whose jack
stops, starts or meets its stop take that step by finer ones (`ehadiag.model.simd_jack_pieces`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ehadiag.compile.elementary import LN2
from ehadiag.compile.jit import Array, Array2, bare_kernel, inlined, kernel
from ehadiag.compile.vector import (
    LANES,
    VECTOR_WIDTH,
    Mask,
    Vector,
    absolute,
    any_lane,
    load,
    maximum,
    minimum,
    packed,
    store,
    where,
)
from ehadiag.model.laws import (
    JackLaw,
    effective_opening,
    jack_law,
    plant_of,
    stage_pressure,
    stage_resistance,
)
from ehadiag.model.second_stage import (
    ORIFICE_STEPS,
    land_opening,
    land_opening_slope,
    oil_at,
    orifice_rate,
    orifice_step,
)
from ehadiag.model.sensors import (
    RADAU,
    cubic_through_ends,
    cubic_through_stages,
    filter_output,
    radau_creep_pressures,
    radau_pressures,
    radau_velocity,
    read_pressure,
    sensor_law,
)
from ehadiag.model.simd_jack_pieces import (
    JACK_STEPS,
    jack_over_pieces,
    jacks,
    limited_pressure,
    linear_step_events,
    orifice_step_events,
    sensed_linear_step_events,
    sensed_orifice_step_events,
)
from ehadiag.model.simd_layout import (
    BLOCK,
    COEFFICIENTS,
    LANE_FILTER_ROWS,
    LANE_NODES,
    LANE_PATH,
    LANE_PATH_SLOPE,
    MAX_JACK_HALVINGS,
    ROWS,
    aligned_numbers,
    block_part,
    full_filter_steps,
    jack_law_of_lane,
    jack_laws,
    keep_jack_law,
    keep_sensor_law,
    sampled_filter_steps,
    sensor_laws,
)


class LaneSteps(NamedTuple):
    """Steps of the jack of a block; a lane with a larger one takes finer ones."""

    travel: float = 8.0e-6
    """Spool travel from first to last stage of a step, m; further from the middle, its distance."""
    corner_travel: float = 4.0e-6
    """Spool travel of a step past the opening at which the pressure gain saturates, m."""
    orifice_halvings: int = 2
    """Least halvings of a tick with orifices, 1: nodes of the spool's path are then ends of
    steps."""
    ringing: float = 2.0 * ORIFICE_STEPS.ringing
    """Step in radians of the ringing, 1."""


LANE_STEPS = LaneSteps()


def _stages() -> Array:
    """Where stages, start and middle of steps stand on the spool's path, shape (5, 16, 5, 5), flat.

    For a tick cut into 1, 2, 4, 8 or 16 steps, and each step: the node before, and Hermite's
    weights of place before and after and of slope (by the length of the tick) before and after.
    """
    out = np.zeros((MAX_JACK_HALVINGS + 1, 1 << MAX_JACK_HALVINGS, 5, 5))
    for level in range(MAX_JACK_HALVINGS + 1):
        for step in range(1 << level):
            for stage, share in enumerate((RADAU.c1, RADAU.c2, 1.0, 0.0, 0.5)):
                where = (step + share) / (1 << level) * LANE_NODES
                node = min(int(where), LANE_NODES - 1)
                u = where - node
                out[level, step, stage] = (
                    node,
                    (1.0 + 2.0 * u) * (1.0 - u) ** 2,
                    u * u * (3.0 - 2.0 * u),
                    u * (1.0 - u) ** 2 / LANE_NODES,
                    u * u * (u - 1.0) / LANE_NODES,
                )
    return out.ravel()


STAGE_TABLE = _stages()
NODE_HALVINGS = LANE_NODES.bit_length() - 1
"""Halvings of a tick up to which its steps end at nodes of the path, 1."""


class StagePlaces(NamedTuple):
    """Places in the table of stages, of a step."""

    end: int = 10
    """First number of its end; the other stages precede it."""
    start: int = 15
    """First number of its start."""
    middle: int = 20
    """First number of its middle."""
    columns: int = 25
    """Numbers of a step."""


STAGES = StagePlaces()


@packed
def _stage(k: int) -> float:
    """Number `k` of the table of stages, without a check for places from its end."""
    return STAGE_TABLE[np.uint64(k)]


@packed
def stage_position(path: Array, o: int, k: int, tick: float) -> Vector:
    """Spool at the stage whose place in STAGES is `k`, lanes from `o`."""
    a = int(_stage(k)) * LANES + o
    b = a + LANES
    slopes = load(path, LANE_PATH_SLOPE * LANES + a) * _stage(k + 3)
    slopes = slopes + load(path, LANE_PATH_SLOPE * LANES + b) * _stage(k + 4)
    return _stage(k + 1) * load(path, a) + _stage(k + 2) * load(path, b) + tick * slopes


@packed
def land_opening_lanes(end: int, path: Array, coefficients: Array) -> None:
    """Make the spool's path of a tick that of the lands' opening, all lanes, in place."""
    for o in range(0, end, VECTOR_WIDTH):
        j = jack_laws(coefficients, o)
        for n in range(LANE_NODES + 1):
            place, slope = (LANE_PATH + n) * LANES + o, (LANE_PATH_SLOPE + n) * LANES + o
            x = load(path, place)
            store(path, slope, land_opening_slope(j, x) * load(path, slope))
            store(path, place, land_opening(j, x))


@packed
def _sense(
    j: JackLaw, these: Mask, level: int, step: int, o: int,
    p0: Vector, p1: Vector, p2: Vector, p3: Vector,
    state: Array, coefficients: Array,
) -> None:  # fmt: skip
    """Follow the pressure of these lanes through their filters, from start and stages of a step."""
    cubic = cubic_through_stages(
        limited_pressure(j, p0),
        limited_pressure(j, p1),
        limited_pressure(j, p2),
        limited_pressure(j, p3),
    )
    filter_pressure(cubic, these, level, step, o, state, coefficients)


@packed
def filter_pressure(
    cubic: Any, these: Mask, level: int, step: int, o: int,
    state: Array, coefficients: Array,
) -> None:  # fmt: skip
    """Follow the pressure of these lanes, cubics over a step, through their filters."""
    place = level * LANE_FILTER_ROWS * LANES + o
    before, seen = (
        load(state, ROWS.pressure_lagged * LANES + o),
        load(state, ROWS.pressure_sampled * LANES + o),
    )
    sampled = (
        load(coefficients, (COEFFICIENTS.filter + LANE_FILTER_ROWS - 1) * LANES + place)
        == step * 1.0
    )
    at_sampling = filter_output(sampled_filter_steps(coefficients, place), before, cubic)
    store(state, ROWS.pressure_sampled * LANES + o, where(these & sampled, at_sampling, seen))
    at_end = filter_output(full_filter_steps(coefficients, place), before, cubic)
    store(state, ROWS.pressure_lagged * LANES + o, where(these, at_end, before))


def _jack_tick(senses: bool) -> Any:
    """Compiled tick of the jack of all lanes, with or without the sensor of pressure."""
    step_events = sensed_linear_step_events if senses else linear_step_events

    @packed
    def ticks(
        end: int, tick: float, level: int, state: Array, path: Array, coefficients: Array
    ) -> None:
        h = tick / (1 << level)
        for o in range(0, end, VECTOR_WIDTH):
            j = jack_laws(coefficients, o)
            place, velocity, d, fresh = jacks(state, o)
            done = load(state, ROWS.done * LANES + o) != 0.0
            law = sensor_laws(coefficients, o)
            follows = senses and any_lane(law.lag + law.lead > 0.0)
            # From step to step in registers: what is stored in part cannot be loaded at once.
            for step in range(1 << level):
                k = ((level << MAX_JACK_HALVINGS) + step) * STAGES.columns
                if level <= NODE_HALVINGS:  # it ends at a node
                    x3 = load(path, ((step + 1) * (LANE_NODES >> level)) * LANES + o)
                else:
                    x3 = stage_position(path, o, k + STAGES.end, tick)
                e3 = stage_resistance(j, x3)
                force = j.load + j.spring * place
                rests, moves = (d == 0.0) & ~done, (d != 0.0) & ~done
                if any_lane(rests):
                    # The force of the second stage, times e, against what holds.
                    push = j.area * j.flow * x3 - force * e3
                    held = absolute(push) <= j.static * e3
                    held = held | ((absolute(place) >= j.stroke) & (place * push > 0.0))
                    rests = rests & held
                fine, place0, velocity0 = done | rests, place, velocity
                if senses and follows and any_lane(rests):
                    x0, x1, x2 = (
                        stage_position(path, o, k + STAGES.start, tick),
                        stage_position(path, o, k, tick),
                        stage_position(path, o, k + 5, tick),
                    )
                    _sense(
                        j, rests, level, step, o,
                        stage_pressure(j, x0, 0.0), stage_pressure(j, x1, 0.0),
                        stage_pressure(j, x2, 0.0), stage_pressure(j, x3, 0.0),
                        state, coefficients,
                    )  # fmt: skip
                if any_lane(moves):
                    creeps = senses and any_lane(j.extra > 0.0)
                    x1 = stage_position(path, o, k, tick)
                    x2 = stage_position(path, o, k + 5, tick)
                    e1, e2, pull = (
                        stage_resistance(j, x1),
                        stage_resistance(j, x2),
                        force + d * j.friction,
                    )
                    later = radau_velocity(j, h, pull, velocity, x1, x2, x3, e1, e2, e3)
                    if creeps:
                        p1, p2, p3 = radau_creep_pressures(
                            j, h, pull, d, velocity, x1, x2, x3, e1, e2, e3
                        )
                        later = where(j.extra > 0.0, j.flow * x3 - e3 * p3, later)
                    elif senses:
                        p1, p2, p3 = radau_pressures(j, h, pull, velocity, x1, x2, x3, e1, e2, e3)
                    moved = place + 0.5 * h * (velocity + later)
                    slides = (later * d > 0.0) & (absolute(moved) < j.stroke)
                    # What the collocation does not follow: a fresh start, a fast way past the
                    # closed orifice.
                    near = where(x1 * x3 > 0.0, minimum(absolute(x1), absolute(x3)), 0.0)
                    travel = absolute(x3 - x1)
                    coarse = travel > maximum(near, LANE_STEPS.travel)
                    coarse = coarse | (
                        (near < j.corner)
                        & (maximum(effective_opening(j, x1), effective_opening(j, x3)) > j.corner)
                        & (travel > LANE_STEPS.corner_travel)
                    )
                    if creeps:
                        fade = j.flow * j.by_stribeck
                        coarse = coarse | (
                            (near * fade < JACK_STEPS.creep_limit)
                            & (travel * fade > JACK_STEPS.fade)
                        )
                    slides = slides & ~coarse & (fresh == 0.0) & moves
                    if senses and follows and any_lane(slides):
                        p0 = stage_pressure(
                            j, stage_position(path, o, k + STAGES.start, tick), velocity
                        )
                        _sense(j, slides, level, step, o, p0, p1, p2, p3, state, coefficients)
                    fine = fine | slides
                    # Whether it slides need not be known before the next step begins.
                    place, velocity = where(moves, moved, place), where(moves, later, velocity)
                if any_lane(~fine):
                    place, velocity = where(fine, place, place0), where(fine, velocity, velocity0)
                    store(state, ROWS.jack * LANES + o, place)
                    store(state, ROWS.jack_velocity * LANES + o, velocity)
                    step_events(o, level, step, tick, ~fine, state, path, coefficients)
                    place, velocity, d, fresh = jacks(state, o)
            store(state, ROWS.jack * LANES + o, place)
            store(state, ROWS.jack_velocity * LANES + o, velocity)

    return ticks


jack_tick, sensed_jack_tick = _jack_tick(False), _jack_tick(True)
"""Compiled: jack of all lanes over a tick cut into 2^level steps; with the second one their
pressure as the filter before its converter has it."""


@packed
def sampled_pressures(end: int, kept: bool, state: Array, path: Array, coefficients: Array) -> None:
    """Differential pressure of all lanes as it is sampled in a tick, into the state.

    kept: whether any lane has it in the state, stored in the oil or behind a filter.
    """
    for o in range(0, end, VECTOR_WIDTH):
        j = jack_laws(coefficients, o)
        x = load(path, (LANE_PATH + LANE_NODES) * LANES + o)
        p12 = limited_pressure(j, stage_pressure(j, x, load(state, ROWS.jack_velocity * LANES + o)))
        if kept:
            law = sensor_laws(coefficients, o)
            p12 = where(j.oil > 0.0, load(state, ROWS.pressure * LANES + o), p12)
            p12 = where(
                law.lag + law.lead > 0.0, load(state, ROWS.pressure_sampled * LANES + o), p12
            )
        store(state, ROWS.pressure_sampled * LANES + o, p12)


@packed
def sampled_positions(end: int, state: Array, coefficients: Array) -> None:
    """Jack of all lanes as it is sampled in a tick, into the state."""
    for o in range(0, end, VECTOR_WIDTH):
        before = sensor_laws(coefficients, o).lead * load(state, ROWS.jack_velocity * LANES + o)
        store(state, ROWS.position_sampled * LANES + o, load(state, ROWS.jack * LANES + o) - before)


@packed
def anchor_jack_lanes(
    end: int, measured: float, follow: float, state: Array, coefficients: Array
) -> None:
    """Move the jack of all lanes by a share of its innovation."""
    for o in range(0, end, VECTOR_WIDTH):
        law, stroke = sensor_laws(coefficients, o), jack_laws(coefficients, o).stroke
        error = measured - law.position_offset
        error = error - law.position_gain * load(state, ROWS.position_sampled * LANES + o)
        place = load(state, ROWS.jack * LANES + o) + follow * error
        store(state, ROWS.jack * LANES + o, maximum(minimum(place, stroke), -stroke))


@packed
def rest_jack_lanes(
    end: int, origin: float, place: float, state: Array, coefficients: Array
) -> None:
    """Jack of all lanes at rest, spool and jack at these positions, m."""
    for o in range(0, end, VECTOR_WIDTH):
        j = jack_laws(coefficients, o)
        store(state, ROWS.jack * LANES + o, place)
        p12 = limited_pressure(j, stage_pressure(j, land_opening(j, j.load * 0.0 + origin), 0.0))
        store(state, ROWS.pressure_lagged * LANES + o, p12)
        store(state, ROWS.pressure * LANES + o, p12)


@inlined
def orifice_level(tick: float, coefficients: Array) -> int:
    """Halvings of a tick (s) for the lane that rings fastest."""
    fastest = 0.0
    for i in range(LANES):
        j = jack_law_of_lane(coefficients, i)
        fastest = max(fastest, math.sqrt(j.oil * j.area * j.by_mass))
    wanted = math.ceil(math.log(max(tick * fastest / ORIFICE_STEPS.ringing, 1.0)) / LN2 - 1e-9)
    return min(max(wanted, LANE_STEPS.orifice_halvings), MAX_JACK_HALVINGS)


def _orifice_lane_step(senses: bool) -> Any:
    """Compiled step of all lanes, with or without the sensor of pressure."""
    step_events = sensed_orifice_step_events if senses else orifice_step_events

    @packed
    def lanes(
        end: int, level: int, step: int, tick: float,
        state: Array, path: Array, coefficients: Array, later: Array,
    ) -> None:  # fmt: skip
        h = tick / (1 << level)
        k = ((level << MAX_JACK_HALVINGS) + step) * STAGES.columns
        # Apart from what becomes of it: a processor works on all vectors at once.
        for o in range(0, end, VECTOR_WIDTH):
            j = jack_laws(coefficients, o)
            velocity = load(state, ROWS.jack_velocity * LANES + o)
            x0 = stage_position(path, o, k + STAGES.start, tick)
            x1 = stage_position(path, o, k + STAGES.middle, tick)
            x2 = stage_position(path, o, k + STAGES.end, tick)
            closest = minimum(minimum(absolute(x0), absolute(x1)), absolute(x2))
            middle = load(state, ROWS.jack * LANES + o) + 0.5 * h * velocity
            p, v, travel = orifice_step(
                j, h, j.load + j.spring * middle, oil_at(j, middle),
                load(state, ROWS.jack_direction * LANES + o), x0, x1, x2,
                load(state, ROWS.pressure * LANES + o), velocity,
                any_lane(closest < 2.0 * j.corner), any_lane(j.extra > 0.0),
            )  # fmt: skip
            store(later, o, p)
            store(later, LANES + o, v)
            store(later, 2 * LANES + o, travel)
        for o in range(0, end, VECTOR_WIDTH):
            j = jack_laws(coefficients, o)
            place, velocity = (
                load(state, ROWS.jack * LANES + o),
                load(state, ROWS.jack_velocity * LANES + o),
            )
            d, p12 = (
                load(state, ROWS.jack_direction * LANES + o),
                load(state, ROWS.pressure * LANES + o),
            )
            p, v, travel = load(later, o), load(later, LANES + o), load(later, 2 * LANES + o)
            oil = oil_at(j, place + 0.5 * h * velocity)
            push = j.area * p - j.load - j.spring * place
            held = absolute(push) <= j.static
            held = held | ((absolute(place) >= j.stroke) & (place * push > 0.0))
            slides = (v * d > 0.0) & (absolute(place + travel) < j.stroke)
            done = load(state, ROWS.done * LANES + o) != 0.0
            goes = (((d == 0.0) & held) | slides) & ~done
            fits = oil * j.area * j.by_mass * (h * h) < LANE_STEPS.ringing * LANE_STEPS.ringing
            steep = j.extra * j.by_stribeck * j.by_mass * h > ORIFICE_STEPS.creep_growth
            slow = (
                minimum(absolute(velocity), absolute(v)) * j.by_stribeck < ORIFICE_STEPS.creep_limit
            )
            fits = fits & ~(steep & slow)
            goes = goes & fits
            events = ~(goes | done)
            law = sensor_laws(coefficients, o)
            if senses and any_lane(law.lag + law.lead > 0.0):
                x0 = stage_position(path, o, k + STAGES.start, tick)
                x2 = stage_position(path, o, k + STAGES.end, tick)
                cubic = cubic_through_ends(
                    p12, p,
                    h * orifice_rate(j, x0, p12, velocity, oil), h * orifice_rate(j, x2, p, v, oil),
                )  # fmt: skip
                filter_pressure(cubic, goes, level, step, o, state, coefficients)
            store(state, ROWS.pressure * LANES + o, where(goes, p, p12))
            store(state, ROWS.jack_velocity * LANES + o, where(goes, v, velocity))
            store(state, ROWS.jack * LANES + o, where(goes, place + travel, place))
            if any_lane(events):
                step_events(o, level, step, tick, events, state, path, coefficients)

    return lanes


def _ticks(senses: bool) -> Any:
    """Compiled tick of all lanes, with or without the sensor of pressure."""
    lanes = _orifice_lane_step(senses)

    @bare_kernel
    def ticks(
        end: int, tick: float, level: int, state: Array, path: Array, coefficients: Array,
        later: Array,
    ) -> None:  # fmt: skip
        for step in range(1 << level):
            lanes(end, level, step, tick, state, path, coefficients, later)

    return ticks


orifice_tick, sensed_orifice_tick = _ticks(False), _ticks(True)
"""Compiled: jack of all lanes over a tick cut into 2^level steps; with the second one their
pressure as the filter before its converter has it."""


def driven_jack_costs(
    candidates: Array, nodes: Array, before: float, pressure: Array, noise: float, cap: float
) -> Array:
    """Capped squared pressure residuals of candidates, from rest: shape (n,).

    candidates: rows of physical constants; nodes: the spool's path, a piece each tick: duration
    (s), position at its end (m), velocities at start and end (m/s), shape (ticks, 4 or more);
    before: position before, m; pressure: measured, Pa, NaN where missing; noise: of it, Pa.
    """
    out, memory = np.zeros(len(candidates)), aligned_numbers(BLOCK.end)
    contiguous = (np.ascontiguousarray(item) for item in (candidates, nodes, pressure))
    candidates, nodes, pressure = contiguous
    fill_driven_jack_costs(candidates, nodes, before, pressure, noise, cap, memory.ctypes.data, out)
    return out


@packed
def drive_jacks(
    address: int, end: int, tick: float, from_xs: float, to_xs: float, rate0: float, rate1: float
) -> None:
    """Jacks of a block over a tick (s) of a spool that is given: its places (m), its velocities."""
    state = block_part(address, BLOCK.state, BLOCK.path)
    path = block_part(address, BLOCK.path, BLOCK.coefficients)
    coefficients = block_part(address, BLOCK.coefficients, BLOCK.moving)
    pieces = block_part(address, BLOCK.pieces, BLOCK.scratch)
    store(pieces, 0, tick)
    store(pieces, VECTOR_WIDTH, to_xs)
    store(pieces, 2 * VECTOR_WIDTH, rate0)
    store(pieces, 3 * VECTOR_WIDTH, rate1)
    for o in range(0, end, VECTOR_WIDTH):
        j = jack_laws(coefficients, o)
        every = j.load * 0.0 + 1.0
        store(path, LANE_PATH * LANES + o, every * from_xs)
        jack_over_pieces(o, every, 1, tick, state, path, coefficients, pieces)
        store(path, (LANE_PATH + LANE_NODES) * LANES + o, land_opening(j, every * to_xs))
    sampled_pressures(end, True, state, path, coefficients)


@kernel
def fill_driven_jack_costs(
    candidates: Array2,
    nodes: Array2,
    before: float,
    pressure: Array,
    noise: float,
    cap: float,
    address: int,
    out: Array,
) -> None:
    """Write what `driven_jack_costs` returns; address: of a block's memory."""
    state = block_part(address, BLOCK.state, BLOCK.path)
    coefficients = block_part(address, BLOCK.coefficients, BLOCK.moving)
    sums = block_part(address, BLOCK.scratch, BLOCK.scratch + LANES)
    for first in range(0, candidates.shape[0], LANES):
        here = min(LANES, candidates.shape[0] - first)
        end = VECTOR_WIDTH if here <= VECTOR_WIDTH else LANES
        for i in range(LANES):
            c = plant_of(candidates[first + min(i, here - 1)])
            keep_jack_law(coefficients, i, jack_law(c))
            keep_sensor_law(coefficients, i, sensor_law(c))
        state[:] = 0.0
        sums[:] = 0.0
        rest_jack_lanes(end, before, 0.0, state, coefficients)
        from_xs = before
        for k in range(nodes.shape[0]):
            tick, to_xs = nodes[k, 0], nodes[k, 1]
            drive_jacks(address, end, tick, from_xs, to_xs, nodes[k, 2], nodes[k, 3])
            from_xs = to_xs
            if math.isfinite(pressure[k]):
                for o in range(0, end, VECTOR_WIDTH):
                    seen = load(state, ROWS.pressure_sampled * LANES + o)
                    shown = read_pressure(sensor_laws(coefficients, o), seen)
                    residual = (pressure[k] - shown) * (1.0 / noise)
                    store(sums, o, load(sums, o) + minimum(residual * residual, cap))
        for i in range(here):
            out[first + i] = sums[i]
