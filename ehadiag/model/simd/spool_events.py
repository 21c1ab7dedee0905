"""First stage and spool of one lane over a tick with events, and the jack beside them.

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
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.spool_events import (
    BREAKAWAY,
    FLAPPER_STOP,
    NOTHING,
    REVERSAL,
    SPOOL_STOP,
    clamped_event,
    held,
    switch,
)
from ehadiag.model.scalar.transition import FINEST, SpoolScalars
from ehadiag.model.simd.coefficients import MOVING_ROWS, SHIFTS, STUCK_ROWS
from ehadiag.model.simd.jack_events import jack_piece
from ehadiag.model.simd.layout import (
    BREAK,
    BUSY,
    CLAMPED,
    DAMPING,
    DIRECTION,
    DONE,
    DRY,
    DYNAMIC,
    FLAPPER,
    FLAPPER_RATE,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_FRICTION,
    JACK_VELOCITY,
    LANES,
    NODES,
    PATH_ROWS,
    PLACE,
    ROOM,
    SLOPE,
    SPOOL,
    SPOOL_RATE,
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
    c: PlantConstants,
    torque: float,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Flapper and spool of BUSY lanes over a tick with events, located to tick / 2^FINEST."""
    for i in range(LANES):
        if state[BUSY * LANES + i] != 0.0:
            _event_tick(c, i, torque, tick, state, path, coefficients, moving, stuck)


@packed
def _moving_instants(
    c: PlantConstants, table: NDArray[np.float64], place: int, h: float, fine: bool, dry: float,
    base: float, d: float, xf: float, wf: float, xs: float, vs: float, path: NDArray[np.float64],
) -> Mask:  # fmt: skip
    """Moving spool and flapper after 1 … WIDTH steps of `h` seconds, into the path's scratch.

    All is positive along the motion d, about the point (dry, base d) where both would rest.
    Returns where an event has come or, steps not being the finest, may hide.
    """
    a, w, b, v = xf * d - dry, wf * d, (xs - base) * d, vs * d
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
    found = (nv <= 0.0) | (nb >= c.XSM - base * d) | (size >= c.XFM)
    if not fine:
        # Where an extreme of the flapper lies inside a step the spool may stop, the flapper touch.
        before_a, before_w = behind(a, na), behind(w, nw)
        swing = 0.25 * h * most(magnitude(before_w), magnitude(nw))
        low = least(before_a, na) - swing <= 0.0
        far = most(behind(abs(a + dry), size), size) + swing >= c.XFM
        found = found | ((before_w * nw < 0.0) & (low | far))
    return found


@packed
def _stuck_instants(
    c: PlantConstants, table: NDArray[np.float64], place: int, h: float, fine: bool, still: float,
    room: float, limit: float, side: float, xf: float, wf: float, path: NDArray[np.float64],
) -> Mask:  # fmt: skip
    """As `_moving_instants` for a spool at rest, whose flapper rings about `still`, m.

    The spool breaks away beyond `limit`, but not to the side on which its stop holds it; within
    `room` nothing happens, m.
    """
    a = xf - still
    k = place * STUCK_ROWS * WIDTH
    new_xf = load(table, k) * a + load(table, k + WIDTH) * wf + still
    new_wf = load(table, k + 2 * WIDTH) * a + load(table, k + 3 * WIDTH) * wf
    store(path, INSTANTS, new_xf)
    store(path, INSTANTS + WIDTH, new_wf)
    size = magnitude(new_xf)
    found = ((size > limit) & (side * new_xf <= 0.0)) | (size >= c.XFM)
    if not fine:
        before = behind(wf, new_wf)
        swing = 0.25 * h * most(magnitude(before), magnitude(new_wf))
        far = most(behind(abs(xf), size), size) + swing > room
        found = found | ((before * new_wf < 0.0) & far)
    return found


@packed
def _clamped_instants(
    c: PlantConstants, t: SpoolScalars, table: NDArray[np.float64], place: int, torque: float,
    d: float, xf: float, xs: float, vs: float, path: NDArray[np.float64],
) -> Mask:  # fmt: skip
    """As `_moving_instants` with the flapper on its stop; the spool may be at rest (d = 0)."""
    k = (place * MOVING_ROWS + 16) * WIDTH
    time, fade = load(table, k), load(table, k + WIDTH)
    steady = (t.force * xf - t.dynamic * d) / t.damping
    if d == 0.0:
        steady = 0.0
    excess = vs - steady
    new_xs = time * steady + (1.0 - fade) * (excess * c.MS / t.damping) + xs
    new_vs = fade * excess + steady
    store(path, INSTANTS, xf)
    store(path, INSTANTS + WIDTH, 0.0)
    store(path, INSTANTS + 2 * WIDTH, new_xs)
    store(path, INSTANTS + 3 * WIDTH, new_vs)
    leaves = (torque - c.KF * xf - c.KSF * new_xs) * xf < 0.0
    if d == 0.0:
        return leaves if held(c, t, xf, xs) else new_vs <= 0.0  # all of them: it rests
    return leaves | (new_vs * d <= 0.0) | (new_xs * d >= c.XSM)


