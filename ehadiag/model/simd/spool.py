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
from ehadiag.model.laws import driven, lagged, play, slide_base, still_flapper
from ehadiag.model.sensors import followed, read_spool, through_ends
from ehadiag.model.simd.layout import (
    ANCHORED,
    BUSY,
    CLAMPED,
    DEFLECTION,
    DIRECTION,
    DONE,
    FILTERED,
    FLAPPER,
    FLAPPER_RATE,
    FLOWING,
    IDLE,
    LANES,
    LOOSE,
    MOVE,
    NODES,
    PLACE,
    PLAYS,
    REST,
    RING_TIME,
    ROOM,
    SEEN,
    SENSING,
    SENSING_ROWS,
    SLOPE,
    SPOOL,
    SPOOL_LAGGED,
    SPOOL_RATE,
    WIRE,
    drive_laws,
    sampled_steps,
    sensor_laws,
    spool_laws,
    whole_steps,
)
from ehadiag.model.spool_events import TOUCH

__all__ = ["anchor_lanes", "deflect_lanes", "drive_lanes", "rest_lanes", "see_lanes", "spool_lanes"]

QUARTERS = 2
"""Halvings of a tick that make its pieces."""
BIG = 1e30
LEAST_DEPTH = -1e-14
"""m and (times 10) m/s: what rounding may make of a spool that creeps towards rest."""
CREEP = 1e-18
"""m/s. A creeping spool never stops by the equations; slower than this it would run into
denormal numbers, which cost a hundred times as much."""


