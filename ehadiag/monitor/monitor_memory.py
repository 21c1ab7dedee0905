"""Memory of a monitor, one flat array: places of its numbers, and kernels that fill it."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from ehadiag.compile.elementary import exponential, logarithm
from ehadiag.compile.jit import Array, bare_kernel, brief_kernel, inlined_exact
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at, packer, places, unpacker
from ehadiag.model.laws import (
    ControlLaw,
    ControlState,
)
from ehadiag.model.plant import PLANT_FIELDS, PlantConstants
from ehadiag.model.severities import (
    EXPONENT_PLACES,
    FAULT_CHANGES,
    FAULT_LAWS,
    FAULT_PLACES,
    LIMIT_PLACES,
    PRESSURE_PLACES,
    damaged_constant,
)
from ehadiag.model.simd_layout import block_places, tabulate_coefficients
from ehadiag.model.simd_tick import rest_block


class MonitorSettings(NamedTuple):
    """Settings of a monitor, besides the laws."""

    plays: float
    """Number of plays of the hysteresis."""
    closed: float
    """Not 0: the command is a position."""
    invertible: float
    """Not 0: a lost position's code follows from the current."""
    linear: float
    """Below this current it does, A."""
    code_position: float
    """Converter step of the position, m."""
    anchor_gain: float
    """See `ehadiag.model.batch.Anchor`."""
    anchor_small: float
    anchor_large: float
    spool_weight: float
    """Reciprocal noise of both."""
    pressure_weight: float
    reference: float
    """Of the CUSUM: k, h, largest residual that counts."""
    threshold: float
    limit: float
    deviation: float
    """A lost command did not go on where the current is off by more, A."""
    halvings: float
    """Further halvings of the jack's ticks: 1 where severities are estimated."""


class CommandMemory(NamedTuple):
    """Command and position between two ticks."""

    seen: float
    """Measured position of the tick before, m; NaN if lost."""
    command: float
    """Of the tick before, known or not."""
    slope: float
    """Its rise over a tick."""
    lost: float
    """Ticks lost since one was known."""


class HealthMemory(NamedTuple):
    """What an exported monitor counts of its inputs, see `ehadiag.onboard.c_interface`."""

    spool: float
    """Ticks since the last sample of the spool, and of the pressure."""
    pressure: float
    command: float
    """Ticks since command or current was there."""
    beyond: float
    """Not 0: a number of the last tick was beyond what its unit allows."""


class LibraryIdentity(NamedTuple):
    """Of which library an object is; in its plan, and in what it has begun."""

    version: float
    """Of the package: major, minor and patch, three digits each."""
    plan: float
    """First 48 bits of the plan's digest."""
    serial: float
    """Serial number of the unit that the data are of; 0: of no certain one."""
    smallest: float
    """Root of what makes of a pressure a number that is lost where small ones are flushed to
    zero."""


class MonitorPlaces(NamedTuple):
    """Places of the parts of a monitor's memory."""

    control_law: int
    settings: int
    identity: int
    """`LibraryIdentity` of an exported monitor."""
    control: int
    """First of the state, which ends with that of the model: a restart sets all of it to 0."""
    command: int
    health: int
    """`HealthMemory` of an exported monitor."""
    predicted: int
    """Modelled spool, pressure and position."""
    residual: int
    """Residuals of spool and pressure, in deviations."""
    cusum: int
    """Upper and lower sum of the spool, then of the pressure."""
    model: int
    """Block of one lane, see `ehadiag.model.simd_layout`; its state comes first."""


MONITOR = MonitorPlaces(
    *places(ControlLaw, MonitorSettings, LibraryIdentity, ControlState, CommandMemory,
            HealthMemory, 3, 2, 4)
)  # fmt: skip
MODEL = block_places(1, MONITOR.model)
"""Places of the parts of a monitor's model in its memory."""
MONITOR_SIZE: Final = MODEL.end
"""Numbers of a monitor, 1."""
if MODEL.scratch - MODEL.pieces < PLANT_FIELDS:  # see `prepare_monitor_by`
    raise AssertionError("a unit's constants have no room where pieces of a path will be")

control_law_of = unpacker(ControlLaw, MONITOR.control_law)
settings_of = unpacker(MonitorSettings, MONITOR.settings)
control_of, keep_control = (
    unpacker(ControlState, MONITOR.control),
    packer(ControlState, MONITOR.control),
)
command_of, keep_command = (
    unpacker(CommandMemory, MONITOR.command),
    packer(CommandMemory, MONITOR.command),
)
health_of, keep_health = (
    unpacker(HealthMemory, MONITOR.health),
    packer(HealthMemory, MONITOR.health),
)


@inlined_exact
def model_at(address: int) -> int:
    """Address of a monitor's model."""
    return address + BYTES_PER_NUMBER * MONITOR.model


MONITOR_PLAN_CONTROL: Final = PLANT_FIELDS
"""A plan is a row of `PlantConstants`, a `ControlLaw` and `MonitorSettings`: what the unit's data
fix."""
MONITOR_PLAN_SETTINGS: Final = MONITOR_PLAN_CONTROL + len(ControlLaw._fields)
MONITOR_PLAN_SIZE: Final = MONITOR_PLAN_SETTINGS + len(MonitorSettings._fields)


