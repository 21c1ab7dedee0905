"""First stage and spool of one lane over a tick with events, and the jack beside them.

For lanes that `ehadiag.model.simd.spool_halving` leaves.

The vectors that else hold candidates hold instants here: the state after 1 … WIDTH steps of one
length, each by a transition of its own from the same start. The first of them that lies past an
event is looked into with shorter steps, down to the finest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined, merged
from ehadiag.compile.vector import (
    WIDTH,
    Mask,
    behind,
    first_place,
    least,
    load,
    magnitude,
    most,
    packed,
    store,
)
from ehadiag.model.jack_state import Piece, Probe
from ehadiag.model.lands import open_piece
from ehadiag.model.laws import SpoolLaw, play, slide_base, steady_rate, still_flapper
from ehadiag.model.scalar.transition import FINEST
from ehadiag.model.second_stage import jack_piece
from ehadiag.model.sensors import sensing
from ehadiag.model.simd.coefficients import MOVING_ROWS, SHIFTS, STUCK_ROWS
from ehadiag.model.simd.jack_events import keep_lane_jack, lane_jack
from ehadiag.model.simd.layout import (
    BUSY,
    CLAMPED,
    DEFLECTION,
    DIRECTION,
    DONE,
    FLAPPER,
    FLAPPER_RATE,
    LANES,
    NODES,
    PATH_ROWS,
    PLACE,
    SLOPE,
    SPOOL,
    SPOOL_RATE,
    WIRE,
    jack_law_of_lane,
    sensor_law_of_lane,
    spool_law_of_lane,
)
from ehadiag.model.simd.spool_creep import held_friction
from ehadiag.model.spool_events import (
    BREAKAWAY,
    ENGAGE,
    FLAPPER_STOP,
    NOTHING,
    REVERSAL,
    SPOOL_STOP,
    TOUCH,
    SpoolState,
    carried,
    clamped_event,
    held,
    switch,
)

__all__ = ["SCRATCH_SIZE", "event_ticks"]

WHOLE = 1 << FINEST
QUARTER = WHOLE // NODES
MOST_PIECES = 32
PIECES = PATH_ROWS * LANES
"""Behind the rows of the path: pieces (duration in s, place at the end, velocities) …"""
INSTANTS = PIECES + 4 * MOST_PIECES
"""… and flapper, its rate, spool and its rate at the instants of a vector."""
SCRATCH_SIZE = 4 * MOST_PIECES + 4 * WIDTH


@bare_kernel
def event_ticks(
    count: int,
    tick: float,
    with_jack: bool,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    loose: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Flapper and spool of BUSY lanes, of the first `count`, over a tick with events.

    Events are located to tick / 2^FINEST. with_jack: whether the jack is to go along.
    """
    for i in range(count):
        if state[BUSY * LANES + i] != 0.0:
            _event_tick(i, tick, with_jack, state, path, coefficients, moving, loose, stuck)


