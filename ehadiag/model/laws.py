"""Physical equations of the actuator and its controller, of one candidate or of many.

Named tuples hold what a law needs of a candidate, precombined; the functions take numbers or
vectors of lanes. Symbols and requirement numbers are those of docs/reference/physics.md.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ehadiag.compile.elementary import exponential
from ehadiag.compile.jit import Array, inlined, inlined_exact, kernel
from ehadiag.compile.vector import absolute, maximum, minimum, packed, unpacker
from ehadiag.model.plant import PlantConstants

if TYPE_CHECKING:  # what a kernel imports is part of its cache key
    from firmware_iface.stored_test import Controller

SPOOL_DYNAMIC_FRICTION_SHARE = 0.5
"""Dynamic over static dry friction of the spool (PHY-14)."""
JACK_STATIC_FRICTION_RATIO = 2.0
"""Static over dynamic dry friction of the jack (PHY-15)."""
MIN_STRIBECK_VELOCITY = 1e-5
"""Stribeck velocity below which it is not felt, m/s."""
MAX_DECAY_EXPONENT = 40.0
BRIDGE_ROUNDS = 24
"""Rounds of the regula falsi (Illinois) for the first stage's pressures, 1: to 1e-9 of a speed."""

plant_of = unpacker(PlantConstants)
"""Compiled: the constants that a row of `PLANT_FIELDS` numbers holds."""


class DriveLaw(NamedTuple):
    """What the torque motor of one candidate makes of the current."""

    gain: Any
    """Flapper deflection per current, GM / KF, m/A."""
    bias: Any
    """Current that the motor adds to the commanded one, A."""
    spacing: Any
    """Of the half-widths of the plays, A: they are spacing (i + 1/2)."""
    share: Any
    """Of the narrowest play in the current that acts."""
    fade: Any
    """Share of each play over that of the next narrower one."""
    even: Any
    odd: Any
    """Relative gain of the torque per current (1/A) and per its square (1/A²)."""
    left: Any
    """Share of a change of the current that its driver's lag leaves after a tick."""
    late: Any
    """The same in the mean over the tick."""


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
def lagged_current(share: Any, before: Any, current: Any) -> Any:
    """Current (A) of which a driver's lag leaves a share of its change from that of before."""
    return current + share * (before - current)


@packed
def motor_deflection(law: DriveLaw, total: Any) -> Any:
    """Flapper deflection (m) by the sum of what the plays hold, each with its weight (A)."""
    acting = law.share * total
    return law.gain * acting * (1.0 + acting * (law.even + law.odd * acting))


@packed
def play_output(held: Any, value: Any, half_width: Any) -> Any:
    """What a play of a half-width holds after its input has gone to a value (PHY-30)."""
    return minimum(maximum(held, value - half_width), value + half_width)


MAX_STALL_DEFLECTION = 1.2
"""Deflection, 1 over the nozzle's gap, taken for that of a spool that no flapper would move: a
closed nozzle gives 0.8 of the supply, and the filter's loss less."""


@inlined
def bridge_load(part: float, near: float, far: float, flow: float) -> tuple[float, float]:
    """Load on a spool between a bridge's ends, and its speed, by the flow into them (PHY-43).

    part: pressure behind the filter at no load over the valve's supply, 1; near, far: openings of
    the nozzles over that in the middle, 1; flow: over the largest one of the pressure behind the
    filter, 0 … 1. With u² and w² the pressures at the ends over that one, the one end's inlet feeds
    the nearer nozzle and the spool, the other's with the spool the further nozzle. Returns the load
    over the pressure at no load, and the speed over that without a load at a deflection of 1.
    """
    by_near, by_far = 1.0 / (1.0 + near * near), 1.0 / (1.0 + far * far)
    u = (math.sqrt(max(1.0 + near * near - flow * flow, 0.0)) - near * flow) * by_near
    w = (math.sqrt(max(1.0 + far * far - flow * flow, 0.0)) + far * flow) * by_far
    total = near * u + far * w
    supply = 1.0 / (part + (1.0 - part) * 0.5 * total * total)
    return supply * (u * u - w * w), flow * math.sqrt(2.0 * supply)


