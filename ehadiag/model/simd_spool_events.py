"""First stage and spool of one lane over a tick with events, and the jack with them.

For lanes that `ehadiag.model.simd_spool_halving` leaves.

The vectors that else hold candidates hold instants here: the state after 1 … VECTOR_WIDTH steps of
one length, each by a transition of its own from the same start. The first of them that lies past an
event is looked into with shorter steps, down to the finest.
"""

from __future__ import annotations

from ehadiag.compile.jit import Array, bare_kernel, inlined, merged
from ehadiag.compile.vector import (
    VECTOR_WIDTH,
    Mask,
    absolute,
    first_lane,
    load,
    maximum,
    minimum,
    packed,
    shifted_lanes,
    store,
)
from ehadiag.model.laws import (
    SpoolLaw,
    clamped_spool_velocity,
    flapper_rest,
    play_output,
    spool_rest_position,
)
from ehadiag.model.scalar_spool import TICK_UNITS
from ehadiag.model.second_stage import jack_piece, land_opening_piece
from ehadiag.model.sensors import PathPiece, PressureProbe, has_sensor_dynamics
from ehadiag.model.simd_jack_pieces import keep_lane_jack, lane_jack
from ehadiag.model.simd_layout import (
    LANE_NODES,
    LANE_PATH,
    LANE_PATH_ROWS,
    LANE_PATH_SLOPE,
    LANES,
    MOVING_ROWS,
    ROWS,
    STEP_SHIFTS,
    STUCK_ROWS,
    jack_law_of_lane,
    sensor_law_of_lane,
    spool_law_of_lane,
)
from ehadiag.model.simd_spool import held_friction
from ehadiag.model.spool_events import (
    EVENTS,
    WIRE_TOLERANCE,
    SpoolState,
    clamped_event,
    is_spool_held,
    is_wire_carried,
    state_after_event,
)

LANE_QUARTER_UNITS = TICK_UNITS // LANE_NODES
MAX_EVENT_PIECES = 32
EVENT_PIECES_START = LANE_PATH_ROWS * LANES
"""Behind the rows of the path: pieces (duration in s, place at the end, velocities) …"""
EVENT_INSTANTS_START = EVENT_PIECES_START + 4 * MAX_EVENT_PIECES
"""… and flapper, its rate, spool and its rate at the instants of a vector."""
EVENT_SCRATCH_SIZE = 4 * MAX_EVENT_PIECES + 4 * VECTOR_WIDTH


@bare_kernel
def event_ticks(
    count: int,
    tick: float,
    with_jack: bool,
    state: Array,
    path: Array,
    coefficients: Array,
    moving: Array,
    loose: Array,
    stuck: Array,
) -> None:
    """Flapper and spool of busy lanes, of the first `count`, over a tick with events.

    Events are located to tick / 2^finest_level. with_jack: whether the jack is to go along.
    """
    for i in range(count):
        if state[ROWS.busy * LANES + i] != 0.0:
            _event_tick(i, tick, with_jack, state, path, coefficients, moving, loose, stuck)


@packed
def _moving_instants(
    t: SpoolLaw, table: Array, place: int, h: float, fine: bool, base: float,
    s: SpoolState, path: Array,
) -> Mask:  # fmt: skip
    """Moving spool and flapper after 1 … VECTOR_WIDTH steps of `h` seconds, into the path's
    scratch.

    All is positive along the motion d, about the point (dry, base d) where both would rest.
    Returns where an event has come or, steps not being the finest, may hide.
    """
    d, dry = float(s.direction), t.dry
    a, w, b, v = s.xf * d - dry, s.wf * d, (s.xs - base) * d, s.vs * d
    k = place * MOVING_ROWS * VECTOR_WIDTH
    na = load(table, k) * a + load(table, k + VECTOR_WIDTH) * w
    na = na + load(table, k + 2 * VECTOR_WIDTH) * b + load(table, k + 3 * VECTOR_WIDTH) * v
    nw = load(table, k + 4 * VECTOR_WIDTH) * a + load(table, k + 5 * VECTOR_WIDTH) * w
    nw = nw + load(table, k + 6 * VECTOR_WIDTH) * b + load(table, k + 7 * VECTOR_WIDTH) * v
    nb = load(table, k + 8 * VECTOR_WIDTH) * a + load(table, k + 9 * VECTOR_WIDTH) * w
    nb = nb + load(table, k + 10 * VECTOR_WIDTH) * b + load(table, k + 11 * VECTOR_WIDTH) * v
    nv = load(table, k + 12 * VECTOR_WIDTH) * a + load(table, k + 13 * VECTOR_WIDTH) * w
    nv = nv + load(table, k + 14 * VECTOR_WIDTH) * b + load(table, k + 15 * VECTOR_WIDTH) * v
    store(path, EVENT_INSTANTS_START, (na + dry) * d)
    store(path, EVENT_INSTANTS_START + VECTOR_WIDTH, nw * d)
    store(path, EVENT_INSTANTS_START + 2 * VECTOR_WIDTH, nb * d + base)
    store(path, EVENT_INSTANTS_START + 3 * VECTOR_WIDTH, nv * d)
    size = absolute(na + dry)
    found = (nv <= 0.0) | (nb >= t.stroke - base * d) | (size >= t.flapper_stop)
    if not fine:
        # Where an extreme of the flapper lies inside a step the spool may stop, the flapper touch.
        before_a, before_w = shifted_lanes(a, na), shifted_lanes(w, nw)
        swing = 0.25 * h * maximum(absolute(before_w), absolute(nw))
        low = minimum(before_a, na) - swing <= 0.0
        far = maximum(shifted_lanes(abs(a + dry), size), size) + swing >= t.flapper_stop
        found = found | ((before_w * nw < 0.0) & (low | far))
    return found


