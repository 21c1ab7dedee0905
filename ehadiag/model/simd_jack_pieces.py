"""Jacks of a block of candidates over pieces of the spool's path, with stops and starts."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ehadiag.compile.jit import Array
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
from ehadiag.model.laws import JackLaw, excess_force, stage_pressure, stage_resistance
from ehadiag.model.second_stage import (
    ORIFICE_STEPS,
    driving_force,
    land_opening_piece,
    oil_at,
    orifice_rate,
    stepped_jack,
)
from ehadiag.model.sensors import (
    RADAU,
    PathPiece,
    SensorLaw,
    cubic_through_ends,
    cubic_through_stages,
    position_on_piece,
    radau_creep_pressures,
    radau_pressures,
    radau_velocity,
    sample_pressure,
)
from ehadiag.model.simd_layout import (
    LANE_NODES,
    LANE_PATH,
    LANE_PATH_SLOPE,
    ROWS,
    jack_laws,
    max_path_pieces,
    sensor_laws,
)


class JackSteps(NamedTuple):
    """Steps of a jack with a linear second stage over a piece."""

    travel: float = 3.0e-6
    """Spool travel within a step, m."""
    travel_share: float = 0.3
    """Spool travel within a step, as a share of its distance from the middle, 1."""
    decay: float = 3.0
    """Decay of the jack's velocity within a step where it starts or stops, as a power of e, 1."""
    creep_limit: float = 10.0
    """Velocity at which a jack no longer creeps, in Stribeck velocities."""
    fade: float = 0.5
    """Change of a creeping velocity within a step, in Stribeck velocities."""
    most: int = 32
    """Largest number of steps of a piece, 1."""
    iterations: int = 30
    """Largest number of iterations for a stop or a start, 1."""
    least_share: float = 1e-6
    """Share of a piece that is neglected, 1."""
    force_tolerance: float = 1e-9
    """Share of the holding force that is no excess, 1."""
    least_rate: float = 1e-30
    """Rate that is none, 1/m: not to divide by 0, nor beyond numbers of single precision."""
    least_velocity: float = 1e-12
    """Velocity that counts as none, m/s."""


JACK_STEPS = JackSteps()


@packed
def jacks(state: Array, o: int) -> tuple[Vector, Vector, Vector, Vector]:
    """Place, velocity, direction, and whether it has just started or stopped, lanes from `o`."""
    return (
        load(state, ROWS.jack * LANES + o),
        load(state, ROWS.jack_velocity * LANES + o),
        load(state, ROWS.jack_direction * LANES + o),
        load(state, ROWS.fresh * LANES + o),
    )


@packed
def keep_jacks(
    o: int, mine: Mask, place: Vector, velocity: Vector, d: Vector, fresh: Vector,
    state: Array,
) -> None:  # fmt: skip
    """Write the jack of these lanes."""
    store_where(state, ROWS.jack * LANES + o, mine, place)
    store_where(state, ROWS.jack_velocity * LANES + o, mine, velocity)
    store_where(state, ROWS.jack_direction * LANES + o, mine, d)
    store_where(state, ROWS.fresh * LANES + o, mine, fresh)


@packed
def limited_pressure(j: JackLaw, p12: Any) -> Any:
    """Pressure within what the supply allows, Pa."""
    return maximum(minimum(p12, j.supply), -j.supply)


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


def _orifice_events(senses: bool) -> Any:
    """Compiled jack behind orifices; senses: with its pressure as the filter has it."""

    @large_packed
    def events(
        o: int, these: Vector, piece: PathPiece, due: Vector, begin: float, stop: float,
        state: Array, coefficients: Array,
    ) -> None:  # fmt: skip
        j, mine = jack_laws(coefficients, o), these != 0.0
        place, velocity, d, _ = jacks(state, o)
        p12, zero = load(state, ROWS.pressure * LANES + o), d * 0.0
        one, creeps = zero + 1.0, any_lane(j.extra > 0.0)
        span = where(mine, piece.span, 1.0)
        follows = False
        if senses:
            sensor = sensor_laws(coefficients, o)
            follows = any_lane(sensor.lag + sensor.lead > 0.0)
            lagged, seen = (
                load(state, ROWS.pressure_lagged * LANES + o),
                load(state, ROWS.pressure_sampled * LANES + o),
            )
        piece = PathPiece(span, piece.x0, piece.x1, piece.rise0, piece.rise1)
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
            later, reached = driving_force(j, there, p), v
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
                there, reached = where(meets & events, copy_sign(j.stroke, way), there), v
                v = where(events & ~starts, 0.0, v)
                d = where(events, where(starts, way, 0.0), d)
            moves = goes & ~stays
            if senses and follows:
                h, oil = where(until > q, (until - q) * span, 1.0), oil_at(j, place)
                cubic = cubic_through_ends(
                    p12, p,
                    h * orifice_rate(j, position_on_piece(piece, q), p12, velocity, oil),
                    h * orifice_rate(j, position_on_piece(piece, until), p, reached, oil),
                )  # fmt: skip
                lagged, seen = sample_pressure(
                    sensor.lag, due - q * span, h, moves & (until > q), cubic, lagged, seen
                )
            place, p12 = where(moves, there, place), where(moves, p, p12)
            velocity, q = where(moves, v, velocity), where(moves, until, q)
            d = where(goes & stays, 0.0, d)
            count = where(events, count + 1.0, where(stays, ORIFICE_STEPS.events * 1.0, 0.0))
            goes = goes & (end - q >= ORIFICE_STEPS.least_share)
        keep_jacks(o, mine, place, velocity, d, zero, state)
        store_where(state, ROWS.pressure * LANES + o, mine, p12)
        if senses and follows:
            store_where(state, ROWS.pressure_lagged * LANES + o, mine, lagged)
            store_where(state, ROWS.pressure_sampled * LANES + o, mine, seen)

    return events


