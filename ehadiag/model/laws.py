"""The actuator's physical equations, each written once for the scalar and the vector kernels.

Named tuples hold what a law needs of a candidate, precombined; the functions take plain numbers or
vectors of lanes. Symbols and requirement numbers are those of docs/reference/physics.md.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ehadiag.compile.kernels import inlined
from ehadiag.compile.vector import least, magnitude, most, packed
from ehadiag.model.exponential import exponential
from ehadiag.model.plant import PlantConstants

__all__ = [
    "BEND",
    "ESTIMATED_BEND",
    "DriveLaw",
    "JackLaw",
    "SpoolLaw",
    "creeping",
    "drive_law",
    "driven",
    "excess",
    "faded",
    "flapper_held",
    "jack_law",
    "lagged",
    "opening",
    "play",
    "pressure",
    "resistance",
    "slide_base",
    "spool_law",
    "steady_rate",
    "still_flapper",
]

STATIC_SHARE_SPOOL = 0.5
"""Dynamic over static dry friction of the spool (PHY-14)."""
STATIC_RATIO_JACK = 2.0
"""Static over dynamic dry friction of the jack (PHY-15)."""
SLOWEST_STRIBECK = 1e-5
"""Stribeck velocity below which it is not felt, m/s."""
MOST_FADED = 40.0
BEND, FINE_BEND = 0.05e-6, 0.5e-9
"""Bend of the spool's path (m) that the jack does not feel: with a linear second stage, which
follows the spool at once, and with one that stores what flows."""
ESTIMATED_BEND = 0.02e-6
"""The same where severities are estimated, m: with a monitor's 0.05e-6 jack friction would be up to
0.2 deviations off."""


class DriveLaw(NamedTuple):
    """What the torque motor of one candidate makes of the current.

    Attributes
    ----------
    gain: flapper deflection per current, GM / KF, m/A.
    bias: current that the motor adds to the commanded one, A.
    spacing: of the half-widths of the plays, A: they are spacing (i + 1/2).
    share: of the narrowest play in the current that acts.
    fade: share of each play over that of the next narrower one.
    even, odd: relative gain of the torque per current (1/A) and per its square (1/A²).
    left: share of a change of the current that its driver's lag leaves after a tick.
    late: the same in the mean over the tick.
    """

    gain: Any
    bias: Any
    spacing: Any
    share: Any
    fade: Any
    even: Any
    odd: Any
    left: Any
    late: Any


@inlined
def drive_law(c: PlantConstants, tick: float) -> DriveLaw:
    """Precombine what the torque motor's law needs (PHY-4, PHY-29, PHY-30); tick: s."""
    fade = exponential(-c.SKW / c.NPL)
    total, weight = 0.0, 1.0
    for _ in range(int(c.NPL)):
        total += weight
        weight *= fade
    even, odd = c.TQ2 / c.IM, c.TQ3 / (c.IM * c.IM)
    left, late = 0.0, 0.0
    if c.LAG > 0.0:
        left = exponential(-tick / c.LAG)
        late = c.LAG / tick * (1.0 - left)
    spacing = c.HYS * c.IM / c.NPL
    return DriveLaw(c.GM / c.KF, c.IB, spacing, 1.0 / total, fade, even, odd, left, late)


@packed
def lagged(share: Any, before: Any, current: Any) -> Any:
    """Current (A) of which a driver's lag leaves a share of its change from that of before."""
    return current + share * (before - current)


@packed
def driven(law: DriveLaw, total: Any) -> Any:
    """Flapper deflection (m) by the sum of what the plays hold, each with its weight (A)."""
    acting = law.share * total
    return law.gain * acting * (1.0 + acting * (law.even + law.odd * acting))


@packed
def play(held: Any, value: Any, half_width: Any) -> Any:
    """What a play of a half-width holds after its input has gone to a value (PHY-30)."""
    return least(most(held, value - half_width), value + half_width)


