"""Spools whose friction falls with their velocity: all lanes by quarters of a tick, or one alone.

`ehadiag.model.simd.spool` leaves such a lane BUSY where it moves; most of them come through here
(`creeping_lanes`), the rest is looked into in short steps with a friction held over some of them
(`held_friction`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined
from ehadiag.compile.vector import (
    WIDTH,
    Mask,
    Vector,
    anywhere,
    least,
    load,
    magnitude,
    most,
    packed,
    store,
    where,
)
from ehadiag.model.laws import SpoolLaw, play, slide_base, steady_rate, still_flapper
from ehadiag.model.simd.coefficients import MOVING_ROWS
from ehadiag.model.simd.layout import (
    BUSY,
    CLAMPED,
    DEFLECTION,
    DIRECTION,
    FLAPPER,
    FLAPPER_RATE,
    LANES,
    MOVE,
    PLACE,
    SLOPE,
    SPOOL,
    SPOOL_RATE,
    WIRE,
    spool_laws,
)
from ehadiag.model.spool_creep import DOUBT, creep
from ehadiag.model.spool_events import TOUCH, SpoolState, carried

__all__ = ["creeping_lanes", "held_friction"]

BIG = 1e30
LONGEST = 3e-4
"""s, for which friction is held; the flapper rings with a period of about 1 ms."""
LEAST_VELOCITY = 1e-13
"""m/s, of a spool that still moves."""


@packed
def _quarter(
    t: SpoolLaw, m: tuple[Vector, ...], span: float, a: Vector, w: Vector, b: Vector, v: Vector,
    slowest: Vector, lowest: Vector, widest: Vector, doubt: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector, Vector]:  # fmt: skip
    """One step, positive along the motion, and how near it came to an event.

    a, b: from where flapper and spool would rest by the dynamic friction alone.
    """
    free = m[12] * a + m[13] * w + m[14] * b + m[15] * v
    swing = m[4] * a + m[5] * w + m[6] * b + m[7] * v - w
    mean, largest, less, miss = creep(t, span, v, free, m[12] - m[14] * t.reach, swing)
    a, b = a - mean, b + t.reach * mean
    na = m[0] * a + m[1] * w + m[2] * b + m[3] * v + mean
    nw = m[4] * a + m[5] * w + m[6] * b + m[7] * v
    nb = m[8] * a + m[9] * w + m[10] * b + m[11] * v - t.reach * mean
    nv = m[12] * a + m[13] * w + m[14] * b + m[15] * v - less
    swing = 0.25 * span * most(magnitude(w), magnitude(nw))
    inside = where(w * nw < 0.0, least(a + mean, na) - largest - swing, BIG)
    widest = most(widest, magnitude(na + t.dry) + swing)
    return na, nw, nb, nv, least(slowest, nv), least(lowest, inside), widest, most(doubt, miss)


@bare_kernel
def creeping_lanes(
    end: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> bool:
    """Flapper and spool of the BUSY lanes before `end` that creep, over a tick without events.

    Lanes in which an event may hide stay BUSY and as they were; returns whether there are any.
    """
    any_busy = False
    span = 0.25 * tick
    for o in range(0, end, WIDTH):
        t = spool_laws(coefficients, o)
        busy, d = load(state, BUSY * LANES + o), load(state, DIRECTION * LANES + o)
        tries = (busy != 0.0) & (d != 0.0) & (load(state, CLAMPED * LANES + o) == 0.0)
        tries = tries & (t.extra > 0.0)
        if anywhere(tries):
            k = MOVE * LANES + o
            m = (
                load(coefficients, k), load(coefficients, k + LANES),
                load(coefficients, k + 2 * LANES), load(coefficients, k + 3 * LANES),
                load(coefficients, k + 4 * LANES), load(coefficients, k + 5 * LANES),
                load(coefficients, k + 6 * LANES), load(coefficients, k + 7 * LANES),
                load(coefficients, k + 8 * LANES), load(coefficients, k + 9 * LANES),
                load(coefficients, k + 10 * LANES), load(coefficients, k + 11 * LANES),
                load(coefficients, k + 12 * LANES), load(coefficients, k + 13 * LANES),
                load(coefficients, k + 14 * LANES), load(coefficients, k + 15 * LANES),
            )  # fmt: skip
            xf, wf = load(state, FLAPPER * LANES + o), load(state, FLAPPER_RATE * LANES + o)
            xs, vs = load(state, SPOOL * LANES + o), load(state, SPOOL_RATE * LANES + o)
            wire = load(state, WIRE * LANES + o)
            base = slide_base(t, load(state, DEFLECTION * LANES + o), d)
            a, w, b, v = xf * d - t.dry, wf * d, (xs - base) * d, vs * d
            zero = d * 0.0
            s, n, x, y = zero + BIG, zero + BIG, zero, zero
            a, w, b, v, s, n, x, y = _quarter(t, m, span, a, w, b, v, s, n, x, y)
            b1, v1 = base + d * b, d * v
            a, w, b, v, s, n, x, y = _quarter(t, m, span, a, w, b, v, s, n, x, y)
            b2, v2 = base + d * b, d * v
            a, w, b, v, s, n, x, y = _quarter(t, m, span, a, w, b, v, s, n, x, y)
            b3, v3 = base + d * b, d * v
            a, w, b, v, s, n, x, y = _quarter(t, m, span, a, w, b, v, s, n, x, y)
            b4, v4 = base + d * b, d * v
            goes = tries & (d * (xs - wire) >= t.backlash - TOUCH)
            goes = goes & (s > LEAST_VELOCITY) & (n > 0.0) & (y <= DOUBT)
            goes = goes & (x < t.flapper_stop) & (d * b4 < t.stroke)
            _keep(path, state, goes, o, b1, b2, b3, b4, v1, v2, v3, v4)
            store(state, FLAPPER * LANES + o, where(goes, (a + t.dry) * d, xf))
            store(state, FLAPPER_RATE * LANES + o, where(goes, w * d, wf))
            store(state, WIRE * LANES + o, where(goes, play(wire, b4, t.backlash), wire))
            busy = where(goes, 0.0, busy)
            store(state, BUSY * LANES + o, busy)
        if anywhere(busy != 0.0):
            any_busy = True
    return any_busy


@packed
def _keep(
    path: NDArray[np.float64], state: NDArray[np.float64], goes: Mask, o: int,
    b1: Vector, b2: Vector, b3: Vector, b4: Vector, v1: Vector, v2: Vector, v3: Vector, v4: Vector,
) -> None:  # fmt: skip
    """Write places and velocities at the nodes of the lanes that came through."""
    p, q = (PLACE + 1) * LANES + o, (SLOPE + 1) * LANES + o
    store(path, p, where(goes, b1, load(path, p)))
    store(path, p + LANES, where(goes, b2, load(path, p + LANES)))
    store(path, p + 2 * LANES, where(goes, b3, load(path, p + 2 * LANES)))
    store(path, p + 3 * LANES, where(goes, b4, load(path, p + 3 * LANES)))
    store(path, q, where(goes, v1, load(path, q)))
    store(path, q + LANES, where(goes, v2, load(path, q + LANES)))
    store(path, q + 2 * LANES, where(goes, v3, load(path, q + 2 * LANES)))
    store(path, q + 3 * LANES, where(goes, v4, load(path, q + 3 * LANES)))
    store(state, SPOOL * LANES + o, where(goes, b4, load(state, SPOOL * LANES + o)))
    store(state, SPOOL_RATE * LANES + o, where(goes, v4, load(state, SPOOL_RATE * LANES + o)))


@inlined
def held_friction(
    t: SpoolLaw, moving: NDArray[np.float64], loose: NDArray[np.float64], place: int, steps: int,
    h: float, deflection: float, s: SpoolState,
) -> tuple[SpoolLaw, float, bool]:  # fmt: skip
    """Law of a moving spool with the friction that it has in the mean of some steps of one length.

    Parameters
    ----------
    moving, loose: transitions, see `ehadiag.model.simd.coefficients`.
    place: of the lane and the length of the steps in them.
    steps: 1 … WIDTH.
    h: length of a step, s.
    s: state before.

    Returns
    -------
    The law, the velocity (m/s) that the end has less along the motion, and whether the friction
    may be held for so long.
    """
    d, swing = float(s.direction), 0.0
    k = place * MOVING_ROWS * WIDTH + steps - 1
    if steps * h > LONGEST:
        return t, 0.0, False
    if s.clamped:
        rest, fade = steady_rate(t, s.xf, d), moving[k + 17 * WIDTH]
        free, pull = rest + (s.vs - rest) * fade, t.force / t.damping * (1.0 - fade)
    elif carried(t, s.direction, s.xs, s.wire):
        a, b = s.xf - t.dry * d, s.xs - slide_base(t, deflection, d)
        free = moving[k + 12 * WIDTH] * a + moving[k + 13 * WIDTH] * s.wf
        free += moving[k + 14 * WIDTH] * b + moving[k + 15 * WIDTH] * s.vs
        swing = moving[k + 4 * WIDTH] * a + moving[k + 5 * WIDTH] * s.wf - s.wf
        swing += moving[k + 6 * WIDTH] * b + moving[k + 7 * WIDTH] * s.vs
        pull = moving[k + 12 * WIDTH] - moving[k + 14 * WIDTH] * t.reach
    else:
        still = still_flapper(t.ratio, deflection, s.wire)
        rest, fade = steady_rate(t, still, d), loose[k + 15 * WIDTH]
        free = rest + (s.vs - rest) * fade
        free += loose[k + 12 * WIDTH] * (s.xf - still) + loose[k + 13 * WIDTH] * s.wf
        swing = loose[k + 4 * WIDTH] * (s.xf - still) + loose[k + 5 * WIDTH] * s.wf - s.wf
        pull = t.force / t.damping * (1.0 - fade)
    mean, _, less, doubt = creep(t, steps * h, s.vs * d, free * d, pull, swing * d)
    law = SpoolLaw(
        t.ratio, t.reach, t.force, t.mass, t.damping, t.dynamic + t.force * mean, t.dry + mean,
        t.breakaway, t.extra, t.by_stribeck, t.flapper_stop, t.stroke, t.backlash, t.bend,
        t.ring_damping, t.ring_rate,
    )  # fmt: skip
    return law, less, doubt <= DOUBT