orifice_events, sensed_orifice_events = _orifice_events(False), _orifice_events(True)
"""The same behind orifices; both with Stribeck's friction."""


@packed
def _radau_to(
    creeps: bool, j: JackLaw, p: PathPiece, load: Vector, d: Vector, velocity: Vector,
    begin: Vector, end: Vector,
) -> Vector:  # fmt: skip
    """Velocity of the moving jacks at the share `end` of a piece, `velocity` at `begin`, m/s.

    creeps: whether friction may have Stribeck's part.
    """
    step = end - begin
    h = step * p.span
    x1 = position_on_piece(p, begin + RADAU.c1 * step)
    x2 = position_on_piece(p, begin + RADAU.c2 * step)
    x3 = position_on_piece(p, end)
    e1, e2, e3 = stage_resistance(j, x1), stage_resistance(j, x2), stage_resistance(j, x3)
    later = radau_velocity(j, h, load, velocity, x1, x2, x3, e1, e2, e3)
    if creeps:
        p3 = radau_creep_pressures(j, h, load, d, velocity, x1, x2, x3, e1, e2, e3)[2]
        later = where(j.extra > 0.0, j.flow * x3 - e3 * p3, later)
    return later


@packed
def _sensed(
    creeps: bool, j: JackLaw, sensor: SensorLaw, p: PathPiece, due: Vector, these: Mask,
    load: Vector, d: Vector, velocity: Vector, begin: Vector, end: Vector, before: Vector,
    seen: Vector,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Pressure behind the filter at the share `end` of a piece, and when it was sampled, Pa.

    Of these lanes. due: from the start of the piece to the instant of sampling, s; load, d,
    velocity: of the jacks over the step, 0 at rest; before, seen: pressures at `begin`, Pa.
    """
    step = end - begin
    these = these & (step > 0.0)
    h = where(these, step * p.span, 1.0)
    x0, x1 = position_on_piece(p, begin), position_on_piece(p, begin + RADAU.c1 * step)
    x2, x3 = position_on_piece(p, begin + RADAU.c2 * step), position_on_piece(p, end)
    p1, p2, p3 = (
        stage_pressure(j, x1, 0.0),
        stage_pressure(j, x2, 0.0),
        stage_pressure(j, x3, 0.0),
    )
    moves = these & (d != 0.0)
    if any_lane(moves):
        e1, e2, e3 = stage_resistance(j, x1), stage_resistance(j, x2), stage_resistance(j, x3)
        if creeps:
            q1, q2, q3 = radau_creep_pressures(j, h, load, d, velocity, x1, x2, x3, e1, e2, e3)
        else:
            q1, q2, q3 = radau_pressures(j, h, load, velocity, x1, x2, x3, e1, e2, e3)
        p1, p2, p3 = where(moves, q1, p1), where(moves, q2, p2), where(moves, q3, p3)
    p0 = stage_pressure(j, x0, where(moves, velocity, 0.0))
    cubic = cubic_through_stages(
        limited_pressure(j, p0), limited_pressure(j, p1),
        limited_pressure(j, p2), limited_pressure(j, p3),
    )  # fmt: skip
    return sample_pressure(sensor.lag, due - begin * p.span, h, these, cubic, before, seen)


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
    creeps: bool, j: JackLaw, p: PathPiece, load: Vector, velocity: Vector, d: Vector,
    later: Vector, begin: Vector, end: Vector, seeks: Mask,
) -> Vector:  # fmt: skip
    """Share at which jacks stop, `velocity` at `begin`, `later` at `end`; where `seeks`."""
    there, seeks = end, seeks & (velocity * d > 0.0) & (later * d < 0.0)
    b = _Bracket(begin, end, velocity * d, later * d, begin * 0.0)
    for _ in range(JACK_STEPS.iterations):
        if not any_lane(seeks):
            break
        q = _secant_share(b)
        value = _radau_to(creeps, j, p, load, d, velocity, begin, q) * d
        b = _narrowed(b, q, value)
        near = absolute(value) < JACK_STEPS.least_velocity
        there = where(seeks, where(near, q, b.high), there)
        seeks = seeks & ~near & (b.high - b.low >= JACK_STEPS.least_share)
    return there


def _linear_events(senses: bool) -> Any:
    """Compiled jack of a linear second stage; senses: with its pressure as the filter has it."""

    @large_packed
    def events(
        o: int, these: Vector, piece: PathPiece, due: Vector, begin: float, stop: float,
        state: Array, coefficients: Array,
    ) -> None:  # fmt: skip
        j, goes = jack_laws(coefficients, o), these != 0.0
        mine, creeps = goes, senses and any_lane(j.extra > 0.0)
        place, velocity, d, fresh = jacks(state, o)
        zero = d * 0.0
        one, q = zero + 1.0, zero + begin
        x0, x1 = piece.x0, piece.x1
        piece = PathPiece(where(mine, piece.span, 1.0), x0, x1, piece.rise0, piece.rise1)
        spring, x = j.spring * place, position_on_piece(piece, zero + stop)
        up, down = excess_force(j, x, spring + j.static), excess_force(j, x, spring - j.static)
        rests = goes & (d == 0.0) & (up <= 0.0) & (down >= 0.0)
        goes, follows = goes & ~rests, False
        if senses:
            sensor = sensor_laws(coefficients, o)
            follows = any_lane(sensor.lag + sensor.lead > 0.0)
            lagged, seen = (
                load(state, ROWS.pressure_lagged * LANES + o),
                load(state, ROWS.pressure_sampled * LANES + o),
            )
            if follows and any_lane(rests):
                lagged, seen = _sensed(
                    creeps, j, sensor, piece, due, rests, zero, zero, zero, q, zero + stop,
                    lagged, seen,
                )  # fmt: skip
        near = where(x0 * x1 > 0.0, minimum(absolute(x0), absolute(x1)), 0.0)
        fine = maximum(near * JACK_STEPS.travel_share, JACK_STEPS.travel)
        if creeps:
            fade = j.flow * j.by_stribeck
            short = minimum(fine, JACK_STEPS.fade / maximum(fade, JACK_STEPS.least_rate))
            fine = where((fade > 0.0) & (near * fade < JACK_STEPS.creep_limit), short, fine)
        wanted = (stop - begin) * absolute(x1 - x0) / fine
        # The collocation is slow to forget what a start or a stop leaves.
        rate = (j.area / stage_resistance(j, near) + j.viscosity) * j.by_mass
        decay = (stop - begin) * piece.span * rate * (1.0 / JACK_STEPS.decay)
        wanted = where((d != 0.0) & (fresh == 0.0), wanted, maximum(wanted, decay))
        count, most = one, 1
        while most < JACK_STEPS.most and any_lane(goes & (wanted >= most * 1.0)):
            count = where(wanted >= most * 1.0, count + 1.0, count)
            most += 1
        step, by_count, fresh = one, (stop - begin) / count, zero
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
                if senses and follows:
                    lagged, seen = _sensed(
                        creeps, j, sensor, piece, due, starts, zero, zero, zero, q, away,
                        lagged, seen,
                    )  # fmt: skip
                q, d = where(starts, away, q), where(starts, way, d)
                velocity, fresh = where(starts, 0.0, velocity), where(starts, 1.0, fresh)
            moves, there = goes & (d != 0.0), end
            stops, hold = moves & ~moves, j.load + spring + d * j.friction
            later = velocity
            if any_lane(moves):
                later = _radau_to(creeps, j, piece, hold, d, velocity, q, end)
                stops = moves & ~(later * d > 0.0)
                if any_lane(stops):
                    at = _stop_share(creeps, j, piece, hold, velocity, d, later, q, end, stops)
                    there, later = where(stops, at, end), where(stops, 0.0, later)
            if senses and follows:
                way = where(moves & ~(stops & (velocity == 0.0)), d, 0.0)
                lagged, seen = _sensed(
                    creeps, j, sensor, piece, due, goes, hold, way, velocity, q, there,
                    lagged, seen,
                )  # fmt: skip
            if any_lane(moves):
                moved = place + 0.5 * (there - q) * piece.span * (velocity + later)
                place, velocity = where(moves, moved, place), where(moves, later, velocity)
                meets = moves & (absolute(place) >= j.stroke) & (place * velocity > 0.0)
                place = where(meets, copy_sign(j.stroke, place), place)
                velocity, fresh = where(meets, 0.0, velocity), where(stops, 1.0, fresh)
                d = where(stops | meets, 0.0, d)
            ends = ~stops | (end - there < JACK_STEPS.least_share)
            q, step = where(ends, end, there), where(ends, step + 1.0, step)
            goes = goes & (step <= count)
        keep_jacks(o, mine, place, velocity, d, fresh, state)
        if senses and follows:
            store_where(state, ROWS.pressure_lagged * LANES + o, mine, lagged)
            store_where(state, ROWS.pressure_sampled * LANES + o, mine, seen)

    return events


linear_events, sensed_linear_events = _linear_events(False), _linear_events(True)
"""Compiled: jacks of a linear second stage over the shares begin … stop of a piece of the spool's
path, with stops and starts, of the lanes from `o` in which `these` is not 0; the second one with
Stribeck's friction and their pressure as the filter has it. due: from the start of the piece to the
instant of sampling, s."""


def _step_events(events: Any) -> Any:
    """Compiled jack over one of the 2^level steps of a tick, by the pieces of the path in it."""

    @packed
    def step_events(
        o: int, level: int, step: int, tick: float, these: Mask,
        state: Array, path: Array, coefficients: Array,
    ) -> None:  # fmt: skip
        steps, span = 1 << level, tick / LANE_NODES
        lead = sensor_laws(coefficients, o).lead
        due = tick - minimum(lead, tick)
        begin, stop = step * LANE_NODES / steps, (step + 1) * LANE_NODES / steps
        for n in range(int(begin), math.ceil(stop)):
            a = n * LANES + o
            slope = LANE_PATH_SLOPE * LANES + a
            piece = PathPiece(
                lead * 0.0 + span, load(path, a), load(path, a + LANES),
                span * load(path, slope), span * load(path, slope + LANES),
            )  # fmt: skip
            events(
                o, where(these, 1.0, 0.0), piece, due - n * span,
                max(begin - n, 0.0), min(stop - n, 1.0), state, coefficients,
            )  # fmt: skip

    return step_events


linear_step_events, sensed_linear_step_events = (
    _step_events(linear_events),
    _step_events(sensed_linear_events),
)
orifice_step_events, sensed_orifice_step_events = (
    _step_events(orifice_events),
    _step_events(sensed_orifice_events),
)
"""Compiled: jacks of these lanes from `o` over one of the 2^level steps of a tick."""
PIECE_NUMBERS = 4 * VECTOR_WIDTH
"""Numbers of a piece, VECTOR_WIDTH lanes each: duration (s; 0 in a lane that has no such piece),
place at the end, velocities at start and end."""
LANE_FLAGS = max_path_pieces(VECTOR_WIDTH) * PIECE_NUMBERS
"""Behind them: not 0 in lanes whose jack is to go over them."""


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
    """Jack over a tick, by `count` pieces, of the lanes from `o` in which `these` is not 0."""
    j, sensor, mine = jack_laws(coefficients, o), sensor_laws(coefficients, o), these != 0.0
    orifice, linear = mine & (j.oil > 0.0), mine & (j.oil == 0.0)
    shaped = any_lane(j.shaped != 0.0)
    senses = any_lane(mine & (sensor.lag + sensor.lead + j.extra > 0.0))
    x0, due = load(path, LANE_PATH * LANES + o), tick - minimum(sensor.lead, tick)
    for n in range(count):
        k = n * PIECE_NUMBERS
        span, x1 = load(pieces, k), load(pieces, k + VECTOR_WIDTH)
        rise0 = load(pieces, k + 2 * VECTOR_WIDTH) * span
        rise1 = load(pieces, k + 3 * VECTOR_WIDTH) * span
        piece = PathPiece(span, x0, x1, rise0, rise1)
        if shaped:
            piece = land_opening_piece(j, piece)
        flags = where(orifice & (span > 0.0), 1.0, 0.0)
        if any_lane(flags != 0.0):
            if senses:
                sensed_orifice_events(o, flags, piece, due, 0.0, 1.0, state, coefficients)
            else:
                orifice_events(o, flags, piece, due, 0.0, 1.0, state, coefficients)
        flags = where(linear & (span > 0.0), 1.0, 0.0)
        if any_lane(flags != 0.0):
            if senses:
                sensed_linear_events(o, flags, piece, due, 0.0, 1.0, state, coefficients)
            else:
                linear_events(o, flags, piece, due, 0.0, 1.0, state, coefficients)
        x0, due = where(span > 0.0, x1, x0), due - span
    store(state, ROWS.done * LANES + o, where(mine, 1.0, load(state, ROWS.done * LANES + o)))