@inlined
def bridge_stall(part: float, load: float) -> float:
    """Deflection at which a resting spool's ends carry a load, 1 over the nozzle's gap (PHY-43).

    part, load: see `bridge_load`.
    """
    if load <= 0.0:
        return 0.0
    low, below, high = 0.0, -load, MAX_STALL_DEFLECTION
    above = bridge_load(part, max(1.0 - high, 0.0), 1.0 + high, 0.0)[0] - load
    if above <= 0.0:
        return high
    x, side = 0.0, 0
    for _ in range(BRIDGE_ROUNDS):
        x = (low * above - high * below) / (above - below)
        value = bridge_load(part, max(1.0 - x, 0.0), 1.0 + x, 0.0)[0] - load
        if value == 0.0:
            break
        if value < 0.0:
            low, below, above = x, value, above * (0.5 if side < 0 else 1.0)
            side = -1
        else:
            high, above, below = x, value, below * (0.5 if side > 0 else 1.0)
            side = 1
    return x


@inlined
def bridge_speed(part: float, load: float, viscous: float, x: float) -> float:
    """Speed of a spool by a deflection, over that without a load at a deflection of 1 (PHY-43).

    part, load: see `bridge_load`; viscous: further load by the speed, 1; x: over the nozzle's gap,
    1. 0 where the load holds the spool.
    """
    near, far = max(1.0 - x, 0.0), 1.0 + x
    low, above = 0.0, bridge_load(part, near, far, 0.0)[0] - load
    if above <= 0.0:
        return 0.0
    carried, speed = bridge_load(part, near, far, 1.0)
    high, below, side = 1.0, carried - load - viscous * speed, 0
    for _ in range(BRIDGE_ROUNDS):
        flow = (low * below - high * above) / (below - above)
        carried, speed = bridge_load(part, near, far, flow)
        value = carried - load - viscous * speed
        if value == 0.0:
            break
        if value > 0.0:
            low, above, below = flow, value, below * (0.5 if side > 0 else 1.0)
            side = 1
        else:
            high, below, above = flow, value, above * (0.5 if side < 0 else 1.0)
            side = -1
    return speed


class SpoolLaw(NamedTuple):
    """Torque motor, flapper and spool of one candidate."""

    ratio: float
    """Flapper deflection that the feedback wire takes back per spool travel, KSF / KF."""
    reach: float
    """Its inverse, spool travel per flapper deflection."""
    force: float
    """On the spool per flapper deflection, AS GPF, N/m."""
    mass: float
    """Of the spool, kg."""
    damping: float
    """Viscous coefficient of the moving spool, (GPF/GQF) AS² + CS of a linear stage, N s/m."""
    dynamic: float
    """Dry friction of the moving spool, N."""
    eased: float
    """What of it slows the spool while the flapper is on its stop, N (PHY-43)."""
    null: float
    """Middle between the flapper's stops to the first stage's null, m."""
    dry: float
    """Flapper deflection that balances it, m."""
    breakaway: float
    """Flapper deflection that overcomes the static friction, m."""
    extra: float
    """That which balances the friction that a creeping spool has and a fast one has not, m; 0
    without Stribeck's effect."""
    by_stribeck: float
    """Reciprocal of the velocity over which that fades, s/m."""
    flapper_stop: float
    stroke: float
    """Of flapper and spool, m."""
    backlash: float
    """Half-width of the play between spool and feedback wire, m."""
    by_bend: float
    """Reciprocal of the deflection from `dry` to the flapper's stop, 1/m; 0 without a bridge."""
    bend_linear: float
    bend_square: float
    bend_cube: float
    """What a bridge adds to the deflection that moves the spool, m, by powers of its share of that
    (PHY-43)."""
    ring_damping: float
    ring_rate: float
    """Decay and angular frequency (1/s) of the flapper at a resting spool; rate 0 where it does
    not ring."""


