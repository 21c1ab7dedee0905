"""Second stage and jack of one lane over a step in which it stops or starts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel
from ehadiag.compile.vector import packed
from ehadiag.model.plant import PlantConstants
from ehadiag.model.simd.jack import C1, C2, divide, last_velocity
from ehadiag.model.simd.layout import (
    BUSY,
    FRESH,
    JACK,
    JACK_DIRECTION,
    JACK_FRICTION,
    JACK_VELOCITY,
    LANES,
    NODES,
    SLOPE,
)

__all__ = ["jack_events", "jack_piece"]

FINE_TRAVEL = 3.0e-6
FINE_RATIO = 0.3
"""Spool travel within a part (m, or share of the distance from the middle)."""
FRESH_DECAY = 3.0
"""Decay (power of e) of the jack's velocity within a part, where it starts or stops."""
MOST_CUTS = 32
ITERATIONS = 30
SHORTEST = 1e-6
"""Share of a piece that counts as nothing."""
SLOWEST = 1e-12
"""Velocity that counts as none, m/s."""


@packed
def _place(q: float, x0: float, x1: float, rise0: float, rise1: float) -> float:
    """Spool at the share q of a piece of its path, m."""
    r = 1.0 - q
    return x0 + q * q * (3.0 - 2.0 * q) * (x1 - x0) + q * r * (r * rise0 - q * rise1)


@packed
def _velocity(
    c: PlantConstants, load: float, velocity: float, span: float, begin: float, end: float,
    x0: float, x1: float, rise0: float, rise1: float,
) -> float:  # fmt: skip
    """Velocity of the moving jack at the share `end` of a piece, `velocity` at `begin`, m/s."""
    step, corner = end - begin, c.PSR / c.GP
    first = _place(begin + C1 * step, x0, x1, rise0, rise1)
    second = _place(begin + C2 * step, x0, x1, rise0, rise1)
    third = _place(end, x0, x1, rise0, rise1)
    return last_velocity(
        c,
        step * span,
        load,
        velocity,
        first,
        second,
        third,
        max(abs(first), corner),
        max(abs(second), corner),
        max(abs(third), corner),
    )


@packed
def _excess(
    c: PlantConstants, hold: float, q: float, x0: float, x1: float, rise0: float, rise1: float
) -> float:
    """Force on the jack at rest beyond `hold` (positive away from it), times D."""
    x = _place(q, x0, x1, rise0, rise1)
    return c.AJ * c.PSR * c.GQ * x - (c.FR + hold) * divide(c, max(abs(x), c.PSR / c.GP))


@packed
def _stop(
    c: PlantConstants, load: float, velocity: float, d: float, later: float, span: float,
    begin: float, end: float, x0: float, x1: float, rise0: float, rise1: float,
) -> float:  # fmt: skip
    """Share of a piece at which the jack stops, `velocity` at `begin`, `later` at `end`.

    Chandrupatla, "A new hybrid quadratic/bisection algorithm", Advances in Engineering Software
    28(3), 1997.
    """
    newest, other, at_newest, at_other = end, begin, later * d, velocity * d
    share = at_newest / (at_newest - at_other)
    for _ in range(ITERATIONS):
        q = newest + share * (other - newest)
        value = _velocity(c, load, velocity, span, begin, q, x0, x1, rise0, rise1) * d
        if (value > 0.0) == (at_newest > 0.0):
            oldest, at_oldest = newest, at_newest
        else:
            oldest, at_oldest = other, at_other
            other, at_other = newest, at_newest
        newest, at_newest = q, value
        least = SHORTEST / abs(other - newest)
        if least > 0.5 or abs(value) < SLOWEST:
            return newest
        x = (newest - other) / (oldest - other)
        y = (at_newest - at_other) / (at_oldest - at_other)
        share = 0.5
        if y * y < x and (1.0 - y) * (1.0 - y) < 1.0 - x:
            share = at_newest / (at_other - at_newest) * at_oldest / (at_other - at_oldest)
            share += (
                (oldest - newest) / (other - newest)
                * at_newest / (at_oldest - at_newest) * at_other / (at_oldest - at_other)
            )  # fmt: skip
        share = min(max(share, least), 1.0 - least)
    return newest


