"""Integrates flapper, spool, second stage and jack: servovalve current in, noise-free response out.

The integration is compiled. Each sub-step takes flapper, spool, pressure and jack in the order
of the chain. Forces that grow with a mass's own velocity are implicit (the hydraulic ones have
time constants of microseconds), the rest is explicit; dry friction follows Borello's algorithm
(PHY-8).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ehadiag.compile.jit import Array, bare_kernel, kernel
from ehadiag.core.actuator import Actuator
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.plant_laws import PlantCoefficients, TorqueMotor, plant_coefficients
from firmware_iface.errors import ConfigurationError


class PlantState(NamedTuple):
    """Places of the states of the plant."""

    flapper: int
    """Flapper displacement, m."""
    flapper_velocity: int
    """Flapper velocity, m/s."""
    spool: int
    """Spool position, m."""
    spool_velocity: int
    """Spool velocity, m/s."""
    jack: int
    """Jack position, m."""
    jack_velocity: int
    """Jack velocity, m/s."""
    pressure: int
    """Differential pressure, Pa."""
    ball: int
    """Position of the feedback ball behind the backlash, m."""
    spool_filtered: int
    """Spool position behind the analogue filter, m."""
    pressure_filtered: int
    """Differential pressure behind the analogue filter, Pa."""
    spool_force: int
    """Force of the oil at the spool's ends where it yields, N."""
    pressure_common: int
    """Sum of both chambers' pressures less the supply's, where the lands differ, Pa."""
    first_stage_supply: int
    """Pressure behind the filter, Pa; 0 before the first step."""
    end: int
    """Number of states, 1."""


class BridgeForce(NamedTuple):
    """What the first stage does to the spool."""

    force: float
    """N."""
    damping: float
    """Its decrease by the spool's velocity, N s/m."""
    supply: float
    """Pressure behind the filter, Pa."""


STATE = PlantState(*range(len(PlantState._fields)))


@bare_kernel
def velocity_after(
    momentum: float, force: float, step: float, per_mass: float, static: float, dynamic: float
) -> float:
    """Velocity of a mass with dry friction after one step (Borello's algorithm).

    `momentum` is mass times velocity before, `force` all but dry friction and the viscous force,
    which is implicit: `per_mass` = 1/(mass + step·viscous coefficient). A change of sign within
    the step stops at exactly zero, so that the next step decides between sticking and breaking
    away.
    """
    if momentum == 0.0:
        friction = max(-static, min(static, force))
    elif momentum > 0.0:
        friction = dynamic
    else:
        friction = -dynamic
    after = (momentum + step * (force - friction)) * per_mass
    if momentum * after < 0.0:
        return 0.0
    return after


@bare_kernel
def stribeck(static: float, dynamic: float, speed: float, scale: float) -> float:
    """Friction of a mass that moves, N: FD + (FS - FD)·exp(-|v|/vS) (PHY-31)."""
    return dynamic + (static - dynamic) * math.exp(-abs(speed) / scale)


@bare_kernel
def orifice_flow(opening: float, share: float, underlap: float, gain: float) -> float:
    """Flow through two lands into the chambers, m³/s (PHY-39).

    `opening` is the spool's position against the lands in m, `share` STATE.pressure/PSR, `gain` GQ.
    """
    first = max(opening + underlap, 0.0)
    second = max(underlap - opening, 0.0)
    ahead, behind = 1.0 - share, 1.0 + share
    return gain * (
        first * math.copysign(math.sqrt(abs(ahead)), ahead)
        - second * math.copysign(math.sqrt(abs(behind)), behind)
    )


@kernel
def land_flow(opening: float, drop: float, by_supply: float, gain: float) -> float:
    """Flow through one land of an opening (m) by a pressure drop (Pa), m³/s (PHY-44)."""
    share = 2.0 * drop * by_supply
    return gain * max(opening, 0.0) * math.copysign(math.sqrt(abs(share)), share)


@bare_kernel
def bridge_force(p: PlantCoefficients, xf: float, dxs: float, supply: float) -> BridgeForce:
    """First stage as a bridge of turbulent orifices behind a filter (PHY-43).

    Each end of the spool has an inlet and a nozzle, alike with the flapper in the middle. `supply`
    is the pressure behind the filter a step before.
    """
    near, far = max(1.0 - xf / p.GAP, 0.0), max(1.0 + xf / p.GAP, 0.0)
    flow = p.AREA * dxs / p.INLET
    by_near, by_far = 1.0 / (1.0 + near * near), 1.0 / (1.0 + far * far)
    root_u = math.sqrt(max(supply / by_near - flow * flow, 1e-6 * supply))
    root_w = math.sqrt(max(supply / by_far - flow * flow, 1e-6 * supply))
    u, w = (root_u - near * flow) * by_near, (root_w + far * flow) * by_far
    slope = u * (flow / root_u + near) * by_near + w * (far - flow / root_w) * by_far
    total = near * u + far * w
    relieved = p.REST * (1.0 + p.LOSS) / (1.0 + 0.5 * p.LOSS * total * total / supply)
    return BridgeForce(
        p.AREA * (u * u - w * w),
        max(2.0 * p.AREA * p.AREA / p.INLET * slope, 0.0),
        0.5 * (supply + relieved),
    )


