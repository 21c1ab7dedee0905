"""Jacks of a block of candidates over pieces of the spool's path, with stops and starts."""

from __future__ import annotations

import math
from typing import NamedTuple

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


@packed
def jacks(state: Array, o: int) -> tuple[Vector, Vector, Vector, Vector]:
    """Place, velocity, direction, and whether it has just started or stopped, lanes from `o`."""
    return (
        load(state, ROWS.jack * LANES + o),
        load(state, ROWS.jack_velocity * LANES + o),
        load(state, ROWS.jack_direction * LANES + o),
        load(state, ROWS.fresh * LANES + o),
    )


@bare_kernel
def jack_events(
    begin_lane: int, end_lane: int, level: int, step: int, tick: float,
    state: Array, path: Array, coefficients: Array,
) -> None:  # fmt: skip
    """Jack of busy lanes, each alone, over one of the 2^level steps of a tick, piece by piece.

    begin_lane, end_lane: the first of them, and the one behind the last.
    """
    span, steps = tick / LANE_NODES, 1 << level
    begin, stop = step * LANE_NODES / steps, (step + 1) * LANE_NODES / steps
    first, last = int(begin), math.ceil(stop)
    for i in range(begin_lane, end_lane):
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


@packed
def linear_step_events(
    o: int, level: int, step: int, tick: float, these: Mask,
    state: Array, path: Array, coefficients: Array,
) -> None:  # fmt: skip
    """Jack of these lanes from `o` over one of the 2^level steps of a tick, piece by piece."""
    steps = 1 << level
    begin, stop = step * LANE_NODES / steps, (step + 1) * LANE_NODES / steps
    for n in range(int(begin), math.ceil(stop)):
        span, a = tick / LANE_NODES, n * LANES + o
        slope = LANE_PATH_SLOPE * LANES + a
        linear_events(
            o, where(these, 1.0, 0.0), load(path, a) * 0.0 + span,
            load(path, a), load(path, a + LANES),
            span * load(path, slope), span * load(path, slope + LANES),
            max(begin - n, 0.0), min(stop - n, 1.0), state, coefficients,
        )  # fmt: skip


class _Bracket(NamedTuple):
    """Shares of a piece about a root, and what falls through 0 there: positive at `low`."""

    low: Vector
    high: Vector
    at_low: Vector
    at_high: Vector
    side: Vector
    """Of the last share that was tried: 1 before the root, -1 behind, 0 at first."""


@packed
def _secant_share(b: _Bracket) -> Vector:
    """Share to try next."""
    drop = minimum(b.at_high - b.at_low, -JACK_STEPS.least_rate)
    return b.high - (b.high - b.low) * b.at_high / drop


@packed
def _narrowed(b: _Bracket, q: Vector, value: Vector) -> _Bracket:
    """The bracket less what is beyond a share (regula falsi, Illinois)."""
    before = value > 0.0
    return _Bracket(
        where(before, q, b.low),
        where(before, b.high, q),
        where(before, value, where(b.side < 0.0, 0.5 * b.at_low, b.at_low)),
        where(before, where(b.side > 0.0, 0.5 * b.at_high, b.at_high), value),
        where(before, 1.0, -1.0),
    )


CROSSING_ROUNDS = 10
"""Rounds for the root of a cubic, 1: from each side to 1e-9 of a step."""


@packed
def _crossing(g0: Vector, g1: Vector, s0: Vector, s1: Vector) -> Vector:
    """Share of a step at which a cubic with ends g0 > 0 >= g1 and slopes s0, s1 is 0."""
    b = _Bracket(g0 * 0.0, g0 * 0.0 + 1.0, g0, g1, g0 * 0.0)
    for _ in range(CROSSING_ROUNDS):
        q = _secant_share(b)
        r = 1.0 - q
        value = g0 + q * q * (3.0 - 2.0 * q) * (g1 - g0) + q * r * (r * s0 - q * s1)
        b = _narrowed(b, q, value)
    return b.high


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