@packed
def drive_lanes(
    end: int,
    current: float,
    plays: int,
    state: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Flapper deflection that the current (A) of a tick alone makes, all lanes, into the state."""
    for o in range(0, end, WIDTH):
        law = drive_laws(coefficients, o)
        flowing = load(state, FLOWING * LANES + o)
        store(state, FLOWING * LANES + o, lagged(law.left, flowing, current))
        value = law.bias + lagged(law.late, flowing, current)
        total, weight = value * 0.0, value * 0.0 + 1.0
        for i in range(plays):
            row = (PLAYS + i) * LANES + o
            held = play(load(state, row), value, law.spacing * (i + 0.5))
            store(state, row, held)
            total = total + weight * held
            weight = weight * law.fade
        store(state, DEFLECTION * LANES + o, driven(law, total))


@packed
def deflect_lanes(
    end: int, plays: int, state: NDArray[np.float64], coefficients: NDArray[np.float64]
) -> None:
    """Flapper deflection by what the plays hold, all lanes, into the state."""
    for o in range(0, end, WIDTH):
        law = drive_laws(coefficients, o)
        total, weight = law.bias * 0.0, law.bias * 0.0 + 1.0
        for i in range(plays):
            total = total + weight * load(state, (PLAYS + i) * LANES + o)
            weight = weight * law.fade
        store(state, DEFLECTION * LANES + o, driven(law, total))


@packed
def rest_lanes(
    end: int, origin: float, state: NDArray[np.float64], coefficients: NDArray[np.float64]
) -> None:
    """All lanes at rest, the spool at `origin` (m), the flapper in equilibrium if it can be.

    The deflection by the current is in the state; the count of re-anchorings goes on.
    """
    state[: DEFLECTION * LANES] = 0.0
    for o in range(0, end, WIDTH):
        t = spool_laws(coefficients, o)
        xs = most(least(t.stroke * 0.0 + origin, t.stroke), -t.stroke)
        still = still_flapper(t.ratio, load(state, DEFLECTION * LANES + o), xs)
        store(state, FLAPPER * LANES + o, most(least(still, t.breakaway), -t.breakaway))
        store(state, SPOOL * LANES + o, xs)
        store(state, WIRE * LANES + o, xs)
        store(state, SPOOL_LAGGED * LANES + o, xs)


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
def _loose_quarter(
    m: tuple[Vector, ...], a: Vector, w: Vector, b: Vector, v: Vector, bow: float,
    lift: Vector, dry: Vector, slowest: Vector, lowest: Vector, widest: Vector, steady: Vector,
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector]:  # fmt: skip
    """As `_quarter` within the backlash; a from the flapper's rest, b and v beside `steady`."""
    na, nw = m[0] * a + m[1] * w, m[2] * a + m[3] * w
    nb = b + m[4] * a + m[5] * w + m[6] * v
    nv = m[7] * a + m[8] * w + m[9] * v
    swing = bow * most(magnitude(w), magnitude(nw))
    inside = where(w * nw < 0.0, least(a, na) + lift - dry - swing, BIG)
    widest = most(widest, magnitude(na + lift) + swing)
    return na, nw, nb, nv, least(slowest, nv + steady), least(lowest, inside), widest


@packed
def spool_lanes(
    end: int,
    tick: float,
    backlash: bool,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> bool:
    """Flapper and spool of all lanes over a tick without events; backlash: of any lane.

    Lanes in which an event may hide are marked BUSY and left as they were; returns whether there
    are any.
    """
    any_busy = False
    bow = tick / 16.0
    for o in range(0, end, WIDTH):
        xf, wf = load(state, FLAPPER * LANES + o), load(state, FLAPPER_RATE * LANES + o)
        xs, vs = load(state, SPOOL * LANES + o), load(state, SPOOL_RATE * LANES + o)
        d, clamped = load(state, DIRECTION * LANES + o), load(state, CLAMPED * LANES + o)
        deflection, wire = load(state, DEFLECTION * LANES + o), load(state, WIRE * LANES + o)
        t = spool_laws(coefficients, o)
        dry = t.dry
        # At rest, if the flapper rings too little to end that.
        still = still_flapper(t.ratio, deflection, wire)
        ra = xf - still
        rb = (wf + t.ring_damping * ra) * load(coefficients, RING_TIME * LANES + o)
        room = load(coefficients, ROOM * LANES + o) - magnitude(still)
        free, idle = clamped == 0.0, load(coefficients, IDLE * LANES + o)
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
            base = slide_base(t, deflection, d)
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
            loose = d * (xs - wire) < t.backlash - TOUCH
            # A spool whose friction falls with its velocity: `ehadiag.model.simd.spool_creep`.
            plain = free & (t.extra == 0.0)
            moves = (d != 0.0) & plain & ~loose & (s > 10.0 * LEAST_DEPTH) & (n > LEAST_DEPTH)
            moves = moves & (x < t.flapper_stop) & (d * b4 < t.stroke)
            w = where(magnitude(w) > CREEP, w, 0.0)
            x1, x2 = where(moves, b1, xs), where(moves, b2, xs)
            x3, x4 = where(moves, b3, xs), where(moves, b4, xs)
            v1, v2 = where(moves, u1, 0.0), where(moves, u2, 0.0)
            v3, v4 = where(moves, u3, 0.0), where(moves, u4, vs)
            new_xf, new_wf = where(moves, (a + dry) * d, new_xf), where(moves, w * d, new_wf)
            fine = moves | rests
            if backlash and anywhere(loose & (d != 0.0) & free):
                k = LOOSE * LANES + o
                q = (
                    load(coefficients, k), load(coefficients, k + LANES),
                    load(coefficients, k + 4 * LANES), load(coefficients, k + 5 * LANES),
                    load(coefficients, k + 8 * LANES), load(coefficients, k + 9 * LANES),
                    load(coefficients, k + 11 * LANES), load(coefficients, k + 12 * LANES),
                    load(coefficients, k + 13 * LANES), load(coefficients, k + 15 * LANES),
                )  # fmt: skip
                # All positive along the motion; the flapper rings about `still`.
                lift, step = still * d, 0.25 * tick
                steady = (t.force * lift - t.dynamic) / t.damping
                a, w, b, v = xf * d - lift, wf * d, zero, vs * d - steady
                s, n, x = zero + BIG, zero + BIG, zero
                a, w, b, v, s, n, x = _loose_quarter(q, a, w, b, v, bow, lift, dry, s, n, x, steady)
                b1, u1 = xs + d * (b + step * steady), d * (v + steady)
                a, w, b, v, s, n, x = _loose_quarter(q, a, w, b, v, bow, lift, dry, s, n, x, steady)
                b2, u2 = xs + d * (b + 2.0 * step * steady), d * (v + steady)
                a, w, b, v, s, n, x = _loose_quarter(q, a, w, b, v, bow, lift, dry, s, n, x, steady)
                b3, u3 = xs + d * (b + 3.0 * step * steady), d * (v + steady)
                a, w, b, v, s, n, x = _loose_quarter(q, a, w, b, v, bow, lift, dry, s, n, x, steady)
                b4, u4 = xs + d * (b + 4.0 * step * steady), d * (v + steady)
                slips = (d != 0.0) & plain & loose & (s > 10.0 * LEAST_DEPTH) & (n > LEAST_DEPTH)
                slips = slips & (x < t.flapper_stop) & (d * b4 < t.stroke)
                slips = slips & (d * (b4 - wire) < t.backlash - TOUCH)
                x1, x2 = where(slips, b1, x1), where(slips, b2, x2)
                x3, x4 = where(slips, b3, x3), where(slips, b4, x4)
                v1, v2 = where(slips, u1, v1), where(slips, u2, v2)
                v3, v4 = where(slips, u3, v3), where(slips, u4, v4)
                new_xf = where(slips, (a + lift) * d, new_xf)
                new_wf = where(slips, w * d, new_wf)
                fine = fine | slips
        store(state, WIRE * LANES + o, play(wire, x4, t.backlash))
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
        fine = fine | (idle != 0.0)
        store(state, BUSY * LANES + o, where(fine, 0.0, 1.0))
        store(state, DONE * LANES + o, idle)
        if anywhere(~fine):
            any_busy = True
    return any_busy


@packed
def see_lanes(
    end: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Spool of all lanes as it is sampled in a tick, behind its filter or early, into the state."""
    for o in range(0, end, WIDTH):
        at_end = load(path, (PLACE + NODES) * LANES + o)
        law = sensor_laws(coefficients, o)
        place = QUARTERS * SENSING_ROWS * LANES + o
        step = load(coefficients, (SENSING + SENSING_ROWS - 1) * LANES + place)
        whole, upto = whole_steps(coefficients, place), sampled_steps(coefficients, place)
        lagged, early = load(state, SPOOL_LAGGED * LANES + o), at_end
        for n in range(NODES):
            a, b = n * LANES + o, (n + 1) * LANES + o
            cubic = through_ends(
                load(path, a), load(path, b),
                0.25 * tick * load(path, SLOPE * LANES + a),
                0.25 * tick * load(path, SLOPE * LANES + b),
            )  # fmt: skip
            early = where(step == n * 1.0, followed(upto, lagged, cubic), early)
            lagged = followed(whole, lagged, cubic)
        store(state, SPOOL_LAGGED * LANES + o, lagged)
        seen = where(law.lag + law.lead == 0.0, at_end, early)
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
        law = sensor_laws(coefficients, o)
        error = measured - read_spool(law, load(state, read * LANES + o))
        filtered = filtered + gain * (error - filtered)
        move = where(magnitude(filtered) > small, filtered, 0.0)
        move = where(magnitude(error) > large, error, move)
        jumps = move != 0.0
        store(state, FILTERED * LANES + o, where(jumps, 0.0, filtered))
        store(
            state, ANCHORED * LANES + o, load(state, ANCHORED * LANES + o) + where(jumps, 1.0, 0.0)
        )
        stroke = spool_laws(coefficients, o).stroke
        placed = most(least(xs + move, stroke), -stroke)
        store(state, SPOOL * LANES + o, placed)
        store(state, WIRE * LANES + o, load(state, WIRE * LANES + o) + (placed - xs))
        if read == SEEN:
            lagged = load(state, SPOOL_LAGGED * LANES + o)
            store(state, SPOOL_LAGGED * LANES + o, lagged + (placed - xs))
