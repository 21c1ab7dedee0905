"""Second stage and jack of one lane over a part with events."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import inlined, kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.lanejack import jack_step
from ehadiag.model.lanelayout import (
    BUSY,
    DIVIDE,
    EASE,
    JACK,
    JACK_DIRECTION,
    JACK_FRICTION,
    JACK_VELOCITY,
    LANES,
    PLACE,
    RATE,
    SLOPE,
)

__all__ = ["jack_events"]

FINE_TRAVEL = 1.5e-6
MOST_CUTS = 32
SHORTEST = 1e-9


@inlined
def _denominator(c: PlantConstants, x: float) -> tuple[float, float, float]:
    """What `jack_step` wants to know of a spool position."""
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
def jack_events(
    c: PlantConstants,
    begin: int,
    end: int,
    span: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Jack of BUSY lanes over a part in which it stops, starts or crosses the closed orifice."""
    for i in range(LANES):
        if state[BUSY * LANES + i] != 0.0:
            _jack_event(c, i, begin, end, span, state, path, coefficients)


@inlined
def _jack_event(
    c: PlantConstants,
    i: int,
    begin: int,
    end: int,
    span: float,
    state: NDArray[np.float64],
    path: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> None:
    """Lane `i`."""
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
            p0, p1, p2, decay = jack_step(
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
