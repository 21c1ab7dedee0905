"""Physical constants of an actuator, an input of every kernel, and how severities change them.

A candidate of the identification is one `PlantConstants`: severities and nuisance parameters have
been turned into physical constants before, so kernels are independent of faults.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ehadiag.compile.jit import Array

if TYPE_CHECKING:  # what a kernel imports is part of its cache key
    from ehadiag.core.actuator import Actuator, Servovalve
    from firmware_iface.recording import Environment

ConstantValue = Any
"""A number, or an array with one of each candidate, shape (n,)."""
WALTHER_POINTS = ((40.0, 14.5), (100.0, 3.5))
"""MIL-PRF-83282: temperature (degC), kinematic viscosity (mm²/s) (PHY-19)."""
(REFERENCE_TEMPERATURE, _), (_, _) = WALTHER_POINTS
"""degC at which an actuator's viscous coefficients are given (PHY-19)."""


class PlantConstants(NamedTuple):
    """Physical constants at the oil and supply of the day; SI units.

    Symbols are those of the specification (docs/reference/physics.md). `FSS` and `FDJ` are the
    frictions of the unit as it is, `FSS1` and `FDJ1` those at the limit of damage, which only the
    scales of severity use.
    """

    IM: ConstantValue
    """Rated current, A."""
    IB: ConstantValue
    """Null bias of the torque motor, A."""
    HYS: ConstantValue
    """Hysteresis of the torque motor: width of the loop over rated current."""
    NPL: ConstantValue
    """Number of plays whose mean the hysteresis is."""
    SKW: ConstantValue
    """How much less a wide play counts in that mean: by exp(-SKW (i + 1/2) / NPL), i = 0, 1 …"""
    TQ2: ConstantValue
    """Even part of the torque's curve: at rated current the torque is GM IM (1 + TQ2 + TQ3)."""
    TQ3: ConstantValue
    """Odd part of it, by the square of the current."""
    LAG: ConstantValue
    """Time constant of the current's driver and the coil, s."""
    GM: ConstantValue
    """Torque-motor gain, N m/A."""
    JF: ConstantValue
    """Flapper inertia, N m/(m/s²)."""
    CF: ConstantValue
    """Flapper damping, N m/(m/s)."""
    KF: ConstantValue
    """Net flapper stiffness, N m/m."""
    KSF: ConstantValue
    """Feedback-wire stiffness, N m/m."""
    XFM: ConstantValue
    """Flapper stop, m."""
    XFN: ConstantValue
    """First stage's null from the middle between the flapper's stops, m."""
    GQF: ConstantValue
    """First-stage flow gain, m²/s."""
    GPF: ConstantValue
    """First-stage pressure gain, Pa/m."""
    CLE: ConstantValue
    """Exponent of the first stage's pressure gain behind a clogged filter, 1."""
    BRG: ConstantValue
    """Flapper's stop over the gap of a nozzle, of a bridge of turbulent orifices behind the filter,
    1 (PHY-43); 0: a linear first stage."""
    AS: ConstantValue
    """Spool end area, m²."""
    MS: ConstantValue
    """Spool mass, kg."""
    CS: ConstantValue
    """Spool viscous coefficient, N s/m."""
    XSM: ConstantValue
    """Spool stop, m."""
    BKL: ConstantValue
    """Half-width of the backlash between spool and feedback spring, m."""
    FSS: ConstantValue
    """Static dry friction of the spool, N."""
    FSS1: ConstantValue
    """Static dry friction of the spool at the limit of damage, N."""
    VSS: ConstantValue
    """Stribeck velocity of the spool's friction, m/s; 0: moving, it is the dynamic one."""
    PSR: ConstantValue
    """Supply minus return pressure, Pa."""
    GP: ConstantValue
    """Pressure gain, Pa/m."""
    GQ: ConstantValue
    """Flow gain, m²/s."""
    XLD: ConstantValue
    """Spool position at which the metering lands are closed, m."""
    LD2: ConstantValue
    """Opening of the lands to the plus side over the mean of both, less 1."""
    LD3: ConstantValue
    """Odd part of their opening: at the spool's stop it is 1 + LD3 of the travel."""
    LAP: ConstantValue
    """Travel about the middle that the lands' overlap takes, m; below 0: an underlap."""
    CLK: ConstantValue
    """Leakage, m³/(s Pa)."""
    OIL: ConstantValue
    """Rise of the differential pressure by a flow into the chambers, 2 β / V, Pa/m³; 0: of a linear
    second stage, whose oil does not yield."""
    CHB: ConstantValue
    """Share of a chamber's volume that the jack displaces by its travel, AJ / V, 1/m; 0: chambers
    of the same volume everywhere."""
    AJ: ConstantValue
    """Active area of the jack, m²."""
    MJ: ConstantValue
    """Equivalent mass of jack and surface, kg."""
    CJ: ConstantValue
    """Viscous coefficient of the jack, N s/m."""
    XJM: ConstantValue
    """Jack stop, m."""
    FDJ: ConstantValue
    """Dynamic dry friction of the jack, N."""
    FDJ1: ConstantValue
    """Dynamic dry friction of the jack at the limit of damage, N."""
    VSJ: ConstantValue
    """Stribeck velocity of the jack's friction, m/s; 0: moving, it is the dynamic one."""
    WAY: ConstantValue
    """Friction of a jack that moves out over the mean of both ways, less 1."""
    FR: ConstantValue
    """External load, N."""
    KA: ConstantValue
    """Load spring that draws the jack to its middle, N/m."""
    OXS: ConstantValue
    """Constant error of the spool's sensor, m."""
    OPD: ConstantValue
    """Constant error of the sensor of differential pressure, Pa."""
    OXJ: ConstantValue
    """Constant error of the jack's sensor, m."""
    GXS: ConstantValue
    """Relative error of the gain of the spool's sensor."""
    BX2: ConstantValue
    """Even part of the curve of the spool's sensor: at its stop the spool reads 1 + BX2 + BX3."""
    BX3: ConstantValue
    """Odd part of it, by the square of the position."""
    GPD: ConstantValue
    """The same of the sensor of differential pressure."""
    BP2: ConstantValue
    """Even part of that sensor's curve: at the supply pressure it reads 1 + BP2 + BP3."""
    BP3: ConstantValue
    """Odd part of it, by the square of the pressure."""
    GXJ: ConstantValue
    """The same of the jack's sensor."""
    TAU: ConstantValue
    """Time constant of the analogue filter before the converters of spool and pressure, s."""
    DLY: ConstantValue
    """Time before the end of the tick at which the channels are sampled, s."""


