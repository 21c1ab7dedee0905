"""Jack and surface over a piece of the spool's path: one algorithm for all kernels.

Radau's collocation of order 5 (IIA, three stages; Hairer, Wanner, Solving Ordinary Differential
Equations II, section IV.5), which damps what is stiff. Unknown are the pressures of the stages, not
the velocities: the second stage reads P12 = (flow x - v) / e at any x (`ehadiag.model.laws`), so
the stages' equations are linear with coefficients that need no division, no branch and no
exponential, and a step takes one division, for the last stage's pressure. Stops and starts are
located inside the piece.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import bare_kernel, inlined
from ehadiag.compile.vector import packed
from ehadiag.model.laws import JackLaw, excess, pressure, resistance

__all__ = ["C1", "C2", "JackState", "Piece", "jack_piece", "jack_tick", "radau_velocity"]

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

FINE_TRAVEL = 3.0e-6
FINE_RATIO = 0.3
"""Spool travel within a step (m, or share of the distance from the middle)."""
FRESH_DECAY = 3.0
"""Decay (power of e) of the jack's velocity within a step, where it starts or stops."""
MOST_STEPS = 32
ITERATIONS = 30
SHORTEST = 1e-6
"""Share of a piece that counts as nothing."""
BALANCED = 1e-9
"""Share of the holding force that counts as no excess."""
SLOWEST = 1e-12
"""Velocity that counts as none, m/s."""


class JackState(NamedTuple):
    """Jack between two pieces.

    Attributes
    ----------
    place: m.
    velocity: m/s.
    direction: of its motion, +1 or -1; 0 at rest.
    fresh: not 0 if it has just started or stopped.
    """

    place: float
    velocity: float
    direction: float
    fresh: float


class Piece(NamedTuple):
    """Piece of the spool's path, a cubic.

    Attributes
    ----------
    span: duration, s.
    x0, x1: spool at its ends, m.
    rise0, rise1: slopes there times `span`, m.
    """

    span: float
    x0: float
    x1: float
    rise0: float
    rise1: float


@packed
def radau_velocity(
    j: JackLaw, h: float, load: Any, velocity: Any,
    x1: Any, x2: Any, x3: Any, e1: Any, e2: Any, e3: Any,
) -> Any:  # fmt: skip
    """Velocity (m/s) of the moving jack after a step of `h` seconds.

    load: external and friction force, N; x1, x2, x3: spool at the three stages, m;
    e1, e2, e3: `resistance` there. Numbers or vectors of them.
    """
    k = h * j.by_mass
    thrust, drag = k * j.area, k * j.viscosity
    y1, y2, y3 = j.flow * x1, j.flow * x2, j.flow * x3
    f1, f2, f3 = thrust + drag * e1, thrust + drag * e2, thrust + drag * e3
    pull = k * load
    z1 = y1 + drag * (A11 * y1 + A12 * y2 + A13 * y3) + C1 * pull - velocity
    z2 = y2 + drag * (A21 * y1 + A22 * y2 + A23 * y3) + C2 * pull - velocity
    z3 = y3 + drag * (A31 * y1 + A32 * y2 + A33 * y3) + pull - velocity
    m11, m12, m13 = e1 + A11 * f1, A12 * f2, A13 * f3
    m21, m22, m23 = A21 * f1, e2 + A22 * f2, A23 * f3
    m31, m32, m33 = A31 * f1, A32 * f2, e3 + A33 * f3
    # Cramer's rule for the last stage's pressure.
    minor = m11 * m22 - m12 * m21
    above = m31 * (m12 * z2 - z1 * m22) - m32 * (m11 * z2 - z1 * m21) + z3 * minor
    below = m31 * (m12 * m23 - m13 * m22) - m32 * (m11 * m23 - m13 * m21) + m33 * minor
    return y3 - e3 * above / below


@packed
def _place(p: Piece, q: float) -> float:
    """Spool at the share q of a piece, m."""
    r = 1.0 - q
    return p.x0 + q * q * (3.0 - 2.0 * q) * (p.x1 - p.x0) + q * r * (r * p.rise0 - q * p.rise1)


@packed
def _velocity(
    j: JackLaw, p: Piece, load: float, velocity: float, begin: float, end: float
) -> float:
    """Velocity of the moving jack at the share `end` of a piece, `velocity` at `begin`, m/s."""
    step = end - begin
    first, second, third = (
        _place(p, begin + C1 * step),
        _place(p, begin + C2 * step),
        _place(p, end),
    )
    return radau_velocity(
        j, step * p.span, load, velocity, first, second, third,
        resistance(j, first), resistance(j, second), resistance(j, third),
    )  # fmt: skip