@merged
def _event_tick(
    c: PlantConstants,
    i: int,
    torque: float,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Lane `i`."""
    force, unit = c.AS * c.GPF, tick / WHOLE
    damping, dry = coefficients[DAMPING * LANES + i], coefficients[DRY * LANES + i]
    limit, room = coefficients[BREAK * LANES + i], coefficients[ROOM * LANES + i]
    t = SpoolScalars(force, damping, coefficients[DYNAMIC * LANES + i], limit, 0.0, 0.0)
    xf, wf = state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i]
    xs, vs = state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i]
    direction, clamped = int(state[DIRECTION * LANES + i]), state[CLAMPED * LANES + i] != 0.0
    from_xs, from_vs, since = xs, vs, 0
    kinks, count = False, 0
    done, level, finest = 0, 0, len(SHIFTS) - 1
    while done < WHOLE:
        # Steps begin at whole numbers of their length.
        while done & ((1 << SHIFTS[level]) - 1) != 0:
            level += 1
        shift, fine = SHIFTS[level], level == finest
        whole = WIDTH - ((done >> shift) & (WIDTH - 1))
        h = unit * (1 << shift)
        if clamped:
            found = _clamped_instants(
                c, t, moving, i * len(SHIFTS) + level, torque, float(direction), xf, xs, vs, path
            )
        elif direction != 0:
            base = (torque - c.KF * dry * direction) / c.KSF
            found = _moving_instants(
                c, moving, i * len(SHIFTS) + level, h, fine, dry, base, float(direction),
                xf, wf, xs, vs, path,
            )  # fmt: skip
        else:
            still = (torque - c.KSF * xs) / c.KF
            side = xs if abs(xs) >= c.XSM else 0.0
            found = _stuck_instants(
                c, stuck, level, h, fine, still, room, limit, side, xf, wf, path
            )
            store(path, INSTANTS + 2 * WIDTH, xs)
            store(path, INSTANTS + 3 * WIDTH, 0.0)
        first = first_place(found)
        event = NOTHING
        if first < whole and fine:
            o = INSTANTS + first
            new_xf, new_xs, new_vs = path[o], path[o + 2 * WIDTH], path[o + 3 * WIDTH]
            if clamped:
                event = clamped_event(c, t, torque, new_xf, new_xs, new_vs, direction)
            else:
                event = _event(c, t, new_xf, new_xs, new_vs, direction)
        steps = whole if first >= whole else first + 1 if fine else first
        for n in range(steps):
            o = INSTANTS + n
            xf, wf, xs, vs = path[o], path[o + WIDTH], path[o + 2 * WIDTH], path[o + 3 * WIDTH]
            end_vs = vs
            done += 1 << shift
            since += 1 << shift
            switches = event > NOTHING and n == steps - 1
            if switches:
                xf, wf, xs, vs, direction, clamped = switch(
                    c, t, event, xf, wf, xs, vs, direction, clamped
                )
                kinks = kinks or event == SPOOL_STOP or (direction != 0 and vs == 0.0)
            at_node = done & (QUARTER - 1) == 0
            if at_node or (switches and count < MOST_PIECES - NODES):
                o = PIECES + 4 * count
                path[o], path[o + 1], path[o + 2], path[o + 3] = since * unit, xs, from_vs, end_vs
                from_vs, since = vs, 0
                count += 1
            if at_node:
                path[(PLACE + done // QUARTER) * LANES + i] = xs
                path[(SLOPE + done // QUARTER) * LANES + i] = vs
        level = 0 if fine or steps == whole else level + 1
    if kinks:
        _jack_beside(c, i, from_xs, count, state, path, coefficients)
    state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i] = xf, wf
    state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i] = xs, vs
    state[DIRECTION * LANES + i] = direction
    state[CLAMPED * LANES + i] = 1.0 if clamped else 0.0


@inlined
def _event(
    c: PlantConstants, t: SpoolScalars, xf: float, xs: float, vs: float, direction: int
) -> int:
    """Which event has come at an instant that is past one."""
    if direction == 0:
        return FLAPPER_STOP if held(c, t, xf, xs) else BREAKAWAY
    if vs * direction <= 0.0:
        return REVERSAL
    return FLAPPER_STOP if abs(xf) >= c.XFM else SPOOL_STOP


@merged
def _jack_beside(
    c: PlantConstants,
    i: int,
    from_xs: float,
    count: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of lane `i` over the tick, by `count` pieces of the spool's path."""
    friction = coefficients[JACK_FRICTION * LANES + i]
    place, velocity = state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i]
    d, fresh = state[JACK_DIRECTION * LANES + i], state[FRESH * LANES + i]
    for n in range(count):
        o = PIECES + 4 * n
        span = path[o]
        place, velocity, d, fresh = jack_piece(
            c, friction, span, 0.0, 1.0, from_xs, path[o + 1],
            path[o + 2] * span, path[o + 3] * span, place, velocity, d, fresh,
        )  # fmt: skip
        from_xs = path[o + 1]
    state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i] = place, velocity
    state[JACK_DIRECTION * LANES + i], state[FRESH * LANES + i] = d, fresh
    state[DONE * LANES + i] = 1.0