class MonitorUnit(NamedTuple):
    """State of the unit when a monitor starts, behind its severities; all numbers."""

    spool_offset: float
    """Constant error of the spool's sensor, m."""
    pressure_offset: float
    """Constant error of the sensor of differential pressure, Pa."""
    viscosity: float
    """Of the oil, over that for which the plan's constants hold; > 0."""
    supply: float
    """Supply minus return pressure, Pa; > 0."""
    closed: float
    """Not 0: commands are positions, m; 0: currents, A."""


MONITOR_UNIT_FIELDS: Final = (*FAULT_LAWS, *MonitorUnit._fields)
"""What a monitor is started with: severities, each 0 … 1, then the rest of the unit's state."""
MONITOR_UNIT_SIZE: Final = len(MONITOR_UNIT_FIELDS)
SEVERITY_COUNT: Final = len(FAULT_LAWS)
_unit_of = unpacker(MonitorUnit, SEVERITY_COUNT)
_plan_control_of = unpacker(ControlLaw, MONITOR_PLAN_CONTROL)
_plan_settings_of = unpacker(MonitorSettings, MONITOR_PLAN_SETTINGS)
_keep_control_law, _keep_settings = (
    packer(ControlLaw, MONITOR.control_law),
    packer(MonitorSettings, MONITOR.settings),
)
OXS, OPD, CS, CJ, CLK, PSR = (
    PlantConstants._fields.index(name) for name in ("OXS", "OPD", "CS", "CJ", "CLK", "PSR")
)
MONITOR_CLOSED = MONITOR.settings + MonitorSettings._fields.index("closed")
"""Place of the kind of commands: not 0 in closed loop."""
_damaged = inlined_exact(damaged_constant)


@inlined_exact
def _is_valid(numbers: Array, u: MonitorUnit) -> bool:
    """Whether a monitor can be started so; a NaN is not sound."""
    for k in range(SEVERITY_COUNT):
        if not 0.0 <= numbers[k] <= 1.0:
            return False
    return (
        math.isfinite(u.spool_offset)
        and math.isfinite(u.pressure_offset)
        and 0.0 < u.viscosity < math.inf
        and 0.0 < u.supply < math.inf
        and math.isfinite(u.closed)
    )


@inlined_exact
def _make_constants(row: Array, severities: Array, u: MonitorUnit) -> None:
    """Make a row of constants those of the unit with its faults, sensors' errors and oil."""
    for k in range(SEVERITY_COUNT):
        place, change, severity = FAULT_PLACES[k], FAULT_CHANGES[k], severities[k]
        row[place] = _damaged(row[place], row[LIMIT_PLACES[k]], change, severity)
        if PRESSURE_PLACES[k] >= 0:
            share = logarithm(_damaged(1.0, 1.0, change, severity))
            row[PRESSURE_PLACES[k]] *= exponential(row[EXPONENT_PLACES[k]] * share)
    row[OXS], row[OPD] = u.spool_offset, u.pressure_offset
    row[CS] *= u.viscosity
    row[CJ] *= u.viscosity
    row[CLK] /= u.viscosity
    row[PSR] = u.supply


@brief_kernel
def prepare_monitor(address: int, plan_address: int, unit_address: int) -> int:
    """Write laws, settings and tables of a monitor, with the spool at rest in the middle.

    Addresses are those of the monitor's MONITOR_SIZE numbers, of a plan, and of a unit's
    MONITOR_UNIT_FIELDS.
    Returns 0, or 1 where a number of the unit is out of its range and nothing was written.
    """
    return int(prepare_monitor_by(address, plan_address, plan_address, unit_address))


@bare_kernel
def prepare_monitor_by(
    address: int, constants_address: int, plan_address: int, unit_address: int
) -> int:
    """Prepare a monitor as `prepare_monitor`, by other constants than the plan's."""
    p, plan = array_at(address, (MONITOR.model,)), array_at(plan_address, (MONITOR_PLAN_SIZE,))
    given = array_at(constants_address, (PLANT_FIELDS,))
    numbers = array_at(unit_address, (MONITOR_UNIT_SIZE,))
    unit = _unit_of(numbers)
    if not _is_valid(numbers, unit):
        return 1
    # Until the first tick there is room where pieces of the path will be.
    row = array_at(address + BYTES_PER_NUMBER * MODEL.pieces, (1, PLANT_FIELDS))
    for i in range(PLANT_FIELDS):
        row[0, i] = given[i]
    _make_constants(row[0], numbers, unit)
    control = _plan_control_of(plan)
    tabulate_coefficients(model_at(address), row, control.tick)
    _keep_control_law(p, control)
    _keep_settings(p, _plan_settings_of(plan))
    p[MONITOR_CLOSED] = 1.0 if unit.closed != 0.0 else 0.0
    _rest(address, 0.0)
    return 0


@brief_kernel
def reset_monitor(address: int, spool: float) -> int:
    """Restart a prepared monitor from rest with the spool there (m), limited by its stroke; returns
    0.
    """
    _rest(address, spool)
    return 0


@bare_kernel
def _rest(address: int, spool: float) -> None:
    p = array_at(address, (MODEL.path,))
    for i in range(MONITOR.control, MODEL.path):
        p[i] = 0.0
    plays = int(settings_of(p).plays)
    rest_block(model_at(address), 1, plays, spool, 0.0)
    keep_command(p, CommandMemory(math.nan, 0.0, 0.0, 0.0))