@packed
def _loose_instants(
    t: SpoolLaw, table: Array, place: int, h: float, fine: bool, still: float,
    s: SpoolState, path: Array,
) -> Mask:  # fmt: skip
    """As `_moving_instants` within the backlash, without the feedback wire."""
    d = float(s.direction)
    lift = still * d
    steady = (t.force * lift - t.dynamic) / t.damping
    a, w, v = s.xf * d - lift, s.wf * d, s.vs * d - steady
    k = place * MOVING_ROWS * VECTOR_WIDTH
    na = load(table, k) * a + load(table, k + VECTOR_WIDTH) * w
    nw = load(table, k + 4 * VECTOR_WIDTH) * a + load(table, k + 5 * VECTOR_WIDTH) * w
    nb = load(table, k + 8 * VECTOR_WIDTH) * a + load(table, k + 9 * VECTOR_WIDTH) * w
    nb = nb + load(table, k + 11 * VECTOR_WIDTH) * v + load(table, k + 16 * VECTOR_WIDTH) * steady
    nv = load(table, k + 12 * VECTOR_WIDTH) * a + load(table, k + 13 * VECTOR_WIDTH) * w
    nv = nv + load(table, k + 15 * VECTOR_WIDTH) * v + steady
    store(path, EVENT_INSTANTS_START, (na + lift) * d)
    store(path, EVENT_INSTANTS_START + VECTOR_WIDTH, nw * d)
    store(path, EVENT_INSTANTS_START + 2 * VECTOR_WIDTH, nb * d + s.xs)
    store(path, EVENT_INSTANTS_START + 3 * VECTOR_WIDTH, nv * d)
    size = absolute(na + lift)
    travel = s.xs * d
    found = (nv <= 0.0) | (nb >= t.stroke - travel) | (size >= t.flapper_stop)
    found = found | (nb >= t.backlash - WIRE_TOLERANCE - (s.xs - s.wire) * d)
    if not fine:
        before_a, before_w = shifted_lanes(a, na), shifted_lanes(w, nw)
        swing = 0.25 * h * maximum(absolute(before_w), absolute(nw))
        low = minimum(before_a, na) - swing <= t.dry - lift
        far = maximum(shifted_lanes(abs(a + lift), size), size) + swing >= t.flapper_stop
        found = found | ((before_w * nw < 0.0) & (low | far))
    return found


@packed
def _stuck_instants(
    t: SpoolLaw, table: Array, place: int, h: float, fine: bool, still: float,
    s: SpoolState, path: Array,
) -> Mask:  # fmt: skip
    """As `_moving_instants` for a spool at rest, whose flapper rings about `still`, m.

    The spool breaks away beyond the static friction, but not to the side on which its stop holds
    it.
    """
    xf, wf, side = s.xf, s.wf, s.xs if abs(s.xs) >= t.stroke else 0.0
    room = min(t.breakaway, t.flapper_stop)
    a = xf - still
    k = place * STUCK_ROWS * VECTOR_WIDTH
    new_xf = load(table, k) * a + load(table, k + VECTOR_WIDTH) * wf + still
    new_wf = load(table, k + 2 * VECTOR_WIDTH) * a + load(table, k + 3 * VECTOR_WIDTH) * wf
    store(path, EVENT_INSTANTS_START, new_xf)
    store(path, EVENT_INSTANTS_START + VECTOR_WIDTH, new_wf)
    size = absolute(new_xf)
    found = ((size > t.breakaway) & (side * new_xf <= 0.0)) | (size >= t.flapper_stop)
    if not fine:
        before = shifted_lanes(wf, new_wf)
        swing = 0.25 * h * maximum(absolute(before), absolute(new_wf))
        far = maximum(shifted_lanes(abs(xf), size), size) + swing > room
        found = found | ((before * new_wf < 0.0) & far)
    store(path, EVENT_INSTANTS_START + 2 * VECTOR_WIDTH, s.xs)
    store(path, EVENT_INSTANTS_START + 3 * VECTOR_WIDTH, 0.0)
    return found


