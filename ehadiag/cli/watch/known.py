"""What is known of the unit that a monitor watches: from a result, a history, its actuator file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.small_file import read_small_file
from ehadiag.live.snapshot import Severity

__all__ = ["KnownUnit", "as_new", "from_history", "from_result"]

MAX_RESULT_BYTES = 1 << 20
NAMES = ("Kintas", "FSS", "FDJ")
OFFSETS = ("spool_offset", "pressure_offset")
"""Effects that a result states as offsets of the fit."""


@dataclass(frozen=True, slots=True)
class KnownUnit:
    """What a monitor starts from."""

    source: str
    """Where it is from, for people."""
    severities: tuple[Severity, ...]
    offsets: tuple[float, float] = (0.0, 0.0)
    """Of the sensors of spool (m) and pressure (Pa)."""
    noise: tuple[float, float] | None = None
    """Of spool (m) and pressure (Pa); None: as specified."""
    effects: Mapping[str, float] = field(default_factory=dict)
    """Of the unit, by the registry's names; SI."""
    serial: int | None = None

    @property
    def faults(self) -> tuple[float, ...]:
        """Severities, each cut to 0 … 1."""
        return tuple(min(max(item.estimate, 0.0), 1.0) for item in self.severities)

    def unit(self, actuator: Actuator) -> tuple[Actuator, dict[str, float]]:
        """Return the actuator's data with what was found since, and the effects beside it.

        A calibrated file has effects of its own: those found since take their place.
        """
        calibration = actuator.calibration
        if calibration is None:
            return actuator, dict(self.effects)
        newer = {**calibration.effects, **self.effects}
        calibration = msgspec.structs.replace(calibration, effects=newer)
        return msgspec.structs.replace(actuator, calibration=calibration), {}


def as_new(actuator: Actuator) -> KnownUnit:
    """Return what is known without a result: all severities 0, and what a calibration learned.

    Parameters
    ----------
    actuator : Actuator
        Its file.

    Returns
    -------
    KnownUnit
        The unit as new.
    """
    calibration = actuator.calibration
    if calibration is None:
        source, serial = "a unit as new", None
    else:
        source, serial = f"the calibration of {calibration.date}", calibration.serial
    severities = tuple(Severity(name=name, estimate=0.0, source=source) for name in NAMES)
    return KnownUnit(source, severities, serial=serial)


def from_result(path: Path, actuator: Actuator) -> KnownUnit:
    """Read the JSON result of a diagnosis.

    Parameters
    ----------
    path : Path
        The file; of several lines the last counts.
    actuator : Actuator
        The one that is watched.

    Returns
    -------
    KnownUnit
        What the result says.

    Raises
    ------
    ConfigurationError
        It is no result, holds no severities, or is one of another actuator.
    InputOutputError
        It cannot be read.
    """
    where = f"result {path}"
    lines = read_small_file(path, MAX_RESULT_BYTES, "result").splitlines()
    return _of_line(next((line for line in reversed(lines) if line.strip()), b""), actuator, where)


def from_history(path: Path, serial: int, actuator: Actuator) -> KnownUnit | None:
    """Take the newest diagnosis of a unit that has severities from a health history.

    Parameters
    ----------
    path : Path
        The history.
    serial : int
        Of the unit.
    actuator : Actuator
        The one that is watched.

    Returns
    -------
    KnownUnit | None
        What the diagnosis says; None where there is none of this unit.

    Raises
    ------
    ConfigurationError
        The file is no history, or the diagnosis one of another actuator.
    """
    from ehadiag.history.counted import counted  # noqa: PLC0415
    from ehadiag.history.store import History  # noqa: PLC0415

    with History(path) as history:
        entries = [item for item in counted(history.entries(serial)) if item.severities]
    if not entries:
        return None
    newest = max(entries, key=lambda item: item.when)
    known = _of_line(newest.result.encode(), actuator, f"diagnosis {newest.number} of {path}")
    effects = {item.name: item.value for item in newest.effects if item.value is not None}
    return KnownUnit(
        source=f"diagnosis {newest.number} of {path}, {newest.when}",
        severities=known.severities,
        offsets=known.offsets,
        noise=known.noise,
        effects=_totals(effects),
        serial=serial,
    )


def _of_line(line: bytes, actuator: Actuator, where: str) -> KnownUnit:
    try:
        tree = json.loads(line)
        schema = tree["schema"]
        if not str(schema).startswith("ehadiag.diagnosis/"):
            raise ConfigurationError(f"{where}: its schema is {schema}, need ehadiag.diagnosis")
        if tree["actuator"] != actuator.name:
            raise ConfigurationError(
                f"{where}: of actuator {tree['actuator']}, not {actuator.name}: name its file by"
                " --actuator"
            )
        if tree["fit"] is None:
            raise ConfigurationError(f"{where}: holds no severities, its test was not identified")
        return _of_tree(tree, where)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        # What is wrong in it is not said: it may be any file.
        raise ConfigurationError(f"{where}: is none of ehadiag's JSON results") from None


def _of_tree(tree: dict[str, Any], where: str) -> KnownUnit:
    fit = tree["fit"]
    others = {item["name"]: float(item["value"]) for item in tree.get("other", ())}
    return KnownUnit(
        source=where,
        severities=tuple(_severity(name, tree["faults"][name], where) for name in NAMES),
        offsets=(_number(fit["spool_offset_mm"]) * 1e-3, _number(fit["pressure_offset_MPa"]) * 1e6),
        noise=(_number(fit["spool_noise_mm"]) * 1e-3, _number(fit["pressure_noise_MPa"]) * 1e6),
        effects=_totals(others),
        serial=tree["serial"],
    )


def _severity(name: str, tree: dict[str, Any], where: str) -> Severity:
    std = tree["std"]
    return Severity(
        name=name,
        estimate=_number(tree["estimate"]),
        std=None if std is None else _number(std),
        source=where,
    )


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} for a number")
    return number


def _totals(effects: Mapping[str, float]) -> dict[str, float]:
    """Effects that are not stated as offsets of the fit."""
    return {name: value for name, value in effects.items() if name not in OFFSETS}
