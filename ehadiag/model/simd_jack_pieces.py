"""Jacks of a block of candidates over pieces of the spool's path, with stops and starts."""

from __future__ import annotations

import math

from ehadiag.compile.jit import Array, bare_kernel, inlined
from ehadiag.compile.vector import (
    LANES,
    VECTOR_WIDTH,
    Mask,
    Vector,
    absolute,
    any_lane,
    large_packed,
    load,
    maximum,
    minimum,
    packed,
    store,
    store_where,
    where,
)
from ehadiag.model.jack import JACK_STEPS
from ehadiag.model.laws import JackLaw, excess_force, stage_resistance
from ehadiag.model.second_stage import jack_piece, land_opening_piece
from ehadiag.model.sensors import (
    RADAU,
    JackState,
    PathPiece,
    PressureProbe,
    has_sensor_dynamics,
    position_on_piece,
    radau_velocity,
)
from ehadiag.model.simd_layout import (
    LANE_NODES,
    LANE_PATH,
    LANE_PATH_SLOPE,
    ROWS,
    jack_law_of_lane,
    jack_laws,
    max_lane_pieces,
    sensor_law_of_lane,
    sensor_laws,
)


@inlined
def lane_jack(state: Array, i: int) -> JackState:
    """Jack of lane `i`."""
    return JackState(
        state[ROWS.jack * LANES + i],
        state[ROWS.jack_velocity * LANES + i],
        state[ROWS.jack_direction * LANES + i],
        state[ROWS.fresh * LANES + i],
        state[ROWS.pressure * LANES + i],
        state[ROWS.pressure_lagged * LANES + i],
        state[ROWS.pressure_sampled * LANES + i],
    )


@inlined
def keep_lane_jack(jack: JackState, state: Array, i: int) -> None:
    """Write the jack of lane `i`."""
    state[ROWS.jack * LANES + i] = jack.place
    state[ROWS.jack_velocity * LANES + i] = jack.velocity
    state[ROWS.jack_direction * LANES + i] = jack.direction
    state[ROWS.fresh * LANES + i] = jack.fresh
    state[ROWS.pressure * LANES + i] = jack.pressure
    state[ROWS.pressure_lagged * LANES + i] = jack.lagged
    state[ROWS.pressure_sampled * LANES + i] = jack.seen


@bare_kernel
def jack_events(
    count: int, level: int, step: int, tick: float, state: Array, path: Array, coefficients: Array
) -> None:
    """Jack of busy lanes, of the first `count`, over one of the 2^level steps of a tick.

    Piece by piece of the spool's path.
    """
    span, steps = tick / LANE_NODES, 1 << level
    begin, stop = step * LANE_NODES / steps, (step + 1) * LANE_NODES / steps
    first, last = int(begin), math.ceil(stop)
    for i in range(count):
        if state[ROWS.busy * LANES + i] == 0.0:
            continue
        j, jack = jack_law_of_lane(coefficients, i), lane_jack(state, i)
        sensor = sensor_law_of_lane(coefficients, i)
        due, senses = tick - min(sensor.lead, tick), has_sensor_dynamics(sensor)
        for n in range(first, last):
            a, b = n * LANES + i, (n + 1) * LANES + i
            rise0, rise1 = (
                span * path[LANE_PATH_SLOPE * LANES + a],
                span * path[LANE_PATH_SLOPE * LANES + b],
            )
            piece = PathPiece(span, path[a], path[b], rise0, rise1)
            probe = PressureProbe(sensor.lag, due - n * span)
            jack = jack_piece(
                j, probe, senses, piece, max(begin - n, 0.0), min(stop - n, 1.0), jack
            )
        keep_lane_jack(jack, state, i)


PIECE_NUMBERS = 4 * VECTOR_WIDTH
"""Numbers of a piece, VECTOR_WIDTH lanes each: duration (s; 0 in a lane that has no such piece),
place at the end, velocities at start and end."""
SINGLE_LANE_FLAGS = max_lane_pieces(VECTOR_WIDTH) * PIECE_NUMBERS
"""Behind them: not 0 in lanes that go alone."""


