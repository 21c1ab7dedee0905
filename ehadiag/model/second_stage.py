"""Laws of the second stage over the spool's path: lands, orifices, and the step of a jack behind.

With orifices the pressure is stored in the oil and rings with the jack's mass; the classical Runge-
Kutta formula of order 4 follows it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ehadiag.compile.vector import absolute, copy_sign, lane_sqrt, maximum, minimum, packed
from ehadiag.model.laws import JackLaw, stribeck_friction
from ehadiag.model.sensors import PathPiece, position_on_piece

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
    least_share: float = 1e-7
    """Share of a piece that is neglected, 1."""
    events: int = 16
    """Largest number of events of a step, 1; a jack that chatters on counts as resting."""


ORIFICE_STEPS = OrificeSteps()


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
