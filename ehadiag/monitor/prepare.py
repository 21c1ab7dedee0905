"""Laws and tables of a monitor from the unit's constants and severities: kernels of its start."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.compile.rows import packer, unpacker
from ehadiag.model.control import ControlLaw
from ehadiag.model.laws import DriveLaw, JackLaw, SpoolLaw, drive_law, jack_law, spool_law
from ehadiag.model.plant import FIELDS, PlantConstants, plant_of
from ehadiag.model.scalar.transition import FINEST, SCRATCH, fill_tables
from ehadiag.model.sensors import SensorLaw, sensor_law
from ehadiag.model.severity import clogged, worn
from ehadiag.monitor.layout import (
    CONTROL_LAW,
    DECAY,
    DRIVE_LAW,
    JACK_LAW,
    LOOSE,
    NODES,
    NUMBER,
    RING,
    SENSOR_LAW,
    SETTINGS,
    SIZE,
    SLIDE,
    SPOOL_LAW,
    STATE,
    TABLES,
    Followed,
    Moving,
    Settings,
    keep_followed,
    keep_moving,
    spool_law_of,
)

__all__ = ["PLAN_CONTROL", "PLAN_SETTINGS", "PLAN_SIZE", "UNIT_SIZE", "Unit", "prepare", "rest"]

PLAN_CONTROL: Final = FIELDS
"""A plan is a row of `PlantConstants`, a `ControlLaw` and `Settings`: what the unit's data fix."""
PLAN_SETTINGS: Final = PLAN_CONTROL + len(ControlLaw._fields)
PLAN_SIZE: Final = PLAN_SETTINGS + len(Settings._fields)


class Unit(NamedTuple):
    """What a monitor is told of its unit when it is started, all numbers.

    Attributes
    ----------
    Kintas : float
        Severity of the filter's clogging, 0 … 1.
    FSS : float
        Severity of the spool's friction, 0 … 1.
    FDJ : float
        Severity of the jack's friction, 0 … 1.
    spool_offset : float
        Constant error of the spool's sensor, m.
    pressure_offset : float
        Constant error of the sensor of differential pressure, Pa.
    viscosity : float
        Of the oil, over that for which the plan's constants hold; > 0.
    supply : float
        Supply minus return pressure, Pa; > 0.
    closed : float
        Not 0: commands are positions, m; 0: currents, A.
    """

    Kintas: float
    FSS: float
    FDJ: float
    spool_offset: float
    pressure_offset: float
    viscosity: float
    supply: float
    closed: float


UNIT_SIZE: Final = len(Unit._fields)
_unit_of = unpacker(Unit)
_plan_control_of = unpacker(ControlLaw, PLAN_CONTROL)
_plan_settings_of = unpacker(Settings, PLAN_SETTINGS)
_keep_drive_law, _keep_spool_law = packer(DriveLaw, DRIVE_LAW), packer(SpoolLaw, SPOOL_LAW)
_keep_jack_law, _keep_sensor_law = packer(JackLaw, JACK_LAW), packer(SensorLaw, SENSOR_LAW)
_keep_control_law, _keep_settings = packer(ControlLaw, CONTROL_LAW), packer(Settings, SETTINGS)
GQF, FSS, FSS1, FDJ, FDJ1, OXS, OPD, CS, CJ, CLK, PSR = (
    PlantConstants._fields.index(name)
    for name in ("GQF", "FSS", "FSS1", "FDJ", "FDJ1", "OXS", "OPD", "CS", "CJ", "CLK", "PSR")
)
CLOSED = SETTINGS + Settings._fields.index("closed")
_clogged, _worn = inlined_exact(clogged), inlined_exact(worn)


@inlined_exact
def _within(severity: float) -> bool:
    return 0.0 <= severity <= 1.0