@packed
def _stop(
    j: JackLaw, p: Piece, load: float, velocity: float, d: float, later: float,
    begin: float, end: float,
) -> float:  # fmt: skip
    """Share of a piece at which the jack stops, `velocity` at `begin`, `later` at `end`.

    Chandrupatla, "A new hybrid quadratic/bisection algorithm", Advances in Engineering Software
    28(3), 1997.
    """
    newest, other, at_newest, at_other = end, begin, later * d, velocity * d
    share = at_newest / (at_newest - at_other)
    for _ in range(ITERATIONS):
        q = newest + share * (other - newest)
        value = _velocity(j, p, load, velocity, begin, q) * d
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


@packed
def _break_away(j: JackLaw, p: Piece, hold: float, d: float, begin: float, end: float) -> float:
    """Share of a piece at which the force on the resting jack exceeds `hold` in direction d.

    It does so at `end`; regula falsi of the Illinois kind.
    """
    low, high = begin, end
    at_low = excess(j, _place(p, low), hold) * d
    at_high = excess(j, _place(p, high), hold) * d
    if at_low >= 0.0:
        return low
    for _ in range(ITERATIONS):
        q = low + (high - low) * at_low / (at_low - at_high)
        x = _place(p, q)
        value = excess(j, x, hold) * d
        if value < 0.0:
            low, at_low = q, value
            at_high *= 0.5
        else:
            high, at_high = q, value
            at_low *= 0.5
        if abs(value) < BALANCED * abs(hold) * resistance(j, x):
            # Not `high`: where the path is straight the first q is the root, from either side.
            return q
        if high - low < SHORTEST:
            break
    return high


@packed
def _steps(j: JackLaw, p: Piece, begin: float, stop: float, state: JackState) -> int:
    """Into how many steps a piece is cut."""
    near = min(abs(p.x0), abs(p.x1)) if p.x0 * p.x1 > 0.0 else 0.0
    wanted = (stop - begin) * abs(p.x1 - p.x0) / max(FINE_TRAVEL, FINE_RATIO * near)
    if state.direction == 0.0 or state.fresh != 0.0:
        # The collocation is slow to forget what a start or a stop leaves.
        rate = (j.area / resistance(j, near) + j.viscosity) * j.by_mass
        wanted = max(wanted, (stop - begin) * p.span * rate / FRESH_DECAY)
    return min(MOST_STEPS, 1 + int(wanted))


@bare_kernel
def jack_piece(j: JackLaw, p: Piece, begin: float, stop: float, state: JackState) -> JackState:
    """Jack over the shares begin … stop of a piece of the spool's path."""
    place, velocity, d, fresh = state
    if d == 0.0:
        x = _place(p, stop)
        if excess(j, x, j.static) <= 0.0 <= excess(j, x, -j.static):
            return JackState(place, velocity, 0.0, 0.0)
    steps = _steps(j, p, begin, stop, state)
    q, step, fresh = begin, 1, 0.0
    while step <= steps:
        end = begin + (stop - begin) * step / steps
        if d == 0.0:
            x = _place(p, end)
            up, down = excess(j, x, j.static), excess(j, x, -j.static)
            if (up <= 0.0 and down >= 0.0) or (
                abs(place) >= j.stroke and place * (up + down) > 0.0
            ):
                q, step = end, step + 1
                continue
            d = 1.0 if up > 0.0 else -1.0
            q = _break_away(j, p, j.static * d, d, q, end)
            velocity, fresh = 0.0, 1.0
        load = j.load + d * j.friction
        later = _velocity(j, p, load, velocity, q, end)
        if later * d > 0.0:
            place += 0.5 * (end - q) * p.span * (velocity + later)
            velocity = later
            if abs(place) >= j.stroke and place * velocity > 0.0:
                place = math.copysign(j.stroke, place)
                velocity, d = 0.0, 0.0
            q, step = end, step + 1
            continue
        q = _stop(j, p, load, velocity, d, later, q, end) if velocity != 0.0 else end
        velocity, d, fresh = 0.0, 0.0, 1.0
        if end - q < SHORTEST:
            q, step = end, step + 1
    return JackState(place, velocity, d, fresh)


@inlined
def jack_tick(
    j: JackLaw, nodes: NDArray[np.float64], first: int, end: int, state: JackState, spool: float
) -> tuple[float, JackState, float]:
    """Second stage and jack over the spool's path of one tick.

    Parameters
    ----------
    nodes, first, end: the path, rows first … end - 1, see `ehadiag.model.scalar.spool_tick`.
    spool: position before the tick, m.

    Returns
    -------
    Differential pressure at the end of the tick (Pa), jack and spool there. Jumps of the path are
    the caller's.
    """
    for node in range(first, end):
        span, x1 = nodes[node, 0], nodes[node, 1]
        piece = Piece(span, spool, x1, span * nodes[node, 2], span * nodes[node, 3])
        state = jack_piece(j, piece, 0.0, 1.0, state)
        spool = x1
    p12 = pressure(j, spool, state.velocity)
    return min(max(p12, -j.supply), j.supply), state, spool
