"""What C calls of an exported library: arguments and objects are checked before a kernel runs.

A pointer that is NULL, an object that this library has not begun, a number that cannot be: a code
says so, and nothing is written.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from ehadiag.compile.jit import Array, brief_kernel, inlined_exact
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at, unpacker
from ehadiag.model.laws import ControlLaw, JackLaw
from ehadiag.model.plant import PlantConstants
from ehadiag.model.simd_layout import COEFFICIENTS
from ehadiag.monitor.monitor_memory import (
    MODEL,
    MONITOR,
    MONITOR_PLAN_CONTROL,
    MONITOR_UNIT_SIZE,
    SEVERITY_COUNT,
    HealthMemory,
    LibraryIdentity,
    MonitorUnit,
    health_of,
    keep_health,
    prepare_monitor,
    reset_monitor,
    settings_of,
)
from ehadiag.monitor.push_kernel import push_tick
from ehadiag.onboard.onboard_identification import (
    MAX_TICKS,
    begin_identification,
    continue_identification,
)
from ehadiag.onboard.onboard_memory import (
    MAX_VISCOSITY,
    MIN_VISCOSITY,
    ONBOARD,
    ONBOARD_PLAN_SIZE,
    PLAN_IDENTITY,
    UNIT_SUPPLY,
    set_environment,
    verdict_rules_of,
)


class ErrorCodes(NamedTuple):
    """What the functions return where they have done nothing."""

    pointer: int = -1
    """A pointer is NULL, or not aligned to a double."""
    object: int = -2
    """The object was not begun by this library."""
    range: int = -3
    """A number is out of its range, or NaN."""
    arithmetic: int = -4
    """The processor does not round to nearest, or flushes small numbers to zero."""
    library: int = -5
    """The header is another library's, or the unit is another one."""


ERRORS = ErrorCodes()


class HealthBits(NamedTuple):
    """Why a monitor cannot judge; 0: it can."""

    object: int = 1
    """It was not begun by this library."""
    spool: int = 2
    """No sample of the spool for longer than a test may lack one; of the pressure."""
    pressure: int = 4
    command: int = 8
    """The same of command and current."""
    beyond: int = 16
    """A number of the last tick was beyond what its unit allows, and counts as lost."""
    model: int = 32
    """A number of the model is none: it is to be begun again."""
    arithmetic: int = 64
    """The processor does not round to nearest, or flushes small numbers to zero."""


HEALTH = HealthBits()
SUPPLY_RANGE: Final = (0.05, 5.0)
"""Range of the supply, in supplies of the actuator's data: one in MPa or bar is far below."""
COMMAND_RANGE: Final = 4.0
"""Range of a command and a current either way, in rated currents, or in ends of the position's
converter: a command in mA or mm is far beyond."""
IDENTITY_SIZE: Final = len(LibraryIdentity._fields)
EXPORTED_UNIT_SIZE: Final = MONITOR_UNIT_SIZE + IDENTITY_SIZE - 1
"""Of a unit's MONITOR_UNIT_FIELDS, and what the caller's header says of the library."""
UNIT_IDENTITY: Final = MONITOR_UNIT_SIZE
PLAN_SUPPLY: Final = PlantConstants._fields.index("PSR")
MAX_INT64: Final = np.int64(2**63 - 1)
"""Largest whole number of 64 bits, 1."""


class ObjectPlaces(NamedTuple):
    """Where an object keeps what its functions check."""

    identity: int
    """`LibraryIdentity` of the library that has begun it."""
    version: int
    """Place of the version in that, 0 or 1: the digest has the other one, so that no object is one
    of the other kind. No arithmetic marks them: it may be rounded."""
    supply: int
    """Supply of its unit, Pa."""


A_MONITOR: Final = ObjectPlaces(
    MONITOR.identity,
    0,
    MODEL.coefficients + COEFFICIENTS.jack_law + JackLaw._fields.index("supply"),
)
AN_IDENTIFICATION: Final = ObjectPlaces(ONBOARD.identity, 1, ONBOARD.unit + UNIT_SUPPLY)
plan_identity_of = unpacker(LibraryIdentity, PLAN_IDENTITY)
plan_control_of = unpacker(ControlLaw, MONITOR_PLAN_CONTROL)
exported_unit_of = unpacker(MonitorUnit, SEVERITY_COUNT)


@inlined_exact
def is_pointer(address: int) -> bool:
    """Whether an address can be that of doubles."""
    return address != 0 and address % BYTES_PER_NUMBER == 0