@large_packed
def jack_over_pieces(
    o: int,
    these: Vector,
    count: int,
    tick: float,
    state: Array,
    path: Array,
    coefficients: Array,
    pieces: Array,
) -> None:
    """Jack over a tick, by `count` pieces, of the lanes from `o` in which `these` is not 0.

    After a start or a stop it takes some steps a piece. A lane in which it starts or stops within a
    piece goes over that alone, and one whose second stage, lands or sensor are not the plain ones
    over all of them.
    """
    j, law = jack_laws(coefficients, o), sensor_laws(coefficients, o)
    place, velocity = (
        load(state, ROWS.jack * LANES + o),
        load(state, ROWS.jack_velocity * LANES + o),
    )
    d, fresh = load(state, ROWS.jack_direction * LANES + o), load(state, ROWS.fresh * LANES + o)
    plain = (j.oil == 0.0) & (j.extra == 0.0) & (j.shaped == 0.0) & (law.lag + law.lead == 0.0)
    plain = plain & (these != 0.0)
    if any_lane((these != 0.0) & ~plain):
        store(pieces, SINGLE_LANE_FLAGS, where(plain, 0.0, these))
        _single_lanes(o, 0, count, tick, state, path, coefficients, pieces)
    x0 = load(path, LANE_PATH * LANES + o)
    for n in range(count):
        k = n * PIECE_NUMBERS
        span, x1 = load(pieces, k), load(pieces, k + VECTOR_WIDTH)
        here = plain & (span > 0.0)
        if any_lane(here):
            hold = j.spring * place
            up, down = excess_force(j, x1, hold + j.static), excess_force(j, x1, hold - j.static)
            rests = here & (d == 0.0) & (up <= 0.0) & (down >= 0.0)
            slides = here & (d != 0.0)
            if any_lane(slides):
                piece = PathPiece(
                    span, x0, x1, load(pieces, k + 2 * VECTOR_WIDTH) * span,
                    load(pieces, k + 3 * VECTOR_WIDTH) * span,
                )  # fmt: skip
                near = where(x0 * x1 > 0.0, minimum(absolute(x0), absolute(x1)), 0.0)
                fine = maximum(near * JACK_STEPS.travel_share, JACK_STEPS.travel)
                many = slides & ((fresh != 0.0) | (absolute(x1 - x0) >= fine))
                slides = slides & ~many
                if any_lane(many):
                    rate = (j.area / stage_resistance(j, near) + j.viscosity) * j.by_mass
                    wanted = absolute(x1 - x0) / fine
                    decay = where(fresh != 0.0, span * rate * (1.0 / JACK_STEPS.decay), 0.0)
                    many, place, velocity = _in_steps(
                        j, piece, many, maximum(wanted, decay), d, place, velocity
                    )
                xa, xb = position_on_piece(piece, RADAU.c1), position_on_piece(piece, RADAU.c2)
                later = radau_velocity(
                    j, span, j.load + hold + d * j.friction, velocity, xa, xb, x1,
                    stage_resistance(j, xa), stage_resistance(j, xb), stage_resistance(j, x1),
                )  # fmt: skip
                moved = place + 0.5 * span * (velocity + later)
                slides = slides & (later * d > 0.0) & (absolute(moved) < j.stroke)
                place, velocity = where(slides, moved, place), where(slides, later, velocity)
                slides = slides | many
            alone = here & ~rests & ~slides
            fresh = where(rests | slides, 0.0, fresh)
            if any_lane(alone):
                _keep(o, plain, place, velocity, d, fresh, state)
                store(pieces, SINGLE_LANE_FLAGS, where(alone, 1.0, 0.0))
                _single_lanes(o, n, n + 1, tick, state, path, coefficients, pieces)
                place = load(state, ROWS.jack * LANES + o)
                velocity = load(state, ROWS.jack_velocity * LANES + o)
                d, fresh = (
                    load(state, ROWS.jack_direction * LANES + o),
                    load(state, ROWS.fresh * LANES + o),
                )
            x0 = where(span > 0.0, x1, x0)
    _keep(o, plain, place, velocity, d, fresh, state)
    store(
        state, ROWS.done * LANES + o, where(these != 0.0, 1.0, load(state, ROWS.done * LANES + o))
    )