@packed
def _moving_instants(
    t: SpoolLaw, table: NDArray[np.float64], place: int, h: float, fine: bool, base: float,
    s: SpoolState, path: NDArray[np.float64],
) -> Mask:  # fmt: skip
    """Moving spool and flapper after 1 … WIDTH steps of `h` seconds, into the path's scratch.

    All is positive along the motion d, about the point (dry, base d) where both would rest.
    Returns where an event has come or, steps not being the finest, may hide.
    """
    d, dry = float(s.direction), t.dry
    a, w, b, v = s.xf * d - dry, s.wf * d, (s.xs - base) * d, s.vs * d
    k = place * MOVING_ROWS * WIDTH
    na = load(table, k) * a + load(table, k + WIDTH) * w
    na = na + load(table, k + 2 * WIDTH) * b + load(table, k + 3 * WIDTH) * v
    nw = load(table, k + 4 * WIDTH) * a + load(table, k + 5 * WIDTH) * w
    nw = nw + load(table, k + 6 * WIDTH) * b + load(table, k + 7 * WIDTH) * v
    nb = load(table, k + 8 * WIDTH) * a + load(table, k + 9 * WIDTH) * w
    nb = nb + load(table, k + 10 * WIDTH) * b + load(table, k + 11 * WIDTH) * v
    nv = load(table, k + 12 * WIDTH) * a + load(table, k + 13 * WIDTH) * w
    nv = nv + load(table, k + 14 * WIDTH) * b + load(table, k + 15 * WIDTH) * v
    store(path, INSTANTS, (na + dry) * d)
    store(path, INSTANTS + WIDTH, nw * d)
    store(path, INSTANTS + 2 * WIDTH, nb * d + base)
    store(path, INSTANTS + 3 * WIDTH, nv * d)
    size = magnitude(na + dry)
    found = (nv <= 0.0) | (nb >= t.stroke - base * d) | (size >= t.flapper_stop)
    if not fine:
        # Where an extreme of the flapper lies inside a step the spool may stop, the flapper touch.
        before_a, before_w = behind(a, na), behind(w, nw)
        swing = 0.25 * h * most(magnitude(before_w), magnitude(nw))
        low = least(before_a, na) - swing <= 0.0
        far = most(behind(abs(a + dry), size), size) + swing >= t.flapper_stop
        found = found | ((before_w * nw < 0.0) & (low | far))
    return found


@packed
def _loose_instants(
    t: SpoolLaw, table: NDArray[np.float64], place: int, h: float, fine: bool, still: float,
    s: SpoolState, path: NDArray[np.float64],
) -> Mask:  # fmt: skip
    """As `_moving_instants` within the backlash, without the feedback wire."""
    d = float(s.direction)
    lift = still * d
    steady = (t.force * lift - t.dynamic) / t.damping
    a, w, v = s.xf * d - lift, s.wf * d, s.vs * d - steady
    k = place * MOVING_ROWS * WIDTH
    na = load(table, k) * a + load(table, k + WIDTH) * w
    nw = load(table, k + 4 * WIDTH) * a + load(table, k + 5 * WIDTH) * w
    nb = load(table, k + 8 * WIDTH) * a + load(table, k + 9 * WIDTH) * w
    nb = nb + load(table, k + 11 * WIDTH) * v + load(table, k + 16 * WIDTH) * steady
    nv = load(table, k + 12 * WIDTH) * a + load(table, k + 13 * WIDTH) * w
    nv = nv + load(table, k + 15 * WIDTH) * v + steady
    store(path, INSTANTS, (na + lift) * d)
    store(path, INSTANTS + WIDTH, nw * d)
    store(path, INSTANTS + 2 * WIDTH, nb * d + s.xs)
    store(path, INSTANTS + 3 * WIDTH, nv * d)
    size = magnitude(na + lift)
    travel = s.xs * d
    found = (nv <= 0.0) | (nb >= t.stroke - travel) | (size >= t.flapper_stop)
    found = found | (nb >= t.backlash - TOUCH - (s.xs - s.wire) * d)
    if not fine:
        before_a, before_w = behind(a, na), behind(w, nw)
        swing = 0.25 * h * most(magnitude(before_w), magnitude(nw))
        low = least(before_a, na) - swing <= t.dry - lift
        far = most(behind(abs(a + lift), size), size) + swing >= t.flapper_stop
        found = found | ((before_w * nw < 0.0) & (low | far))
    return found


