"""Second stage and jack of many candidates: one lane each.

The equations of `ehadiag.model.scalar.jack` by Radau's collocation of order 5 (IIA, three stages;
Hairer, Wanner, Solving Ordinary Differential Equations II, section IV.5), which damps what is
stiff. Unknown are the pressures of the stages, not the velocities: with D = GQ max(abs(x),
PSR/GP) + PSR CLK the second stage of model.md section 1 reads P12 = PSR (GQ x - AJ v) / D at any x,
so the stages' equations are linear with coefficients that need no division, no branch and no
exponential, and a step takes one division, for the last stage's pressure. A lane whose jack sticks,
breaks away or meets its stop takes that step alone (`ehadiag.model.simd.jack_events`).
"""

from __future__ import annotations

import math
from typing import Any

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
    BUSY,
    DONE,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_FRICTION,
    JACK_VELOCITY,
    LANES,
    NODES,
    PLACE,
    PRESSURE,
    SLOPE,
)

__all__ = ["C1", "C2", "divide", "jack_lanes", "last_velocity", "pressures"]

ROOT = math.sqrt(6.0)
C1, C2 = (4.0 - ROOT) / 10.0, (4.0 + ROOT) / 10.0
A11, A12, A13 = (
    (88.0 - 7.0 * ROOT) / 360.0,
    (296.0 - 169.0 * ROOT) / 1800.0,
    (3.0 * ROOT - 2.0) / 225.0,
)
A21, A22, A23 = (
    (296.0 + 169.0 * ROOT) / 1800.0,
    (88.0 + 7.0 * ROOT) / 360.0,
    -(3.0 * ROOT + 2.0) / 225.0,
)
A31, A32, A33 = (16.0 - ROOT) / 36.0, (16.0 + ROOT) / 36.0, 1.0 / 9.0


MOST_HALVINGS = 4
COARSE_TRAVEL = 8.0e-6
"""Spool travel from first to last stage of a step (m, or the distance from the middle) from which
a lane goes alone."""
CORNER_TRAVEL = 4.0e-6
"""The same where the step passes the opening at which the pressure gain saturates, m."""


def _stages() -> NDArray[np.float64]:
    """Where the stages of a step stand on the spool's path, shape (5, 16, 3, 5), flat.

    For a tick cut into 1, 2, 4, 8 or 16 steps, and each step: the node before, and Hermite's
    weights of place before and after and of slope (by the length of the tick) before and after.
    """
    out = np.zeros((MOST_HALVINGS + 1, 1 << MOST_HALVINGS, 3, 5))
    for level in range(MOST_HALVINGS + 1):
        for step in range(1 << level):
            for stage, share in enumerate((C1, C2, 1.0)):
                where = (step + share) / (1 << level) * NODES
                node = min(int(where), NODES - 1)
                u = where - node
                out[level, step, stage] = (
                    node,
                    (1.0 + 2.0 * u) * (1.0 - u) ** 2,
                    u * u * (3.0 - 2.0 * u),
                    u * (1.0 - u) ** 2 / NODES,
                    u * u * (u - 1.0) / NODES,
                )
    return out.ravel()


STAGES = _stages()


@packed
def divide(c: PlantConstants, width: Any) -> Any:
    """Common denominator D of the second stage, its opening `width` (m) no less than PSR / GP."""
    return c.GQ * width + c.PSR * c.CLK


@packed
def opening(c: PlantConstants, x: Any) -> Any:
    """Opening from which both gains follow, spool at x, in many lanes, m."""
    return most(magnitude(x), c.PSR / c.GP)


@packed
def last_velocity(
    c: PlantConstants, h: float, load: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, width1: Any, width2: Any, width3: Any,
) -> Any:  # fmt: skip
    """Velocity (m/s) of the moving jack after a step of `h` seconds.

    load: external and friction force, N; x1, x2, x3: spool at the three stages, m;
    width1, width2, width3: openings there, m. Numbers or vectors of them.
    """
    # E = D / (PSR AJ): velocity that a pressure takes; y: velocity without load.
    scale, k = 1.0 / (c.PSR * c.AJ), h / c.MJ
    e1, e2 = divide(c, width1) * scale, divide(c, width2) * scale
    e3 = divide(c, width3) * scale
    flow, thrust, drag = c.GQ / c.AJ, k * c.AJ, k * c.CJ
    y1, y2, y3 = flow * x1, flow * x2, flow * x3
    f1, f2, f3 = thrust + drag * e1, thrust + drag * e2, thrust + drag * e3
    z1 = y1 + drag * (A11 * y1 + A12 * y2 + A13 * y3) + k * C1 * load - velocity
    z2 = y2 + drag * (A21 * y1 + A22 * y2 + A23 * y3) + k * C2 * load - velocity
    z3 = y3 + drag * (A31 * y1 + A32 * y2 + A33 * y3) + k * load - velocity
    m11, m12, m13 = e1 + A11 * f1, A12 * f2, A13 * f3
    m21, m22, m23 = A21 * f1, e2 + A22 * f2, A23 * f3
    m31, m32, m33 = A31 * f1, A32 * f2, e3 + A33 * f3
    # Cramer's rule for the last stage's pressure.
    minor = m11 * m22 - m12 * m21
    above = m31 * (m12 * z2 - z1 * m22) - m32 * (m11 * z2 - z1 * m21) + z3 * minor
    below = m31 * (m12 * m23 - m13 * m22) - m32 * (m11 * m23 - m13 * m21) + m33 * minor
    return y3 - e3 * above / below