@packed
def _clamped_instants(
    t: SpoolLaw, table: Array, place: int, deflection: float, s: SpoolState,
    path: Array,
) -> Mask:  # fmt: skip
    """As `_moving_instants` with the flapper on its stop; the spool may be at rest."""
    d, xf = float(s.direction), s.xf
    k = (place * MOVING_ROWS + 16) * VECTOR_WIDTH
    time, fade = load(table, k), load(table, k + VECTOR_WIDTH)
    steady = clamped_spool_velocity(t, xf, d) if d != 0.0 else 0.0
    excess = s.vs - steady
    new_xs = time * steady + (1.0 - fade) * (excess * t.mass / t.damping) + s.xs
    new_vs = fade * excess + steady
    store(path, EVENT_INSTANTS_START, xf)
    store(path, EVENT_INSTANTS_START + VECTOR_WIDTH, 0.0)
    store(path, EVENT_INSTANTS_START + 2 * VECTOR_WIDTH, new_xs)
    store(path, EVENT_INSTANTS_START + 3 * VECTOR_WIDTH, new_vs)
    wire = play_output(s.wire, new_xs, t.backlash)
    leaves = (flapper_rest(t.ratio, deflection, wire) - xf) * xf < 0.0
    if d == 0.0:
        return leaves if is_spool_held(t, xf, s.xs) else new_vs <= 0.0  # all of them: it rests
    return leaves | (new_vs * d <= 0.0) | (new_xs * d >= t.stroke)


