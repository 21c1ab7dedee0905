"""Second stage, jack and surface over one tick: kernel of the monitoring model.

Given the spool's path as pieces (`ehadiag.model.scalar.spool_tick`), the jack velocity approaches
its steady value exponentially, tau = MJ / (AJ² g R + CJ) with g = 1 / (1 + R CLK) (model.md
section 1, the second-stage equation solved for P12). Over a part of a piece the steady value is
taken as a parabola and tau as a straight line. Sticking and break-away are located inside it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import inlined
from ehadiag.model.plant import PlantConstants

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
def second_stage(c: PlantConstants, spool: float) -> tuple[float, float, float]:
    """Second stage at a spool position (m), leakage solved for.

    With D = GQ max(abs(spool), PSR / GP) + PSR CLK the stage gives g PS = PSR GQ spool / D and
    g R = PSR / D whether the pressure gain saturates or not. Returns D, 1 / D and
    1 / (AJ² PSR + CJ D).
    """
    divide = c.GQ * max(abs(spool), c.PSR / c.GP) + c.PSR * c.CLK
    return divide, 1.0 / divide, 1.0 / (c.AJ * c.AJ * c.PSR + c.CJ * divide)


@inlined
def _parts(origin: float, target: float, rise0: float, rise1: float) -> int:
    """Into how many parts a piece is cut: short ones where the orifice is almost closed."""
    travel = abs(target - origin)
    nearest = 0.0 if origin * target <= 0.0 else min(abs(origin), abs(target))
    limit = max(TRAVEL, RATIO * nearest)
    bend = 0.125 * abs(rise1 - rise0)
    if travel < limit and bend < BEND:
        return 1
    return min(MOST_PARTS, 1 + int(max(travel / limit, math.sqrt(bend / BEND))))


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
    per_span: float,
    velocity: float,
    spool: float,
    divide: float,
    by_divide: float,
    ease: float,
    end_spool: float,
    end_rate: float,
    end_divide: float,
    end_by_divide: float,
    end_ease: float,
) -> tuple[float, float, float, float, float]:
    """How the velocity of the moving jack goes over a part of a piece.

    The steady velocity s = (AJ PSR GQ spool - load D) / (AJ² PSR + CJ D) is taken as a parabola
    that ends with the slope of the spool's path (`end_rate`, m/s), tau = MJ D / (AJ² PSR + CJ D) as
    a straight line: tau v' + v = s is then met by a parabola p0 + p1 t + p2 t² exactly, and the
    rest of the velocity decays. `per_span` is 1 over the part's duration, `divide`, `by_divide` and
    `ease` are of `second_stage`. Returns p0, p1, p2, that rest at the start, and its decay rate.
    """
    gain = c.AJ * c.PSR * c.GQ
    steady = (gain * spool - load * divide) * ease
    end_steady = (gain * end_spool - load * end_divide) * end_ease
    turn = math.copysign(c.GQ, end_spool) if abs(end_spool) > c.PSR / c.GP else 0.0
    slope = end_rate * (gain - (load + c.CJ * end_steady) * turn) * end_ease
    mean = (end_steady - steady) * per_span
    tau, end_tau = c.MJ * divide * ease, c.MJ * end_divide * end_ease
    drift = max((end_tau - tau) * per_span, DRIFT)
    once, twice, both = 1.0 + drift, 1.0 + 2.0 * drift, tau + end_tau
    inverse = 1.0 / (once * twice * both)
    share = inverse * both
    p2 = (slope - mean) * per_span * once * share
    p1 = (2.0 * mean - slope - 2.0 * p2 * tau) * twice * share
    p0 = steady - tau * p1
    # Mean of 1/tau by Simpson's rule.
    rate = (c.AJ * c.AJ * c.PSR * (by_divide + end_by_divide) + 2.0 * c.CJ) * (1.0 / (6.0 * c.MJ))
    rate += inverse * once * twice * (4.0 / 3.0)
    return p0, p1, p2, velocity - p0, rate


@inlined
def _break_away(
    c: PlantConstants, static: float, push: float, end_push: float, place: float
) -> tuple[float, float]:
    """Whether a jack at rest breaks away while the force on it (N) goes from `push` to `end_push`.

    Returns its direction, 0 if it stays, and the share of the way at which it goes.
    """
    blocked = abs(place) >= c.XJM and place * end_push > 0.0
    if abs(end_push) <= static or blocked:
        return 0.0, 1.0
    direction = 1.0 if end_push > 0.0 else -1.0
    if push * direction <= static:
        return direction, (static * direction - push) / (end_push - push)
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
) -> tuple[float, float, float, float, float]:
    """Second stage and jack over the spool's path of one tick.

    Parameters
    ----------
    dynamic: dry friction of the moving jack, N; at rest it is twice that.
    nodes, first, end: the path, rows first … end - 1, see
        `ehadiag.model.scalar.spool_tick.spool_tick`.
    velocity, place: of the jack, m/s and m.
    direction: of its motion, +1 or -1; 0 at rest.
    spool: position before the tick, m.

    Returns
    -------
    Differential pressure at the end of the tick (Pa), then velocity, place, direction and spool
    there. Jumps of the path are the caller's.
    """
    static = 2.0 * dynamic
    gain = c.AJ * c.PSR * c.GQ
    divide, by_divide, ease = second_stage(c, spool)
    for node in range(first, end):
        span = nodes[node, 0]
        per_span = 1.0 / span
        start, target = spool, nodes[node, 1]
        rise0, rise1 = span * nodes[node, 2], span * nodes[node, 3]
        parts = _parts(start, target, rise0, rise1)
        for part in range(1, parts + 1):
            left, per_left = span, per_span
            end_spool, rise = target, rise1
            if parts > 1:
                left, per_left = span / parts, per_span * parts
                end_spool, rise = _path(part / parts, start, target, rise0, rise1)
            end_divide, end_by_divide, end_ease = second_stage(c, end_spool)
            while left > SHORTEST:
                if direction == 0.0:
                    push = gain * spool * by_divide - c.FR
                    end_push = gain * end_spool * end_by_divide - c.FR
                    direction, wait = _break_away(c, static, push, end_push, place)
                    if direction == 0.0:
                        break
                    if wait != 0.0:
                        spool += wait * (end_spool - spool)
                        divide, by_divide, ease = second_stage(c, spool)
                        left -= wait * left
                        per_left = 1.0 / max(left, SHORTEST)
                    continue
                p0, p1, p2, excess, rate = _approach(
                    c,
                    c.FR + direction * dynamic,
                    per_left,
                    velocity,
                    spool,
                    divide,
                    by_divide,
                    ease,
                    end_spool,
                    rise * per_span,
                    end_divide,
                    end_by_divide,
                    end_ease,
                )
                fade = math.exp(-left * rate)
                end_velocity = p0 + left * (p1 + left * p2) + excess * fade
                if end_velocity * direction > 0.0:
                    place += left * (p0 + left * (0.5 * p1 + left * p2 * (1.0 / 3.0)))
                    place += excess * (1.0 - fade) / rate
                    velocity = end_velocity
                    if abs(place) >= c.XJM and place * velocity > 0.0:
                        place = math.copysign(c.XJM, place)
                        velocity, direction = 0.0, 0.0
                    break
                moved = _sign_change(p0, p1, p2, excess, rate, left)
                spool += moved * per_left * (end_spool - spool)
                divide, by_divide, ease = second_stage(c, spool)
                left -= moved
                per_left = 1.0 / max(left, SHORTEST)
                velocity, direction = 0.0, 0.0
            spool, divide, by_divide, ease = end_spool, end_divide, end_by_divide, end_ease
    p12 = c.PSR * (c.GQ * spool - c.AJ * velocity) * by_divide
    return min(max(p12, -c.PSR), c.PSR), velocity, place, direction, spool
