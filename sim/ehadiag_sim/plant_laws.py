"""Coefficients, torque motor and control law of the simulated unit, in plain arithmetic."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import NamedTuple

import numpy as np

from ehadiag.core.actuator import Actuator
from ehadiag_sim.conditions import Effects, Faults
from firmware_iface.recording import CommandMode
from firmware_iface.stored_test import Controller

MAX_FLOW_GAIN_LOSS = 0.8
"""Share of the first-stage flow gain that is lost at the limit of damage (PHY-13)."""

CELSIUS_OFFSET_K = 273.15
OIL_VISCOSITY_POINTS = ((40.0, 14.5), (100.0, 3.5))
"""degC and mm²/s of MIL-PRF-83282 (PHY-19)."""
WALTHER_SHIFT = 0.7


class PlantCoefficients(NamedTuple):
    """Symbols of docs/reference/physics.md, SI units, with faults and effects already in them."""

    GM: float
    JF: float
    CF: float
    KSF: float
    KF: float
    XFM: float
    FORCE: float
    """Spool driving force per flapper displacement, AS·GPF, N/m."""
    DAMPING: float
    """Viscous coefficient of the spool, AS²·GPF/GQF + CS, N s/m."""
    MS: float
    XSM: float
    FSS: float
    """Static spool friction, N."""
    FDS: float
    """Dynamic spool friction, N."""
    PSR: float
    GP: float
    GQ: float
    CLK: float
    AJ: float
    MJ: float
    CJ: float
    XJM: float
    FSJ: float
    """Static jack friction, N."""
    FDJ: float
    """Dynamic jack friction, N."""
    FR: float
    KA: float
    """Load spring, N/m."""
    BACKLASH: float
    """Half-width of the play between spool and feedback ball, m."""
    VSS: float
    """Stribeck velocity of the spool, m/s; 0: none."""
    VSJ: float
    """Stribeck velocity of the jack, m/s; 0: none."""
    OIL: float
    """Stiffness of the oil in the chambers, 2·β/V, Pa/m³; 0: a linear second stage."""
    U: float
    """Underlap of the orifices, 2·PSR/GP, m."""
    TAU: float
    """Time constant of the analogue filter on spool and pressure, s; 0: none."""
    LAND: float
    """Asymmetry of the lands."""
    NULL: float
    """Spool position at which the lands are closed, m."""
    WAY: float
    """Asymmetry of the jack's friction."""
    SLEEVE: float
    """Growth of spool friction along the sleeve, 1/m."""
    CHAMBER: float
    """Share of a chamber's volume that the jack displaces by its travel, AJ/V, 1/m; 0: none."""
    HYDRAULIC: float
    """Part of DAMPING by the first stage's flow, AS²·GPF/GQF, N s/m."""
    ENDS: float
    """Time in which the pressure on the spool's ends follows, V·GPF/(2·β·GQF), s; 0: at once."""
    AREA: float
    """Of the spool's end, m²."""
    GAP: float
    """Of the first stage's nozzles, m; 0: a linear first stage."""
    INLET: float
    """Flow through an inlet of the first stage by the root of the pressure, m³/(s √Pa)."""
    REST: float
    """Pressure behind the filter at no load, Pa."""
    LOSS: float
    """Of the filter at no load, over that pressure, 1."""
    U1: float
    """Underlaps of the four lands, m: supply to the first chamber, first chamber to the return,
    second chamber to the return, supply to the second chamber."""
    U2: float
    U3: float
    U4: float


class UnitData(NamedTuple):
    """Numbers of an actuator file, with its symbols; `OIL` as in `PlantCoefficients`."""

    GM: float
    JF: float
    CF: float
    KSF: float
    KF: float
    XFM: float
    GQF: float
    GPF: float
    AS: float
    MS: float
    CS: float
    XSM: float
    FSS0: float
    FSS1: float
    PSR: float
    GP: float
    GQ: float
    CLK: float
    AJ: float
    MJ: float
    CJ: float
    XJM: float
    FDJ0: float
    FDJ1: float
    FR: float
    OIL: float
    CLE: float
    """Exponent of the pressure gain behind a clogged filter (PHY-45)."""
    CHAMBER: float


