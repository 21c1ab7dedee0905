"""First stage and spool of many candidates over a tick.

The same equations as `ehadiag.model.scalar.spool_tick`. The spool moves by quarters of a tick,
exactly; a lane in which an event may hide takes the whole tick alone
(`ehadiag.model.simd.spool_events`). No lane's result depends on its neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.vector import (
    WIDTH,
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
from ehadiag.model.plant import PlantConstants
from ehadiag.model.simd.layout import (
    ANCHORED,
    BREAK,
    BUSY,
    CLAMPED,
    DIRECTION,
    DONE,
    DRY,
    FILTERED,
    FLAPPER,
    FLAPPER_RATE,
    LANES,
    MOVE,
    PLACE,
    REST,
    ROOM,
    SLOPE,
    SPOOL,
    SPOOL_OFFSET,
    SPOOL_RATE,
)

__all__ = ["anchor_lanes", "rest", "spool_lanes"]

BIG = 1e30
LEAST_DEPTH = -1e-14
"""m and (times 10) m/s: what rounding may make of a spool that creeps towards rest."""
CREEP = 1e-18
"""m/s. A creeping spool never stops by the equations; slower than this it would run into
denormal numbers, which cost a hundred times as much."""


@packed
def rest(
    c: PlantConstants,
    current_before: float,
    origin: float,
    coefficients: NDArray[np.float64],
    state: NDArray[np.float64],
) -> None:
    """State of all lanes before the first tick: at rest, the flapper in equilibrium if it can.

    The count of re-anchorings goes on from span to span.
    """
    xs = min(max(origin, -c.XSM), c.XSM)
    state[: ANCHORED * LANES] = 0.0
    for o in range(0, LANES, WIDTH):
        held = load(coefficients, BREAK * LANES + o)
        store(
            state,
            FLAPPER * LANES + o,
            most(least((c.GM * current_before - c.KSF * xs) / c.KF, held), -held),
        )
        store(state, SPOOL * LANES + o, xs)


@packed
def _quarter(
    m: tuple[Vector, ...], a: Vector, w: Vector, b: Vector, v: Vector,
    bow: float, dry: Vector, slowest: Vector, lowest: Vector, widest: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector]:  # fmt: skip
    """One step of the moving spool, positive along its motion, and how near it came to an event."""
    na = m[0] * a + m[1] * w + m[2] * b + m[3] * v
    nw = m[4] * a + m[5] * w + m[6] * b + m[7] * v
    nb = m[8] * a + m[9] * w + m[10] * b + m[11] * v
    nv = m[12] * a + m[13] * w + m[14] * b + m[15] * v
    swing = bow * most(magnitude(w), magnitude(nw))
    # Where the flapper turns inside the step, the spool might stop there.
    inside = where(w * nw < 0.0, least(a, na) - swing, BIG)
    widest = most(widest, magnitude(na + dry) + swing)
    return na, nw, nb, nv, least(slowest, nv), least(lowest, inside), widest


@packed
def spool_lanes(
    c: PlantConstants,
    torque: float,
    tick: float,
    ring_damping: float,
    ring_time: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> bool:
    """Flapper and spool of all lanes over a tick without events.

    `ring_time`: reciprocal of the flapper's angular frequency, s. Lanes in which an event may hide
    are marked BUSY and left as they were; returns whether there are any.
    """
    any_busy = False
    bow, by_KSF, by_KF = tick / 16.0, 1.0 / c.KSF, 1.0 / c.KF
    for o in range(0, LANES, WIDTH):
        xf, wf = load(state, FLAPPER * LANES + o), load(state, FLAPPER_RATE * LANES + o)
        xs, vs = load(state, SPOOL * LANES + o), load(state, SPOOL_RATE * LANES + o)
        d, clamped = load(state, DIRECTION * LANES + o), load(state, CLAMPED * LANES + o)
        dry = load(coefficients, DRY * LANES + o)
        # At rest, if the flapper rings too little to end that.
        still = (torque - c.KSF * xs) * by_KF
        ra = xf - still
        rb = (wf + ring_damping * ra) * ring_time
        room = load(coefficients, ROOM * LANES + o) - magnitude(still)
        free = clamped == 0.0
        rests = (d == 0.0) & free & (room > 0.0) & (ra * ra + rb * rb < room * room)
        k = REST * LANES + o
        rest_xf = still + load(coefficients, k) * ra + load(coefficients, k + LANES) * wf
        rest_wf = load(coefficients, k + 2 * LANES) * ra + load(coefficients, k + 3 * LANES) * wf
        new_xf, new_wf = where(rests, rest_xf, xf), where(rests, rest_wf, wf)
        zero = d * 0.0
        x1, x2, x3, x4 = xs, xs, xs, xs
        v1, v2, v3, v4 = zero, zero, zero, vs
        fine = rests
        if anywhere(d != 0.0):
            # Moving, about the point where both would rest.
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
            base = (torque - c.KF * dry * d) * by_KSF
            a, w, b, v = xf * d - dry, wf * d, (xs - base) * d, vs * d
            s, n, x = zero + BIG, zero + BIG, zero
            a, w, b, v, s, n, x = _quarter(m, a, w, b, v, bow, dry, s, n, x)
            b1, u1 = base + d * b, d * v
            a, w, b, v, s, n, x = _quarter(m, a, w, b, v, bow, dry, s, n, x)
            b2, u2 = base + d * b, d * v
            a, w, b, v, s, n, x = _quarter(m, a, w, b, v, bow, dry, s, n, x)
            b3, u3 = base + d * b, d * v
            a, w, b, v, s, n, x = _quarter(m, a, w, b, v, bow, dry, s, n, x)
            b4, u4 = base + d * b, d * most(v, CREEP)
            moves = (d != 0.0) & free & (s > 10.0 * LEAST_DEPTH) & (n > LEAST_DEPTH)
            moves = moves & (x < c.XFM) & (d * b4 < c.XSM)
            w = where(magnitude(w) > CREEP, w, 0.0)
            x1, x2 = where(moves, b1, xs), where(moves, b2, xs)
            x3, x4 = where(moves, b3, xs), where(moves, b4, xs)
            v1, v2 = where(moves, u1, 0.0), where(moves, u2, 0.0)
            v3, v4 = where(moves, u3, 0.0), where(moves, u4, vs)
            new_xf, new_wf = where(moves, (a + dry) * d, new_xf), where(moves, w * d, new_wf)
            fine = moves | rests
        store(path, PLACE * LANES + o, xs)
        store(path, SLOPE * LANES + o, vs)
        store(path, (PLACE + 1) * LANES + o, x1)
        store(path, (PLACE + 2) * LANES + o, x2)
        store(path, (PLACE + 3) * LANES + o, x3)
        store(path, (PLACE + 4) * LANES + o, x4)
        store(path, (SLOPE + 1) * LANES + o, v1)
        store(path, (SLOPE + 2) * LANES + o, v2)
        store(path, (SLOPE + 3) * LANES + o, v3)
        store(path, (SLOPE + 4) * LANES + o, v4)
        store(state, FLAPPER * LANES + o, new_xf)
        store(state, FLAPPER_RATE * LANES + o, new_wf)
        store(state, SPOOL * LANES + o, x4)
        store(state, SPOOL_RATE * LANES + o, v4)
        store(state, BUSY * LANES + o, where(fine, 0.0, 1.0))
        store(state, DONE * LANES + o, 0.0)
        if anywhere(~fine):
            any_busy = True
    return any_busy


@packed
def anchor_lanes(
    c: PlantConstants,
    measured: float,
    gain: float,
    small: float,
    large: float,
    state: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Re-anchor the spool of all lanes at the end of a tick (`ehadiag.model.anchor.Anchor`)."""
    for o in range(0, LANES, WIDTH):
        xs, filtered = load(state, SPOOL * LANES + o), load(state, FILTERED * LANES + o)
        error = measured - load(coefficients, SPOOL_OFFSET * LANES + o) - xs
        filtered = filtered + gain * (error - filtered)
        move = where(magnitude(filtered) > small, filtered, 0.0)
        move = where(magnitude(error) > large, error, move)
        jumps = move != 0.0
        store(state, FILTERED * LANES + o, where(jumps, 0.0, filtered))
        store(
            state, ANCHORED * LANES + o, load(state, ANCHORED * LANES + o) + where(jumps, 1.0, 0.0)
        )
        store(state, SPOOL * LANES + o, most(least(xs + move, c.XSM), -c.XSM))