PLANT_FIELDS = len(PlantConstants._fields)
"""Numbers of a candidate as kernels are given it, a row of an array."""


def plant_row(constants: PlantConstants) -> Array:
    """One candidate as a row that kernels take, shape (PLANT_FIELDS,)."""
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


def bridge_stop(valve: Servovalve) -> float:
    """Flapper's stop over the gap of a nozzle of a bridge (`BRG`), at the rated supply."""
    return valve.GPF * valve.XFM / valve.PSR


SLIP_SPEED_RATIO = 1.5
"""Speed below which a jack slips in steps, over friction / (mass, ring), 1: of four units of other
components three rang on at 1.1, 0.9 and 0.6 of it, one did not at 2."""
SLIP_TICKS = 25
"""Ticks, 1, over which the jack's travel shows whether it slides: two periods of a ring at 80
Hz."""


def slip_speed(c: PlantConstants, severity: float = 0.0) -> float:
    """Speed, m/s, below which a jack of a severity of `FDJ` slips in steps and rings on.

    Friction holds any pressure of its band on a standing jack: which one is decided by 0.1 µm of
    the spool. A slow one slips in steps, and rings on: the phase is decided by as little. Without
    oil in the second stage nothing rings: 0.
    """
    if c.OIL == 0.0:
        return 0.0
    friction = c.FDJ + severity * (c.FDJ1 - c.FDJ)
    return float(SLIP_SPEED_RATIO * friction / (c.AJ * math.sqrt(c.OIL * c.MJ)))


def ring_out_time(c: PlantConstants, severity: float, noise: float) -> float:
    """Time, s, in which a jack that slides forgets at what phase it slipped before.

    Steps leave it somewhere in the band of its friction. By then a ring of the whole band is less
    than the noise of the pressure, Pa: viscous friction damps it, and the lands, through which less
    flows against more pressure, at `slip_speed` at least. severity: of `FDJ`. Without oil in the
    second stage nothing rings: 0.
    """
    if c.OIL == 0.0:
        return 0.0
    friction = c.FDJ + severity * (c.FDJ1 - c.FDJ)
    lands = c.AJ * slip_speed(c, severity) / (2.0 * c.PSR)
    rate = 0.5 * (c.CJ / c.MJ + c.OIL * lands)
    return float(max(math.log(2.0 * friction / (c.AJ * noise)), 0.0) / rate)


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
    orifices = stage.kind == "orifice"
    none = PlantConstants(*(0.0 for _ in PlantConstants._fields))
    return none._replace(
        IM=actuator.controller.IM,
        NPL=1.0,
        GM=valve.GM,
        JF=valve.JF,
        CF=valve.CF,
        KF=valve.KF,
        KSF=valve.KSF,
        XFM=valve.XFM,
        GQF=valve.GQF,
        GPF=valve.GPF,
        CLE=sum(valve.clogging_range) / 2.0,
        BRG=bridge_stop(valve) if valve.clogging_range[1] > 0.0 else 0.0,
        AS=valve.AS,
        MS=valve.MS,
        CS=valve.CS * viscosity,
        XSM=valve.XSM,
        FSS=valve.FSS0,
        FSS1=valve.FSS1,
        PSR=supply,
        GP=valve.GP,
        GQ=valve.GQ,
        CLK=valve.CLK / viscosity,
        OIL=2.0 * stage.beta / stage.volume_of_one_chamber if orifices else 0.0,
        CHB=jack.AJ / stage.volume_of_one_chamber if orifices and stage.by_position else 0.0,
        AJ=jack.AJ,
        MJ=jack.MJ,
        CJ=jack.CJ * viscosity,
        XJM=jack.XJM,
        FDJ=jack.FDJ0,
        FDJ1=jack.FDJ1,
        FR=jack.FR,
    )
