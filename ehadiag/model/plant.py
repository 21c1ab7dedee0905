"""Physical constants of an actuator: what every kernel of the monitoring model is given.

A candidate of the identification is one `PlantConstants`: severities and nuisance parameters have
been turned into physical constants before (`ehadiag.model.parameters`), so no kernel knows what a
fault is.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.rows import unpacker
from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Environment

__all__ = [
    "FIELDS",
    "REFERENCE_TEMPERATURE",
    "PlantConstants",
    "Value",
    "plant_constants",
    "plant_of",
    "plant_row",
    "relative_viscosity",
]

Value = Any
"""A number, or an array with one of each candidate, shape (n,)."""
REFERENCE_TEMPERATURE = 40.0
"""degC at which an actuator's viscous coefficients are given (PHY-19)."""
WALTHER_POINTS = ((40.0, 14.5), (100.0, 3.5))
"""MIL-PRF-83282: temperature (degC), kinematic viscosity (mm²/s) (PHY-19)."""


class PlantConstants(NamedTuple):
    """Physical constants at the oil and supply of the day; SI units.

    Symbols are those of the specification (docs/reference/physics.md). `FSS` and `FDJ` are the
    frictions of the unit as it is, `FSS1` and `FDJ1` those at the limit of damage, which only the
    scales of severity use.
    """

    IM: Value
    """Rated current, A."""
    IB: Value
    """Null bias of the torque motor, A."""
    HYS: Value
    """Hysteresis of the torque motor: width of the loop over rated current."""
    NPL: Value
    """Number of plays whose mean the hysteresis is."""
    SKW: Value
    """How much less a wide play counts in that mean: by exp(-SKW (i + 1/2) / NPL), i = 0, 1 …"""
    TQ2: Value
    """Even part of the torque's curve: at rated current the torque is GM IM (1 + TQ2 + TQ3)."""
    TQ3: Value
    """Odd part of it, by the square of the current."""
    LAG: Value
    """Time constant of the current's driver and the coil, s."""
    GM: Value
    """Torque-motor gain, N m/A."""
    JF: Value
    """Flapper inertia, N m/(m/s²)."""
    CF: Value
    """Flapper damping, N m/(m/s)."""
    KF: Value
    """Net flapper stiffness, N m/m."""
    KSF: Value
    """Feedback-wire stiffness, N m/m."""
    XFM: Value
    """Flapper stop, m."""
    GQF: Value
    """First-stage flow gain, m²/s."""
    GPF: Value
    """First-stage pressure gain, Pa/m."""
    AS: Value
    """Spool end area, m²."""
    MS: Value
    """Spool mass, kg."""
    CS: Value
    """Spool viscous coefficient, N s/m."""
    XSM: Value
    """Spool stop, m."""
    BKL: Value
    """Half-width of the backlash between spool and feedback spring, m."""
    FSS: Value
    """Static dry friction of the spool, N."""
    FSS1: Value
    """Static dry friction of the spool at the limit of damage, N."""
    VSS: Value
    """Stribeck velocity of the spool's friction, m/s; 0: moving, it is the dynamic one."""
    PSR: Value
    """Supply minus return pressure, Pa."""
    GP: Value
    """Pressure gain, Pa/m."""
    GQ: Value
    """Flow gain, m²/s."""
    XLD: Value
    """Spool position at which the metering lands are closed, m."""
    LD2: Value
    """Opening of the lands to the plus side over the mean of both, less 1."""
    LD3: Value
    """Odd part of their opening: at the spool's stop it is 1 + LD3 of the travel."""
    LAP: Value
    """Travel about the middle that the lands' overlap takes, m; below 0: an underlap."""
    CLK: Value
    """Leakage, m³/(s Pa)."""
    OIL: Value
    """Rise of the differential pressure by a flow into the chambers, 2 β / V, Pa/m³; 0: of a linear
    second stage, whose oil does not yield."""
    AJ: Value
    """Active area of the jack, m²."""
    MJ: Value
    """Equivalent mass of jack and surface, kg."""
    CJ: Value
    """Viscous coefficient of the jack, N s/m."""
    XJM: Value
    """Jack stop, m."""
    FDJ: Value
    """Dynamic dry friction of the jack, N."""
    FDJ1: Value
    """Dynamic dry friction of the jack at the limit of damage, N."""
    VSJ: Value
    """Stribeck velocity of the jack's friction, m/s; 0: moving, it is the dynamic one."""
    WAY: Value
    """Friction of a jack that moves out over the mean of both ways, less 1."""
    FR: Value
    """External load, N."""
    KA: Value
    """Load spring that draws the jack to its middle, N/m."""
    OXS: Value
    """Constant error of the spool's sensor, m."""
    OPD: Value
    """Constant error of the sensor of differential pressure, Pa."""
    OXJ: Value
    """Constant error of the jack's sensor, m."""
    GXS: Value
    """Relative error of the gain of the spool's sensor."""
    BX2: Value
    """Even part of the curve of the spool's sensor: at its stop the spool reads 1 + BX2 + BX3."""
    BX3: Value
    """Odd part of it, by the square of the position."""
    GPD: Value
    """The same of the sensor of differential pressure."""
    BP2: Value
    """Even part of that sensor's curve: at the supply pressure it reads 1 + BP2 + BP3."""
    BP3: Value
    """Odd part of it, by the square of the pressure."""
    GXJ: Value
    """The same of the jack's sensor."""
    TAU: Value
    """Time constant of the analogue filter before the converters of spool and pressure, s."""
    DLY: Value
    """Time before the end of the tick at which the channels are sampled, s."""