@packed
def _radau_to(
    j: JackLaw, p: PathPiece, load: Vector, velocity: Vector, begin: Vector, end: Vector
) -> Vector:
    """Velocity of the moving jacks at the share `end` of a piece, `velocity` at `begin`, m/s."""
    step = end - begin
    x1 = position_on_piece(p, begin + RADAU.c1 * step)
    x2 = position_on_piece(p, begin + RADAU.c2 * step)
    x3 = position_on_piece(p, end)
    return radau_velocity(
        j, step * p.span, load, velocity, x1, x2, x3,
        stage_resistance(j, x1), stage_resistance(j, x2), stage_resistance(j, x3),
    )  # fmt: skip


@packed
def _break_away_share(
    j: JackLaw, p: PathPiece, hold: Vector, way: Vector, begin: Vector, end: Vector, seeks: Mask
) -> Vector:
    """Share at which the force on resting jacks exceeds `hold` (N, signed) along `way`.

    It does so at `end`, where `seeks`.
    """
    at_begin = -way * excess_force(j, position_on_piece(p, begin), hold)
    at_end = -way * excess_force(j, position_on_piece(p, end), hold)
    there, seeks = begin, seeks & (at_begin > 0.0)
    b = _Bracket(begin, end, at_begin, at_end, begin * 0.0)
    for _ in range(JACK_STEPS.iterations):
        if not any_lane(seeks):
            break
        q = _secant_share(b)
        x = position_on_piece(p, q)
        value = -way * excess_force(j, x, hold)
        b = _narrowed(b, q, value)
        limit = JACK_STEPS.force_tolerance * absolute(hold) * stage_resistance(j, x)
        near = absolute(value) <= limit
        # Not `high`: where the path is straight the first share is the root, from either side.
        there = where(seeks, where(near, q, b.high), there)
        seeks = seeks & ~near & (b.high - b.low >= JACK_STEPS.least_share)
    return there


@packed
def _stop_share(
    j: JackLaw, p: PathPiece, load: Vector, velocity: Vector, d: Vector, later: Vector,
    begin: Vector, end: Vector, seeks: Mask,
) -> Vector:  # fmt: skip
    """Share at which jacks stop, `velocity` at `begin`, `later` at `end`; where `seeks`."""
    there, seeks = end, seeks & (velocity * d > 0.0) & (later * d < 0.0)
    b = _Bracket(begin, end, velocity * d, later * d, begin * 0.0)
    for _ in range(JACK_STEPS.iterations):
        if not any_lane(seeks):
            break
        q = _secant_share(b)
        value = _radau_to(j, p, load, velocity, begin, q) * d
        b = _narrowed(b, q, value)
        near = absolute(value) < JACK_STEPS.least_velocity
        there = where(seeks, where(near, q, b.high), there)
        seeks = seeks & ~near & (b.high - b.low >= JACK_STEPS.least_share)
    return there