@bare_kernel
def jack_piece(
    c: PlantConstants,
    friction: float,
    span: float,
    begin: float,
    stop: float,
    x0: float,
    x1: float,
    rise0: float,
    rise1: float,
    place: float,
    velocity: float,
    d: float,
    fresh: float,
) -> tuple[float, float, float, float]:
    """Jack of one lane over the shares begin … stop of a piece of the spool's path.

    span: of the whole piece, s; x0, x1: its ends, m; rise0, rise1: slopes there by span, m.

    d: direction of its motion, 0 at rest; fresh: not 0 if it has just started or stopped.
    Returns place, velocity, d and fresh afterwards.
    """
    if d == 0.0:
        up = _excess(c, 2.0 * friction, stop, x0, x1, rise0, rise1)
        down = _excess(c, -2.0 * friction, stop, x0, x1, rise0, rise1)
        if up <= 0.0 <= down:
            return place, velocity, 0.0, 0.0
    near = min(abs(x0), abs(x1)) if x0 * x1 > 0.0 else 0.0
    wanted = (stop - begin) * abs(x1 - x0) / max(FINE_TRAVEL, FINE_RATIO * near)
    # The collocation is slow to forget what a start or a stop leaves.
    scale = divide(c, max(near, c.PSR / c.GP))
    decay = (stop - begin) * span * (c.AJ * c.AJ * c.PSR / scale + c.CJ) / c.MJ
    if d == 0.0 or fresh != 0.0:
        wanted = max(wanted, decay / FRESH_DECAY)
    cuts = min(MOST_CUTS, 1 + int(wanted))
    q, cut, fresh = begin, 1, 0.0
    while cut <= cuts:
        end = begin + (stop - begin) * cut / cuts
        if d == 0.0:
            hold = 2.0 * friction
            up = _excess(c, hold, end, x0, x1, rise0, rise1)
            down = _excess(c, -hold, end, x0, x1, rise0, rise1)
            if (up <= 0.0 and down >= 0.0) or (abs(place) >= c.XJM and place * (up + down) > 0.0):
                q, cut = end, cut + 1
                continue
            d = 1.0 if up > 0.0 else -1.0
            hold *= d
            low, high = q, end
            at_low = _excess(c, hold, q, x0, x1, rise0, rise1) * d
            at_high = up if d > 0.0 else -down
            if at_low < 0.0:
                for _ in range(ITERATIONS):
                    q = low + (high - low) * at_low / (at_low - at_high)
                    value = _excess(c, hold, q, x0, x1, rise0, rise1) * d
                    if value < 0.0:
                        low, at_low = q, value
                        at_high *= 0.5
                    else:
                        high, at_high = q, value
                        at_low *= 0.5
                    if high - low < SHORTEST or abs(value) < 1e-9 * abs(hold):
                        break
            velocity, fresh = 0.0, 1.0
        load = c.FR + d * friction
        later = _velocity(c, load, velocity, span, q, end, x0, x1, rise0, rise1)
        if later * d > 0.0:
            place += 0.5 * (end - q) * span * (velocity + later)
            velocity = later
            if abs(place) >= c.XJM and place * velocity > 0.0:
                place = math.copysign(c.XJM, place)
                velocity, d = 0.0, 0.0
            q, cut = end, cut + 1
            continue
        if velocity != 0.0:
            q = _stop(c, load, velocity, d, later, span, q, end, x0, x1, rise0, rise1)
        else:
            q = end
        velocity, d, fresh = 0.0, 0.0, 1.0
        if end - q < SHORTEST:
            q, cut = end, cut + 1
    return place, velocity, d, fresh


@bare_kernel
def jack_events(
    c: PlantConstants,
    level: int,
    step: int,
    tick: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of BUSY lanes over one of the 2^level steps of a tick, piece by piece of the path."""
    span, steps = tick / NODES, 1 << level
    begin, stop = step * NODES / steps, (step + 1) * NODES / steps
    first, last = int(begin), math.ceil(stop)
    for i in range(LANES):
        if state[BUSY * LANES + i] == 0.0:
            continue
        place, velocity = state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i]
        d, fresh = state[JACK_DIRECTION * LANES + i], state[FRESH * LANES + i]
        for n in range(first, last):
            a, b = n * LANES + i, (n + 1) * LANES + i
            place, velocity, d, fresh = jack_piece(
                c, coefficients[JACK_FRICTION * LANES + i], span,
                max(begin - n, 0.0), min(stop - n, 1.0), path[a], path[b],
                span * path[SLOPE * LANES + a], span * path[SLOPE * LANES + b],
                place, velocity, d, fresh,
            )  # fmt: skip
        state[JACK * LANES + i], state[JACK_VELOCITY * LANES + i] = place, velocity
        state[JACK_DIRECTION * LANES + i], state[FRESH * LANES + i] = d, fresh