@inlined_exact
def is_own(address: int, plan: Array, places: ObjectPlaces) -> bool:
    """Whether an object was begun by this library."""
    found = array_at(address + BYTES_PER_NUMBER * places.identity, (IDENTITY_SIZE,))
    own, version = plan_identity_of(plan), places.version
    return bool(
        found[version] == own.version and found[1 - version] == own.plan and found[2] == own.serial
    )


@inlined_exact
def keep_identity(address: int, plan: Array, places: ObjectPlaces) -> None:
    """Write whose the object is."""
    kept = array_at(address + BYTES_PER_NUMBER * places.identity, (IDENTITY_SIZE,))
    own, version = plan_identity_of(plan), places.version
    kept[version], kept[1 - version] = own.version, own.plan
    kept[2], kept[3] = own.serial, own.smallest


@inlined_exact
def computes_as_stated(plan: Array, number: float) -> bool:
    """Whether sums are rounded to nearest, and small numbers are kept.

    number: one that no compiler knows, about 1e7.
    """
    # Sums of what was rounded: a processor without doubles makes them by its own single precision.
    share = plan_identity_of(plan).smallest + 0.0
    number = 0.5 * (3.0 * number)
    small = number * share * share
    return bool(small > 0.0 and number + small == number and number - small == number)


@inlined_exact
def begin_error(address: int, unit_address: int, plan: Array) -> int:
    """Why an object cannot begin with a unit; 0: it can. Severities are looked at further on."""
    if not (is_pointer(address) and is_pointer(unit_address)):
        return ERRORS.pointer
    numbers = array_at(unit_address, (EXPORTED_UNIT_SIZE,))
    own, unit, rules = plan_identity_of(plan), exported_unit_of(numbers), verdict_rules_of(plan)
    if numbers[UNIT_IDENTITY] != own.version or numbers[UNIT_IDENTITY + 1] != own.plan:
        return ERRORS.library
    serial = numbers[UNIT_IDENTITY + 2]
    if serial not in (own.serial, 0.0) and own.serial != 0.0:
        return ERRORS.library
    supply = unit.supply / plan[PLAN_SUPPLY]
    if not (
        SUPPLY_RANGE[0] <= supply <= SUPPLY_RANGE[1]
        and MIN_VISCOSITY <= unit.viscosity <= MAX_VISCOSITY
        and rules.spool_low <= unit.spool_offset <= rules.spool_high
        and rules.pressure_low <= unit.pressure_offset <= rules.pressure_high
    ):
        return ERRORS.range
    return 0 if computes_as_stated(plan, unit.supply) else ERRORS.arithmetic


@inlined_exact
def object_error(address: int, other_address: int, plan: Array, places: ObjectPlaces) -> int:
    """Why a function cannot go on with an object and its argument; 0: it can."""
    if not (is_pointer(address) and is_pointer(other_address)):
        return ERRORS.pointer
    if not is_own(address, plan, places):
        return ERRORS.object
    supply = array_at(address + BYTES_PER_NUMBER * places.supply, (1,))[0]
    return 0 if computes_as_stated(plan, supply) else ERRORS.arithmetic


@brief_kernel
def c_unit_environment(unit_address: int, environment_address: int) -> int:
    """Set viscosity and supply of a unit, see `set_environment`."""
    if not (is_pointer(unit_address) and is_pointer(environment_address)):
        return ERRORS.pointer
    around = array_at(environment_address, (3,))
    wrong = set_environment(unit_address, (around[0], around[1], around[2]))
    return ERRORS.range if wrong else 0


@brief_kernel
def c_monitor_init(address: int, plan_address: int, unit_address: int) -> int:
    """Prepare a monitor; 0 or an error's code."""
    plan = array_at(plan_address, (ONBOARD_PLAN_SIZE,))
    error = begin_error(address, unit_address, plan)
    if error == 0 and prepare_monitor(address, plan_address, unit_address) != 0:
        error = ERRORS.range
    if error == 0:
        keep_identity(address, plan, A_MONITOR)
    return error


@brief_kernel
def c_monitor_reset(address: int, plan_address: int, spool_address: int) -> int:
    """Restart a monitor from rest; 0 or an error's code."""
    plan = array_at(plan_address, (ONBOARD_PLAN_SIZE,))
    error = object_error(address, spool_address, plan, A_MONITOR)
    if error != 0:
        return error
    spool = array_at(spool_address, (1,))[0]
    if not math.isfinite(spool):
        return ERRORS.range
    reset_monitor(address, spool)
    return 0


@inlined_exact
def _rank(value: float) -> int:
    """Place of a number in the order of all: a whole number; a NaN is before or behind all."""
    bits = np.float64(value).view(np.int64)
    return int(bits if bits >= 0 else bits ^ MAX_INT64)


