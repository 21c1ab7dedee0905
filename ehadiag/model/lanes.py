"""The monitoring model for many candidates at once: one lane of a vector register each.

The same equations as `ehadiag.model.spooltick` and `ehadiag.model.jacktick`, as loops over lanes that the
compiler turns into vector instructions. The spool moves by quarters of a tick, exactly; a lane in
which an event may hide takes the whole tick alone (`event_tick`). The second stage is written with
one common denominator, so that it needs no branch and two divisions a part; a lane whose jack
sticks, breaks away or crosses the closed orifice fast takes that part alone (`jack_event`).
No lane's result hangs on its neighbours.

Arrays are flat, row r of lane i at r * LANES + i: the compiler then knows that rows do not overlap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import inlined, kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.spooltick import (
    BREAKAWAY,
    FLAPPER_STOP,
    NOTHING,
    RELEASE,
    REVERSAL,
    SPOOL_STOP,
    _clamped_event,
    _moving_event,
    _stuck_event,
)
from ehadiag.model.transition import FINEST, TAYLOR_HALVINGS, SpoolScalars

__all__ = [
    "BUSY",
    "COEFFICIENT_ROWS",
    "DIVIDE",
    "JACK_VELOCITY",
    "LANES",
    "NODES",
    "PATH_ROWS",
    "PRESSURE",
    "SPOOL",
    "STATE_ROWS",
    "event_tick",
    "jack_event",
    "jack_part",
    "midpoints",
    "pressures",
    "rest",
    "spool_tick",
    "tabulate",
]

F = TypeVar("F", bound=Callable[..., Any])


def packed(function: F) -> F:
    """Compile into the kernels that call it; min and max become one instruction: no NaN enters."""
    return numba.njit(nogil=True, error_model="numpy", fastmath=LOOSE)(function)


def packed_inline(function: F) -> F:
    """Compile as a part of a loop over lanes."""
    return numba.njit(nogil=True, error_model="numpy", fastmath=LOOSE, forceinline=True)(function)


LOOSE = {"contract", "nnan", "nsz"}
LANES = 16
NODES = 8
"""Nodes of the spool's path a tick; the vector step writes the even ones."""

# Rows of the state.
FLAPPER, FLAPPER_RATE, SPOOL, SPOOL_RATE, DIRECTION, CLAMPED, BUSY = 0, 1, 2, 3, 4, 5, 6
JACK, JACK_VELOCITY, JACK_DIRECTION, DIVIDE, EASE, RATE, PRESSURE = 7, 8, 9, 10, 11, 12, 13
STATE_ROWS = 14
# Rows of the path: position and velocity of the spool at the nodes 0 … NODES.
PLACE, SLOPE = 0, NODES + 1
PATH_ROWS = 2 * (NODES + 1)
# Rows of the coefficients: the step of a quarter tick (4 x 4), of a whole tick at rest (2 x 2).
DRY, BREAK, ROOM, DAMPING, DYNAMIC, JACK_FRICTION, REST, MOVE = 0, 1, 2, 3, 4, 5, 6, 10
COEFFICIENT_ROWS = 26

WHOLE = 1 << FINEST
GRID = WHOLE >> 3
TAYLOR_ORDER = 8
BIG = 1e30
LEAST_DEPTH = -1e-14
"""m and (times 10) m/s: what rounding may make of a spool that creeps towards rest."""
CREEP = 1e-18
"""m/s. A creeping spool never stops by the equations; slower than this it would run into
denormal numbers, which cost a hundred times as much."""
COARSE_TRAVEL = 8.0e-6
COARSE_RATIO = 0.5
"""Spool travel within a part (m, or share of the distance from the middle) to be cut up."""
CORNER_TRAVEL = 2.0e-6
"""The same where the part passes the opening at which the pressure gain saturates, m."""
FINE_TRAVEL = 1.5e-6
MOST_CUTS = 32
DRIFT = -0.45
SHORTEST = 1e-9


