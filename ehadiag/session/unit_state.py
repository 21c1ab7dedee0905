"""State of a unit before it is watched: from a result, a history, its actuator file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import msgspec
from msgspec.structs import replace

from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import MAX_RESULT_BYTES
from ehadiag.estimate import Severity
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS
from ehadiag.result import Result
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import read_small_file

STATED_AS_OFFSETS = {item.name for item in SENSOR_OFFSETS}
"""Effects that a result states as offsets of the fit."""


class UnitState(msgspec.Struct, frozen=True):
    """Severities, offsets, noise and effects that a monitor starts from."""

    source: str
    """Origin of the state, for people."""
    severities: tuple[Severity, ...]
    offsets: tuple[float, float] = (0.0, 0.0)
    """Offsets of the sensors of spool (m) and pressure (Pa)."""
    noise: tuple[float, float] | None = None
    """Noise of spool (m) and pressure (Pa); None: as specified."""
    effects: Mapping[str, float] = msgspec.field(default_factory=dict)
    """Effects of the unit, by the registry's names; SI."""
    serial: int | None = None
    known: bool = True
    """Whether offsets and effects are this unit's, by a diagnosis or a calibration."""

    @property
    def faults(self) -> tuple[float, ...]:
        """Severities, each cut to 0 … 1."""
        return tuple(min(max(item.value, 0.0), 1.0) for item in self.severities)

    def unit(self, actuator: Actuator) -> tuple[Actuator, dict[str, float]]:
        """Return the actuator's data with the newer effects, and effects that it cannot hold.

        Of a calibrated file the newer effects take the place of its own.
        """
        calibration = actuator.calibration
        if calibration is None:
            return actuator, dict(self.effects)
        newer = {**calibration.effects, **self.effects}
        calibration = msgspec.structs.replace(calibration, effects=newer)
        return msgspec.structs.replace(actuator, calibration=calibration), {}


def new_unit_state(actuator: Actuator) -> UnitState:
    """Return the state of a unit without a result: severities 0, effects of its calibration."""
    calibration = actuator.calibration
    if calibration is None:
        source, serial = "a unit as new", None
    else:
        source, serial = f"the calibration of {calibration.date}", calibration.serial
    severities = tuple(
        Severity(name=item.name, estimate=0.0, meaning=item.short, source=source) for item in FAULTS
    )
    return UnitState(source, severities, serial=serial, known=calibration is not None)


KnownUnit: TypeAlias = UnitState | Result | str | os.PathLike[str]
"""State of a unit, the result of its diagnosis, or that one's JSON file."""


def unit_state_of(given: KnownUnit, actuator: Actuator) -> UnitState:
    """Return the state of a unit by the result of a diagnosis.

    given: the state itself, the result, or its JSON file: of several lines the last counts;
    actuator: the one that is watched. Returns state by the result. ConfigurationError: it is no
    result, holds no severities, or is one of another actuator; InputOutputError: it cannot be read.
    """
    if isinstance(given, UnitState):
        return given
    if isinstance(given, Result):
        return _of_result(given, actuator, f"result of {given.source}")
    path = Path(given)
    where = f"result {path}"
    lines = read_small_file(path, MAX_RESULT_BYTES, "result").splitlines()
    line = next((line for line in reversed(lines) if line.strip()), b"")
    return _of_result(_read(line, where), actuator, where)


def unit_state_from_history(path: Path, serial: int, actuator: Actuator) -> UnitState | None:
    """Take the newest diagnosis of a unit that has severities from a health history.

    actuator: the one that is watched. Returns state by the diagnosis; None where there is none of
    this unit. ConfigurationError: the file is no history, or the diagnosis one of another actuator.
    """
    from ehadiag.history.records import counted_entries  # noqa: PLC0415
    from ehadiag.history.store import History  # noqa: PLC0415

    with History(path) as history:
        counted = counted_entries(history.entries(serial))
    entries = [item for item in counted if item.severities and item.by_test]
    if not entries:
        return None
    newest = max(entries, key=lambda item: item.when)
    where = f"diagnosis {newest.number} of {path}"
    found = _read(newest.result.encode(), where)
    if len(found.effects) < len(newest.effects):  # a former result has only those with a limit
        found = msgspec.structs.replace(found, effects=newest.effects)
    known = _of_result(found, actuator, where)
    return replace(known, source=f"{where}, {newest.when}", serial=serial)


def _read(line: bytes, where: str) -> Result:
    try:
        schema = msgspec.json.decode(line)["schema"]
        if not str(schema).startswith("ehadiag.diagnosis/"):
            raise ConfigurationError(f"{where}: its schema is {schema}, need ehadiag.diagnosis")
        return Result.from_json(line)
    except (ValueError, LookupError, TypeError, RecursionError):
        # What is wrong in it is not said: it may be any file.
        raise ConfigurationError(f"{where}: is none of ehadiag's JSON results") from None


def _of_result(result: Result, actuator: Actuator, where: str) -> UnitState:
    fit = result.fit
    if result.actuator != actuator.name:
        raise ConfigurationError(
            f"{where}: of actuator {result.actuator}, not {actuator.name}: name its file by"
            " --actuator"
        )
    if fit is None:
        raise ConfigurationError(f"{where}: holds no severities, its test was not identified")
    severities = tuple(  # one that a former version did not know was 0 in its model
        msgspec.structs.replace(result.severities.get(item.name, item), source=where)
        for item in new_unit_state(actuator).severities
    )
    numbers = [fit.spool_offset_mm, fit.pressure_offset_MPa, fit.spool_noise_mm]
    numbers += [fit.pressure_noise_MPa, *(item.estimate for item in severities)]
    if not result.severities or None in numbers:
        raise ConfigurationError(f"{where}: is none of ehadiag's JSON results")
    return UnitState(
        source=where,
        severities=severities,
        offsets=((fit.spool_offset_mm or 0.0) * 1e-3, (fit.pressure_offset_MPa or 0.0) * 1e6),
        noise=((fit.spool_noise_mm or 0.0) * 1e-3, (fit.pressure_noise_MPa or 0.0) * 1e6),
        effects={
            item.name: item.value
            for item in result.effects
            if item.value is not None and item.name not in STATED_AS_OFFSETS
        },
        serial=result.serial,
    )