@kernel
def advance_plant(
    state: Array, p: PlantCoefficients, torque: float, step: float, substeps: int
) -> None:
    """Advance `state` (shape (STATE.end,), in place) by `substeps` steps of `step` s.

    `torque` is that of the torque motor on the flapper, N m, constant meanwhile.
    """
    xf, dxf = state[STATE.flapper], state[STATE.flapper_velocity]
    xs, dxs = state[STATE.spool], state[STATE.spool_velocity]
    xj, dxj = state[STATE.jack], state[STATE.jack_velocity]
    p12, ball = state[STATE.pressure], state[STATE.ball]
    xs_seen, p12_seen = state[STATE.spool_filtered], state[STATE.pressure_filtered]
    per_flapper = 1.0 / (p.JF + step * p.CF)
    per_spool = 1.0 / (p.MS + step * p.DAMPING)
    per_jack_free = 1.0 / (p.MJ + step * p.CJ)
    knee = p.PSR / p.GP
    stiffness = p.GP / p.GQ
    share = 1.0 / (1.0 + stiffness * p.CLK)
    drag = share * stiffness * p.AJ
    per_jack = 1.0 / (p.MJ + step * (p.AJ * drag + p.CJ))
    per_knee = 1.0 / p.PSR
    oil_step = step * p.OIL
    per_oil = 1.0 / (1.0 + oil_step * p.CLK)
    filtered = p.TAU > 0.0
    follow = 1.0 - math.exp(-step / p.TAU) if filtered else 1.0
    force_xs, common = state[STATE.spool_force], state[STATE.pressure_common]
    per_free_spool = 1.0 / (p.MS + step * (p.DAMPING - p.HYDRAULIC))
    supply = state[STATE.first_stage_supply]
    if supply == 0.0:
        supply = p.REST
    fss, fds = p.FSS, p.FDS
    fsj, fdj = p.FSJ, p.FDJ
    varies = p.VSS > 0.0 or p.VSJ > 0.0 or p.WAY != 0.0 or p.SLEEVE != 0.0

    for _ in range(substeps):
        if varies:
            fss = p.FSS * (1.0 + p.SLEEVE * xs)
            fds = 0.5 * fss
            if p.VSS > 0.0:
                fds = stribeck(fss, fds, dxs, p.VSS)
            way = dxj if dxj != 0.0 else p12
            fsj = p.FSJ * (1.0 + math.copysign(p.WAY, way * p.WAY))
            fdj = 0.5 * fsj
            if p.VSJ > 0.0:
                fdj = stribeck(fsj, fdj, dxj, p.VSJ)

        dxf = (p.JF * dxf + step * (torque - p.KSF * ball - p.KF * xf)) * per_flapper
        xf += step * dxf
        if abs(xf) >= p.XFM:
            xf = math.copysign(p.XFM, xf)
            dxf = 0.0

        if p.GAP > 0.0:
            pushed = bridge_force(p, xf, dxs, supply)
            supply = pushed.supply
            if p.ENDS > 0.0:
                force_xs += step / (p.ENDS + step) * (pushed.force - force_xs)
                dxs = velocity_after(p.MS * dxs, force_xs, step, per_free_spool, fss, fds)
            else:
                force = pushed.force + pushed.damping * dxs
                per = 1.0 / (p.MS + step * (p.DAMPING - p.HYDRAULIC + pushed.damping))
                dxs = velocity_after(p.MS * dxs, force, step, per, fss, fds)
        elif p.ENDS > 0.0:
            force_xs += step / (p.ENDS + step) * (p.FORCE * xf - p.HYDRAULIC * dxs - force_xs)
            dxs = velocity_after(p.MS * dxs, force_xs, step, per_free_spool, fss, fds)
        else:
            dxs = velocity_after(p.MS * dxs, p.FORCE * xf, step, per_spool, fss, fds)
        xs += step * dxs
        if abs(xs) >= p.XSM:
            xs = math.copysign(p.XSM, xs)
            dxs = 0.0
        ball = max(xs - p.BACKLASH, min(xs + p.BACKLASH, ball))

        opening = xs - p.NULL
        if p.LAND != 0.0:
            opening *= 1.0 + math.copysign(p.LAND, opening * p.LAND)
        load = p.FR + p.KA * xj
        momentum = p.MJ * dxj
        if p.OIL > 0.0:
            force = p.AJ * p12 - load
            dxj = velocity_after(momentum, force, step, per_jack_free, fsj, fdj)
            xj += step * dxj
            if abs(xj) >= p.XJM:
                xj = math.copysign(p.XJM, xj)
                dxj = 0.0
            if p.U1 > 0.0:
                first, second = 0.5 * (p.PSR + common + p12), 0.5 * (p.PSR + common - p12)
                inflow = land_flow(opening + p.U1, p.PSR - first, per_knee, p.GQ) - land_flow(
                    p.U2 - opening, first, per_knee, p.GQ
                )
                outflow = land_flow(opening + p.U3, second, per_knee, p.GQ) - land_flow(
                    p.U4 - opening, p.PSR - second, per_knee, p.GQ
                )
                gone = p.AJ * dxj + p.CLK * p12
                rise = 0.5 * oil_step * (inflow - gone) / (1.0 + p.CHAMBER * xj)
                fall = 0.5 * oil_step * (outflow - gone) / (1.0 - p.CHAMBER * xj)
                p12, common = p12 + rise + fall, common + rise - fall
            elif p.CHAMBER > 0.0:
                flow = orifice_flow(opening, p12 * per_knee, p.U, p.GQ)
                near = oil_step / (1.0 - (p.CHAMBER * xj) ** 2)
                p12 = (p12 + near * (flow - p.AJ * dxj)) / (1.0 + near * p.CLK)
            else:
                flow = orifice_flow(opening, p12 * per_knee, p.U, p.GQ)
                p12 = (p12 + oil_step * (flow - p.AJ * dxj)) * per_oil
        else:
            blocked = share * p.GP * opening  # pressure at zero jack velocity
            slope, per = drag, per_jack
            if abs(opening) > knee:
                beyond = p.PSR / (p.GQ * abs(opening))
                part = 1.0 / (1.0 + beyond * p.CLK)
                blocked = part * math.copysign(p.PSR, opening)
                slope = part * beyond * p.AJ
                per = 1.0 / (p.MJ + step * (p.AJ * slope + p.CJ))
            dxj = velocity_after(momentum, p.AJ * blocked - load, step, per, fsj, fdj)
            p12 = blocked - slope * dxj
            if abs(p12) > p.PSR:
                # A jack driven back against the valve: the pressure cannot exceed the supply.
                p12 = math.copysign(p.PSR, p12)
                force = p.AJ * p12 - load
                dxj = velocity_after(momentum, force, step, per_jack_free, fsj, fdj)
            xj += step * dxj
            if abs(xj) >= p.XJM:
                xj = math.copysign(p.XJM, xj)
                dxj = 0.0
                p12 = blocked
        if filtered:
            xs_seen += follow * (xs - xs_seen)
            p12_seen += follow * (p12 - p12_seen)

    if not filtered:
        xs_seen, p12_seen = xs, p12
    state[STATE.flapper], state[STATE.flapper_velocity] = xf, dxf
    state[STATE.spool], state[STATE.spool_velocity] = xs, dxs
    state[STATE.jack], state[STATE.jack_velocity] = xj, dxj
    state[STATE.pressure], state[STATE.ball] = p12, ball
    state[STATE.spool_force], state[STATE.pressure_common] = force_xs, common
    state[STATE.spool_filtered], state[STATE.pressure_filtered] = xs_seen, p12_seen
    state[STATE.first_stage_supply] = supply