@packed
def _product(
    a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64], n: int, scale: float
) -> None:
    """Product of the n x n matrices of all lanes, times `scale`; shape (n * n, LANES)."""
    for r in range(n):
        for q in range(n):
            row = out[r * n + q]
            row[:] = 0.0
            for k in range(n):
                x, y = a[r * n + k], b[k * n + q]
                for i in range(LANES):
                    row[i] += scale * x[i] * y[i]


@packed
def _smallest(rates: NDArray[np.float64], n: int, tick: float) -> NDArray[np.float64]:
    """exp(rates h) for the finest step: Taylor at a still smaller one, then squaring."""
    scaled = rates * (tick / 2.0 ** (FINEST + TAYLOR_HALVINGS))
    term, power, spare = np.zeros_like(rates), np.zeros_like(rates), np.zeros_like(rates)
    for r in range(n):
        term[r * n + r] = 1.0
        power[r * n + r] = 1.0
    for order in range(1, TAYLOR_ORDER + 1):
        _product(term, scaled, spare, n, 1.0 / order)
        term, spare = spare, term
        power += term
    for _ in range(TAYLOR_HALVINGS):
        _product(power, power, spare, n, 1.0)
        power, spare = spare, power
    return power


@kernel
def tabulate(
    c: PlantConstants,
    tick: float,
    candidates: NDArray[np.float64],
    coefficients: NDArray[np.float64],
    moving: NDArray[np.float64],
    stuck: NDArray[np.float64],
) -> None:
    """Coefficients of all lanes.

    Parameters
    ----------
    candidates: (Kintas, FSS, FDJ, ...), shape (LANES, at least 3).
    coefficients: out, shape (COEFFICIENT_ROWS * LANES,).
    moving: out, transition over j finest steps with the spool moving, lane by lane, shape
        (LANES * (GRID + 1) * 16,).
    stuck: out, the same with the spool at rest, for all lanes, shape ((GRID + 1) * 4,).
    """
    rates, ring = np.zeros((16, LANES)), np.zeros((4, LANES))
    force = c.AS * c.GPF
    for i in range(LANES):
        flow_gain = c.GQF * (1.0 - 0.8 * candidates[i, 0])
        damping = c.GPF / flow_gain * c.AS * c.AS + c.CS
        static = c.FSS0 + candidates[i, 1] * (c.FSS1 - c.FSS0)
        coefficients[DRY * LANES + i] = 0.5 * static / force
        coefficients[BREAK * LANES + i] = static / force
        coefficients[ROOM * LANES + i] = min(static / force, c.XFM)
        coefficients[DAMPING * LANES + i] = damping
        coefficients[DYNAMIC * LANES + i] = 0.5 * static
        coefficients[JACK_FRICTION * LANES + i] = c.FDJ0 + candidates[i, 2] * (c.FDJ1 - c.FDJ0)
        rates[1, i], rates[11, i] = 1.0, 1.0
        rates[4, i], rates[5, i], rates[6, i] = -c.KF / c.JF, -c.CF / c.JF, -c.KSF / c.JF
        rates[12, i], rates[15, i] = force / c.MS, -damping / c.MS
        ring[1, i], ring[2, i], ring[3, i] = 1.0, -c.KF / c.JF, -c.CF / c.JF
    one, spare = _smallest(rates, 4, tick), np.empty((16, LANES))
    power = one.copy()
    for j in range(1, GRID + 1):
        for i in range(LANES):
            for e in range(16):
                moving[(i * (GRID + 1) + j) * 16 + e] = power[e, i]
        if j < GRID:
            _product(power, one, spare, 4, 1.0)
            power, spare = spare, power
    _product(power, power, spare, 4, 1.0)
    coefficients[MOVE * LANES : (MOVE + 16) * LANES] = spare.ravel()
    one, spare = _smallest(ring, 2, tick), np.empty((4, LANES))
    power = one.copy()
    for j in range(1, GRID + 1):
        for e in range(4):
            stuck[j * 4 + e] = power[e, 0]
        if j < GRID:
            _product(power, one, spare, 2, 1.0)
            power, spare = spare, power
    for _ in range(3):
        _product(power, power, spare, 2, 1.0)
        power, spare = spare, power
    coefficients[REST * LANES : (REST + 4) * LANES] = power.ravel()