@inlined_exact
def _sound(u: Unit) -> bool:
    """Whether a monitor can be started so; a NaN is not sound."""
    return (
        _within(u.Kintas)
        and _within(u.FSS)
        and _within(u.FDJ)
        and math.isfinite(u.spool_offset)
        and math.isfinite(u.pressure_offset)
        and 0.0 < u.viscosity < math.inf
        and 0.0 < u.supply < math.inf
        and math.isfinite(u.closed)
    )


@inlined_exact
def _make_constants(row: NDArray[np.float64], u: Unit) -> None:
    """Make a row of constants those of the unit with its faults, sensors' errors and oil."""
    row[GQF] = _clogged(row[GQF], u.Kintas)
    row[FSS] = _worn(row[FSS], row[FSS1], u.FSS)
    row[FDJ] = _worn(row[FDJ], row[FDJ1], u.FDJ)
    row[OXS], row[OPD] = u.spool_offset, u.pressure_offset
    row[CS] *= u.viscosity
    row[CJ] *= u.viscosity
    row[CLK] /= u.viscosity
    row[PSR] = u.supply


@brief_kernel
def prepare(address: int, plan_address: int, unit_address: int) -> int:
    """Write laws, settings and tables of a monitor, and begin with the spool in the middle.

    Parameters
    ----------
    address : int
        Of the SIZE numbers of `ehadiag.monitor.layout`.
    plan_address : int
        Of the PLAN_SIZE numbers of a plan.
    unit_address : int
        Of the numbers of a `Unit`.

    Returns
    -------
    int
        0; 1: a number of the unit is out of its range, and nothing was written.
    """
    p, plan = array_at(address, (SIZE,)), array_at(plan_address, (PLAN_SIZE,))
    unit = _unit_of(array_at(unit_address, (UNIT_SIZE,)))
    if not _sound(unit):
        return 1
    # Until the first tick there is room where its path will be.
    row = array_at(address + NUMBER * NODES, (FIELDS,))
    for i in range(FIELDS):
        row[i] = plan[i]
    _make_constants(row, unit)
    constants, control = plant_of(row), _plan_control_of(plan)
    law = spool_law(constants)
    _keep_drive_law(p, drive_law(constants, control.tick))
    _keep_spool_law(p, law)
    _keep_jack_law(p, jack_law(constants))
    _keep_sensor_law(p, sensor_law(constants))
    _keep_control_law(p, control)
    _keep_settings(p, _plan_settings_of(plan))
    p[CLOSED] = 1.0 if unit.closed != 0.0 else 0.0
    fill_tables(
        constants,
        law,
        control.tick,
        array_at(address + NUMBER * (NODES + FIELDS), (SCRATCH, 4, 4)),
        array_at(address + NUMBER * SLIDE, (FINEST + 1, 4, 4)),
        array_at(address + NUMBER * LOOSE, (FINEST + 1, 4, 4)),
        array_at(address + NUMBER * RING, (FINEST + 1, 2, 2)),
        array_at(address + NUMBER * DECAY, (FINEST + 1,)),
    )
    _rest(p, 0.0)
    return 0


@brief_kernel
def rest(address: int, spool: float) -> int:
    """Begin anew, from rest with the spool there (m), as a stored test begins.

    Parameters
    ----------
    address : int
        Of a monitor that was prepared.
    spool : float
        m; beyond its stroke it is on its stop.

    Returns
    -------
    int
        0.
    """
    _rest(array_at(address, (SIZE,)), spool)
    return 0


@inlined_exact
def _rest(p: NDArray[np.float64], spool: float) -> None:
    for i in range(STATE, TABLES):
        p[i] = 0.0
    law = spool_law_of(p)
    xs = min(max(spool, -law.stroke), law.stroke)
    xf = min(max(-law.ratio * xs, -law.breakaway), law.breakaway)
    keep_moving(p, Moving(xf, 0.0, xs, 0.0, xs, 0.0, 0.0, 0.0, xs, xs))
    keep_followed(p, Followed(math.nan, 0.0, 0.0, 0.0))
