"""Jack with a second stage of orifices and compressible oil over a piece of the spool's path.

The pressure is stored in the oil: with the jack's mass it rings, hardly damped, at some tens of
hertz, and nothing else is fast. So the classical Runge-Kutta formula of order 4 follows it in steps
of a small share of a radian. (Beside the supply pressure the orifices' roots are steep; there the
pressure stands still within a few hundred pascals.) Stops and starts are located inside a step.
"""

from __future__ import annotations

import math
from typing import Any

from ehadiag.compile.kernels import bare_kernel
from ehadiag.compile.vector import magnitude, most, packed, root, with_sign
from ehadiag.model.jack_state import JackState, Piece, Probe, place_on, sense
from ehadiag.model.laws import JackLaw, creeping
from ehadiag.model.sensors import through_ends

__all__ = [
    "CREEPING",
    "LONGEST",
    "STEEPEST",
    "orifice_piece",
    "orifice_rate",
    "orifice_step",
    "sensed_orifice_piece",
]

LONGEST = 0.2
"""Longest step in radians of the ringing."""
LONGEST_S = 0.25e-3
"""… and in seconds: what the spool does to the orifices is to be followed too."""
CREEPING = 20.0
"""Velocity at which a jack no longer creeps, in Stribeck velocities."""
STEEPEST = 0.1
"""Largest growth (power of e) of a creeping jack's velocity within a step."""
ITERATIONS = 40
SHORTEST = 1e-7
"""Share of a piece that counts as nothing."""
STOP, BOUND, START = 0, 1, 2
"""What may end a step: the jack stops, it meets its bound, it breaks away."""
MOST_EVENTS = 16
"""Of a step; a jack that chatters on is taken for one that rests."""


@packed
def _signed_root(share: Any) -> Any:
    return with_sign(root(magnitude(share)), share)


@packed
def orifice_rate(j: JackLaw, x: Any, p12: Any, velocity: Any) -> Any:
    """Rate of the pressure with the spool at `x` and the jack at a velocity, Pa/s (PHY-39)."""
    underlap, share = 2.0 * j.corner, p12 * j.by_supply
    ahead, behind = most(x + underlap, x * 0.0), most(underlap - x, x * 0.0)
    flow = ahead * _signed_root(1.0 - share) - behind * _signed_root(1.0 + share)
    return j.oil * (j.flow * flow - velocity - j.leak * p12)


@packed
def _friction(j: JackLaw, d: Any, velocity: Any) -> Any:
    """Dry friction of a jack that moves in direction d, N."""
    return d * (j.friction + creeping(j, most(velocity * d, velocity * 0.0)))


@packed
def orifice_step(
    j: JackLaw, h: Any, load: Any, d: Any, x0: Any, x1: Any, x2: Any, p12: Any, velocity: Any
) -> Any:
    """Pressure (Pa), velocity (m/s) and travel (m) after a step of `h` seconds.

    load: external force, N; d: direction of the motion, 0 where the jack rests; x0, x1, x2: spool
    at the start, in the middle and at the end, m; p12, velocity: at the start. Numbers or vectors.
    """
    half, ease = 0.5 * h, d * d * j.by_mass
    dp1 = orifice_rate(j, x0, p12, velocity)
    dv1 = ease * (j.area * p12 - j.viscosity * velocity - load - _friction(j, d, velocity))
    p, v = p12 + half * dp1, velocity + half * dv1
    dp2 = orifice_rate(j, x1, p, v)
    dv2 = ease * (j.area * p - j.viscosity * v - load - _friction(j, d, v))
    p, v2 = p12 + half * dp2, velocity + half * dv2
    dp3 = orifice_rate(j, x1, p, v2)
    dv3 = ease * (j.area * p - j.viscosity * v2 - load - _friction(j, d, v2))
    p, v3 = p12 + h * dp3, velocity + h * dv3
    dp4 = orifice_rate(j, x2, p, v3)
    dv4 = ease * (j.area * p - j.viscosity * v3 - load - _friction(j, d, v3))
    sixth = h / 6.0
    return (
        p12 + sixth * (dp1 + 2.0 * (dp2 + dp3) + dp4),
        velocity + sixth * (dv1 + 2.0 * (dv2 + dv3) + dv4),
        h * velocity + sixth * h * (dv1 + dv2 + dv3),
    )