class UnitCondition(NamedTuple):
    """Faults and effects of a unit as numbers, without the unmodelled ones.

    Symbols are those of `Faults`, `DataErrors` (`E_…`) and `Effects`.
    """

    Kintas: float
    FSS: float
    FDJ: float
    gain_change: float
    backlash: float
    oil_temperature: float
    supply_pressure: float
    return_pressure: float
    spool_stribeck: float
    jack_stribeck: float
    load: float
    load_spring: float
    E_GM: float
    E_KSF: float
    E_KF: float
    E_GP: float
    E_GQ: float
    E_CS: float
    E_CJ: float
    E_MJ: float
    E_FSS0: float
    E_FDJ0: float
    filter_time: float


def unit_data(actuator: Actuator) -> UnitData:
    """Take the numbers of an actuator."""
    valve, jack, stage = actuator.servovalve, actuator.jack, actuator.second_stage
    stiffness = 2.0 * stage.beta / stage.volume_of_one_chamber if stage.kind == "orifice" else 0.0
    of_valve = {name: getattr(valve, name) for name in UnitData._fields if hasattr(valve, name)}
    of_jack = {name: getattr(jack, name) for name in UnitData._fields if hasattr(jack, name)}
    moves = stage.kind == "orifice" and stage.by_position
    return UnitData(
        **of_valve,
        **of_jack,
        OIL=stiffness,
        CLE=sum(valve.clogging_range) / 2.0,
        CHAMBER=jack.AJ / stage.volume_of_one_chamber if moves else 0.0,
    )


def unit_condition(
    faults: Faults, effects: Effects, filter_time: float, oil_temperature: float
) -> UnitCondition:
    """Take the numbers of faults and effects."""
    errors = {f"E_{item.name}": getattr(effects.data, item.name) for item in fields(effects.data)}
    named = {
        name: getattr(source, name)
        for source in (faults, effects)
        for name in UnitCondition._fields
        if hasattr(source, name)
    }
    of_day = {"oil_temperature": oil_temperature, "filter_time": filter_time}
    return UnitCondition(**{**named, **errors, **of_day})


def scale_unit_data(d: UnitData, c: UnitCondition) -> PlantCoefficients:
    """Scale a unit's data by its condition (PHY-13 to 39), without unmodelled.

    Plain arithmetic, which may be compiled too. The first-stage pressure gain does not follow the
    supply (PHY-20). The ends of the friction scales (FSS1, FDJ1) have no tolerance.
    """
    thickness = relative_viscosity(c.oil_temperature)
    flow_gain = d.GQF * (1.0 - MAX_FLOW_GAIN_LOSS * c.Kintas)
    pressure_gain = d.GPF * (1.0 - MAX_FLOW_GAIN_LOSS * c.Kintas) ** d.CLE
    hydraulic = d.AS**2 * pressure_gain / flow_gain
    spool_new = d.FSS0 * (1.0 + c.E_FSS0)
    spool_friction = spool_new + c.FSS * (d.FSS1 - spool_new)
    jack_new = d.FDJ0 * (1.0 + c.E_FDJ0)
    jack_friction = jack_new + c.FDJ * (d.FDJ1 - jack_new)
    drop = c.supply_pressure - c.return_pressure
    gain = d.GP * (1.0 + c.E_GP)
    gap = d.PSR / d.GPF if d.CLE > 0.0 else 0.0
    rest = pressure_gain * d.PSR / d.GPF
    return PlantCoefficients(
        GM=d.GM * (1.0 + c.E_GM) * (1.0 + c.gain_change),
        JF=d.JF,
        CF=d.CF,
        KSF=d.KSF * (1.0 + c.E_KSF),
        KF=d.KF * (1.0 + c.E_KF),
        XFM=d.XFM,
        FORCE=d.AS * pressure_gain,
        DAMPING=hydraulic + d.CS * (1.0 + c.E_CS) * thickness,
        MS=d.MS,
        XSM=d.XSM,
        FSS=spool_friction,
        FDS=0.5 * spool_friction,
        PSR=drop,
        GP=gain,
        GQ=d.GQ * (1.0 + c.E_GQ),
        CLK=d.CLK / thickness,
        AJ=d.AJ,
        MJ=d.MJ * (1.0 + c.E_MJ),
        CJ=d.CJ * (1.0 + c.E_CJ) * thickness,
        XJM=d.XJM,
        FSJ=2.0 * jack_friction,
        FDJ=jack_friction,
        FR=d.FR + c.load,
        KA=c.load_spring,
        BACKLASH=c.backlash,
        VSS=c.spool_stribeck,
        VSJ=c.jack_stribeck,
        OIL=d.OIL,
        U=2.0 * drop / gain,
        TAU=c.filter_time,
        LAND=0.0,
        NULL=0.0,
        WAY=0.0,
        SLEEVE=0.0,
        CHAMBER=d.CHAMBER,
        HYDRAULIC=hydraulic,
        ENDS=0.0,
        AREA=d.AS,
        GAP=gap,
        INLET=flow_gain * gap / math.sqrt(0.5 * rest),
        REST=rest,
        LOSS=max(drop / rest - 1.0, 0.0),
        U1=0.0,
        U2=0.0,
        U3=0.0,
        U4=0.0,
    )