@packed
def _in_steps(
    j: JackLaw, piece: PathPiece, these: Mask, wanted: Vector, d: Vector, place: Vector,
    velocity: Vector,
) -> tuple[Mask, Vector, Vector]:  # fmt: skip
    """Sliding jack over a piece in as many steps as a lane alone would take, 1 + wanted of them.

    Returns in which of the lanes it goes on sliding, and theirs moved.
    """
    zero = d * 0.0
    count, most_steps = zero + 1.0, 1
    while most_steps < JACK_STEPS.most and any_lane(these & (wanted >= most_steps * 1.0)):
        count = where(wanted >= most_steps * 1.0, count + 1.0, count)
        most_steps += 1
    begin, at, speed, by_count = zero, place, velocity, (zero + 1.0) / count
    for step in range(1, most_steps + 1):
        goes = these & (count >= step * 1.0)
        end = where(count == step * 1.0, 1.0, by_count * (step * 1.0))
        width = end - begin
        xa, xb = (
            position_on_piece(piece, begin + RADAU.c1 * width),
            position_on_piece(piece, begin + RADAU.c2 * width),
        )
        xe, h = position_on_piece(piece, end), width * piece.span
        later = radau_velocity(
            j, h, j.load + j.spring * at + d * j.friction, speed, xa, xb, xe,
            stage_resistance(j, xa), stage_resistance(j, xb), stage_resistance(j, xe),
        )  # fmt: skip
        moved = at + 0.5 * h * (speed + later)
        these = these & (~goes | ((later * d > 0.0) & (absolute(moved) < j.stroke)))
        at, speed = where(goes, moved, at), where(goes, later, speed)
        begin = end
    return these, where(these, at, place), where(these, speed, velocity)


@packed
def _keep(
    o: int, mine: Mask, place: Vector, velocity: Vector, d: Vector, fresh: Vector,
    state: Array,
) -> None:  # fmt: skip
    """Write the jack of these lanes."""
    store_where(state, ROWS.jack * LANES + o, mine, place)
    store_where(state, ROWS.jack_velocity * LANES + o, mine, velocity)
    store_where(state, ROWS.jack_direction * LANES + o, mine, d)
    store_where(state, ROWS.fresh * LANES + o, mine, fresh)


@bare_kernel
def _single_lanes(
    o: int,
    first: int,
    count: int,
    tick: float,
    state: Array,
    path: Array,
    coefficients: Array,
    pieces: Array,
) -> None:
    """Jack of the lanes that go alone, one after the other, over the pieces first … count - 1."""
    for lane in range(VECTOR_WIDTH):
        if pieces[SINGLE_LANE_FLAGS + lane] == 0.0:
            continue
        i = o + lane
        j, jack = jack_law_of_lane(coefficients, i), lane_jack(state, i)
        sensor = sensor_law_of_lane(coefficients, i)
        due, senses = tick - min(sensor.lead, tick), has_sensor_dynamics(sensor)
        from_xs = path[LANE_PATH * LANES + i]
        for n in range(count):
            k = n * PIECE_NUMBERS + lane
            span, to_xs = pieces[k], pieces[k + VECTOR_WIDTH]
            if span > 0.0:
                if n >= first:
                    rise0, rise1 = (
                        pieces[k + 2 * VECTOR_WIDTH] * span,
                        pieces[k + 3 * VECTOR_WIDTH] * span,
                    )
                    piece = land_opening_piece(j, PathPiece(span, from_xs, to_xs, rise0, rise1))
                    jack = jack_piece(
                        j, PressureProbe(sensor.lag, due), senses, piece, 0.0, 1.0, jack
                    )
                due -= span
                from_xs = to_xs
        keep_lane_jack(jack, state, i)
