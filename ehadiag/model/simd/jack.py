"""Second stage and jack of many candidates over a step, one lane each.

One step of the collocation of `ehadiag.model.jack` for all lanes; a lane whose jack sticks, breaks
away or meets its stop takes that step alone (`ehadiag.model.simd.jack_events`).
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
from ehadiag.model.jack import C1, C2, radau_velocity
from ehadiag.model.laws import opening, pressure, resistance
from ehadiag.model.simd.layout import (
    BUSY,
    DONE,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_VELOCITY,
    LANES,
    NODES,
    PLACE,
    PRESSURE,
    SLOPE,
    jack_laws,
)

__all__ = ["jack_lanes", "pressures"]

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
def _place(path: NDArray[np.float64], o: int, k: int, tick: float) -> Vector:
    """Spool at the stage whose place in STAGES is `k`, lanes from `o`."""
    a = int(STAGES[k]) * LANES + o
    b = a + LANES
    slopes = load(path, SLOPE * LANES + a) * STAGES[k + 3]
    slopes = slopes + load(path, SLOPE * LANES + b) * STAGES[k + 4]
    return STAGES[k + 1] * load(path, a) + STAGES[k + 2] * load(path, b) + tick * slopes


@packed
def jack_lanes(
    end: int,
    level: int,
    step: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> bool:
    """Jack of the lanes before `end` over one of the 2^level steps of a tick.

    Lanes with an event are marked BUSY and left as they were; returns whether there are any.
    """
    any_busy = False
    h = tick / (1 << level)
    k = ((level << MOST_HALVINGS) + step) * 15
    for o in range(0, end, WIDTH):
        j = jack_laws(coefficients, o)
        place, velocity = load(state, JACK * LANES + o), load(state, JACK_VELOCITY * LANES + o)
        d = load(state, JACK_DIRECTION * LANES + o)
        x3 = _place(path, o, k + 10, tick)
        e3 = resistance(j, x3)
        # At rest: the force of the second stage, times e, against what holds.
        push = j.area * j.flow * x3 - j.load * e3
        held = magnitude(push) <= j.static * e3
        held = held | ((magnitude(place) >= j.stroke) & (place * push > 0.0))
        done = load(state, DONE * LANES + o) != 0.0
        fine = done | ((d == 0.0) & held)
        if anywhere(d != 0.0):
            x1 = _place(path, o, k, tick)
            x2 = _place(path, o, k + 5, tick)
            later = radau_velocity(
                j, h, j.load + d * j.friction, velocity, x1, x2, x3,
                resistance(j, x1), resistance(j, x2), e3,
            )  # fmt: skip
            moved = place + 0.5 * h * (velocity + later)
            slides = (later * d > 0.0) & (magnitude(moved) < j.stroke)
            # What the collocation does not follow: a fresh start, a fast way past the closed
            # orifice.
            near = where(x1 * x3 > 0.0, least(magnitude(x1), magnitude(x3)), 0.0)
            travel = magnitude(x3 - x1)
            coarse = travel > most(near, COARSE_TRAVEL)
            coarse = coarse | (
                (near < j.corner)
                & (most(opening(j, x1), opening(j, x3)) > j.corner)
                & (travel > CORNER_TRAVEL)
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
def pressures(
    end: int,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Differential pressure of all lanes at the end of a tick, into the state."""
    for o in range(0, end, WIDTH):
        j = jack_laws(coefficients, o)
        x = load(path, (PLACE + NODES) * LANES + o)
        p12 = pressure(j, x, load(state, JACK_VELOCITY * LANES + o))
        store(state, PRESSURE * LANES + o, most(least(p12, j.supply), -j.supply))
