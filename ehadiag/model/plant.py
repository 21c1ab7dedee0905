"""Constants of the monitoring model: actuator data at the oil and supply of the day."""

from __future__ import annotations

import math
from typing import NamedTuple

from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Environment

__all__ = ["REFERENCE_TEMPERATURE", "PlantConstants", "plant_constants", "relative_viscosity"]

REFERENCE_TEMPERATURE = 40.0
"""degC at which an actuator's viscous coefficients are given (model.md section 2)."""

WALTHER_POINTS = ((40.0, 14.5), (100.0, 3.5))
"""MIL-PRF-83282: temperature (degC), kinematic viscosity (mm²/s) (model.md section 4)."""


class PlantConstants(NamedTuple):
    """What the kernels need besides the fault constants; SI units, symbols of model.md."""

    GM: float
    JF: float
    CF: float
    KF: float
    KSF: float
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


def relative_viscosity(temperature: float) -> float:
    """Kinematic viscosity at `temperature` (degC) over that at 40 degC, default oil.

    Walther's law, ASTM D341: lg lg(ν + 0.7) = A − B lg T, through two points.
    """
    (t1, v1), (t2, v2) = WALTHER_POINTS
    x1, x2 = math.log10(t1 + 273.15), math.log10(t2 + 273.15)
    y1, y2 = math.log10(math.log10(v1 + 0.7)), math.log10(math.log10(v2 + 0.7))
    slope = (y1 - y2) / (x2 - x1)
    y = y1 - slope * (math.log10(temperature + 273.15) - x1)
    return float((10.0 ** (10.0**y) - 0.7) / v1)


def plant_constants(actuator: Actuator, environment: Environment | None = None) -> PlantConstants:
    """Constants at the oil temperature and supply that the bus reports.

    Without an environment, or for a quantity it does not state, the actuator's own data hold:
    40 degC and its `PSR`. Viscous coefficients scale with the relative viscosity, the leakage with
    its inverse (model.md section 4).
    """
    valve, jack = actuator.servovalve, actuator.jack
    viscosity, supply = 1.0, valve.PSR
    if environment is not None:
        if environment.oil_temperature is not None:
            viscosity = relative_viscosity(environment.oil_temperature)
        if environment.supply_pressure is not None and environment.return_pressure is not None:
            supply = environment.supply_pressure - environment.return_pressure
    return PlantConstants(
        GM=valve.GM,
        JF=valve.JF,
        CF=valve.CF,
        KF=valve.KF,
        KSF=valve.KSF,
        XFM=valve.XFM,
        GQF=valve.GQF,
        GPF=valve.GPF,
        AS=valve.AS,
        MS=valve.MS,
        CS=valve.CS * viscosity,
        XSM=valve.XSM,
        FSS0=valve.FSS0,
        FSS1=valve.FSS1,
        PSR=supply,
        GP=valve.GP,
        GQ=valve.GQ,
        CLK=valve.CLK / viscosity,
        AJ=jack.AJ,
        MJ=jack.MJ,
        CJ=jack.CJ * viscosity,
        XJM=jack.XJM,
        FDJ0=jack.FDJ0,
        FDJ1=jack.FDJ1,
        FR=jack.FR,
    )