@packed
def _stuck_instants(
    t: SpoolLaw, table: NDArray[np.float64], place: int, h: float, fine: bool, still: float,
    s: SpoolState, path: NDArray[np.float64],
) -> Mask:  # fmt: skip
    """As `_moving_instants` for a spool at rest, whose flapper rings about `still`, m.

    The spool breaks away beyond the static friction, but not to the side on which its stop holds
    it.
    """
    xf, wf, side = s.xf, s.wf, s.xs if abs(s.xs) >= t.stroke else 0.0
    room = min(t.breakaway, t.flapper_stop)
    a = xf - still
    k = place * STUCK_ROWS * WIDTH
    new_xf = load(table, k) * a + load(table, k + WIDTH) * wf + still
    new_wf = load(table, k + 2 * WIDTH) * a + load(table, k + 3 * WIDTH) * wf
    store(path, INSTANTS, new_xf)
    store(path, INSTANTS + WIDTH, new_wf)
    size = magnitude(new_xf)
    found = ((size > t.breakaway) & (side * new_xf <= 0.0)) | (size >= t.flapper_stop)
    if not fine:
        before = behind(wf, new_wf)
        swing = 0.25 * h * most(magnitude(before), magnitude(new_wf))
        far = most(behind(abs(xf), size), size) + swing > room
        found = found | ((before * new_wf < 0.0) & far)
    store(path, INSTANTS + 2 * WIDTH, s.xs)
    store(path, INSTANTS + 3 * WIDTH, 0.0)
    return found


@packed
def _clamped_instants(
    t: SpoolLaw, table: NDArray[np.float64], place: int, deflection: float, s: SpoolState,
    path: NDArray[np.float64],
) -> Mask:  # fmt: skip
    """As `_moving_instants` with the flapper on its stop; the spool may be at rest."""
    d, xf = float(s.direction), s.xf
    k = (place * MOVING_ROWS + 16) * WIDTH
    time, fade = load(table, k), load(table, k + WIDTH)
    steady = steady_rate(t, xf, d) if d != 0.0 else 0.0
    excess = s.vs - steady
    new_xs = time * steady + (1.0 - fade) * (excess * t.mass / t.damping) + s.xs
    new_vs = fade * excess + steady
    store(path, INSTANTS, xf)
    store(path, INSTANTS + WIDTH, 0.0)
    store(path, INSTANTS + 2 * WIDTH, new_xs)
    store(path, INSTANTS + 3 * WIDTH, new_vs)
    wire = play(s.wire, new_xs, t.backlash)
    leaves = (still_flapper(t.ratio, deflection, wire) - xf) * xf < 0.0
    if d == 0.0:
        return leaves if held(t, xf, s.xs) else new_vs <= 0.0  # all of them: it rests
    return leaves | (new_vs * d <= 0.0) | (new_xs * d >= t.stroke)