def plant_coefficients(
    actuator: Actuator,
    faults: Faults,
    effects: Effects,
    *,
    filter_time: float = 0.0,
    oil_temperature: float | None = None,
) -> PlantCoefficients:
    """Scale the actuator's data by faults (PHY-13 to 15) and effects (PHY-16 to 39).

    `oil_temperature` (degC) stands for that of the effects.
    """
    degc = effects.oil_temperature if oil_temperature is None else oil_temperature
    strange = effects.unmodelled
    made = scale_unit_data(unit_data(actuator), unit_condition(faults, effects, filter_time, degc))
    return made._replace(
        LAND=strange.land_asymmetry,
        NULL=strange.land_shift,
        WAY=strange.friction_asymmetry,
        SLEEVE=strange.spool_friction_slope / actuator.servovalve.XSM,
        ENDS=0.5
        * strange.spool_end_volume
        / actuator.second_stage.beta
        * made.HYDRAULIC
        / actuator.servovalve.AS**2,
        **{
            name: made.U * (1.0 + error) if any(strange.underlap_errors) else 0.0
            for name, error in zip(("U1", "U2", "U3", "U4"), strange.underlap_errors, strict=True)
        },
    )


def relative_viscosity(temperature: float) -> float:
    """Kinematic viscosity at `temperature` (degC) over the one at 40 degC.

    Walther's law (ASTM D341), lg lg(ν + 0.7) = a - b·lg T, through the two known viscosities.
    """
    slope = (WALTHER_W1 - WALTHER_W0) / (WALTHER_X1 - WALTHER_X0)
    exponent = WALTHER_W0 + slope * (math.log10(temperature + CELSIUS_OFFSET_K) - WALTHER_X0)
    at, reference = 10.0 ** (10.0**exponent), 10.0 ** (10.0**WALTHER_W0)
    return float((at - WALTHER_SHIFT) / (reference - WALTHER_SHIFT))


def _walther(viscosity: float) -> float:
    return math.log10(math.log10(viscosity + WALTHER_SHIFT))


WALTHER_W0, WALTHER_W1 = (_walther(viscosity) for _, viscosity in OIL_VISCOSITY_POINTS)
WALTHER_X0, WALTHER_X1 = (math.log10(degc + CELSIUS_OFFSET_K) for degc, _ in OIL_VISCOSITY_POINTS)


def play_operator(held: float, value: float, half_width: float) -> float:
    """Play operator: the output follows `value` at a distance of at most `half_width`."""
    return max(value - half_width, min(value + half_width, held))