@inlined_exact
def within(value: float, low: float, high: float) -> float:
    """Value, NaN where it is beyond its range.

    It is compared as a whole number: to compare a NaN is an exception of the processor's, and a
    compiler may move a comparison before what keeps NaN from it.
    """
    return value if _rank(low) <= _rank(value) <= _rank(high) else math.nan


@brief_kernel
def c_monitor_push(address: int, plan_address: int, tick_address: int) -> int:
    """Advance a monitor by a tick; alarms, or an error's code."""
    plan, tick = array_at(plan_address, (ONBOARD_PLAN_SIZE,)), array_at(tick_address, (5,))
    error = object_error(address, tick_address, plan, A_MONITOR)
    if error != 0:
        return error
    p, r, most = array_at(address, (MODEL.path,)), verdict_rules_of(plan), plan_control_of(plan).IM
    most_current, before = COMMAND_RANGE * most, health_of(p)
    most_command = most_current
    if settings_of(p).closed != 0.0:
        most_command = COMMAND_RANGE * max(-r.position_low, r.position_high)
    command = within(tick[0], -most_command, most_command)
    current = within(tick[1], -most_current, most_current)
    spool = within(tick[2], r.spool_low, r.spool_high)
    pressure = within(tick[3], r.pressure_low, r.pressure_high)
    position = within(tick[4], r.position_low, r.position_high)
    beyond = (
        _is_beyond(tick[0], command)
        or _is_beyond(tick[1], current)
        or _is_beyond(tick[2], spool)
        or _is_beyond(tick[3], pressure)
        or _is_beyond(tick[4], position)
    )
    alarms = push_tick(address, (command, current, spool, pressure, position))
    keep_health(
        p,
        HealthMemory(
            0.0 if math.isfinite(spool) else min(before.spool + 1.0, MAX_TICKS),
            0.0 if math.isfinite(pressure) else min(before.pressure + 1.0, MAX_TICKS),
            0.0
            if math.isfinite(command) or math.isfinite(current)
            else min(before.command + 1.0, MAX_TICKS),
            1.0 if beyond else 0.0,
        ),
    )
    return int(alarms)


@inlined_exact
def _is_beyond(value: float, kept: float) -> bool:
    """Whether a number that was there is not kept."""
    return not math.isnan(value) and math.isnan(kept)


@brief_kernel
def c_monitor_health(address: int, plan_address: int) -> int:
    """Sum of `HealthBits`: why a monitor cannot judge; 0: it can."""
    plan = array_at(plan_address, (ONBOARD_PLAN_SIZE,))
    error = object_error(address, address, plan, A_MONITOR)
    if error != 0:
        return HEALTH.arithmetic if error == ERRORS.arithmetic else HEALTH.object
    p, longest = array_at(address, (MODEL.path,)), verdict_rules_of(plan).longest_gap
    health, bits = health_of(p), 0
    if health.spool > longest:
        bits += HEALTH.spool
    if health.pressure > longest:
        bits += HEALTH.pressure
    if health.command > longest:
        bits += HEALTH.command
    if health.beyond != 0.0:
        bits += HEALTH.beyond
    for first, end in ((MONITOR.control, MONITOR.command), (MODEL.state, MODEL.path)):
        for i in range(first, end):
            if not math.isfinite(p[i]):
                return bits + HEALTH.model
    return bits


@brief_kernel
def c_identify_begin(address: int, plan_address: int, unit_address: int) -> int:
    """Begin an identification; 0 or an error's code."""
    plan = array_at(plan_address, (ONBOARD_PLAN_SIZE,))
    error = begin_error(address, unit_address, plan)
    if error == 0 and begin_identification(address, plan_address, unit_address) != 0:
        error = ERRORS.range
    if error == 0:
        keep_identity(address, plan, AN_IDENTIFICATION)
    return error


@brief_kernel
def c_identify_run(address: int, plan_address: int, ticks_address: int, slice_address: int) -> int:
    """Continue an identification: 0 done, 1 to be continued, or an error's code."""
    if not is_pointer(slice_address):
        return ERRORS.pointer
    plan = array_at(plan_address, (ONBOARD_PLAN_SIZE,))
    error = object_error(address, ticks_address, plan, AN_IDENTIFICATION)
    if error != 0:
        return error
    amounts = array_at(slice_address, (2,))
    going = continue_identification(address, plan_address, ticks_address, (amounts[0], amounts[1]))
    return ERRORS.range if going == 2 else int(going)
