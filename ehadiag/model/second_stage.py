"""Second stage and jack over the spool's path: lands, orifices, choice of the stage.

With orifices the pressure is stored in the oil and rings with the jack's mass; the classical Runge-
Kutta formula of order 4 follows it. Stops and starts are located inside a step.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ehadiag.compile.jit import bare_kernel, inlined
from ehadiag.compile.vector import absolute, copy_sign, lane_sqrt, maximum, minimum, packed
from ehadiag.model.jack import linear_piece, sensed_linear_piece
from ehadiag.model.laws import JackLaw, stribeck_friction
from ehadiag.model.sensors import (
    JackState,
    PathPiece,
    PressureProbe,
    cubic_through_ends,
    position_on_piece,
    sample_pressure,
)

MAX_CHAMBER_SHARE = 0.95
"""Largest share of a chamber's volume that the jack's travel takes, 1: what is left at its stop in
lines and dead volume."""


@packed
def land_opening(j: JackLaw, x: Any) -> Any:
    """How far the lands are open with the spool at `x`, as much of its travel, m."""
    z = x - j.closed
    size = absolute(z)
    return z * (1.0 + j.odd * (z * z) - j.lap / (j.corner + size)) + j.even * size


@packed
def land_opening_slope(j: JackLaw, x: Any) -> Any:
    """What a small travel of the spool at `x` opens, over itself."""
    z = x - j.closed
    size = absolute(z)
    wide = j.corner + size
    side = copy_sign(size * 0.0 + 1.0, z)
    return 1.0 + 3.0 * j.odd * (z * z) - j.lap * j.corner / (wide * wide) + j.even * side


@packed
def land_opening_piece(j: JackLaw, p: PathPiece) -> PathPiece:
    """Path of the lands' opening over a piece of the spool's path."""
    if j.shaped == 0.0:
        return p
    rise0, rise1 = land_opening_slope(j, p.x0) * p.rise0, land_opening_slope(j, p.x1) * p.rise1
    return PathPiece(p.span, land_opening(j, p.x0), land_opening(j, p.x1), rise0, rise1)


class OrificeSteps(NamedTuple):
    """Steps of a jack behind orifices."""

    ringing: float = 0.2
    """Longest step in radians of the ringing, 1."""
    longest_s: float = 0.25e-3
    """Longest step, s: the orifices change with the spool."""
    creep_limit: float = 20.0
    """Velocity at which a jack no longer creeps, in Stribeck velocities."""
    creep_growth: float = 0.1
    """Largest growth of a creeping jack's velocity within a step, as a power of e, 1."""
    iterations: int = 40
    """Largest number of iterations for an event, 1."""
    least_share: float = 1e-7
    """Share of a piece that is neglected, 1."""
    events: int = 16
    """Largest number of events of a step, 1; a jack that chatters on counts as resting."""


ORIFICE_STEPS = OrificeSteps()


class JackEvents(NamedTuple):
    """Codes of what may end a step of the jack."""

    stop: int = 0
    """The jack stops."""
    bound: int = 1
    """The jack meets its bound."""
    start: int = 2
    """The jack breaks away."""


JACK_EVENTS = JackEvents()


@packed
def _signed_root(share: Any) -> Any:
    return copy_sign(lane_sqrt(absolute(share)), share)


@packed
def oil_at(j: JackLaw, place: Any) -> Any:
    """Rise of the pressure by the jack's travel with the jack at a place, Pa/m (PHY-39, PHY-42)."""
    share = minimum(absolute(j.bulge * place), MAX_CHAMBER_SHARE)
    return j.oil / (1.0 - share * share)


@packed
def orifice_rate(j: JackLaw, x: Any, p12: Any, velocity: Any, oil: Any, both: bool = True) -> Any:
    """Rate of the pressure with the spool at `x` and the jack at a velocity, Pa/s (PHY-39).

    oil: see `oil_at`; both: whether both orifices of a chamber may be open, as they are within
    their underlap.
    """
    underlap, share = 2.0 * j.corner, p12 * j.by_supply
    if both:
        ahead, behind = maximum(x + underlap, x * 0.0), maximum(underlap - x, x * 0.0)
        flow = ahead * _signed_root(1.0 - share) - behind * _signed_root(1.0 + share)
    else:
        side = copy_sign(x * 0.0 + 1.0, x)
        flow = (x + side * underlap) * _signed_root(1.0 - side * share)
    return oil * (j.flow * flow - velocity - j.leak * p12)