@large_packed
def linear_events(
    o: int, these: Vector, span: Vector, x0: Vector, x1: Vector, rise0: Vector, rise1: Vector,
    begin: float, stop: float, state: Array, coefficients: Array,
) -> None:  # fmt: skip
    """Jack of a linear second stage over the shares begin … stop of a piece, with stops and starts.

    Of the lanes from `o` in which `these` is not 0; the other numbers are those of a `PathPiece`.
    """
    j, goes = jack_laws(coefficients, o), these != 0.0
    mine = goes
    place, velocity, d, fresh = jacks(state, o)
    zero = d * 0.0
    one = zero + 1.0
    piece = PathPiece(where(mine, span, 1.0), x0, x1, rise0, rise1)
    spring, x = j.spring * place, position_on_piece(piece, zero + stop)
    up, down = excess_force(j, x, spring + j.static), excess_force(j, x, spring - j.static)
    goes = goes & ~((d == 0.0) & (up <= 0.0) & (down >= 0.0))
    near = where(x0 * x1 > 0.0, minimum(absolute(x0), absolute(x1)), 0.0)
    fine = maximum(near * JACK_STEPS.travel_share, JACK_STEPS.travel)
    wanted = (stop - begin) * absolute(x1 - x0) / fine
    # The collocation is slow to forget what a start or a stop leaves.
    rate = (j.area / stage_resistance(j, near) + j.viscosity) * j.by_mass
    decay = (stop - begin) * piece.span * rate * (1.0 / JACK_STEPS.decay)
    wanted = where((d != 0.0) & (fresh == 0.0), wanted, maximum(wanted, decay))
    count, most = one, 1
    while most < JACK_STEPS.most and any_lane(goes & (wanted >= most * 1.0)):
        count = where(wanted >= most * 1.0, count + 1.0, count)
        most += 1
    q, step, by_count, fresh = zero + begin, one, (stop - begin) / count, zero
    while any_lane(goes):
        end = where(step == count, stop, begin + by_count * step)
        spring, x = j.spring * place, position_on_piece(piece, end)
        up, down = excess_force(j, x, spring + j.static), excess_force(j, x, spring - j.static)
        stays = ((up <= 0.0) & (down >= 0.0)) | (
            (absolute(place) >= j.stroke) & (place * (up + down) > 0.0)
        )
        starts = goes & (d == 0.0) & ~stays
        if any_lane(starts):
            way = where(up > 0.0, one, -one)
            away = _break_away_share(j, piece, spring + j.static * way, way, q, end, starts)
            q, d = where(starts, away, q), where(starts, way, d)
            velocity, fresh = where(starts, 0.0, velocity), where(starts, 1.0, fresh)
        moves, there = goes & (d != 0.0), end
        stops = moves & ~moves
        if any_lane(moves):
            hold = j.load + spring + d * j.friction
            later = _radau_to(j, piece, hold, velocity, q, end)
            stops = moves & ~(later * d > 0.0)
            if any_lane(stops):
                at = _stop_share(j, piece, hold, velocity, d, later, q, end, stops)
                there, later = where(stops, at, end), where(stops, 0.0, later)
            moved = place + 0.5 * (there - q) * piece.span * (velocity + later)
            place, velocity = where(moves, moved, place), where(moves, later, velocity)
            meets = moves & (absolute(place) >= j.stroke) & (place * velocity > 0.0)
            place = where(meets, copy_sign(j.stroke, place), place)
            velocity, fresh = where(meets, 0.0, velocity), where(stops, 1.0, fresh)
            d = where(stops | meets, 0.0, d)
        ends = ~stops | (end - there < JACK_STEPS.least_share)
        q, step = where(ends, end, there), where(ends, step + 1.0, step)
        goes = goes & (step <= count)
    _keep(o, mine, place, velocity, d, fresh, state)


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

    A lane whose second stage, lands or sensor are not the plain ones goes over them alone.
    """
    j, law = jack_laws(coefficients, o), sensor_laws(coefficients, o)
    plain = (j.shaped == 0.0) & (law.lag + law.lead == 0.0) & (these != 0.0)
    orifice = plain & (j.oil > 0.0)
    plain = plain & (j.oil == 0.0) & (j.extra == 0.0)
    if any_lane((these != 0.0) & ~plain & ~orifice):
        store(pieces, SINGLE_LANE_FLAGS, where(plain | orifice, 0.0, these))
        _single_lanes(o, count, tick, state, path, coefficients, pieces)
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
            linear_events(
                o, where(here, 1.0, 0.0), span, x0, x1,
                load(pieces, k + 2 * VECTOR_WIDTH) * span,
                load(pieces, k + 3 * VECTOR_WIDTH) * span, 0.0, 1.0, state, coefficients,
            )  # fmt: skip
        x0 = where(span > 0.0, x1, x0)
    store(
        state, ROWS.done * LANES + o, where(these != 0.0, 1.0, load(state, ROWS.done * LANES + o))
    )


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
    count: int,
    tick: float,
    state: Array,
    path: Array,
    coefficients: Array,
    pieces: Array,
) -> None:
    """Jack of the lanes that go alone, one after the other, over the first `count` pieces."""
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
                rise0 = pieces[k + 2 * VECTOR_WIDTH] * span
                rise1 = pieces[k + 3 * VECTOR_WIDTH] * span
                piece = land_opening_piece(j, PathPiece(span, from_xs, to_xs, rise0, rise1))
                jack = jack_piece(j, PressureProbe(sensor.lag, due), senses, piece, 0.0, 1.0, jack)
                due -= span
                from_xs = to_xs
        keep_lane_jack(jack, state, i)