@packed
def rest(
    c: PlantConstants,
    current_before: float,
    origin: float,
    coefficients: NDArray[np.float64],
    state: NDArray[np.float64],
) -> None:
    """State of all lanes before the first tick: at rest, the flapper in equilibrium if it can."""
    xs = min(max(origin, -c.XSM), c.XSM)
    divide = c.GQ * max(abs(xs), c.PSR / c.GP) + c.PSR * c.CLK
    ease = 1.0 / (c.AJ * c.AJ * c.PSR + c.CJ * divide)
    state[:] = 0.0
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
def spool_tick(
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


@kernel
def event_tick(
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
    """Flapper and spool of lane `i` over a tick with events, located to tick / 2^FINEST.

    A step to the next node that ends with an event is shortened, by regula falsi on the quantity
    that decides the event where there is one and by halving else, until the event is one finest
    step away; then that step is taken.
    """
    force, unit = c.AS * c.GPF, tick / WHOLE
    damping, dry = coefficients[DAMPING * LANES + i], coefficients[DRY * LANES + i]
    limit = coefficients[BREAK * LANES + i]
    t = SpoolScalars(force, damping, coefficients[DYNAMIC * LANES + i], limit, 0.0, 0.0)
    xf, wf = state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i]
    xs, vs = state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i]
    direction, clamped = int(state[DIRECTION * LANES + i]), state[CLAMPED * LANES + i] != 0.0
    done, single = 0, False
    while done < WHOLE:
        grid = GRID - (done & (GRID - 1))
        step = 1 if single else grid
        settled, single = single, False
        low, high = 0, grid + 1
        at_low = vs * direction if direction != 0 else limit - abs(xf)
        at_high = 1.0
        while True:
            new_xf, new_wf, new_xs, new_vs = xf, wf, xs, vs
            h = step * unit
            decides = 1.0
            if clamped:
                if direction != 0:
                    steady = (force * xf - t.dynamic * direction) / damping
                    fade = math.exp(-h * damping / c.MS)
                    new_xs += steady * h + (vs - steady) * (1.0 - fade) * c.MS / damping
                    new_vs = steady + (vs - steady) * fade
                event = _clamped_event(c, t, torque, xf, new_xs, new_vs, direction)
            elif direction != 0:
                rest_xf = dry * direction
                rest_xs = (torque - c.KF * rest_xf) / c.KSF
                a, b = xf - rest_xf, xs - rest_xs
                m = (i * (GRID + 1) + step) * 16
                new_xf = rest_xf + moving[m] * a + moving[m + 1] * wf
                new_xf += moving[m + 2] * b + moving[m + 3] * vs
                new_wf = moving[m + 4] * a + moving[m + 5] * wf
                new_wf += moving[m + 6] * b + moving[m + 7] * vs
                new_xs = rest_xs + moving[m + 8] * a + moving[m + 9] * wf
                new_xs += moving[m + 10] * b + moving[m + 11] * vs
                new_vs = moving[m + 12] * a + moving[m + 13] * wf
                new_vs += moving[m + 14] * b + moving[m + 15] * vs
                event = _moving_event(c, t, h, xf, wf, new_xf, new_wf, new_xs, new_vs, direction)
                decides = new_vs * direction
            else:
                rest_xf = (torque - c.KSF * xs) / c.KF
                a = xf - rest_xf
                new_xf = rest_xf + stuck[step * 4] * a + stuck[step * 4 + 1] * wf
                new_wf = stuck[step * 4 + 2] * a + stuck[step * 4 + 3] * wf
                event = _stuck_event(c, t, h, xf, wf, new_xf, new_wf, xs)
                decides = limit - abs(new_xf)
            if settled:
                break
            if event == NOTHING:
                if step == grid:
                    break
                low, at_low = step, decides
                at_high *= 0.5
            else:
                high, at_high = step, decides
                at_low *= 0.5
            if high - low == 1:
                settled = True
                if low == 0:
                    break
                step, single = low, True
            elif at_low > 0.0 and at_high < 0.0:
                guess = low + int((high - low) * at_low / (at_low - at_high) + 0.5)
                step = min(max(guess, low + 1), high - 1)
            else:
                step = (low + high) >> 1
        done += step
        xf, wf, xs, vs = new_xf, new_wf, new_xs, new_vs
        if event == REVERSAL:
            vs, direction = 0.0, 0
            if abs(xf) > limit:
                direction = 1 if xf > 0.0 else -1
        elif event == SPOOL_STOP:
            xs, vs, direction = math.copysign(c.XSM, xs), 0.0, 0
        elif event == BREAKAWAY:
            direction = 1 if xf > 0.0 else -1
        elif event == FLAPPER_STOP:
            xf, wf, clamped = math.copysign(c.XFM, xf), 0.0, True
        elif event == RELEASE:
            clamped = False
        if done & (GRID - 1) == 0:
            path[(PLACE + done // GRID) * LANES + i] = xs
            path[(SLOPE + done // GRID) * LANES + i] = vs
    state[FLAPPER * LANES + i], state[FLAPPER_RATE * LANES + i] = xf, wf
    state[SPOOL * LANES + i], state[SPOOL_RATE * LANES + i] = xs, vs
    state[DIRECTION * LANES + i] = direction
    state[CLAMPED * LANES + i] = 1.0 if clamped else 0.0


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


@packed_inline
def _fade(z: float) -> float:
    """exp(-z) for z >= 0, absolute error below 1e-7: a polynomial at z / 64, then squarings."""
    y = min(z, 40.0) * (-1.0 / 64.0)
    e = 1.0 / 24.0 + y * (1.0 / 120.0 + y * (1.0 / 720.0 + y * (1.0 / 5040.0)))
    e = 1.0 + y * (1.0 + y * (0.5 + y * (1.0 / 6.0 + y * e)))
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    return e * e


@packed_inline
def _jack_step(
    c: PlantConstants, load: float, span: float,
    x0: float, divide0: float, ease0: float, rate0: float,
    x1: float, v1: float, divide1: float, ease1: float, rate1: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Velocity of the moving jack over a part, p0 + p1 t + p2 t² + (v - p0) exp(-rate t).

    See `ehadiag.model.jacktick._approach`. With D = GQ max(abs(x), PSR/GP) + PSR CLK the second stage
    gives g PS = PSR GQ x / D and g R = PSR / D at any x, so the steady velocity is
    (AJ PSR GQ x - load D) / (AJ² PSR + CJ D) and tau = MJ D / (AJ² PSR + CJ D).
    """
    gain, by_span = c.AJ * c.PSR * c.GQ, 1.0 / span
    steady0 = (gain * x0 - load * divide0) * ease0
    steady1 = (gain * x1 - load * divide1) * ease1
    turn = math.copysign(c.GQ, x1) if abs(x1) > c.PSR / c.GP else 0.0
    slope1 = v1 * (gain - (load + steady1 * c.CJ) * turn) * ease1
    mean = (steady1 - steady0) * by_span
    tau0, tau1 = c.MJ * divide0 * ease0, c.MJ * divide1 * ease1
    drift = max((tau1 - tau0) * by_span, DRIFT)
    once, twice = 1.0 + drift, 1.0 + 2.0 * drift
    both, sum_tau = once * twice, tau0 + tau1
    inverse = 1.0 / (both * sum_tau)
    share = inverse * sum_tau
    p2 = (slope1 - mean) * by_span * once * share
    p1 = (2.0 * mean - slope1 - 2.0 * p2 * tau0) * twice * share
    p0 = steady0 - tau0 * p1
    return p0, p1, p2, (rate0 + rate1) * (1.0 / 6.0) + inverse * both * (4.0 / 3.0)


@packed
def jack_part(
    c: PlantConstants,
    begin: int,
    end: int,
    span: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> int:
    """Jack of all lanes from one node of the path to another, `span` s later.

    Lanes with an event are marked BUSY and left as they were; returns their number.
    """
    busy = 0
    gain, flow = c.AJ * c.PSR * c.GQ, c.AJ * c.AJ * c.PSR
    corner, leak, by_MJ = c.PSR / c.GP, c.PSR * c.CLK, 1.0 / c.MJ
    for i in range(LANES):
        x0, x1 = path[(PLACE + begin) * LANES + i], path[(PLACE + end) * LANES + i]
        v1 = path[(SLOPE + end) * LANES + i]
        place, velocity = state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i]
        d = state[JACK_DIRECTION * LANES + i]
        divide0, ease0 = state[DIVIDE * LANES + i], state[EASE * LANES + i]
        rate0 = state[RATE * LANES + i]
        friction = coefficients[JACK_FRICTION * LANES + i]
        divide1 = c.GQ * max(abs(x1), corner) + leak
        stiff = flow + c.CJ * divide1
        inverse = 1.0 / (divide1 * stiff)
        ease1, by_divide = inverse * divide1, inverse * stiff
        rate1 = stiff * by_divide * by_MJ
        p0, p1, p2, rate = _jack_step(
            c, c.FR + d * friction, span, x0, divide0, ease0, rate0, x1, v1, divide1, ease1, rate1
        )
        later = p0 + span * (p1 + span * p2) + (velocity - p0) * _fade(span * rate)
        moved = place + 0.5 * span * (velocity + later)
        push = gain * x1 * by_divide - c.FR
        near = min(abs(x0), abs(x1)) if x0 * x1 > 0.0 else 0.0
        coarse = abs(x1 - x0) > max(COARSE_TRAVEL, COARSE_RATIO * near)
        coarse |= ((abs(x0) - corner) * (abs(x1) - corner) < 0.0) & (abs(x1 - x0) > CORNER_TRAVEL)
        still = d == 0.0
        slides = (d != 0.0) & (later * d > 0.0) & (abs(moved) < c.XJM) & (not coarse)
        fine = slides | (still & (abs(push) <= 2.0 * friction))
        state[JACK * LANES + i] = moved if slides else place
        state[JACK_VELOCITY * LANES + i] = later if slides else velocity
        state[DIVIDE * LANES + i] = divide1 if fine else divide0
        state[EASE * LANES + i] = ease1 if fine else ease0
        state[RATE * LANES + i] = rate1 if fine else rate0
        state[BUSY * LANES + i] = 0.0 if fine else 1.0
        busy += int(not fine)
    return busy


@inlined
def _denominator(c: PlantConstants, x: float) -> tuple[float, float, float]:
    """What `_jack_step` wants to know of a spool position."""
    divide = c.GQ * max(abs(x), c.PSR / c.GP) + c.PSR * c.CLK
    stiff = c.AJ * c.AJ * c.PSR + c.CJ * divide
    return divide, 1.0 / stiff, stiff / (divide * c.MJ)


@inlined
def _zero(p0: float, p1: float, p2: float, excess: float, rate: float, span: float) -> float:
    """First time, s, where the velocity, not 0 before and turned at `span`, is 0: regula falsi."""
    low, high = 0.0, span
    at_low = p0 + excess
    at_high = p0 + span * (p1 + span * p2) + excess * math.exp(-span * rate)
    for _ in range(30):
        if at_low == at_high:
            break
        t = low + (high - low) * at_low / (at_low - at_high)
        value = p0 + t * (p1 + t * p2) + excess * math.exp(-t * rate)
        if value * at_low > 0.0:
            low, at_low = t, value
            at_high *= 0.5
        else:
            high, at_high = t, value
            at_low *= 0.5
        if high - low < SHORTEST or abs(value) < 1e-12:
            return t
    return high


@kernel
def jack_event(
    c: PlantConstants,
    i: int,
    begin: int,
    end: int,
    span: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of lane `i` over a part in which it stops, starts or crosses the closed orifice."""
    place, velocity = state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i]
    direction = state[JACK_DIRECTION * LANES + i]
    friction = coefficients[JACK_FRICTION * LANES + i]
    gain = c.AJ * c.PSR * c.GQ
    x, target = path[(PLACE + begin) * LANES + i], path[(PLACE + end) * LANES + i]
    rise0, rise1 = path[(SLOPE + begin) * LANES + i] * span, path[(SLOPE + end) * LANES + i] * span
    origin, cuts = x, min(MOST_CUTS, 1 + int(abs(target - x) / FINE_TRAVEL))
    divide, ease, rate = _denominator(c, x)
    for cut in range(1, cuts + 1):
        q = cut / cuts
        r = 1.0 - q
        end_x = origin + q * q * (3.0 - 2.0 * q) * (target - origin)
        end_x += q * r * (r * rise0 - q * rise1)
        slope = 6.0 * q * r * (target - origin) + r * (1.0 - 3.0 * q) * rise0
        slope = (slope + q * (3.0 * q - 2.0) * rise1) / span
        end_divide, end_ease, end_rate = _denominator(c, end_x)
        left = span / cuts
        while left > SHORTEST:
            if direction == 0.0:
                push0 = gain * x / divide - c.FR
                push1 = gain * end_x / end_divide - c.FR
                blocked = abs(place) >= c.XJM and place * push1 > 0.0
                if abs(push1) <= 2.0 * friction or blocked:
                    break
                direction = 1.0 if push1 > 0.0 else -1.0
                if push0 * direction <= 2.0 * friction:
                    wait = (2.0 * friction * direction - push0) / (push1 - push0)
                    x += wait * (end_x - x)
                    divide, ease, rate = _denominator(c, x)
                    left -= wait * left
                continue
            p0, p1, p2, decay = _jack_step(
                c, c.FR + direction * friction, left,
                x, divide, ease, rate, end_x, slope, end_divide, end_ease, end_rate,
            )  # fmt: skip
            excess = velocity - p0
            fade = math.exp(-left * decay)
            later = p0 + left * (p1 + left * p2) + excess * fade
            if later * direction > 0.0:
                place += left * (p0 + left * (0.5 * p1 + left * p2 / 3.0))
                place += excess * (1.0 - fade) / decay
                velocity = later
                if abs(place) >= c.XJM and place * velocity > 0.0:
                    place = math.copysign(c.XJM, place)
                    velocity, direction = 0.0, 0.0
                break
            moved = left if velocity == 0.0 else _zero(p0, p1, p2, excess, decay, left)
            x += moved / left * (end_x - x)
            divide, ease, rate = _denominator(c, x)
            left -= moved
            velocity, direction = 0.0, 0.0
        x, divide, ease, rate = end_x, end_divide, end_ease, end_rate
    state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i] = place, velocity
    state[JACK_DIRECTION * LANES + i] = direction
    state[DIVIDE * LANES + i], state[EASE * LANES + i] = divide, ease
    state[RATE * LANES + i] = rate


@packed
def pressures(c: PlantConstants, state: NDArray[np.float64], path: NDArray[np.float64]) -> None:
    """Differential pressure of all lanes at the end of a tick, into the state."""
    for i in range(LANES):
        flow = c.GQ * path[(PLACE + NODES) * LANES + i] - c.AJ * state[JACK_VELOCITY * LANES + i]
        p12 = c.PSR * flow / state[DIVIDE * LANES + i]
        state[PRESSURE * LANES + i] = min(max(p12, -c.PSR), c.PSR)