@packed
def _friction(j: JackLaw, d: Any, velocity: Any, creeps: bool) -> Any:
    """Dry friction of a jack that moves in direction d, N."""
    if not creeps:
        return d * j.friction
    return d * (j.friction + stribeck_friction(j, maximum(velocity * d, velocity * 0.0)))


@packed
def orifice_step(
    j: JackLaw, h: Any, load: Any, oil: Any, d: Any, x0: Any, x1: Any, x2: Any, p12: Any,
    velocity: Any, both: bool = True, creeps: bool = True,
) -> Any:  # fmt: skip
    """Pressure (Pa), velocity (m/s) and travel (m) after a step of `h` seconds.

    load: external force, N; oil: see `oil_at`, in the middle of the step; d: direction of the
    motion, 0 where the jack rests; x0, x1, x2: spool at the start, in the middle and at the end, m;
    p12, velocity: at the start; both: see `orifice_rate`; creeps: whether friction may have
    Stribeck's part. Numbers or vectors.
    """
    half, ease = 0.5 * h, d * d * j.by_mass
    dp1 = orifice_rate(j, x0, p12, velocity, oil, both)
    dv1 = ease * (j.area * p12 - j.viscosity * velocity - load - _friction(j, d, velocity, creeps))
    p, v = p12 + half * dp1, velocity + half * dv1
    dp2 = orifice_rate(j, x1, p, v, oil, both)
    dv2 = ease * (j.area * p - j.viscosity * v - load - _friction(j, d, v, creeps))
    p, v2 = p12 + half * dp2, velocity + half * dv2
    dp3 = orifice_rate(j, x1, p, v2, oil, both)
    dv3 = ease * (j.area * p - j.viscosity * v2 - load - _friction(j, d, v2, creeps))
    p, v3 = p12 + h * dp3, velocity + h * dv3
    dp4 = orifice_rate(j, x2, p, v3, oil, both)
    dv4 = ease * (j.area * p - j.viscosity * v3 - load - _friction(j, d, v3, creeps))
    sixth = h / 6.0
    return (
        p12 + sixth * (dp1 + 2.0 * (dp2 + dp3) + dp4),
        velocity + sixth * (dv1 + 2.0 * (dv2 + dv3) + dv4),
        h * velocity + sixth * h * (dv1 + dv2 + dv3),
    )


@packed
def stepped_jack(
    j: JackLaw, p: PathPiece, d: Any, place: Any, p12: Any, velocity: Any, begin: Any, end: Any,
    creeps: bool = True,
) -> Any:  # fmt: skip
    """Place, pressure and velocity at the share `end` of a piece, from those at `begin`."""
    h = (end - begin) * p.span
    middle = place + 0.5 * h * velocity
    load, oil = j.load + j.spring * middle, oil_at(j, middle)
    x0, x1, x2 = (
        position_on_piece(p, begin),
        position_on_piece(p, 0.5 * (begin + end)),
        position_on_piece(p, end),
    )
    p12, velocity, travel = orifice_step(
        j, h, load, oil, d, x0, x1, x2, p12, velocity, True, creeps
    )
    return place + travel, p12, velocity


@packed
def driving_force(j: JackLaw, place: Any, p12: Any) -> Any:
    """Force on the resting jack but for its friction, N."""
    return j.area * p12 - j.load - j.spring * place


@packed
def _event_distance(
    j: JackLaw, event: int, d: float, place: float, p12: float, velocity: float
) -> float:
    """How far off an event is; negative once it has come."""
    if event == JACK_EVENTS.stop:
        return velocity * d
    if event == JACK_EVENTS.bound:
        return j.stroke - place * d
    return j.static - driving_force(j, place, p12) * d


@packed
def _event_share(
    j: JackLaw, event: int, d: float, p: PathPiece, direction: float, place: float, p12: float,
    velocity: float, begin: float, end: float,
) -> float:  # fmt: skip
    """Share of a piece at which an event comes that has come at `end`; the Illinois rule.

    d: direction that the event is of; direction: of the jack, 0 at rest.
    """
    low, high = begin, end
    at_low = _event_distance(j, event, d, place, p12, velocity)
    then = stepped_jack(j, p, direction, place, p12, velocity, begin, end)
    at_high = _event_distance(j, event, d, then[0], then[1], then[2])
    side = 0
    for _ in range(ORIFICE_STEPS.iterations):
        q = high - (high - low) * at_high / (at_high - at_low)
        then = stepped_jack(j, p, direction, place, p12, velocity, begin, q)
        value = _event_distance(j, event, d, then[0], then[1], then[2])
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
        if high - low < ORIFICE_STEPS.least_share or value == 0.0:
            break
    return high


