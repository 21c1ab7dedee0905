"""Second stage and jack of many candidates: one lane each.

The same equations as `ehadiag.model.jack`, written with one common denominator, so that a part
needs no branch. A lane whose jack sticks, breaks away or crosses the closed orifice fast takes that
part alone (`ehadiag.model.lanestops`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.constants import PlantConstants
from ehadiag.model.lanelayout import (
    BUSY,
    DIVIDE,
    EASE,
    JACK,
    JACK_DIRECTION,
    JACK_FRICTION,
    JACK_VELOCITY,
    LANES,
    NODES,
    PLACE,
    PRESSURE,
    RATE,
    SLOPE,
    packed,
    packed_inline,
)

__all__ = ["jack_lanes", "jack_step", "pressures"]

COARSE_TRAVEL = 8.0e-6
COARSE_RATIO = 0.5
"""Spool travel within a part (m, or share of the distance from the middle) to be cut up."""
CORNER_TRAVEL = 2.0e-6
"""The same where the part passes the opening at which the pressure gain saturates, m."""
FINE_TRAVEL = 1.5e-6
MOST_CUTS = 32
DRIFT = -0.45


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
def jack_step(
    c: PlantConstants, load: float, span: float,
    x0: float, divide0: float, ease0: float, rate0: float,
    x1: float, v1: float, divide1: float, ease1: float, rate1: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Velocity of the moving jack over a part, p0 + p1 t + p2 t² + (v - p0) exp(-rate t).

    See `ehadiag.model.jack._approach`. With D = GQ max(abs(x), PSR/GP) + PSR CLK the second stage
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
def jack_lanes(
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
        p0, p1, p2, rate = jack_step(
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


@packed
def pressures(c: PlantConstants, state: NDArray[np.float64], path: NDArray[np.float64]) -> None:
    """Differential pressure of all lanes at the end of a tick, into the state."""
    for i in range(LANES):
        flow = c.GQ * path[(PLACE + NODES) * LANES + i] - c.AJ * state[JACK_VELOCITY * LANES + i]
        p12 = c.PSR * flow / state[DIVIDE * LANES + i]
        state[PRESSURE * LANES + i] = min(max(p12, -c.PSR), c.PSR)
