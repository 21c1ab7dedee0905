"""First stage and spool of one lane over a tick with events, and the jack with them.

For lanes that `ehadiag.model.simd_spool_halving` leaves.

Vectors, which elsewhere hold candidates, hold instants here: the state after 1 … VECTOR_WIDTH steps
of one length, each by a transition of its own from the same start; with one lane, one instant after
the other up to the first event. The step that ends past an event is looked into with shorter ones,
down to the finest.
"""

from __future__ import annotations

from typing import NamedTuple

from ehadiag.compile.jit import Array, bare_kernel, inlined, merged
from ehadiag.compile.vector import (
    LANES,
    VECTOR_WIDTH,
    Mask,
    absolute,
    first_lane,
    last_lane,
    load,
    maximum,
    minimum,
    packed,
    shifted_lanes,
    store,
)
from ehadiag.model.laws import (
    SpoolLaw,
    bridge_bend,
    clamped_spool_velocity,
    flapper_rest,
    play_output,
    spool_rest_position,
    with_friction,
)
from ehadiag.model.simd_jack_pieces import LANE_FLAGS, PIECE_NUMBERS, jack_over_pieces
from ehadiag.model.simd_layout import (
    LANE_NODES,
    LANE_PATH,
    LANE_PATH_ROWS,
    LANE_PATH_SLOPE,
    MAX_EVENT_PIECES,
    MOVING_ROWS,
    QUARTER_UNITS,
    ROWS,
    STEP_SHIFTS,
    STEPS,
    STUCK_ROWS,
    TICK_UNITS,
    spool_law_of_lane,
)
from ehadiag.model.simd_spool import SPOOL_LIMITS, held_friction
from ehadiag.model.spool_events import (
    EVENTS,
    WIRE_TOLERANCE,
    SpoolState,
    clamped_event,
    is_spool_held,
    is_wire_carried,
    state_after_event,
)

EVENT_INSTANTS_START = LANE_PATH_ROWS * LANES
"""Behind the rows of the path: flapper, spool and their rates at the instants of a vector."""


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
    pieces: Array,
) -> None:
    """Flapper and spool of busy lanes, of the first `count`, over a tick with events.

    Events are located to tick / 2^`FINEST_LEVEL`. with_jack: whether the jack is to go along.
    """
    for o in range(0, count, VECTOR_WIDTH):
        most, none = 0, load(state, ROWS.busy * LANES + o) * 0.0
        for n in range(MAX_EVENT_PIECES):
            store(pieces, n * PIECE_NUMBERS, none)
        store(pieces, LANE_FLAGS, none)
        for i in range(o, min(o + VECTOR_WIDTH, count)):
            if state[ROWS.busy * LANES + i] != 0.0:
                cuts = _event_tick(i, tick, state, path, coefficients, moving, loose, stuck, pieces)
                pieces[LANE_FLAGS + i - o] = cuts
                most = max(most, cuts)
        if with_jack and most > 0:
            flags = load(pieces, LANE_FLAGS)
            jack_over_pieces(o, flags, most, tick, state, path, coefficients, pieces)


class _Instant(NamedTuple):
    """What the next step looks back to."""

    xf: float
    wf: float
    size: float
    """Distance of the flapper from the middle."""


