"""Second stage and jack over one tick."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import inlined, kernel
from ehadiag.model.constants import PlantConstants
from ehadiag.model.jack import SHORTEST, _approach, _parts, _path, _sign_change, _valve
from ehadiag.monitor.layout import (
    DYNAMIC,
    JACK_DIRECTION,
    JACK_POSITION,
    JACK_SPOOL,
    JACK_VELOCITY,
)

__all__ = ["jack_tick"]

Vector = NDArray[np.float64]


@inlined
def _break_away(
    c: PlantConstants, static: float, supply: float, end_supply: float, place: float
) -> tuple[float, float]:
    """Whether a jack at rest breaks away on the way from one pressure to the next.

    Returns its direction, 0 if it stays, and the share of the way at which it goes.
    """
    push0, push1 = c.AJ * supply - c.FR, c.AJ * end_supply - c.FR
    blocked = abs(place) >= c.XJM and place * push1 > 0.0
    if abs(push1) <= static or blocked:
        return 0.0, 1.0
    direction = 1.0 if push1 > 0.0 else -1.0
    if push0 * direction <= static:
        return direction, (static * direction - push0) / (push1 - push0)
    return direction, 0.0


@kernel
def jack_tick(
    c: PlantConstants,
    parameters: Vector,
    nodes: Vector,
    count: int,
    jump: float,
    state: Vector,
) -> float:
    """Advance the jack over the spool's path of one tick, in place.

    Parameters
    ----------
    nodes, count: the spool's path.
    jump: of the spool after the tick, m.

    Returns
    -------
    Differential pressure at the end of the tick, Pa, before the jump.
    """
    dynamic = parameters[DYNAMIC]
    static = 2.0 * dynamic
    velocity, place, direction = state[JACK_VELOCITY], state[JACK_POSITION], state[JACK_DIRECTION]
    spool = state[JACK_SPOOL]
    supply, resistance, _, _ = _valve(c, spool)
    for node in range(count):
        span = nodes[node, 0]
        start, target = spool, nodes[node, 1]
        rise0, rise1 = span * nodes[node, 2], span * nodes[node, 3]
        parts = _parts(start, target, rise0, rise1)
        for part in range(1, parts + 1):
            left = span / parts
            end_spool, rise = _path(part / parts, start, target, rise0, rise1)
            end_supply, end_resistance, gain, gain_resistance = _valve(c, end_spool)
            while left > SHORTEST:
                if direction == 0.0:
                    direction, wait = _break_away(c, static, supply, end_supply, place)
                    if direction == 0.0:
                        break
                    if wait != 0.0:
                        spool += wait * (end_spool - spool)
                        supply, resistance, _, _ = _valve(c, spool)
                        left -= wait * left
                    continue
                p0, p1, p2, excess, rate = _approach(
                    c,
                    c.FR + direction * dynamic,
                    left,
                    velocity,
                    supply,
                    resistance,
                    end_supply,
                    end_resistance,
                    gain * rise / span,
                    gain_resistance * rise / span,
                )
                fade = math.exp(-left * rate)
                end_velocity = p0 + left * (p1 + left * p2) + excess * fade
                if end_velocity * direction > 0.0:
                    place += left * (p0 + left * (0.5 * p1 + left * p2 / 3.0))
                    place += excess * (1.0 - fade) / rate
                    velocity = end_velocity
                    if abs(place) >= c.XJM and place * velocity > 0.0:
                        place = math.copysign(c.XJM, place)
                        velocity, direction = 0.0, 0.0
                    break
                moved = _sign_change(p0, p1, p2, excess, rate, left)
                spool += moved / left * (end_spool - spool)
                supply, resistance, _, _ = _valve(c, spool)
                left -= moved
                velocity, direction = 0.0, 0.0
            spool, supply, resistance = end_spool, end_supply, end_resistance
    state[JACK_VELOCITY], state[JACK_POSITION] = velocity, place
    state[JACK_DIRECTION], state[JACK_SPOOL] = direction, spool + jump
    p12 = supply - resistance * c.AJ * velocity
    return float(min(max(p12, -c.PSR), c.PSR))