@packed
def _stepped(
    j: JackLaw, p: Piece, d: float, place: float, p12: float, velocity: float,
    begin: float, end: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Place, pressure and velocity at the share `end` of a piece, from those at `begin`."""
    h = (end - begin) * p.span
    load = j.load + j.spring * (place + 0.5 * h * velocity)
    x0, x1, x2 = place_on(p, begin), place_on(p, 0.5 * (begin + end)), place_on(p, end)
    p12, velocity, travel = orifice_step(j, h, load, d, x0, x1, x2, p12, velocity)
    return place + travel, p12, velocity


@packed
def _push(j: JackLaw, place: float, p12: float) -> float:
    """Force on the resting jack but for its friction, N."""
    return j.area * p12 - j.load - j.spring * place


@packed
def _left(j: JackLaw, event: int, d: float, place: float, p12: float, velocity: float) -> float:
    """How far off an event is; negative once it has come."""
    if event == STOP:
        return velocity * d
    if event == BOUND:
        return j.stroke - place * d
    return j.static - _push(j, place, p12) * d


@packed
def _time(
    j: JackLaw, event: int, d: float, p: Piece, direction: float, place: float, p12: float,
    velocity: float, begin: float, end: float,
) -> float:  # fmt: skip
    """Share of a piece at which an event comes that has come at `end`; the Illinois rule.

    d: direction that the event is of; direction: of the jack, 0 at rest.
    """
    low, high = begin, end
    at_low = _left(j, event, d, place, p12, velocity)
    then = _stepped(j, p, direction, place, p12, velocity, begin, end)
    at_high = _left(j, event, d, then[0], then[1], then[2])
    side = 0
    for _ in range(ITERATIONS):
        q = high - (high - low) * at_high / (at_high - at_low)
        then = _stepped(j, p, direction, place, p12, velocity, begin, q)
        value = _left(j, event, d, then[0], then[1], then[2])
        if value > 0.0:
            low, at_low = q, value
            if side == 1:
                at_high *= 0.5
            side = 1
        else:
            high, at_high = q, value
            if side == -1:
                at_low *= 0.5
            side = -1
        if high - low < SHORTEST or value == 0.0:
            break
    return high


@packed
def _steps(j: JackLaw, span: float, velocity: float) -> int:
    """Into how many steps a span (s) is cut."""
    rate = max(math.sqrt(j.oil * j.area * j.by_mass) / LONGEST, 1.0 / LONGEST_S)
    if abs(velocity) * j.by_stribeck < CREEPING:
        # Friction that falls with the velocity drives the jack away.
        rate = max(rate, j.extra * j.by_stribeck * j.by_mass / STEEPEST)
    return 1 + int(span * rate * (1.0 - 1e-9))


def _pieces(senses: bool) -> Any:
    """Compiled jack over a piece, with or without the sensor of pressure."""

    @bare_kernel
    def piece(
        j: JackLaw, probe: Probe, p: Piece, begin: float, stop: float, state: JackState
    ) -> JackState:
        place, velocity, d, _, p12, lagged, seen = state
        steps = _steps(j, (stop - begin) * p.span, velocity)
        q, step, events = begin, 1, 0
        while step <= steps:
            end = begin + (stop - begin) * step / steps
            push = _push(j, place, p12)
            bound = abs(place) >= j.stroke and place * push > 0.0
            if d == 0.0 and abs(push) > j.static and not bound and events < MOST_EVENTS:
                d = 1.0 if push > 0.0 else -1.0
            until = end
            later = _stepped(j, p, d, place, p12, velocity, q, end)
            event = -1
            if d == 0.0:
                now = _push(j, later[0], later[1])
                held = abs(now) <= j.static or (abs(place) >= j.stroke and place * now > 0.0)
                if not held and events < MOST_EVENTS:
                    event, way = START, 1.0 if now > 0.0 else -1.0
            elif later[2] * d <= 0.0:
                event, way = STOP, d
            elif later[0] * d >= j.stroke:
                event, way = BOUND, d
            if event >= 0:
                events += 1
                if event == STOP and velocity == 0.0:
                    # It does not get away: at rest for this step.
                    events, d = MOST_EVENTS, 0.0
                else:
                    until = _time(j, event, way, p, d, place, p12, velocity, q, end)
                later = _stepped(j, p, d, place, p12, velocity, q, until)
            if senses and until > q:
                h = (until - q) * p.span
                cubic = through_ends(
                    p12, later[1],
                    h * orifice_rate(j, place_on(p, q), p12, velocity),
                    h * orifice_rate(j, place_on(p, until), later[1], later[2]),
                )  # fmt: skip
                lagged, seen = sense(probe, cubic, q * p.span, h, lagged, seen)
            place, p12, velocity = later
            if event == STOP:
                velocity, d = 0.0, 0.0
            elif event == BOUND:
                place, velocity, d = math.copysign(j.stroke, way), 0.0, 0.0
            elif event == START:
                d = way
            q = until
            if end - q < SHORTEST:
                q, step, events = end, step + 1, 0
        return JackState(place, velocity, d, 0.0, p12, lagged, seen)

    return piece


orifice_piece, sensed_orifice_piece = _pieces(False), _pieces(True)
"""Compiled: jack over the shares begin … stop of a piece; the second one with its sensor."""