FIELDS = len(PlantConstants._fields)
"""Numbers of a candidate as kernels are given it, a row of an array."""

plant_of = unpacker(PlantConstants)
"""Compiled: the constants that a row of `FIELDS` numbers holds."""


def plant_row(constants: PlantConstants) -> NDArray[np.float64]:
    """One candidate as a row that kernels take, shape (FIELDS,)."""
    return np.array(constants, dtype=np.float64)


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
    """Constants of the unit as new, at the oil temperature and supply that the bus reports.

    Without an environment, or for a quantity it does not state, the actuator's own data hold:
    40 degC and its `PSR`. Viscous coefficients scale with the relative viscosity, the leakage with
    its inverse (PHY-19).
    """
    valve, stage, jack = actuator.servovalve, actuator.second_stage, actuator.jack
    viscosity, supply = 1.0, valve.PSR
    if environment is not None:
        if environment.oil_temperature is not None:
            viscosity = relative_viscosity(environment.oil_temperature)
        if environment.supply_pressure is not None and environment.return_pressure is not None:
            supply = environment.supply_pressure - environment.return_pressure
    return PlantConstants(
        IM=actuator.controller.IM,
        IB=0.0,
        HYS=0.0,
        NPL=1.0,
        SKW=0.0,
        TQ2=0.0,
        TQ3=0.0,
        LAG=0.0,
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
        BKL=0.0,
        FSS=valve.FSS0,
        FSS1=valve.FSS1,
        VSS=0.0,
        PSR=supply,
        GP=valve.GP,
        GQ=valve.GQ,
        XLD=0.0,
        LD2=0.0,
        LD3=0.0,
        LAP=0.0,
        CLK=valve.CLK / viscosity,
        OIL=2.0 * stage.beta / stage.volume if stage.kind == "orifice" else 0.0,
        AJ=jack.AJ,
        MJ=jack.MJ,
        CJ=jack.CJ * viscosity,
        XJM=jack.XJM,
        FDJ=jack.FDJ0,
        FDJ1=jack.FDJ1,
        VSJ=0.0,
        WAY=0.0,
        FR=jack.FR,
        KA=0.0,
        OXS=0.0,
        OPD=0.0,
        OXJ=0.0,
        GXS=0.0,
        BX2=0.0,
        BX3=0.0,
        GPD=0.0,
        BP2=0.0,
        BP3=0.0,
        GXJ=0.0,
        TAU=0.0,
        DLY=0.0,
    )