class SpoolLaw(NamedTuple):
    """Torque motor, flapper and spool of one candidate.

    Attributes
    ----------
    ratio: flapper deflection that the feedback wire takes back per spool travel, KSF / KF.
    reach: its inverse, spool travel per flapper deflection.
    force: on the spool per flapper deflection, AS GPF, N/m.
    mass: of the spool, kg.
    damping: viscous coefficient of the moving spool, (GPF/GQF) AS² + CS, N s/m.
    dynamic: dry friction of the moving spool, N.
    dry: flapper deflection that balances it, m.
    breakaway: flapper deflection that overcomes the static friction, m.
    extra: that which balances the friction that a creeping spool has and a fast one has not, m; 0
        without Stribeck's effect.
    by_stribeck: reciprocal of the velocity over which that fades, s/m.
    flapper_stop, stroke: of flapper and spool, m.
    backlash: half-width of the play between spool and feedback wire, m.
    bend: of the spool's path that the second stage does not feel, m.
    ring_damping, ring_rate: decay and angular frequency (1/s) of the flapper beside a resting
        spool; rate 0 where it does not ring.
    """

    ratio: float
    reach: float
    force: float
    mass: float
    damping: float
    dynamic: float
    dry: float
    breakaway: float
    extra: float
    by_stribeck: float
    flapper_stop: float
    stroke: float
    backlash: float
    bend: float
    ring_damping: float
    ring_rate: float


@inlined
def spool_law(c: PlantConstants, bend: float = BEND) -> SpoolLaw:
    """Precombine what the flapper and spool laws need (PHY-4, PHY-5, PHY-14).

    bend: of the spool's path that a linear second stage does not feel, m.
    """
    force = c.AS * c.GPF
    ring_damping = 0.5 * c.CF / c.JF
    square = c.KF / c.JF - ring_damping * ring_damping
    return SpoolLaw(
        c.KSF / c.KF,
        c.KF / c.KSF,
        force,
        c.MS,
        c.GPF / c.GQF * c.AS * c.AS + c.CS,
        STATIC_SHARE_SPOOL * c.FSS,
        STATIC_SHARE_SPOOL * c.FSS / force,
        c.FSS / force,
        (1.0 - STATIC_SHARE_SPOOL) * c.FSS / force if c.VSS > 0.0 else 0.0,
        1.0 / max(c.VSS, SLOWEST_STRIBECK) if c.VSS > 0.0 else 0.0,
        c.XFM,
        c.XSM,
        c.BKL,
        FINE_BEND if c.OIL > 0.0 else bend,
        ring_damping,
        math.sqrt(square) if square > 0.0 else 0.0,
    )


@packed
def still_flapper(ratio: Any, deflection: Any, wire: Any) -> Any:
    """Deflection at which the flapper rests while the feedback wire is held at `wire`, m."""
    return deflection - ratio * wire


@packed
def slide_base(t: SpoolLaw, deflection: Any, direction: Any) -> Any:
    """Spool position towards which it slides while the current lasts, m."""
    return (deflection - t.dry * direction) * t.reach + t.backlash * direction


@inlined
def steady_rate(t: SpoolLaw, xf: float, direction: float) -> float:
    """Velocity that the spool approaches with the flapper held at `xf`, m/s."""
    return (t.force * xf - t.dynamic * direction) / t.damping


@inlined
def flapper_held(t: SpoolLaw, deflection: float, wire: float) -> float:
    """Deflection of a flapper in equilibrium beside a spool that friction holds, m."""
    xf = still_flapper(t.ratio, deflection, wire)
    return min(max(xf, -t.breakaway), t.breakaway)