@packed
def _moving_instants(
    t: SpoolLaw, table: Array, place: int, n: int, last: _Instant, h: float, fine: bool,
    base: float, s: SpoolState, path: Array,
) -> tuple[Mask, _Instant]:  # fmt: skip
    """Moving spool and flapper after n + 1 … n + VECTOR_WIDTH steps of `h` seconds, into the path's
    scratch.

    All is positive along the motion d, about the point (dry, base d) where both would rest. last:
    after n steps, of no meaning for 0 of them. Returns where an event has come or, steps not being
    the finest, may hide, and the last instant.
    """
    d, dry = float(s.direction), t.dry
    a, w, b, v = s.xf * d - dry, s.wf * d, (s.xs - base) * d, s.vs * d
    k = place * MOVING_ROWS * STEPS + n
    na = load(table, k) * a + load(table, k + STEPS) * w
    na = na + load(table, k + 2 * STEPS) * b + load(table, k + 3 * STEPS) * v
    nw = load(table, k + 4 * STEPS) * a + load(table, k + 5 * STEPS) * w
    nw = nw + load(table, k + 6 * STEPS) * b + load(table, k + 7 * STEPS) * v
    nb = load(table, k + 8 * STEPS) * a + load(table, k + 9 * STEPS) * w
    nb = nb + load(table, k + 10 * STEPS) * b + load(table, k + 11 * STEPS) * v
    nv = load(table, k + 12 * STEPS) * a + load(table, k + 13 * STEPS) * w
    nv = nv + load(table, k + 14 * STEPS) * b + load(table, k + 15 * STEPS) * v
    store(path, EVENT_INSTANTS_START + n, (na + dry) * d)
    store(path, EVENT_INSTANTS_START + n + STEPS, nw * d)
    store(path, EVENT_INSTANTS_START + n + 2 * STEPS, nb * d + base)
    store(path, EVENT_INSTANTS_START + n + 3 * STEPS, nv * d)
    size = absolute(na + dry)
    first = _Instant(a, w, abs(a + dry)) if n == 0 else last
    found = (nv <= 0.0) | (nb >= t.stroke - base * d) | (size >= t.flapper_stop)
    if not fine:
        # Where an extreme of the flapper lies inside a step the spool may stop, the flapper touch.
        before_a, before_w = shifted_lanes(first.xf, na), shifted_lanes(first.wf, nw)
        swing = 0.25 * h * maximum(absolute(before_w), absolute(nw))
        low = minimum(before_a, na) - swing <= 0.0
        far = maximum(shifted_lanes(first.size, size), size) + swing >= t.flapper_stop
        found = found | ((before_w * nw < 0.0) & (low | far))
    return found, _Instant(last_lane(na), last_lane(nw), last_lane(size))


@packed
def _loose_instants(
    t: SpoolLaw, table: Array, place: int, n: int, last: _Instant, h: float, fine: bool,
    still: float, s: SpoolState, path: Array,
) -> tuple[Mask, _Instant]:  # fmt: skip
    """As `_moving_instants` within the backlash, without the feedback wire."""
    d = float(s.direction)
    lift = still * d
    steady = (t.force * lift - t.dynamic) / t.damping
    a, w, v = s.xf * d - lift, s.wf * d, s.vs * d - steady
    k = place * MOVING_ROWS * STEPS + n
    na = load(table, k) * a + load(table, k + STEPS) * w
    nw = load(table, k + 4 * STEPS) * a + load(table, k + 5 * STEPS) * w
    nb = load(table, k + 8 * STEPS) * a + load(table, k + 9 * STEPS) * w
    nb = nb + load(table, k + 11 * STEPS) * v + load(table, k + 16 * STEPS) * steady
    nv = load(table, k + 12 * STEPS) * a + load(table, k + 13 * STEPS) * w
    nv = nv + load(table, k + 15 * STEPS) * v + steady
    store(path, EVENT_INSTANTS_START + n, (na + lift) * d)
    store(path, EVENT_INSTANTS_START + n + STEPS, nw * d)
    store(path, EVENT_INSTANTS_START + n + 2 * STEPS, nb * d + s.xs)
    store(path, EVENT_INSTANTS_START + n + 3 * STEPS, nv * d)
    size = absolute(na + lift)
    first = _Instant(a, w, abs(a + lift)) if n == 0 else last
    travel = s.xs * d
    found = (nv <= 0.0) | (nb >= t.stroke - travel) | (size >= t.flapper_stop)
    found = found | (nb >= t.backlash - WIRE_TOLERANCE - (s.xs - s.wire) * d)
    if not fine:
        before_a, before_w = shifted_lanes(first.xf, na), shifted_lanes(first.wf, nw)
        swing = 0.25 * h * maximum(absolute(before_w), absolute(nw))
        low = minimum(before_a, na) - swing <= t.dry - lift
        far = maximum(shifted_lanes(first.size, size), size) + swing >= t.flapper_stop
        found = found | ((before_w * nw < 0.0) & (low | far))
    return found, _Instant(last_lane(na), last_lane(nw), last_lane(size))


