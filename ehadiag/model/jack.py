"""Second stage, jack and surface: kernel of the monitoring model.

Given the spool's path as pieces (`ehadiag.model.spool`), the jack velocity approaches its steady
value exponentially, tau = MJ / (AJ² g R + CJ) with g = 1 / (1 + R CLK) (model.md section 1, the
second-stage equation solved for P12). The steady value moves linearly over a piece; tau is that
of the piece's middle. Sticking and break-away are located inside the piece.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import kernel
from ehadiag.model.constants import PlantConstants

__all__ = ["jack_response"]

SHORTEST = 1e-9
"""Pieces shorter than this (s) are taken as no time at all."""
TRAVEL = 1.5e-6
"""Spool travel (m) within one part of a piece, near the closed orifice."""
RATIO = 0.15
"""The same as a share of the spool's distance from the middle, elsewhere."""
BEND = 0.1e-6
"""Largest distance (m) between a part's path and its chord."""
MOST_PARTS = 32


@kernel
def _valve(constants: PlantConstants, spool: float) -> tuple[float, float]:
    """No-flow pressure after leakage g PS (Pa) and g R (Pa s/m³) at a spool position (m)."""
    c = constants
    pressure = c.GP * spool
    if abs(pressure) <= c.PSR:
        resistance = c.GP / c.GQ
    else:
        pressure = c.PSR if spool > 0.0 else -c.PSR
        resistance = c.PSR / (c.GQ * abs(spool))
    share = 1.0 / (1.0 + resistance * c.CLK)
    return share * pressure, share * resistance


@kernel
def _parts(origin: float, target: float, rise0: float, rise1: float) -> int:
    """Into how many parts a piece is cut: short ones where the orifice is almost closed."""
    travel = abs(target - origin)
    nearest = 0.0 if origin * target <= 0.0 else min(abs(origin), abs(target))
    by_travel = travel / max(TRAVEL, RATIO * nearest)
    bend = 0.125 * abs(rise1 - rise0)
    by_bend = math.sqrt(bend / BEND)
    return min(MOST_PARTS, 1 + int(max(by_travel, by_bend)))


@kernel
def _sign_change(start: float, slope: float, excess: float, tau: float, span: float) -> float:
    """First time in 0 … span at which start + slope t + excess exp(-t/tau) changes sign, s."""
    low, high = 0.0, span
    sign = 1.0 if start + excess > 0.0 else -1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        if sign * (start + slope * middle + excess * math.exp(-middle / tau)) > 0.0:
            low = middle
        else:
            high = middle
    return high


@kernel
def jack_response(
    constants: PlantConstants,
    fdj: float,
    nodes: NDArray[np.float64],
    node_end: NDArray[np.int64],
    pressure: NDArray[np.float64],
    position: NDArray[np.float64],
) -> None:
    """Differential pressure and jack position at the end of every tick, from rest in the middle.

    Parameters
    ----------
    fdj: fault constant `FDJ`, 0 … 1.
    nodes, node_end: the spool's path, see `ehadiag.model.spool.spool_response`.
    pressure: out, Pa, shape (n,).
    position: out, m, shape (n,).
    """
    c = constants
    dynamic = c.FDJ0 + fdj * (c.FDJ1 - c.FDJ0)
    static = 2.0 * dynamic
    velocity, place, direction = 0.0, 0.0, 0.0
    spool = 0.0
    supply, resistance = _valve(c, spool)
    node = 0
    for k in range(node_end.shape[0]):
        while node < node_end[k]:
            span = nodes[node, 0]
            origin, target = spool, nodes[node, 1]
            rise0, rise1 = span * nodes[node, 2], span * nodes[node, 3]
            parts = _parts(origin, target, rise0, rise1)
            for part in range(1, parts + 1):
                left = span / parts
                x = part / parts
                end_spool = (
                    origin
                    + x * x * (3.0 - 2.0 * x) * (target - origin)
                    + x * (1.0 - x) * ((1.0 - x) * rise0 - x * rise1)
                )
                end_supply, end_resistance = _valve(c, end_spool)
                while left > SHORTEST:
                    if direction == 0.0:
                        push0 = c.AJ * supply - c.FR
                        push1 = c.AJ * end_supply - c.FR
                        blocked = abs(place) >= c.XJM and place * push1 > 0.0
                        if abs(push1) <= static or blocked:
                            break
                        direction = 1.0 if push1 > 0.0 else -1.0
                        if push0 * direction <= static:
                            wait = (static * direction - push0) / (push1 - push0)
                            spool += wait * (end_spool - spool)
                            supply, resistance = _valve(c, spool)
                            left -= wait * left
                        continue
                    _, middle = _valve(c, 0.5 * (spool + end_spool))
                    load = c.FR + direction * dynamic
                    tau = c.MJ / (c.AJ * c.AJ * middle + c.CJ)
                    steady0 = (c.AJ * supply - load) / (c.AJ * c.AJ * resistance + c.CJ)
                    steady1 = (c.AJ * end_supply - load) / (c.AJ * c.AJ * end_resistance + c.CJ)
                    slope = (steady1 - steady0) / left
                    excess = velocity - steady0 + tau * slope
                    fade = math.exp(-left / tau)
                    end_velocity = steady1 - tau * slope + excess * fade
                    if end_velocity * direction > 0.0:
                        place += left * (0.5 * (steady0 + steady1) - tau * slope)
                        place += tau * excess * (1.0 - fade)
                        velocity = end_velocity
                        if abs(place) >= c.XJM and place * velocity > 0.0:
                            place = c.XJM if place > 0.0 else -c.XJM
                            velocity, direction = 0.0, 0.0
                        break
                    moved = _sign_change(steady0 - tau * slope, slope, excess, tau, left)
                    spool += moved / left * (end_spool - spool)
                    supply, resistance = _valve(c, spool)
                    left -= moved
                    velocity, direction = 0.0, 0.0
                spool, supply, resistance = end_spool, end_supply, end_resistance
            node += 1
        p12 = supply - resistance * c.AJ * velocity
        pressure[k] = min(max(p12, -c.PSR), c.PSR)
        position[k] = place
        if nodes[node - 1, 4] != 0.0:
            spool += nodes[node - 1, 4]
            supply, resistance = _valve(c, spool)