DEFAULT_STEP_S = 0.25e-6
"""Integration step, s: errors below a fiftieth of a converter's step (detailed-model.md)."""
MAX_LAG_PIECE_S = 50e-6
"""Pieces of constant torque into which a current that lags divides a tick, s."""


class PlantDynamics:
    """Torque motor, spool, second stage and jack, at rest in the middle to begin with.

    actuator: the unit and what it suffers from; faults: see `actuator`; effects: see `actuator`;
    step: longest integration step, s; a whole number of equal steps makes a tick; filter_time: time
    constant of the analogue filter before the spool's and the pressure's converter, s; early: what
    is `seen` was sampled so long before the end of the tick, s. ConfigurationError: a step that is
    not within 1 ns … one tick, an instant outside the tick.
    """

    def __init__(
        self,
        actuator: Actuator,
        faults: Faults | None = None,
        effects: Effects | None = None,
        step: float = DEFAULT_STEP_S,
        *,
        filter_time: float = 0.0,
        early: float = 0.0,
    ) -> None:
        self._period = 1.0 / actuator.controller.rate
        if not (math.isfinite(step) and 1e-9 <= step <= self._period):
            raise ConfigurationError(f"integration step {step:g} s: need 1e-9 … {self._period:g} s")
        if not 0.0 <= early < self._period:
            raise ConfigurationError(
                f"sensor early (s): {early:g} is not from 0 to below a tick, {self._period:g}"
            )
        self._actuator, self._filter_time = actuator, filter_time
        self._faults, self._effects = faults or Faults(), effects or Effects()
        self._longest = step
        # Before and after the instant at which the sensors are sampled.
        self._spans = [part for part in (self._period - early, early) if part > 0.0]
        self._ticks = 0
        self._flowing = 0.0
        self._state = np.zeros(STATE.end)
        self._take_coefficients()
        self._motor = TorqueMotor(self._coefficients.GM, actuator.controller.IM, self._effects)
        self._seen = (0.0, 0.0, 0.0, 0.0)

    def change(self, faults: Faults, effects: Effects) -> None:
        """Take other severities and effects from now on; where the actuator is stays."""
        self._faults, self._effects = faults, effects
        self._take_coefficients()
        self._motor.change(self._coefficients.GM, self._actuator.controller.IM, effects)

    def advance(self, current: float) -> None:
        """Hold `current` (A) for one control tick."""
        if self._effects.unmodelled.oil_drift and self._ticks % 10 == 0:
            self._take_coefficients()
        for index, span in enumerate(self._spans):
            if self._effects.unmodelled.driver_lag > 0.0:
                self._lag(current, span)
            else:
                self._flowing = current
                self._integrate(current, span)
            if index == 0:
                state = self._state
                self._seen = (
                    self._flowing,
                    float(state[STATE.spool_filtered]),
                    float(state[STATE.pressure_filtered]),
                    float(state[STATE.jack]),
                )
        self._ticks += 1

    @property
    def spool(self) -> float:
        """Spool position, m."""
        return float(self._state[STATE.spool])

    @property
    def pressure(self) -> float:
        """Differential pressure, Pa."""
        return float(self._state[STATE.pressure])

    @property
    def position(self) -> float:
        """Jack position, m."""
        return float(self._state[STATE.jack])

    @property
    def seen(self) -> tuple[float, float, float, float]:
        """Current (A), spool (m), pressure (Pa), jack (m) behind the filters when sampled last."""
        return self._seen

    @property
    def motor_current(self) -> float:
        """Current behind the torque motor's bias and hysteresis, A."""
        return self._motor.current

    @property
    def oil_temperature(self) -> float:
        """Of the oil now, degC."""
        drift = self._effects.unmodelled.oil_drift
        return self._effects.oil_temperature + drift * self._ticks * self._period

    @property
    def state(self) -> Array:
        """Copy of the state, shape (STATE.end,), indices in `ehadiag_sim.plant_dynamics`."""
        return self._state.copy()

    def _take_coefficients(self) -> None:
        self._coefficients = plant_coefficients(
            self._actuator,
            self._faults,
            self._effects,
            filter_time=self._filter_time,
            oil_temperature=self.oil_temperature,
        )

    def _lag(self, current: float, span: float) -> None:
        """Let the current approach the held one; its mean over each piece drives the motor."""
        pieces = math.ceil(span / MAX_LAG_PIECE_S - 1e-6)
        piece = span / pieces
        left = math.exp(-piece / self._effects.unmodelled.driver_lag)
        for _ in range(pieces):
            before = self._flowing
            self._flowing = current + (before - current) * left
            self._integrate(0.5 * (before + self._flowing), piece)

    def _integrate(self, current: float, span: float) -> None:
        # The slack keeps a step that divides the span but for rounding.
        substeps = math.ceil(span / self._longest - 1e-6)
        advance_plant(
            self._state, self._coefficients, self._motor.torque(current), span / substeps, substeps
        )


def plant_response(
    actuator: Actuator,
    currents: Array,
    faults: Faults | None = None,
    effects: Effects | None = None,
    step: float = DEFAULT_STEP_S,
) -> Array:
    """Response of the plant alone to given currents (A, one a tick), from rest.

    Returns spool (m), pressure (Pa), jack position (m) at the end of each tick, shape (3, ticks).
    """
    plant = PlantDynamics(actuator, faults, effects, step)
    out = np.empty((3, len(currents)))
    for tick, current in enumerate(currents.tolist()):
        plant.advance(current)
        out[:, tick] = plant.spool, plant.pressure, plant.position
    return out