class JackLaw(NamedTuple):
    """Second stage and jack of one candidate.

    The second stage's equation, solved for the pressure, reads P12 = (flow x - v) / e with
    e = slope max(abs(x), corner) + leak, whether its pressure gain saturates or not (PHY-6).

    Attributes
    ----------
    flow: no-load velocity of the jack per spool travel, GQ / AJ, 1/s.
    slope: velocity that a pressure takes, per opening, GQ / (PSR AJ), 1/(s Pa).
    leak: the same by leakage, CLK / AJ, m/(s Pa).
    corner: opening at which the pressure gain saturates, PSR / GP, m.
    area, viscosity: of the jack, m² and N s/m.
    by_mass: reciprocal of its mass, 1/kg.
    supply: supply minus return pressure, Pa.
    by_supply: its reciprocal, 1/Pa.
    oil: rise of the pressure by the jack's travel where the oil yields, 2 β AJ / V, Pa/m; 0: it
        does not, and the second stage is linear.
    stroke: m.
    load: external with the jack in its middle, N, and what friction is more one way than the other.
    spring: what it gains by the jack's travel, N/m.
    friction: dry friction of the moving jack, N.
    static: of the resting one, N.
    extra: friction that a creeping jack has and a fast one has not, N; 0 without Stribeck's effect.
    by_stribeck: reciprocal of the velocity over which that fades, s/m.
    shaped: whether the lands open otherwise than by the spool's travel, 1 or 0.
    closed: spool position at which they are closed, m.
    even, odd: what they open more by the travel from there, to both sides, and by its cube, 1/m².
    lap: travel that their overlap takes, m.
    """

    flow: Any
    slope: Any
    leak: Any
    corner: Any
    area: Any
    viscosity: Any
    by_mass: Any
    supply: Any
    by_supply: Any
    oil: Any
    stroke: Any
    load: Any
    spring: Any
    friction: Any
    static: Any
    extra: Any
    by_stribeck: Any
    shaped: Any
    closed: Any
    even: Any
    odd: Any
    lap: Any


@inlined
def jack_law(c: PlantConstants) -> JackLaw:
    """Precombine what the laws of second stage and jack need (PHY-6, PHY-7, PHY-15, PHY-32)."""
    return JackLaw(
        c.GQ / c.AJ,
        c.GQ / (c.PSR * c.AJ),
        c.CLK / c.AJ,
        c.PSR / c.GP,
        c.AJ,
        c.CJ,
        1.0 / c.MJ,
        c.PSR,
        1.0 / c.PSR,
        c.OIL * c.AJ,
        c.XJM,
        c.FR + c.WAY * c.FDJ,
        c.KA,
        c.FDJ,
        STATIC_RATIO_JACK * c.FDJ,
        (STATIC_RATIO_JACK - 1.0) * c.FDJ if c.VSJ > 0.0 else 0.0,
        1.0 / max(c.VSJ, SLOWEST_STRIBECK) if c.VSJ > 0.0 else 0.0,
        1.0 if c.XLD != 0.0 or c.LD2 != 0.0 or c.LD3 != 0.0 or c.LAP != 0.0 else 0.0,
        c.XLD,
        c.LD2,
        c.LD3 / (c.XSM * c.XSM),
        c.LAP,
    )


@packed
def faded(z: Any) -> Any:
    """exp(-z) of z from 0 on, of numbers or vectors, to 1e-9: series and squarings."""
    y = least(z, MOST_FADED) * (1.0 / 64.0)
    out = 1.0 - y * (1.0 - y / 2.0 * (1.0 - y / 3.0 * (1.0 - y / 4.0 * (1.0 - y / 5.0))))
    for _ in range(6):
        out = out * out
    return out


@packed
def creeping(j: JackLaw, speed: Any) -> Any:
    """Friction that a jack at a speed (m/s) has beside that of a fast one, N (PHY-31)."""
    return j.extra * faded(speed * j.by_stribeck)


@packed
def opening(j: JackLaw, x: Any) -> Any:
    """Opening of the second stage with the spool at `x`, no less than its corner, m."""
    return most(magnitude(x), j.corner)


@packed
def resistance(j: JackLaw, x: Any) -> Any:
    """Velocity that a pressure takes from the jack with the spool at `x`, e, m/(s Pa)."""
    return j.slope * opening(j, x) + j.leak


@packed
def pressure(j: JackLaw, x: Any, velocity: Any) -> Any:
    """Differential pressure with the spool at `x` and the jack at a velocity, unlimited, Pa."""
    return (j.flow * x - velocity) / resistance(j, x)


@packed
def excess(j: JackLaw, x: Any, hold: Any) -> Any:
    """Force on the resting jack beyond `hold` (N, signed), times e, which is positive."""
    return j.area * j.flow * x - (j.load + hold) * resistance(j, x)