@packed
def _stuck_instants(
    t: SpoolLaw, table: Array, place: int, n: int, last: _Instant, h: float, fine: bool,
    still: float, s: SpoolState, path: Array,
) -> tuple[Mask, _Instant]:  # fmt: skip
    """As `_moving_instants` for a spool at rest, whose flapper rings about `still`, m.

    The spool breaks away beyond the static friction, but not to the side on which its stop holds
    it.
    """
    xf, wf, side = s.xf, s.wf, s.xs if abs(s.xs) >= t.stroke else 0.0
    room = min(t.breakaway, t.flapper_stop)
    a = xf - still
    k = place * STUCK_ROWS * STEPS + n
    new_xf = load(table, k) * a + load(table, k + STEPS) * wf + still
    new_wf = load(table, k + 2 * STEPS) * a + load(table, k + 3 * STEPS) * wf
    store(path, EVENT_INSTANTS_START + n, new_xf)
    store(path, EVENT_INSTANTS_START + n + STEPS, new_wf)
    size = absolute(new_xf)
    first = _Instant(xf, wf, abs(xf)) if n == 0 else last
    found = ((size > t.breakaway) & (side * new_xf <= 0.0)) | (size >= t.flapper_stop)
    if not fine:
        before = shifted_lanes(first.wf, new_wf)
        swing = 0.25 * h * maximum(absolute(before), absolute(new_wf))
        far = maximum(shifted_lanes(first.size, size), size) + swing > room
        found = found | ((before * new_wf < 0.0) & far)
    store(path, EVENT_INSTANTS_START + n + 2 * STEPS, s.xs)
    store(path, EVENT_INSTANTS_START + n + 3 * STEPS, 0.0)
    return found, _Instant(last_lane(new_xf), last_lane(new_wf), last_lane(size))


@packed
def _clamped_instants(
    t: SpoolLaw, table: Array, place: int, n: int, deflection: float, s: SpoolState,
    path: Array,
) -> Mask:  # fmt: skip
    """As `_moving_instants` with the flapper on its stop; the spool may be at rest."""
    d, xf = float(s.direction), s.xf
    k = (place * MOVING_ROWS + 16) * STEPS + n
    time, fade = load(table, k), load(table, k + STEPS)
    steady = clamped_spool_velocity(t, xf, d) if d != 0.0 else 0.0
    excess = s.vs - steady
    new_xs = time * steady + (1.0 - fade) * (excess * t.mass / t.damping) + s.xs
    new_vs = fade * excess + steady
    store(path, EVENT_INSTANTS_START + n, xf)
    store(path, EVENT_INSTANTS_START + n + STEPS, 0.0)
    store(path, EVENT_INSTANTS_START + n + 2 * STEPS, new_xs)
    store(path, EVENT_INSTANTS_START + n + 3 * STEPS, new_vs)
    wire = play_output(s.wire, new_xs, t.backlash)
    leaves = (flapper_rest(t.ratio, deflection, wire) - xf) * xf < 0.0
    if d == 0.0:
        return leaves if is_spool_held(t, xf, s.xs) else new_vs <= 0.0  # all of them: it rests
    return leaves | (new_vs * d <= 0.0) | (new_xs * d >= t.stroke)