@inlined
def spool_law(c: PlantConstants) -> SpoolLaw:
    """Precombine what the flapper and spool laws need (PHY-4, PHY-5, PHY-14, PHY-43).

    The speed by a bridge's deflection bends little: a line through the deflection that balances the
    friction, by least squares up to the flapper's stop, and what it leaves as a cubic polynomial.
    """
    force = c.AS * c.GPF
    ring_damping = 0.5 * c.CF / c.JF
    square = c.KF / c.JF - ring_damping * ring_damping
    breakaway = c.FSS / force
    dry = SPOOL_DYNAMIC_FRICTION_SHARE * c.FSS / force
    dynamic = eased = SPOOL_DYNAMIC_FRICTION_SHARE * c.FSS
    damping = c.GPF / c.GQF * c.AS * c.AS + c.CS
    by_bend = linear = square_bend = cube = 0.0
    extra = (1.0 - SPOOL_DYNAMIC_FRICTION_SHARE) * c.FSS / force
    if c.BRG > 0.0:
        gap = c.XFM / c.BRG
        part = min(c.GPF * gap / c.PSR, 1.0)
        load = breakaway / gap
        breakaway = gap * bridge_stall(part, load)
        dry = gap * bridge_stall(part, SPOOL_DYNAMIC_FRICTION_SHARE * load)
        dynamic = eased = force * dry
        unit, span = c.GQF * gap / c.AS, c.XFM - dry
        load, viscous = SPOOL_DYNAMIC_FRICTION_SHARE * load, c.CS * unit / (force * gap)
        speed = unit * bridge_speed(part, load, viscous, c.BRG)
        if span > 0.0 and speed > 0.0:
            quarter, half = (dry + 0.25 * span) / gap, (dry + 0.5 * span) / gap
            at_quarter = unit * bridge_speed(part, load, viscous, quarter)
            at_half = unit * bridge_speed(part, load, viscous, half)
            damping = force * span / (0.5 * speed + at_half)
            eased = force * c.XFM - damping * speed
            quarter_bend = at_quarter * damping / (0.25 * force) - span
            half_bend = at_half * damping / (0.5 * force) - span
            stop_bend = speed * damping / force - span
            # By Newton's divided differences.
            first, second = 4.0 * (half_bend - quarter_bend), 2.0 * (stop_bend - half_bend)
            cube = (second - first) / 0.75
            square_bend = first - 0.75 * cube
            linear = quarter_bend - 0.25 * first + 0.125 * cube
            by_bend = 1.0 / span
        # A spool that creeps to rest stays within its static friction.
        share = min((breakaway - dry) * by_bend, 1.0)
        extra = breakaway - dry + share * (linear + share * (square_bend + share * cube))
    return SpoolLaw(
        c.KSF / c.KF,
        c.KF / c.KSF,
        force,
        c.MS,
        damping,
        dynamic,
        eased,
        c.XFN,
        dry,
        breakaway,
        extra if c.VSS > 0.0 else 0.0,
        1.0 / max(c.VSS, MIN_STRIBECK_VELOCITY) if c.VSS > 0.0 else 0.0,
        c.XFM,
        c.XSM,
        c.BKL,
        by_bend,
        linear,
        square_bend,
        cube,
        ring_damping,
        math.sqrt(square) if square > 0.0 else 0.0,
    )


@packed
def bridge_bend(t: SpoolLaw, deflection: Any) -> Any:
    """What a bridge adds to a deflection beyond `t.dry` along the motion, m (PHY-43)."""
    share = maximum(minimum(deflection * t.by_bend, 1.0), 0.0)
    return share * (t.bend_linear + share * (t.bend_square + share * t.bend_cube))


