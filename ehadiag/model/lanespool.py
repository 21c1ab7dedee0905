"""First stage and spool of many candidates over a tick: one lane each.

The same equations as `ehadiag.model.spooltick`. The spool moves by quarters of a tick, exactly; a
lane in which an event may hide takes the whole tick alone (`ehadiag.model.laneevents`). No lane's
result hangs on its neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.constants import PlantConstants
from ehadiag.model.lanelayout import (
    ANCHORED,
    BREAK,
    BUSY,
    CLAMPED,
    DIRECTION,
    DIVIDE,
    DRY,
    EASE,
    FILTERED,
    FLAPPER,
    FLAPPER_RATE,
    LANES,
    MOVE,
    NODES,
    PLACE,
    RATE,
    REST,
    ROOM,
    SLOPE,
    SPOOL,
    SPOOL_OFFSET,
    SPOOL_RATE,
    packed,
    packed_inline,
)

__all__ = ["anchor_lanes", "midpoints", "rest", "spool_lanes"]

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
    divide = c.GQ * max(abs(xs), c.PSR / c.GP) + c.PSR * c.CLK
    ease = 1.0 / (c.AJ * c.AJ * c.PSR + c.CJ * divide)
    state[: ANCHORED * LANES] = 0.0
    for i in range(LANES):
        most = coefficients[BREAK * LANES + i]
        xf = (c.GM * current_before - c.KSF * xs) / c.KF
        state[FLAPPER * LANES + i] = min(max(xf, -most), most)
        state[SPOOL * LANES + i] = xs
        state[DIVIDE * LANES + i] = divide
        state[EASE * LANES + i] = ease
        state[RATE * LANES + i] = 1.0 / (c.MJ * ease * divide)


@packed_inline
def _quarter(
    m00: float, m01: float, m02: float, m03: float, m10: float, m11: float, m12: float, m13: float,
    m20: float, m21: float, m22: float, m23: float, m30: float, m31: float, m32: float, m33: float,
    a: float, w: float, b: float, v: float,
    bow: float, dry: float, slowest: float, lowest: float, widest: float, fastest: float,
) -> tuple[float, float, float, float, float, float, float, float]:  # fmt: skip
    """One step of the moving spool, positive along its motion, and how near it came to an event."""
    na = m00 * a + m01 * w + m02 * b + m03 * v
    nw = m10 * a + m11 * w + m12 * b + m13 * v
    nb = m20 * a + m21 * w + m22 * b + m23 * v
    nv = m30 * a + m31 * w + m32 * b + m33 * v
    rate = max(abs(w), abs(nw))
    # Where the flapper turns inside the step, the spool might stop there.
    inside = min(a, na) - bow * rate if w * nw < 0.0 else BIG
    return (
        na, nw, nb, nv,
        min(slowest, nv), min(lowest, inside), max(widest, abs(na + dry)), max(fastest, rate),
    )  # fmt: skip


@packed
def spool_lanes(
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    torque: float,
    bow: float,
    KF: float,
    KSF: float,
    XFM: float,
    XSM: float,
    ring_damping: float,
    ring_time: float,
) -> int:
    """Flapper and spool of all lanes over a tick without events.

    `bow`: a sixteenth of a tick, s; `ring_time`: reciprocal of the flapper's angular frequency, s.
    Lanes in which an event may hide are marked BUSY and left as they were; returns their number.
    """
    busy = 0
    by_KSF, by_KF = 1.0 / KSF, 1.0 / KF
    for i in range(LANES):
        xf, wf = state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i]
        xs, vs = state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i]
        d, clamped = state[DIRECTION * LANES + i], state[CLAMPED * LANES + i]
        dry = coefficients[DRY * LANES + i]
        o = MOVE * LANES + i
        m00, m01 = coefficients[o], coefficients[o + LANES]
        m02, m03 = coefficients[o + 2 * LANES], coefficients[o + 3 * LANES]
        m10, m11 = coefficients[o + 4 * LANES], coefficients[o + 5 * LANES]
        m12, m13 = coefficients[o + 6 * LANES], coefficients[o + 7 * LANES]
        m20, m21 = coefficients[o + 8 * LANES], coefficients[o + 9 * LANES]
        m22, m23 = coefficients[o + 10 * LANES], coefficients[o + 11 * LANES]
        m30, m31 = coefficients[o + 12 * LANES], coefficients[o + 13 * LANES]
        m32, m33 = coefficients[o + 14 * LANES], coefficients[o + 15 * LANES]
        # At rest, if the flapper rings too little to end that.
        still = (torque - KSF * xs) * by_KF
        ra = xf - still
        rb = (wf + ring_damping * ra) * ring_time
        room = coefficients[ROOM * LANES + i] - abs(still)
        rests = (d == 0.0) & (clamped == 0.0) & (room > 0.0) & (ra * ra + rb * rb < room * room)
        o = REST * LANES + i
        rest_xf = still + coefficients[o] * ra + coefficients[o + LANES] * wf
        rest_wf = coefficients[o + 2 * LANES] * ra + coefficients[o + 3 * LANES] * wf
        # Moving, about the point where both would rest.
        rest_xs = (torque - KF * dry * d) * by_KSF
        a, w, b, v = xf * d - dry, wf * d, (xs - rest_xs) * d, vs * d
        s, n, x, f = BIG, BIG, 0.0, 0.0
        a, w, b, v, s, n, x, f = _quarter(
            m00, m01, m02, m03, m10, m11, m12, m13, m20, m21, m22, m23, m30, m31, m32, m33,
            a, w, b, v, bow, dry, s, n, x, f,
        )  # fmt: skip
        x1, v1 = rest_xs + d * b, d * v
        a, w, b, v, s, n, x, f = _quarter(
            m00, m01, m02, m03, m10, m11, m12, m13, m20, m21, m22, m23, m30, m31, m32, m33,
            a, w, b, v, bow, dry, s, n, x, f,
        )  # fmt: skip
        x2, v2 = rest_xs + d * b, d * v
        a, w, b, v, s, n, x, f = _quarter(
            m00, m01, m02, m03, m10, m11, m12, m13, m20, m21, m22, m23, m30, m31, m32, m33,
            a, w, b, v, bow, dry, s, n, x, f,
        )  # fmt: skip
        x3, v3 = rest_xs + d * b, d * v
        a, w, b, v, s, n, x, f = _quarter(
            m00, m01, m02, m03, m10, m11, m12, m13, m20, m21, m22, m23, m30, m31, m32, m33,
            a, w, b, v, bow, dry, s, n, x, f,
        )  # fmt: skip
        x4, v4 = rest_xs + d * b, d * max(v, CREEP)
        moves = (d != 0.0) & (clamped == 0.0) & (s > 10.0 * LEAST_DEPTH) & (n > LEAST_DEPTH)
        moves &= (x + bow * f < XFM) & (d * x4 < XSM)
        fine = moves | rests
        w = w if abs(w) > CREEP else 0.0
        path[PLACE * LANES + i], path[SLOPE * LANES + i] = xs, vs
        path[(PLACE + 2) * LANES + i] = x1 if moves else xs
        path[(PLACE + 4) * LANES + i] = x2 if moves else xs
        path[(PLACE + 6) * LANES + i] = x3 if moves else xs
        path[(PLACE + 8) * LANES + i] = x4 if moves else xs
        path[(SLOPE + 2) * LANES + i] = v1 if moves else 0.0
        path[(SLOPE + 4) * LANES + i] = v2 if moves else 0.0
        path[(SLOPE + 6) * LANES + i] = v3 if moves else 0.0
        path[(SLOPE + 8) * LANES + i] = v4 if moves else 0.0
        state[FLAPPER * LANES + i] = (a + dry) * d if moves else (rest_xf if rests else xf)
        state[FLAPPER_RATE * LANES + i] = w * d if moves else (rest_wf if rests else wf)
        state[SPOOL * LANES + i] = x4 if moves else xs
        state[SPOOL_RATE * LANES + i] = v4 if moves else vs
        state[BUSY * LANES + i] = 0.0 if fine else 1.0
        busy += int(not fine)
    return busy


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
    """Re-anchor the spool of all lanes at the end of a tick (`ehadiag.model.monitoring.Anchor`)."""
    corner, leak = c.PSR / c.GP, c.PSR * c.CLK
    moved = 0
    for i in range(LANES):
        xs, filtered = state[SPOOL * LANES + i], state[FILTERED * LANES + i]
        error = measured - coefficients[SPOOL_OFFSET * LANES + i] - xs
        filtered += gain * (error - filtered)
        move = error if abs(error) > large else (filtered if abs(filtered) > small else 0.0)
        jumps = move != 0.0
        state[FILTERED * LANES + i] = 0.0 if jumps else filtered
        state[ANCHORED * LANES + i] += 1.0 if jumps else 0.0
        state[SPOOL * LANES + i] = min(max(xs + move, -c.XSM), c.XSM)
        moved += int(jumps)
    if moved > 0:
        for i in range(LANES):
            divide = c.GQ * max(abs(state[SPOOL * LANES + i]), corner) + leak
            stiff = c.AJ * c.AJ * c.PSR + c.CJ * divide
            state[DIVIDE * LANES + i] = divide
            state[EASE * LANES + i] = 1.0 / stiff
            state[RATE * LANES + i] = stiff / (divide * c.MJ)


@packed
def midpoints(path: NDArray[np.float64], quarter: float) -> None:
    """Fill the odd nodes by Hermite's polynomial; `quarter` of a tick in s."""
    rise, bow = 1.5 / quarter, 0.125 * quarter
    for j in range(0, NODES, 2):
        for i in range(LANES):
            x0, x1 = path[(PLACE + j) * LANES + i], path[(PLACE + j + 2) * LANES + i]
            v0, v1 = path[(SLOPE + j) * LANES + i], path[(SLOPE + j + 2) * LANES + i]
            path[(PLACE + j + 1) * LANES + i] = 0.5 * (x0 + x1) + bow * (v0 - v1)
            path[(SLOPE + j + 1) * LANES + i] = rise * (x1 - x0) - 0.25 * (v0 + v1)