@merged
def _event_tick(
    i: int,
    tick: float,
    with_jack: bool,
    state: Array,
    path: Array,
    coefficients: Array,
    moving: Array,
    loose: Array,
    stuck: Array,
) -> None:
    """Lane `i`."""
    t, unit, deflection = (
        spool_law_of_lane(coefficients, i),
        tick / TICK_UNITS,
        state[ROWS.deflection * LANES + i],
    )
    s = SpoolState(
        state[ROWS.flapper * LANES + i],
        state[ROWS.flapper_rate * LANES + i],
        state[ROWS.spool * LANES + i],
        state[ROWS.spool_rate * LANES + i],
        state[ROWS.wire * LANES + i],
        int(state[ROWS.direction * LANES + i]),
        state[ROWS.clamped * LANES + i] != 0.0,
    )
    from_xs, from_vs, since = s.xs, s.vs, 0
    kinks, count = False, 0
    done, level, finest = 0, 0, len(STEP_SHIFTS) - 1
    while done < TICK_UNITS:
        # Steps begin at whole numbers of their length.
        while done & ((1 << STEP_SHIFTS[level]) - 1) != 0:
            level += 1
        shift, fine = STEP_SHIFTS[level], level == finest
        whole = VECTOR_WIDTH - ((done >> shift) & (VECTOR_WIDTH - 1))
        h, place = unit * (1 << shift), i * len(STEP_SHIFTS) + level
        law, less, short = t, 0.0, True
        if s.direction != 0 and t.extra > 0.0:
            law, less, short = held_friction(t, moving, loose, place, whole, h, deflection, s)
            if fine and not short:
                whole = 1
                law, less, short = held_friction(t, moving, loose, place, whole, h, deflection, s)
        if s.clamped:
            found = _clamped_instants(law, moving, place, deflection, s, path)
        elif s.direction != 0:
            if is_wire_carried(t, s.direction, s.xs, s.wire):
                base = spool_rest_position(law, deflection, float(s.direction))
                found = _moving_instants(law, moving, place, h, fine, base, s, path)
            else:
                still = flapper_rest(t.ratio, deflection, s.wire)
                found = _loose_instants(law, loose, place, h, fine, still, s, path)
        else:
            still = flapper_rest(t.ratio, deflection, s.wire)
            found = _stuck_instants(t, stuck, place, h, fine, still, s, path)
        first = first_lane(found) if short or fine else 0
        event = EVENTS.none
        if first < whole and fine:
            o = EVENT_INSTANTS_START + first
            new_xf, new_xs, new_vs = path[o], path[o + 2 * VECTOR_WIDTH], path[o + 3 * VECTOR_WIDTH]
            if s.clamped:
                wire = play_output(s.wire, new_xs, t.backlash)
                event = clamped_event(t, deflection, new_xf, new_xs, new_vs, wire, s.direction)
            else:
                event = _event(t, s, new_xf, new_xs, new_vs)
        steps = whole if first >= whole else first + 1 if fine else first
        n = 0
        while n < steps:
            # On to the next node of the path, or to the last step.
            taken = min(
                steps - n, (LANE_QUARTER_UNITS - (done & (LANE_QUARTER_UNITS - 1))) >> shift
            )
            n += taken
            o = EVENT_INSTANTS_START + n - 1
            s = SpoolState(
                path[o],
                path[o + VECTOR_WIDTH],
                path[o + 2 * VECTOR_WIDTH],
                path[o + 3 * VECTOR_WIDTH],
                play_output(s.wire, path[o + 2 * VECTOR_WIDTH], t.backlash),
                s.direction,
                s.clamped,
            )
            if less != 0.0 and first >= whole and n == steps:
                vs = s.vs - less * s.direction
                s = SpoolState(s.xf, s.wf, s.xs, vs, s.wire, s.direction, s.clamped)
            end_vs = s.vs
            done += taken << shift
            since += taken << shift
            switches = event > EVENTS.none and n == steps
            if switches:
                s = state_after_event(t, event, s)
                kinks = kinks or event == EVENTS.stop or (s.direction != 0 and s.vs == 0.0)
            at_node = done & (LANE_QUARTER_UNITS - 1) == 0
            if at_node or (switches and count < MAX_EVENT_PIECES - LANE_NODES):
                o = EVENT_PIECES_START + 4 * count
                path[o], path[o + 1], path[o + 2], path[o + 3] = since * unit, s.xs, from_vs, end_vs
                from_vs, since = s.vs, 0
                count += 1
            if at_node:
                path[(LANE_PATH + done // LANE_QUARTER_UNITS) * LANES + i] = s.xs
                path[(LANE_PATH_SLOPE + done // LANE_QUARTER_UNITS) * LANES + i] = s.vs
        level = 0 if fine or steps == whole else level + 1
    if kinks and with_jack:
        _jack_over_pieces(i, tick, from_xs, count, state, path, coefficients)
    state[ROWS.flapper * LANES + i], state[ROWS.flapper_rate * LANES + i] = s.xf, s.wf
    state[ROWS.spool * LANES + i], state[ROWS.spool_rate * LANES + i] = s.xs, s.vs
    state[ROWS.wire * LANES + i] = s.wire
    state[ROWS.direction * LANES + i] = s.direction
    state[ROWS.clamped * LANES + i] = 1.0 if s.clamped else 0.0


@inlined
def _event(t: SpoolLaw, s: SpoolState, xf: float, xs: float, vs: float) -> int:
    """Which event has come at an instant that is past one; `s`: the state before."""
    if s.direction == 0:
        return EVENTS.flapper_stop if is_spool_held(t, xf, xs) else EVENTS.breakaway
    if vs * s.direction <= 0.0:
        return EVENTS.reversal
    if abs(xf) >= t.flapper_stop:
        return EVENTS.flapper_stop
    return EVENTS.stop if abs(xs) >= t.stroke else EVENTS.wire_engagement


@merged
def _jack_over_pieces(
    i: int, tick: float, from_xs: float, count: int, state: Array, path: Array, coefficients: Array
) -> None:
    """Jack of lane `i` over the tick, by `count` pieces of the spool's path."""
    j, jack = jack_law_of_lane(coefficients, i), lane_jack(state, i)
    sensor = sensor_law_of_lane(coefficients, i)
    due, senses = tick - min(sensor.lead, tick), has_sensor_dynamics(sensor)
    for n in range(count):
        o = EVENT_PIECES_START + 4 * n
        span = path[o]
        piece = PathPiece(span, from_xs, path[o + 1], path[o + 2] * span, path[o + 3] * span)
        piece = land_opening_piece(j, piece)
        jack = jack_piece(j, PressureProbe(sensor.lag, due), senses, piece, 0.0, 1.0, jack)
        due -= span
        from_xs = path[o + 1]
    keep_lane_jack(jack, state, i)
    state[ROWS.done * LANES + i] = 1.0