@packed
def _place(path: NDArray[np.float64], o: int, k: int, tick: float) -> Vector:
    """Spool at the stage whose place in STAGES is `k`, lanes from `o`."""
    a = int(STAGES[k]) * LANES + o
    b = a + LANES
    slopes = load(path, SLOPE * LANES + a) * STAGES[k + 3]
    slopes = slopes + load(path, SLOPE * LANES + b) * STAGES[k + 4]
    return STAGES[k + 1] * load(path, a) + STAGES[k + 2] * load(path, b) + tick * slopes


@packed
def jack_lanes(
    c: PlantConstants,
    level: int,
    step: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> bool:
    """Jack of all lanes over one of the 2^level steps of a tick.

    Lanes with an event are marked BUSY and left as they were; returns whether there are any.
    """
    any_busy = False
    h = tick / (1 << level)
    k = ((level << MOST_HALVINGS) + step) * 15
    for o in range(0, LANES, WIDTH):
        place, velocity = load(state, JACK * LANES + o), load(state, JACK_VELOCITY * LANES + o)
        d = load(state, JACK_DIRECTION * LANES + o)
        friction = load(coefficients, JACK_FRICTION * LANES + o)
        x3 = _place(path, o, k + 10, tick)
        width3 = opening(c, x3)
        # At rest: the force of the second stage, times D, against what holds.
        push = c.AJ * c.PSR * c.GQ * x3 - c.FR * divide(c, width3)
        held = magnitude(push) <= 2.0 * friction * divide(c, width3)
        held = held | ((magnitude(place) >= c.XJM) & (place * push > 0.0))
        done = load(state, DONE * LANES + o) != 0.0
        fine = done | ((d == 0.0) & held)
        if anywhere(d != 0.0):
            x1 = _place(path, o, k, tick)
            x2 = _place(path, o, k + 5, tick)
            width1, width2 = opening(c, x1), opening(c, x2)
            later = last_velocity(
                c, h, c.FR + d * friction, velocity, x1, x2, x3, width1, width2, width3
            )
            moved = place + 0.5 * h * (velocity + later)
            slides = (later * d > 0.0) & (magnitude(moved) < c.XJM)
            # What the collocation does not follow: a fresh start, a fast way past the closed
            # orifice.
            near = where(x1 * x3 > 0.0, least(magnitude(x1), magnitude(x3)), 0.0)
            travel = magnitude(x3 - x1)
            corner = c.PSR / c.GP
            coarse = travel > most(near, COARSE_TRAVEL)
            coarse = coarse | (
                (near < corner) & (most(width1, width3) > corner) & (travel > CORNER_TRAVEL)
            )
            slides = slides & ~coarse & (load(state, FRESH * LANES + o) == 0.0)
            slides = slides & ~done
            store(state, JACK * LANES + o, where(slides, moved, place))
            store(state, JACK_VELOCITY * LANES + o, where(slides, later, velocity))
            fine = fine | slides
        store(state, BUSY * LANES + o, where(fine, 0.0, 1.0))
        if anywhere(~fine):
            any_busy = True
    return any_busy


@packed
def pressures(c: PlantConstants, state: NDArray[np.float64], path: NDArray[np.float64]) -> None:
    """Differential pressure of all lanes at the end of a tick, into the state."""
    for o in range(0, LANES, WIDTH):
        x = load(path, (PLACE + NODES) * LANES + o)
        flow = c.GQ * x - c.AJ * load(state, JACK_VELOCITY * LANES + o)
        p12 = c.PSR * flow / divide(c, opening(c, x))
        store(state, PRESSURE * LANES + o, most(least(p12, c.PSR), -c.PSR))