@packed
def with_friction(t: SpoolLaw, more: Any) -> SpoolLaw:
    """Law of a spool that moves against more friction, as the deflection that balances it, m."""
    return SpoolLaw(
        t.ratio, t.reach, t.force, t.mass, t.damping, t.dynamic + t.force * more,
        t.eased + t.force * more, t.null, t.dry + more,
        t.breakaway, t.extra, t.by_stribeck, t.flapper_stop, t.stroke, t.backlash,
        t.by_bend, t.bend_linear, t.bend_square, t.bend_cube, t.ring_damping, t.ring_rate,
    )  # fmt: skip


@packed
def flapper_rest(ratio: Any, deflection: Any, wire: Any) -> Any:
    """Deflection at which the flapper rests while the feedback wire is held at `wire`, m."""
    return deflection - ratio * wire


@packed
def spool_rest_position(t: SpoolLaw, deflection: Any, direction: Any) -> Any:
    """Spool position towards which it slides while the current lasts, m."""
    return (deflection - t.dry * direction) * t.reach + t.backlash * direction


@inlined
def steady_spool_velocity(t: SpoolLaw, xf: float, direction: float) -> float:
    """Velocity that the spool approaches with the flapper held at `xf`, m/s."""
    return (t.force * xf - t.dynamic * direction) / t.damping


@inlined
def clamped_spool_velocity(t: SpoolLaw, xf: float, direction: float) -> float:
    """Velocity that the spool approaches with the flapper on its stop, m/s (PHY-43)."""
    return (t.force * (xf - t.null) - t.eased * direction) / t.damping


class JackLaw(NamedTuple):
    """Second stage and jack of one candidate.

    The second stage's equation, solved for the pressure, reads P12 = (flow x - v) / e with
    e = slope max(abs(x), corner) + leak, whether its pressure gain saturates or not (PHY-6).
    """

    flow: Any
    """No-load velocity of the jack per spool travel, GQ / AJ, 1/s."""
    slope: Any
    """Velocity that a pressure takes, per opening, GQ / (PSR AJ), 1/(s Pa)."""
    leak: Any
    """The same by leakage, CLK / AJ, m/(s Pa)."""
    corner: Any
    """Opening at which the pressure gain saturates, PSR / GP, m."""
    area: Any
    viscosity: Any
    """Of the jack, m² and N s/m."""
    by_mass: Any
    """Reciprocal of its mass, 1/kg."""
    supply: Any
    """Supply minus return pressure, Pa."""
    by_supply: Any
    """Its reciprocal, 1/Pa."""
    oil: Any
    """Rise of the pressure by the jack's travel where the oil yields, 2 β AJ / V, Pa/m; 0: it does
    not, and the second stage is linear."""
    bulge: Any
    """Share of a chamber's volume that the jack's travel displaces, AJ / V, 1/m."""
    stroke: Any
    """m."""
    load: Any
    """External with the jack in its middle, N, and what friction is more one way than the other."""
    spring: Any
    """What it gains by the jack's travel, N/m."""
    friction: Any
    """Dry friction of the moving jack, N."""
    static: Any
    """Of the resting one, N."""
    extra: Any
    """Friction that a creeping jack has and a fast one has not, N; 0 without Stribeck's effect."""
    by_stribeck: Any
    """Reciprocal of the velocity over which that fades, s/m."""
    shaped: Any
    """Whether the lands open otherwise than by the spool's travel, 1 or 0."""
    closed: Any
    """Spool position at which they are closed, m."""
    even: Any
    odd: Any
    """What they open more by the travel from there, to both sides, and by its cube, 1/m²."""
    lap: Any
    """Travel that their overlap takes, m."""


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
        c.CHB,
        c.XJM,
        c.FR + c.WAY * c.FDJ,
        c.KA,
        c.FDJ,
        JACK_STATIC_FRICTION_RATIO * c.FDJ,
        (JACK_STATIC_FRICTION_RATIO - 1.0) * c.FDJ if c.VSJ > 0.0 else 0.0,
        1.0 / max(c.VSJ, MIN_STRIBECK_VELOCITY) if c.VSJ > 0.0 else 0.0,
        1.0 if c.XLD != 0.0 or c.LD2 != 0.0 or c.LD3 != 0.0 or c.LAP != 0.0 else 0.0,
        c.XLD,
        c.LD2,
        c.LD3 / (c.XSM * c.XSM),
        c.LAP,
    )