@packed
def _steps(j: JackLaw, span: float, place: float, velocity: float) -> int:
    """Into how many steps a span (s) is cut."""
    rate = max(
        math.sqrt(oil_at(j, place) * j.area * j.by_mass) / ORIFICE_STEPS.ringing,
        1.0 / ORIFICE_STEPS.longest_s,
    )
    if abs(velocity) * j.by_stribeck < ORIFICE_STEPS.creep_limit:
        # Friction that falls with the velocity drives the jack away.
        rate = max(rate, j.extra * j.by_stribeck * j.by_mass / ORIFICE_STEPS.creep_growth)
    return 1 + int(span * rate * (1.0 - 1e-9))


def _pieces(senses: bool) -> Any:
    """Compiled jack over a piece, with or without the sensor of pressure."""

    @bare_kernel
    def piece(
        j: JackLaw, probe: PressureProbe, p: PathPiece, begin: float, stop: float, state: JackState
    ) -> JackState:
        place, velocity, d, _, p12, lagged, seen = state
        steps = _steps(j, (stop - begin) * p.span, place, velocity)
        q, step, events = begin, 1, 0
        while step <= steps:
            end = begin + (stop - begin) * step / steps
            push = driving_force(j, place, p12)
            bound = abs(place) >= j.stroke and place * push > 0.0
            if d == 0.0 and abs(push) > j.static and not bound and events < ORIFICE_STEPS.events:
                d = 1.0 if push > 0.0 else -1.0
            until = end
            later = stepped_jack(j, p, d, place, p12, velocity, q, end)
            event = -1
            if d == 0.0:
                now = driving_force(j, later[0], later[1])
                held = abs(now) <= j.static or (abs(place) >= j.stroke and place * now > 0.0)
                if not held and events < ORIFICE_STEPS.events:
                    event, way = JACK_EVENTS.start, 1.0 if now > 0.0 else -1.0
            elif later[2] * d <= 0.0:
                event, way = JACK_EVENTS.stop, d
            elif later[0] * d >= j.stroke:
                event, way = JACK_EVENTS.bound, d
            if event >= 0:
                events += 1
                if event == JACK_EVENTS.stop and velocity == 0.0:
                    # It does not get away: at rest for this step.
                    events, d = ORIFICE_STEPS.events, 0.0
                else:
                    until = _event_share(j, event, way, p, d, place, p12, velocity, q, end)
                later = stepped_jack(j, p, d, place, p12, velocity, q, until)
            if senses and until > q:
                h, oil = (until - q) * p.span, oil_at(j, place)
                cubic = cubic_through_ends(
                    p12, later[1],
                    h * orifice_rate(j, position_on_piece(p, q), p12, velocity, oil),
                    h * orifice_rate(j, position_on_piece(p, until), later[1], later[2], oil),
                )  # fmt: skip
                lagged, seen = sample_pressure(probe, cubic, q * p.span, h, lagged, seen)
            place, p12, velocity = later
            if event == JACK_EVENTS.stop:
                velocity, d = 0.0, 0.0
            elif event == JACK_EVENTS.bound:
                place, velocity, d = math.copysign(j.stroke, way), 0.0, 0.0
            elif event == JACK_EVENTS.start:
                d = way
            q = until
            if end - q < ORIFICE_STEPS.least_share:
                q, step, events = end, step + 1, 0
        return JackState(place, velocity, d, 0.0, p12, lagged, seen)

    return piece


orifice_piece, sensed_orifice_piece = _pieces(False), _pieces(True)
"""Compiled: jack over the shares begin … stop of a piece; the second one with its sensor."""


@bare_kernel
def _other_piece(
    j: JackLaw,
    probe: PressureProbe,
    senses: bool,
    p: PathPiece,
    begin: float,
    stop: float,
    state: JackState,
) -> JackState:
    """Jack over a piece where it is not the plain one."""
    if j.oil > 0.0:
        if senses:
            return sensed_orifice_piece(j, probe, p, begin, stop, state)
        return orifice_piece(j, probe, p, begin, stop, state)
    return sensed_linear_piece(j, probe, p, begin, stop, state)


@inlined
def jack_piece(
    j: JackLaw,
    probe: PressureProbe,
    senses: bool,
    p: PathPiece,
    begin: float,
    stop: float,
    state: JackState,
) -> JackState:
    """Jack over the shares begin … stop of a piece of the spool's path.

    senses: whether the pressure is to be followed as its sensor sees it.
    """
    if senses or j.oil > 0.0 or j.extra > 0.0:
        return _other_piece(j, probe, senses, p, begin, stop, state)
    return linear_piece(j, probe, p, begin, stop, state)
