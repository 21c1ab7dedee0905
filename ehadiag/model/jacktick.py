"""Second stage, jack and surface over one tick: kernel of the monitoring model.

Given the spool's path as pieces (`ehadiag.model.spooltick`), the jack velocity approaches its
steady value exponentially, tau = MJ / (AJ² g R + CJ) with g = 1 / (1 + R CLK) (model.md section 1,
the second-stage equation solved for P12). The steady value moves linearly over a piece; tau is that
of the piece's middle. Sticking and break-away are located inside the piece.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import inlined
from ehadiag.model.constants import PlantConstants

__all__ = ["jack_tick", "second_stage"]

SHORTEST = 1e-9
"""Pieces shorter than this (s) are taken as no time at all."""
TRAVEL = 1.0e-6
"""Spool travel (m) within one part of a piece, near the closed orifice."""
RATIO = 0.05
"""The same as a share of the spool's distance from the middle, elsewhere."""
BEND = 0.1e-6
"""Largest distance (m) between a part's path and its chord."""
MOST_PARTS = 32
BISECTIONS = 30
DRIFT = -0.45
"""Fastest fall of tau that the parabola serves (its second coefficient grows beyond bounds)."""


@inlined
def second_stage(constants: PlantConstants, spool: float) -> tuple[float, float, float, float]:
    """Second stage at a spool position (m), leakage solved for.

    Returns g PS (Pa), g R (Pa s/m³) and the derivatives of both by the spool position.
    """
    c = constants
    pressure = c.GP * spool
    if abs(pressure) <= c.PSR:
        resistance = c.GP / c.GQ
        share = 1.0 / (1.0 + resistance * c.CLK)
        return share * pressure, share * resistance, share * c.GP, 0.0
    inverse = 1.0 / spool
    pressure = math.copysign(c.PSR, spool)
    resistance = pressure * inverse / c.GQ
    share = 1.0 / (1.0 + resistance * c.CLK)
    slope = -share * share * resistance * inverse
    return share * pressure, share * resistance, -pressure * c.CLK * slope, slope


@inlined
def _parts(origin: float, target: float, rise0: float, rise1: float) -> int:
    """Into how many parts a piece is cut: short ones where the orifice is almost closed."""
    travel = abs(target - origin)
    nearest = 0.0 if origin * target <= 0.0 else min(abs(origin), abs(target))
    by_travel = travel / max(TRAVEL, RATIO * nearest)
    bend = 0.125 * abs(rise1 - rise0)
    by_bend = math.sqrt(bend / BEND)
    return min(MOST_PARTS, 1 + int(max(by_travel, by_bend)))


@inlined
def _sign_change(c0: float, c1: float, c2: float, excess: float, rate: float, span: float) -> float:
    """First time in 0 … span where c0 + c1 t + c2 t² + excess exp(-rate t) changes sign, s."""
    low, high = 0.0, span
    sign = 1.0 if c0 + excess > 0.0 else -1.0
    for _ in range(BISECTIONS):
        t = 0.5 * (low + high)
        if sign * (c0 + t * (c1 + t * c2) + excess * math.exp(-rate * t)) > 0.0:
            low = t
        else:
            high = t
    return high


@inlined
def _path(
    x: float, origin: float, target: float, rise0: float, rise1: float
) -> tuple[float, float]:
    """Position, and its derivative by x, at the share x of a piece of the spool's path."""
    y = 1.0 - x
    place = origin + x * x * (3.0 - 2.0 * x) * (target - origin) + x * y * (y * rise0 - x * rise1)
    slope = 6.0 * x * y * (target - origin) + y * (1.0 - 3.0 * x) * rise0
    return place, slope + x * (3.0 * x - 2.0) * rise1


@inlined
def _approach(
    c: PlantConstants,
    load: float,
    span: float,
    velocity: float,
    supply: float,
    resistance: float,
    end_supply: float,
    end_resistance: float,
    end_supply_rate: float,
    end_resistance_rate: float,
) -> tuple[float, float, float, float, float]:
    """How the velocity of the moving jack goes over a part of a piece.

    The steady velocity s is taken as a parabola that ends with the slope of the spool's path, tau
    as a straight line: tau v' + v = s is then met by a parabola p0 + p1 t + p2 t² exactly, and the
    rest of the velocity decays. Returns p0, p1, p2, that rest at the start, and its decay rate.
    """
    area2 = c.AJ * c.AJ
    ease0 = 1.0 / (area2 * resistance + c.CJ)
    ease1 = 1.0 / (area2 * end_resistance + c.CJ)
    steady0 = (c.AJ * supply - load) * ease0
    steady1 = (c.AJ * end_supply - load) * ease1
    slope1 = (c.AJ * end_supply_rate - steady1 * area2 * end_resistance_rate) * ease1
    mean = (steady1 - steady0) / span
    bend = (slope1 - mean) / span
    tau, end_tau = c.MJ * ease0, c.MJ * ease1
    drift = max((end_tau - tau) / span, DRIFT)
    p2 = bend / (1.0 + 2.0 * drift)
    p1 = (2.0 * mean - slope1 - 2.0 * p2 * tau) / (1.0 + drift)
    p0 = steady0 - tau * p1
    # Mean of 1/tau by Simpson's rule.
    rate = (area2 * (resistance + end_resistance) + 2.0 * c.CJ) / (6.0 * c.MJ)
    rate += 4.0 / (3.0 * (tau + end_tau))
    return p0, p1, p2, velocity - p0, rate


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


@inlined
def jack_tick(
    c: PlantConstants,
    dynamic: float,
    nodes: NDArray[np.float64],
    first: int,
    end: int,
    velocity: float,
    place: float,
    direction: float,
    spool: float,
    supply: float,
    resistance: float,
) -> tuple[float, float, float, float, float, float, float]:
    """Second stage and jack over the spool's path of one tick.

    Parameters
    ----------
    dynamic: dry friction of the moving jack, N; at rest it is twice that.
    nodes, first, end: the path, rows first … end - 1, see `ehadiag.model.spooltick.spool_tick`.
    velocity, place: of the jack, m/s and m.
    direction: of its motion, +1 or -1; 0 at rest.
    spool: position before the tick, m.
    supply, resistance: `second_stage` there.

    Returns
    -------
    Differential pressure at the end of the tick (Pa), then velocity, place, direction, spool,
    supply and resistance there. Jumps of the path are the caller's.
    """
    static = 2.0 * dynamic
    for node in range(first, end):
        span = nodes[node, 0]
        start, target = spool, nodes[node, 1]
        rise0, rise1 = span * nodes[node, 2], span * nodes[node, 3]
        parts = _parts(start, target, rise0, rise1)
        for part in range(1, parts + 1):
            left = span / parts
            end_spool, rise = _path(part / parts, start, target, rise0, rise1)
            end_supply, end_resistance, gain, gain_resistance = second_stage(c, end_spool)
            while left > SHORTEST:
                if direction == 0.0:
                    direction, wait = _break_away(c, static, supply, end_supply, place)
                    if direction == 0.0:
                        break
                    if wait != 0.0:
                        spool += wait * (end_spool - spool)
                        supply, resistance, _, _ = second_stage(c, spool)
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
                supply, resistance, _, _ = second_stage(c, spool)
                left -= moved
                velocity, direction = 0.0, 0.0
            spool, supply, resistance = end_spool, end_supply, end_resistance
    p12 = supply - resistance * c.AJ * velocity
    pressure = min(max(p12, -c.PSR), c.PSR)
    return pressure, velocity, place, direction, spool, supply, resistance
