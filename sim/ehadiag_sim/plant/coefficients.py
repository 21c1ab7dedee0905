"""Coefficients of the plant's kernel, from actuator data, faults and effects."""

from __future__ import annotations

import math
from typing import NamedTuple

from ehadiag.core.actuator import Actuator
from ehadiag_sim.plant.conditions import Effects, Faults

__all__ = ["Coefficients", "coefficients", "relative_viscosity"]

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


def coefficients(
    actuator: Actuator,
    faults: Faults,
    effects: Effects,
    *,
    filter_time: float = 0.0,
    oil_temperature: float | None = None,
) -> Coefficients:
    """Scale the actuator's data by faults (PHY-13 to 15) and effects (PHY-16 to 39).

    The first-stage pressure gain does not follow the supply (PHY-20). The ends of
    the friction scales (FSS1, FDJ1) have no tolerance. `oil_temperature` (degC) stands for that of
    the effects.
    """
    valve, jack, stage = actuator.servovalve, actuator.jack, actuator.second_stage
    data, strange = effects.data, effects.strangers
    degc = effects.oil_temperature if oil_temperature is None else oil_temperature
    thickness = relative_viscosity(degc)
    flow_gain = valve.GQF * (1.0 - CLOGGING * faults.Kintas)
    spool_new = valve.FSS0 * (1.0 + data.FSS0)
    spool_friction = spool_new + faults.FSS * (valve.FSS1 - spool_new)
    jack_new = jack.FDJ0 * (1.0 + data.FDJ0)
    jack_friction = jack_new + faults.FDJ * (jack.FDJ1 - jack_new)
    drop = effects.supply_pressure - effects.return_pressure
    gain = valve.GP * (1.0 + data.GP)
    return Coefficients(
        GM=valve.GM * (1.0 + data.GM) * (1.0 + effects.gain_change),
        JF=valve.JF,
        CF=valve.CF,
        KSF=valve.KSF * (1.0 + data.KSF),
        KF=valve.KF * (1.0 + data.KF),
        XFM=valve.XFM,
        FORCE=valve.AS * valve.GPF,
        DAMPING=valve.AS**2 * valve.GPF / flow_gain + valve.CS * (1.0 + data.CS) * thickness,
        MS=valve.MS,
        XSM=valve.XSM,
        FSS=spool_friction,
        FDS=0.5 * spool_friction,
        PSR=drop,
        GP=gain,
        GQ=valve.GQ * (1.0 + data.GQ),
        CLK=valve.CLK / thickness,
        AJ=jack.AJ,
        MJ=jack.MJ * (1.0 + data.MJ),
        CJ=jack.CJ * (1.0 + data.CJ) * thickness,
        XJM=jack.XJM,
        FSJ=2.0 * jack_friction,
        FDJ=jack_friction,
        FR=jack.FR + effects.load,
        KA=effects.load_spring,
        BACKLASH=effects.backlash,
        VSS=effects.spool_stribeck,
        VSJ=effects.jack_stribeck,
        OIL=2.0 * stage.beta / stage.volume if stage.kind == "orifice" else 0.0,
        U=2.0 * drop / gain,
        TAU=filter_time,
        LAND=strange.land_asymmetry,
        NULL=strange.land_shift,
        WAY=strange.friction_asymmetry,
        SLEEVE=strange.spool_friction_slope / valve.XSM,
    )


def relative_viscosity(temperature: float) -> float:
    """Kinematic viscosity at `temperature` (degC) over the one at 40 degC.

    Walther's law (ASTM D341), lg lg(ν + 0.7) = a - b·lg T, through the two known viscosities.
    """
    (t0, nu0), (t1, nu1) = KNOWN_VISCOSITIES
    w0, w1 = _walther(nu0), _walther(nu1)
    x0, x1 = math.log10(t0 + KELVIN), math.log10(t1 + KELVIN)
    slope = (w1 - w0) / (x1 - x0)

    def viscosity(degc: float) -> float:
        lglg = w0 + slope * (math.log10(degc + KELVIN) - x0)
        return float(10.0 ** (10.0**lglg) - WALTHER_SHIFT)

    return viscosity(temperature) / viscosity(REFERENCE_DEGC)


def _walther(viscosity: float) -> float:
    return math.log10(math.log10(viscosity + WALTHER_SHIFT))
