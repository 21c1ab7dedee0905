"""Coefficients of the plant's kernel, from actuator data, faults and effects."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import NamedTuple

from ehadiag.core.actuator import Actuator
from ehadiag_sim.plant.conditions import Effects, Faults

__all__ = [
    "Coefficients",
    "Condition",
    "UnitData",
    "coefficients",
    "condition",
    "relative_viscosity",
    "scaled",
    "unit_data",
]

CLOGGING = 0.8
"""Share of the first-stage flow gain that is lost at the limit of damage (PHY-13)."""

KELVIN = 273.15
REFERENCE_DEGC = 40.0
KNOWN_VISCOSITIES = ((40.0, 14.5), (100.0, 3.5))
"""degC and mm²/s of MIL-PRF-83282 (PHY-19)."""
WALTHER_SHIFT = 0.7


class Coefficients(NamedTuple):
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
    """Asymmetry of the lands (stranger)."""
    NULL: float
    """Spool position at which the lands are closed, m (stranger)."""
    WAY: float
    """Asymmetry of the jack's friction (stranger)."""
    SLEEVE: float
    """Growth of spool friction along the sleeve, 1/m (stranger)."""


class UnitData(NamedTuple):
    """Numbers of an actuator file, with its symbols; `OIL` as in `Coefficients`."""

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


class Condition(NamedTuple):
    """Faults and effects of a unit as numbers, beside the strangers.

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
    stiffness = 2.0 * stage.beta / stage.volume if stage.kind == "orifice" else 0.0
    of_valve = {name: getattr(valve, name) for name in UnitData._fields if hasattr(valve, name)}
    of_jack = {name: getattr(jack, name) for name in UnitData._fields if hasattr(jack, name)}
    return UnitData(**of_valve, **of_jack, OIL=stiffness)


def condition(
    faults: Faults, effects: Effects, filter_time: float, oil_temperature: float
) -> Condition:
    """Take the numbers of faults and effects."""
    errors = {f"E_{item.name}": getattr(effects.data, item.name) for item in fields(effects.data)}
    of_effects = {
        name: getattr(effects, name)
        for name in Condition._fields
        if hasattr(effects, name) and name != "oil_temperature"
    }
    return Condition(
        Kintas=faults.Kintas,
        FSS=faults.FSS,
        FDJ=faults.FDJ,
        oil_temperature=oil_temperature,
        filter_time=filter_time,
        **of_effects,
        **errors,
    )


def scaled(d: UnitData, c: Condition) -> Coefficients:
    """Scale a unit's data by its condition (PHY-13 to 39), without strangers.

    Plain arithmetic, which may be compiled too. The first-stage pressure gain does not follow the
    supply (PHY-20). The ends of the friction scales (FSS1, FDJ1) have no tolerance.
    """
    thickness = relative_viscosity(c.oil_temperature)
    flow_gain = d.GQF * (1.0 - CLOGGING * c.Kintas)
    spool_new = d.FSS0 * (1.0 + c.E_FSS0)
    spool_friction = spool_new + c.FSS * (d.FSS1 - spool_new)
    jack_new = d.FDJ0 * (1.0 + c.E_FDJ0)
    jack_friction = jack_new + c.FDJ * (d.FDJ1 - jack_new)
    drop = c.supply_pressure - c.return_pressure
    gain = d.GP * (1.0 + c.E_GP)
    return Coefficients(
        GM=d.GM * (1.0 + c.E_GM) * (1.0 + c.gain_change),
        JF=d.JF,
        CF=d.CF,
        KSF=d.KSF * (1.0 + c.E_KSF),
        KF=d.KF * (1.0 + c.E_KF),
        XFM=d.XFM,
        FORCE=d.AS * d.GPF,
        DAMPING=d.AS**2 * d.GPF / flow_gain + d.CS * (1.0 + c.E_CS) * thickness,
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
    )


def coefficients(
    actuator: Actuator,
    faults: Faults,
    effects: Effects,
    *,
    filter_time: float = 0.0,
    oil_temperature: float | None = None,
) -> Coefficients:
    """Scale the actuator's data by faults (PHY-13 to 15) and effects (PHY-16 to 39).

    `oil_temperature` (degC) stands for that of the effects.
    """
    degc = effects.oil_temperature if oil_temperature is None else oil_temperature
    strange = effects.strangers
    made = scaled(unit_data(actuator), condition(faults, effects, filter_time, degc))
    return made._replace(
        LAND=strange.land_asymmetry,
        NULL=strange.land_shift,
        WAY=strange.friction_asymmetry,
        SLEEVE=strange.spool_friction_slope / actuator.servovalve.XSM,
    )


def relative_viscosity(temperature: float) -> float:
    """Kinematic viscosity at `temperature` (degC) over the one at 40 degC.

    Walther's law (ASTM D341), lg lg(ν + 0.7) = a - b·lg T, through the two known viscosities.
    """
    slope = (W1 - W0) / (X1 - X0)
    at = 10.0 ** (10.0 ** (W0 + slope * (math.log10(temperature + KELVIN) - X0)))
    reference = 10.0 ** (10.0 ** (W0 + slope * (math.log10(REFERENCE_DEGC + KELVIN) - X0)))
    return float((at - WALTHER_SHIFT) / (reference - WALTHER_SHIFT))


def _walther(viscosity: float) -> float:
    return math.log10(math.log10(viscosity + WALTHER_SHIFT))


W0, W1 = (_walther(viscosity) for _, viscosity in KNOWN_VISCOSITIES)
X0, X1 = (math.log10(degc + KELVIN) for degc, _ in KNOWN_VISCOSITIES)
