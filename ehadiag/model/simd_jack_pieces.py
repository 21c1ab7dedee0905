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
    copy_sign,
    lane_sqrt,
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
from ehadiag.model.second_stage import (
    ORIFICE_STEPS,
    driving_force,
    jack_piece,
    land_opening_piece,
    oil_at,
    orifice_rate,
    stepped_jack,
)
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


CROSSING_ROUNDS = 10
"""Rounds for the root of a cubic, 1: from each side to 1e-9 of a step."""


@packed
def _crossing(g0: Vector, g1: Vector, s0: Vector, s1: Vector) -> Vector:
    """Share of a step at which a cubic with ends g0 > 0 >= g1 and slopes s0, s1 is 0 (Illinois)."""
    low, high, at_low, at_high, side = g0 * 0.0, g0 * 0.0 + 1.0, g0, g1, g0 * 0.0
    for _ in range(CROSSING_ROUNDS):
        drop = minimum(at_high - at_low, -JACK_STEPS.least_rate)
        q = high - (high - low) * at_high / drop
        r = 1.0 - q
        value = g0 + q * q * (3.0 - 2.0 * q) * (g1 - g0) + q * r * (r * s0 - q * s1)
        before = value > 0.0
        at_high = where(before, where(side > 0.0, 0.5 * at_high, at_high), value)
        at_low = where(before, value, where(side < 0.0, 0.5 * at_low, at_low))
        low, high = where(before, q, low), where(before, high, q)
        side = where(before, 1.0, -1.0)
    return high


@large_packed
def orifice_events(
    o: int,
    these: Vector,
    span: Vector,
    x0: Vector,
    x1: Vector,
    rise0: Vector,
    rise1: Vector,
    begin: float,
    stop: float,
    state: Array,
    coefficients: Array,
) -> None:
    """Jack behind orifices over the shares begin … stop of a piece, with stops and starts.

    Of the lanes from `o` in which `these` is not 0; the other numbers are those of a `PathPiece`.
    """
    j, mine = jack_laws(coefficients, o), these != 0.0
    place, velocity = (
        load(state, ROWS.jack * LANES + o),
        load(state, ROWS.jack_velocity * LANES + o),
    )
    d, p12 = load(state, ROWS.jack_direction * LANES + o), load(state, ROWS.pressure * LANES + o)
    zero = d * 0.0
    one, creeps = zero + 1.0, any_lane(j.extra > 0.0)
    span = where(mine, span, 1.0)
    piece = PathPiece(span, x0, x1, rise0, rise1)
    ring = lane_sqrt(maximum(oil_at(j, place), ORIFICE_STEPS.least_share) * j.area * j.by_mass)
    usual = minimum(ORIFICE_STEPS.ringing / ring, ORIFICE_STEPS.longest_s) * (1.0 + 1e-9)
    growth = maximum(j.extra * j.by_stribeck * j.by_mass, 1.0)
    q, end, until, count, goes = zero + begin, zero + stop, zero + begin, zero, mine
    while any_lane(goes):
        longest = usual
        if creeps:
            # Friction that falls with the velocity drives the jack away.
            slow = absolute(velocity) * j.by_stribeck < ORIFICE_STEPS.creep_limit
            longest = where(slow, minimum(usual, ORIFICE_STEPS.creep_growth / growth), usual)
        left = (end - q) * span
        until = where(left > longest, q + minimum(longest, 0.5 * left) / span, end)
        push, free = driving_force(j, place, p12), count < ORIFICE_STEPS.events * 1.0
        away = (absolute(push) > j.static) & free
        away = away & ~((absolute(place) >= j.stroke) & (place * push > 0.0))
        d = where((d == 0.0) & away, copy_sign(one, push), d)
        there, p, v = stepped_jack(j, piece, d, place, p12, velocity, q, until, creeps)
        later = driving_force(j, there, p)
        starts = (d == 0.0) & (absolute(later) > j.static) & free
        starts = starts & ~((absolute(place) >= j.stroke) & (place * later > 0.0))
        stops = (d != 0.0) & (v * d <= 0.0)
        meets = (d != 0.0) & (there * d >= j.stroke) & ~stops
        # It does not get away: at rest for this step.
        stays = stops & (velocity == 0.0)
        events = (starts | (stops & ~stays) | meets) & goes
        if any_lane(events):
            way = where(d == 0.0, copy_sign(one, later), d)
            h, oil = (until - q) * span, oil_at(j, place)
            rate0 = h * orifice_rate(j, position_on_piece(piece, q), p12, velocity, oil)
            rate1 = h * orifice_rate(j, position_on_piece(piece, until), p, v, oil)
            drag, by_time = d * j.friction, h * j.by_mass * d
            slope0 = where(starts, -j.area * rate0 * way, -h * velocity * d)
            slope1 = where(starts, -j.area * rate1 * way, -h * v * d)
            slope0 = where(stops, by_time * (push - j.viscosity * velocity - drag), slope0)
            slope1 = where(stops, by_time * (later - j.viscosity * v - drag), slope1)
            off0 = where(starts, j.static - push * way, j.stroke - place * d)
            off1 = where(starts, j.static - later * way, j.stroke - there * d)
            off0, off1 = where(stops, velocity * d, off0), where(stops, v * d, off1)
            share = _crossing(
                where(events, off0, 1.0), where(events, off1, -1.0),
                where(events, slope0, -2.0), where(events, slope1, -2.0),
            )  # fmt: skip
            until = where(events, q + share * (until - q), until)
            there, p, v = stepped_jack(j, piece, d, place, p12, velocity, q, until, creeps)
            there = where(meets & events, copy_sign(j.stroke, way), there)
            v = where(events & ~starts, 0.0, v)
            d = where(events, where(starts, way, 0.0), d)
        moves = goes & ~stays
        place, p12 = where(moves, there, place), where(moves, p, p12)
        velocity, q = where(moves, v, velocity), where(moves, until, q)
        d = where(goes & stays, 0.0, d)
        count = where(events, count + 1.0, where(stays, ORIFICE_STEPS.events * 1.0, 0.0))
        goes = goes & (end - q >= ORIFICE_STEPS.least_share)
    store_where(state, ROWS.jack * LANES + o, mine, place)
    store_where(state, ROWS.jack_velocity * LANES + o, mine, velocity)
    store_where(state, ROWS.jack_direction * LANES + o, mine, d)
    store_where(state, ROWS.fresh * LANES + o, mine, zero)
    store_where(state, ROWS.pressure * LANES + o, mine, p12)


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
    plain = (j.shaped == 0.0) & (law.lag + law.lead == 0.0) & (these != 0.0)
    orifice = plain & (j.oil > 0.0)
    plain = plain & (j.oil == 0.0) & (j.extra == 0.0)
    if any_lane((these != 0.0) & ~plain & ~orifice):
        store(pieces, SINGLE_LANE_FLAGS, where(plain | orifice, 0.0, these))
        _single_lanes(o, 0, count, tick, state, path, coefficients, pieces)
    x0 = load(path, LANE_PATH * LANES + o)
    for n in range(count):
        k = n * PIECE_NUMBERS
        span, x1 = load(pieces, k), load(pieces, k + VECTOR_WIDTH)
        if any_lane(orifice & (span > 0.0)):
            orifice_events(
                o, where(orifice & (span > 0.0), 1.0, 0.0), span, x0, x1,
                load(pieces, k + 2 * VECTOR_WIDTH) * span,
                load(pieces, k + 3 * VECTOR_WIDTH) * span, 0.0, 1.0, state, coefficients,
            )  # fmt: skip
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