@packed
def exp_minus(z: Any) -> Any:
    """exp(-z) of z from 0 on, of numbers or vectors, to 1e-9: series and squarings."""
    y = minimum(z, MAX_DECAY_EXPONENT) * (1.0 / 64.0)
    out = 1.0 - y * (1.0 - y / 2.0 * (1.0 - y / 3.0 * (1.0 - y / 4.0 * (1.0 - y / 5.0))))
    for _ in range(6):
        out = out * out
    return out


@packed
def stribeck_friction(j: JackLaw, speed: Any) -> Any:
    """Friction of a jack at a speed (m/s) beyond that of a fast one, N (PHY-31)."""
    return j.extra * exp_minus(speed * j.by_stribeck)


@packed
def effective_opening(j: JackLaw, x: Any) -> Any:
    """Opening of the second stage with the spool at `x`, no less than its corner, m."""
    return maximum(absolute(x), j.corner)


@packed
def stage_resistance(j: JackLaw, x: Any) -> Any:
    """Velocity that a pressure takes from the jack with the spool at `x`, e, m/(s Pa)."""
    return j.slope * effective_opening(j, x) + j.leak


@packed
def stage_pressure(j: JackLaw, x: Any, velocity: Any) -> Any:
    """Differential pressure with the spool at `x` and the jack at a velocity, unlimited, Pa."""
    return (j.flow * x - velocity) / stage_resistance(j, x)


@packed
def excess_force(j: JackLaw, x: Any, hold: Any) -> Any:
    """Force on the resting jack beyond `hold` (N, signed), times e, which is positive."""
    return j.area * j.flow * x - (j.load + hold) * stage_resistance(j, x)


class ControlLaw(NamedTuple):
    """Gains of the controller (PHY-2), see `ehadiag.core.actuator.Controller`."""

    IM: float
    """Saturation, A."""
    GAP: float
    GAI: float
    GAD: float
    """A/m, A/(m s), A s/m."""
    tick: float
    """s."""


class ControlState(NamedTuple):
    """State of the controller between two ticks."""

    integral: float
    """m s."""
    before: float
    """m; of no meaning until started."""
    started: float
    """0 before the first tick, then 1."""


def control_law(controller: Controller, tick: float) -> ControlLaw:
    """Gains of an actuator's controller, run once each `tick` (s)."""
    return ControlLaw(controller.IM, controller.GAP, controller.GAI, controller.GAD, tick)


@inlined_exact
def control_current(
    law: ControlLaw, state: ControlState, error: float
) -> tuple[float, ControlState]:
    """Demanded current (A) for a position error (m).

    Cor = sat(GAP Err + GAI ∫Err + GAD dErr/dt) (PHY-2).
    """
    wanted = law.GAP * error
    if state.started != 0.0:
        wanted += law.GAD * (error - state.before) / law.tick
    trial = state.integral + error * law.tick
    wanted += law.GAI * trial
    out = min(max(wanted, -law.IM), law.IM)
    integral = state.integral
    # Conditional integration: the integral rests while it would push further into saturation.
    if wanted == out or (wanted - out) * error < 0.0:
        integral = trial
    return out, ControlState(integral, error, 1.0)


def control_currents(law: ControlLaw, errors: Array) -> Array:
    """Demanded current of each tick (A) from its position error (m), both of shape (n,)."""
    out = np.empty_like(errors)
    fill_control_currents(law, np.ascontiguousarray(errors), out)
    return out


@kernel
def fill_control_currents(law: ControlLaw, errors: Array, out: Array) -> None:
    """Write what `control_currents` returns."""
    state = ControlState(0.0, 0.0, 0.0)
    for k in range(errors.shape[0]):
        out[k], state = control_current(law, state, errors[k])
