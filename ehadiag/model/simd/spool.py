"""First stage and spool of many candidates over a tick.

The same equations as `ehadiag.model.scalar.spool_tick`. The spool moves by quarters of a tick,
exactly; a lane in which an event may hide takes the whole tick alone
(`ehadiag.model.simd.spool_events`). No lane's result depends on its neighbours. `end`: the lanes
before it are run, whole vectors.
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
from ehadiag.model.laws import drive, slide_base, still_flapper
from ehadiag.model.simd.layout import (
    ANCHORED,
    BREAKAWAY,
    BUSY,
    CLAMPED,
    DEFLECTION,
    DIRECTION,
    DONE,
    DRIVE_GAIN,
    DRY,
    FILTERED,
    FLAPPER,
    FLAPPER_RATE,
    FLAPPER_STOP,
    LANES,
    MOVE,
    NODES,
    PLACE,
    RATIO,
    REACH,
    REST,
    RING_DAMPING,
    RING_TIME,
    ROOM,
    SEEN,
    SEEN_PLACE,
    SEEN_PLACE_BEFORE,
    SEEN_SLOPE,
    SEEN_SLOPE_BEFORE,
    SLOPE,
    SPOOL,
    SPOOL_OFFSET,
    SPOOL_RATE,
    STROKE,
)

__all__ = ["anchor_lanes", "drive_lanes", "rest_lanes", "see_lanes", "spool_lanes"]

BIG = 1e30
LEAST_DEPTH = -1e-14
"""m and (times 10) m/s: what rounding may make of a spool that creeps towards rest."""
CREEP = 1e-18
"""m/s. A creeping spool never stops by the equations; slower than this it would run into
denormal numbers, which cost a hundred times as much."""


@packed
def drive_lanes(
    end: int, current: float, state: NDArray[np.float64], coefficients: NDArray[np.float64]
) -> None:
    """Flapper deflection that the current (A) of a tick alone makes, all lanes, into the state."""
    for o in range(0, end, WIDTH):
        gain = load(coefficients, DRIVE_GAIN * LANES + o)
        store(state, DEFLECTION * LANES + o, drive(gain, current))


@packed
def rest_lanes(
    end: int, origin: float, state: NDArray[np.float64], coefficients: NDArray[np.float64]
) -> None:
    """All lanes at rest, the spool at `origin` (m), the flapper in equilibrium if it can be.

    The deflection by the current is in the state; the count of re-anchorings goes on.
    """
    state[: DEFLECTION * LANES] = 0.0
    for o in range(0, end, WIDTH):
        stroke = load(coefficients, STROKE * LANES + o)
        xs = most(least(stroke * 0.0 + origin, stroke), -stroke)
        limit = load(coefficients, BREAKAWAY * LANES + o)
        still = still_flapper(
            load(coefficients, RATIO * LANES + o), load(state, DEFLECTION * LANES + o), xs
        )
        store(state, FLAPPER * LANES + o, most(least(still, limit), -limit))
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
    end: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> bool:
    """Flapper and spool of all lanes over a tick without events.

    Lanes in which an event may hide are marked BUSY and left as they were; returns whether there
    are any.
    """
    any_busy = False
    bow = tick / 16.0
    for o in range(0, end, WIDTH):
        xf, wf = load(state, FLAPPER * LANES + o), load(state, FLAPPER_RATE * LANES + o)
        xs, vs = load(state, SPOOL * LANES + o), load(state, SPOOL_RATE * LANES + o)
        d, clamped = load(state, DIRECTION * LANES + o), load(state, CLAMPED * LANES + o)
        deflection = load(state, DEFLECTION * LANES + o)
        dry = load(coefficients, DRY * LANES + o)
        # At rest, if the flapper rings too little to end that.
        still = still_flapper(load(coefficients, RATIO * LANES + o), deflection, xs)
        ra = xf - still
        rb = (wf + load(coefficients, RING_DAMPING * LANES + o) * ra) * load(
            coefficients, RING_TIME * LANES + o
        )
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
            base = slide_base(load(coefficients, REACH * LANES + o), deflection, dry, d)
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
            moves = moves & (x < load(coefficients, FLAPPER_STOP * LANES + o))
            moves = moves & (d * b4 < load(coefficients, STROKE * LANES + o))
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
def see_lanes(
    end: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Spool of all lanes as it is sampled in a tick, into the state."""
    before, now = NODES - 1, NODES
    for o in range(0, end, WIDTH):
        seen = load(coefficients, SEEN_PLACE * LANES + o) * load(path, (PLACE + now) * LANES + o)
        seen = seen + load(coefficients, SEEN_PLACE_BEFORE * LANES + o) * load(
            path, (PLACE + before) * LANES + o
        )
        seen = seen + load(coefficients, SEEN_SLOPE_BEFORE * LANES + o) * load(
            path, (SLOPE + before) * LANES + o
        )
        seen = seen + load(coefficients, SEEN_SLOPE * LANES + o) * load(
            path, (SLOPE + now) * LANES + o
        )
        store(state, SEEN * LANES + o, seen)


@packed
def anchor_lanes(
    end: int,
    read: int,
    measured: float,
    gain: float,
    small: float,
    large: float,
    state: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Re-anchor the spool of all lanes at the end of a tick (`ehadiag.model.anchor.Anchor`).

    read: row of the state that has the spool as it is sampled.
    """
    for o in range(0, end, WIDTH):
        xs, filtered = load(state, SPOOL * LANES + o), load(state, FILTERED * LANES + o)
        error = measured - load(coefficients, SPOOL_OFFSET * LANES + o)
        error = error - load(state, read * LANES + o)
        filtered = filtered + gain * (error - filtered)
        move = where(magnitude(filtered) > small, filtered, 0.0)
        move = where(magnitude(error) > large, error, move)
        jumps = move != 0.0
        store(state, FILTERED * LANES + o, where(jumps, 0.0, filtered))
        store(
            state, ANCHORED * LANES + o, load(state, ANCHORED * LANES + o) + where(jumps, 1.0, 0.0)
        )
        stroke = load(coefficients, STROKE * LANES + o)
        store(state, SPOOL * LANES + o, most(least(xs + move, stroke), -stroke))