@merged
def _event_tick(
    i: int,
    tick: float,
    with_jack: bool,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    loose: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Lane `i`."""
    t, unit, deflection = (
        spool_law_of_lane(coefficients, i),
        tick / WHOLE,
        state[DEFLECTION * LANES + i],
    )
    s = SpoolState(
        state[FLAPPER * LANES + i],
        state[FLAPPER_RATE * LANES + i],
        state[SPOOL * LANES + i],
        state[SPOOL_RATE * LANES + i],
        state[WIRE * LANES + i],
        int(state[DIRECTION * LANES + i]),
        state[CLAMPED * LANES + i] != 0.0,
    )
    from_xs, from_vs, since = s.xs, s.vs, 0
    kinks, count = False, 0
    done, level, finest = 0, 0, len(SHIFTS) - 1
    while done < WHOLE:
        # Steps begin at whole numbers of their length.
        while done & ((1 << SHIFTS[level]) - 1) != 0:
            level += 1
        shift, fine = SHIFTS[level], level == finest
        whole = WIDTH - ((done >> shift) & (WIDTH - 1))
        h, place = unit * (1 << shift), i * len(SHIFTS) + level
        law, less, short = t, 0.0, True
        if s.direction != 0 and t.extra > 0.0:
            law, less, short = held_friction(t, moving, loose, place, whole, h, deflection, s)
            if fine and not short:
                whole = 1
                law, less, short = held_friction(t, moving, loose, place, whole, h, deflection, s)
        if s.clamped:
            found = _clamped_instants(law, moving, place, deflection, s, path)
        elif s.direction != 0:
            if carried(t, s.direction, s.xs, s.wire):
                base = slide_base(law, deflection, float(s.direction))
                found = _moving_instants(law, moving, place, h, fine, base, s, path)
            else:
                still = still_flapper(t.ratio, deflection, s.wire)
                found = _loose_instants(law, loose, place, h, fine, still, s, path)
        else:
            still = still_flapper(t.ratio, deflection, s.wire)
            found = _stuck_instants(t, stuck, place, h, fine, still, s, path)
        first = first_place(found) if short or fine else 0
        event = NOTHING
        if first < whole and fine:
            o = INSTANTS + first
            new_xf, new_xs, new_vs = path[o], path[o + 2 * WIDTH], path[o + 3 * WIDTH]
            if s.clamped:
                wire = play(s.wire, new_xs, t.backlash)
                event = clamped_event(t, deflection, new_xf, new_xs, new_vs, wire, s.direction)
            else:
                event = _event(t, s, new_xf, new_xs, new_vs)
        steps = whole if first >= whole else first + 1 if fine else first
        n = 0
        while n < steps:
            # On to the next node of the path, or to the last step.
            taken = min(steps - n, (QUARTER - (done & (QUARTER - 1))) >> shift)
            n += taken
            o = INSTANTS + n - 1
            s = SpoolState(
                path[o],
                path[o + WIDTH],
                path[o + 2 * WIDTH],
                path[o + 3 * WIDTH],
                play(s.wire, path[o + 2 * WIDTH], t.backlash),
                s.direction,
                s.clamped,
            )
            if less != 0.0 and first >= whole and n == steps:
                vs = s.vs - less * s.direction
                s = SpoolState(s.xf, s.wf, s.xs, vs, s.wire, s.direction, s.clamped)
            end_vs = s.vs
            done += taken << shift
            since += taken << shift
            switches = event > NOTHING and n == steps
            if switches:
                s = switch(t, event, s)
                kinks = kinks or event == SPOOL_STOP or (s.direction != 0 and s.vs == 0.0)
            at_node = done & (QUARTER - 1) == 0
            if at_node or (switches and count < MOST_PIECES - NODES):
                o = PIECES + 4 * count
                path[o], path[o + 1], path[o + 2], path[o + 3] = since * unit, s.xs, from_vs, end_vs
                from_vs, since = s.vs, 0
                count += 1
            if at_node:
                path[(PLACE + done // QUARTER) * LANES + i] = s.xs
                path[(SLOPE + done // QUARTER) * LANES + i] = s.vs
        level = 0 if fine or steps == whole else level + 1
    if kinks and with_jack:
        _jack_beside(i, tick, from_xs, count, state, path, coefficients)
    state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i] = s.xf, s.wf
    state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i] = s.xs, s.vs
    state[WIRE * LANES + i] = s.wire
    state[DIRECTION * LANES + i] = s.direction
    state[CLAMPED * LANES + i] = 1.0 if s.clamped else 0.0


@inlined
def _event(t: SpoolLaw, s: SpoolState, xf: float, xs: float, vs: float) -> int:
    """Which event has come at an instant that is past one; `s`: the state before."""
    if s.direction == 0:
        return FLAPPER_STOP if held(t, xf, xs) else BREAKAWAY
    if vs * s.direction <= 0.0:
        return REVERSAL
    if abs(xf) >= t.flapper_stop:
        return FLAPPER_STOP
    return SPOOL_STOP if abs(xs) >= t.stroke else ENGAGE


@merged
def _jack_beside(
    i: int,
    tick: float,
    from_xs: float,
    count: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of lane `i` over the tick, by `count` pieces of the spool's path."""
    j, jack = jack_law_of_lane(coefficients, i), lane_jack(state, i)
    sensor = sensor_law_of_lane(coefficients, i)
    due, senses = tick - min(sensor.lead, tick), sensing(sensor)
    for n in range(count):
        o = PIECES + 4 * n
        span = path[o]
        piece = Piece(span, from_xs, path[o + 1], path[o + 2] * span, path[o + 3] * span)
        piece = open_piece(j, piece)
        jack = jack_piece(j, Probe(sensor.lag, due), senses, piece, 0.0, 1.0, jack)
        due -= span
        from_xs = path[o + 1]
    keep_lane_jack(jack, state, i)
    state[DONE * LANES + i] = 1.0
