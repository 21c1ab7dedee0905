"""Coefficients of the plant's kernel, from actuator data, faults and effects."""

from __future__ import annotations

import math
from typing import NamedTuple

from ehadiag.core.actuator import Actuator
from ehadiag_sim.plant.conditions import Effects, Faults

__all__ = ["Coefficients", "coefficients", "relative_viscosity"]

CLOGGING = 0.8
"""Share of the first-stage flow gain that is lost at the limit of damage (model.md section 3)."""

KELVIN = 273.15
REFERENCE_DEGC = 40.0
KNOWN_VISCOSITIES = ((40.0, 14.5), (100.0, 3.5))
"""degC and mm²/s of MIL-PRF-83282 (model.md section 4)."""
WALTHER_SHIFT = 0.7


class Coefficients(NamedTuple):
    """Symbols of model.md, SI units, with faults and effects already in them."""

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
    HYSTERESIS: float
    """Half-width of the torque-motor play, A."""
    BACKLASH: float
    """Half-width of the play between spool and feedback ball, m."""


def coefficients(actuator: Actuator, faults: Faults, effects: Effects) -> Coefficients:
    """Scale the actuator's data by faults (model.md section 3) and effects (section 4).

    The first-stage pressure gain does not follow the supply: model.md names PSR only.
    """
    valve, jack = actuator.servovalve, actuator.jack
    thickness = relative_viscosity(effects.oil_temperature)
    flow_gain = valve.GQF * (1.0 - CLOGGING * faults.Kintas)
    spool_friction = valve.FSS0 + faults.FSS * (valve.FSS1 - valve.FSS0)
    jack_friction = jack.FDJ0 + faults.FDJ * (jack.FDJ1 - jack.FDJ0)
    return Coefficients(
        GM=valve.GM * (1.0 + effects.gain_change),
        JF=valve.JF,
        CF=valve.CF,
        KSF=valve.KSF,
        KF=valve.KF,
        XFM=valve.XFM,
        FORCE=valve.AS * valve.GPF,
        DAMPING=valve.AS**2 * valve.GPF / flow_gain + valve.CS * thickness,
        MS=valve.MS,
        XSM=valve.XSM,
        FSS=spool_friction,
        FDS=0.5 * spool_friction,
        PSR=effects.supply_pressure - effects.return_pressure,
        GP=valve.GP,
        GQ=valve.GQ,
        CLK=valve.CLK / thickness,
        AJ=jack.AJ,
        MJ=jack.MJ,
        CJ=jack.CJ * thickness,
        XJM=jack.XJM,
        FSJ=2.0 * jack_friction,
        FDJ=jack_friction,
        FR=jack.FR,
        HYSTERESIS=0.5 * effects.hysteresis * actuator.controller.IM,
        BACKLASH=effects.backlash,
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