class TorqueMotor:
    """Null bias, hysteresis and gain of one torque motor (PHY-16, 17, 29, 30).

    Hysteresis is the mean of n plays (Prandtl-Ishlinskii) with half-widths
    `r_i = hyst·IM·(i + 0.5)/n`; for n = 1 the play of section 4, of half-width hyst·IM/2.

    gain: torque-motor gain with its change, N m/A; rated: rated current, A; effects: null bias,
    hysteresis, and the unmodelled among them.
    """

    def __init__(self, gain: float, rated: float, effects: Effects) -> None:
        self._held = [0.0] * int(effects.plays)
        self.change(gain, rated, effects)

    def change(self, gain: float, rated: float, effects: Effects) -> None:
        """Take other sizes from now on; the number of plays stays."""
        count = len(self._held)
        places = (np.arange(count) + 0.5) / count
        weights = np.exp(-effects.unmodelled.play_skew * places)
        self._widths: list[float] = (effects.hysteresis * rated * places).tolist()
        self._weights: list[float] = (weights / weights.sum()).tolist()
        self._gain, self._rated = gain, rated
        self._bias = effects.null_bias
        self._cubic = effects.unmodelled.torque_cubic

    @property
    def current(self) -> float:
        """Current behind bias and hysteresis, A."""
        return math.fsum(w * h for w, h in zip(self._weights, self._held, strict=True))

    def torque(self, current: float) -> float:
        """Torque (N m) at a servovalve current (A) that changes no way but straight to there."""
        value = current + self._bias
        self._held = [
            play_operator(held, value, width)
            for held, width in zip(self._held, self._widths, strict=True)
        ]
        inside = self.current
        torque = self._gain * inside
        if self._cubic:
            torque *= 1.0 + self._cubic * (inside / self._rated) ** 2
        return torque


class PositionLaw(NamedTuple):
    """Gains of the controller (PHY-2)."""

    IM: float
    """Saturation, A."""
    GAP: float
    """A/m."""
    GAI: float
    """A/(m s)."""
    GAD: float
    """A s/m."""
    tick: float
    """s."""


def position_law(
    law: PositionLaw, integral: float, before: float, error: float
) -> tuple[float, float]:
    """One tick of the control law: servovalve current, A, and the integral after the tick.

    integral: of the error before this tick, m s; before: error of the tick before, m, NaN where
    there was none; error: of this tick, m. Plain arithmetic, which may be compiled too.
    """
    slope = 0.0 if math.isnan(before) else (error - before) / law.tick
    trial = integral + error * law.tick
    wanted = law.GAP * error + law.GAI * trial + law.GAD * slope
    if abs(wanted) > law.IM and wanted * law.GAI * error > 0.0:
        wanted = law.GAP * error + law.GAI * integral + law.GAD * slope
        trial = integral
    return max(-law.IM, min(law.IM, wanted)), trial


class PositionController:
    """PID with saturation at the rated current; in current mode the command passes through.

    The integral holds while the output is saturated and the error would drive it deeper
    (conditional integration); the derivative is the difference quotient over one tick.
    """

    def __init__(self, data: Controller) -> None:
        self._law = PositionLaw(data.IM, data.GAP, data.GAI, data.GAD, 1.0 / data.rate)
        self._integral = 0.0
        self._error: float | None = None

    def reset(self) -> None:
        """Forget the past: no integral, no earlier error."""
        self._integral = 0.0
        self._error = None

    def current(self, command: float, mode: CommandMode, measured: float) -> float:
        """Servovalve current of this tick, A.

        `command` in A (current mode) or m (position mode), `measured` the digitised jack position
        of the tick before, m.
        """
        limit = self._law.IM
        if mode is CommandMode.CURRENT:
            self.reset()
            return max(-limit, min(limit, command))
        error = command - measured
        before = math.nan if self._error is None else self._error
        current, self._integral = position_law(self._law, self._integral, before, error)
        self._error = error
        return current