@merged
def _event_tick(
    i: int,
    tick: float,
    state: Array,
    path: Array,
    coefficients: Array,
    moving: Array,
    loose: Array,
    stuck: Array,
    pieces: Array,
) -> int:
    """Lane `i`; returns how many pieces of the path its jack is to go over, 0: as usual."""
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
    from_vs, since = s.vs, 0
    kinks, count = False, 0
    done, level, finest = 0, 0, len(STEP_SHIFTS) - 1
    while done < TICK_UNITS:
        # Steps begin at whole numbers of their length.
        while done & ((1 << STEP_SHIFTS[level]) - 1) != 0:
            level += 1
        shift, fine = STEP_SHIFTS[level], level == finest
        whole = STEPS - ((done >> shift) & (STEPS - 1))
        h, place = unit * (1 << shift), i * len(STEP_SHIFTS) + level
        law, less, short = t, 0.0, True
        if s.direction != 0 and t.by_bend > 0.0 and not s.clamped:
            # By the bridge's bend in the middle of the steps.
            ahead = (s.xf + 0.5 * whole * h * s.wf) * s.direction - t.dry
            law = with_friction(t, -bridge_bend(t, ahead))
            short = whole * h <= SPOOL_LIMITS.held_s
        if short and s.direction != 0 and t.extra > 0.0:
            bent = law
            law, less, short = held_friction(bent, moving, loose, place, whole, h, deflection, s)
            if fine and not short:
                whole = 1
                law, less, short = held_friction(
                    bent, moving, loose, place, whole, h, deflection, s
                )
        first, last = whole if short or fine else 0, _Instant(0.0, 0.0, 0.0)
        carries = s.direction != 0 and is_wire_carried(t, s.direction, s.xs, s.wire)
        base = spool_rest_position(law, deflection, float(s.direction))
        still = flapper_rest(t.ratio, deflection, s.wire)
        for n in range(0, first, VECTOR_WIDTH):
            if s.clamped:
                found = _clamped_instants(law, moving, place, n, deflection, s, path)
            elif carries:
                found, last = _moving_instants(law, moving, place, n, last, h, fine, base, s, path)
            elif s.direction != 0:
                found, last = _loose_instants(law, loose, place, n, last, h, fine, still, s, path)
            else:
                found, last = _stuck_instants(t, stuck, place, n, last, h, fine, still, s, path)
            first = min(n + first_lane(found), whole)
            if first < n + VECTOR_WIDTH:
                break
        event = EVENTS.none
        if first < whole and fine:
            o = EVENT_INSTANTS_START + first
            new_xf, new_xs, new_vs = path[o], path[o + 2 * STEPS], path[o + 3 * STEPS]
            if s.clamped:
                wire = play_output(s.wire, new_xs, t.backlash)
                event = clamped_event(t, deflection, new_xf, new_xs, new_vs, wire, s.direction)
            else:
                event = _event(t, s, new_xf, new_xs, new_vs)
        steps = whole if first >= whole else first + 1 if fine else first
        n = 0
        while n < steps:
            # On to the next node of the path, or to the last step.
            taken = min(steps - n, (QUARTER_UNITS - (done & (QUARTER_UNITS - 1))) >> shift)
            n += taken
            o = EVENT_INSTANTS_START + n - 1
            s = SpoolState(
                path[o],
                path[o + STEPS],
                path[o + 2 * STEPS],
                path[o + 3 * STEPS],
                play_output(s.wire, path[o + 2 * STEPS], t.backlash),
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
            at_node = done & (QUARTER_UNITS - 1) == 0
            if at_node or (switches and count < MAX_EVENT_PIECES - LANE_NODES):
                o = count * PIECE_NUMBERS + i % VECTOR_WIDTH
                pieces[o], pieces[o + VECTOR_WIDTH] = since * unit, s.xs
                pieces[o + 2 * VECTOR_WIDTH], pieces[o + 3 * VECTOR_WIDTH] = from_vs, end_vs
                from_vs, since = s.vs, 0
                count += 1
            if at_node:
                path[(LANE_PATH + done // QUARTER_UNITS) * LANES + i] = s.xs
                path[(LANE_PATH_SLOPE + done // QUARTER_UNITS) * LANES + i] = s.vs
        level = 0 if fine or steps == whole else level + 1
    state[ROWS.flapper * LANES + i], state[ROWS.flapper_rate * LANES + i] = s.xf, s.wf
    state[ROWS.spool * LANES + i], state[ROWS.spool_rate * LANES + i] = s.xs, s.vs
    state[ROWS.wire * LANES + i] = s.wire
    state[ROWS.direction * LANES + i] = s.direction
    state[ROWS.clamped * LANES + i] = 1.0 if s.clamped else 0.0
    return count if kinks else 0


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
