"""Reads the effects of recorded units from the table beside the recordings."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag_sim.plant.conditions import DataErrors, Effects
from ehadiag_tools.simulator.units import Unit

__all__ = ["read_rows", "read_units"]


def read_rows(path: Path) -> list[dict[str, str]]:
    """Read a table of comma-separated text with a head line.

    Raises
    ------
    InputOutputError: no such file.
    ConfigurationError: not such a table.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))
    except OSError as error:
        raise InputOutputError(f"{path}: {reason_of(error)}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"{path}: not a table of comma-separated text: {error}") from None


def read_units(path: Path, actuator: Actuator) -> dict[str, Unit]:
    """Read `truth-effects.csv`: columns unit, effect, value; units by name.

    `actuator` holds the data that the effects change.

    Raises
    ------
    InputOutputError: no such file.
    ConfigurationError: a column is missing, an effect is not known, a value is no number.
    """
    units: dict[str, Unit] = {}
    for number, row in enumerate(read_rows(path), start=2):
        where = f"{path} line {number}"
        try:
            name, effect, value = row["unit"], row["effect"], float(row["value"])
        except KeyError as error:
            raise ConfigurationError(f"{path}: column {error} is missing") from None
        except (TypeError, ValueError):
            raise ConfigurationError(f"{where}: {row['value']!r} is not a number") from None
        change = _CHANGES.get(effect)
        if change is None:
            raise ConfigurationError(f"{where}: effect {effect!r} is not known")
        if not math.isfinite(value):
            raise ConfigurationError(f"{where}: {value} is not a finite number")
        units[name] = change(units.get(name, Unit(actuator)), value)
    return units


Change = Callable[[Unit, float], Unit]


def _effect(change: Callable[[Effects, float], Effects]) -> Change:
    return lambda unit, value: replace(unit, effects=change(unit.effects, value))


def _offset(index: int) -> Change:
    def change(unit: Unit, value: float) -> Unit:
        channel = CHANNELS[index]
        offsets = list(unit.sensors.offsets_lsb)
        offsets[index] = value * channel.per_unit / channel.lsb
        a, b, c, d = offsets
        return replace(unit, sensors=replace(unit.sensors, offsets_lsb=(a, b, c, d)))

    return change


def _datum(part: str, field: str) -> Change:
    def change(unit: Unit, value: float) -> Unit:
        share = value / getattr(getattr(unit.actuator, part), field) - 1.0
        data: DataErrors = replace(unit.effects.data, **{field: share})
        return replace(unit, effects=replace(unit.effects, data=data))

    return change


def _filter(unit: Unit, value: float) -> Unit:
    return replace(unit, sensors=replace(unit.sensors, filter_time=value))


def _stage(unit: Unit, value: float) -> Unit:
    stage = msgspec.structs.replace(
        unit.actuator.second_stage, kind="orifice" if value == 2.0 else "linear"
    )
    return replace(unit, actuator=msgspec.structs.replace(unit.actuator, second_stage=stage))


def _bulk(unit: Unit, value: float) -> Unit:
    stage = msgspec.structs.replace(unit.actuator.second_stage, beta=value)
    return replace(unit, actuator=msgspec.structs.replace(unit.actuator, second_stage=stage))


_CHANGES: dict[str, Change] = {
    **{f"{channel.name} offset": _offset(index) for index, channel in enumerate(CHANNELS)},
    **{name: _datum("servovalve", name) for name in ("GM", "KSF", "KF", "GP", "GQ", "CS", "FSS0")},
    **{name: _datum("jack", name) for name in ("CJ", "MJ", "FDJ0")},
    "torque motor gain": _effect(lambda item, value: replace(item, gain_change=value - 1.0)),
    "hysteresis": _effect(lambda item, value: replace(item, hysteresis=value)),
    "backlash half-width": _effect(lambda item, value: replace(item, backlash=value)),
    "null bias": _effect(lambda item, value: replace(item, null_bias=value * 1e-3)),
    "number of plays": _effect(lambda item, value: replace(item, plays=round(value))),
    "analogue filter time constant": _filter,
    "Stribeck velocity spool": _effect(lambda item, value: replace(item, spool_stribeck=value)),
    "Stribeck velocity jack": _effect(lambda item, value: replace(item, jack_stribeck=value)),
    "second stage": _stage,
    "bulk modulus": _bulk,
}
