"""Simulator against recordings with known faults: a study, and the replay that it is made of.

Free-running loops with different noise part ways, so in closed loop the control law of the replay
gets the *recorded* (digitised) jack position. What was not recorded follows from the next current.
"""

from __future__ import annotations

import argparse
import copy
import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_sim.conditions import DataErrors, Effects, Faults, Sensors
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S, PlantDynamics
from ehadiag_sim.plant_laws import PositionController
from ehadiag_sim.sensing import SimulatedConverters
from ehadiag_sim.simulation import bus_command
from ehadiag_tools.simulator.units import Unit
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.errors import ConfigurationError, InputOutputError
from firmware_iface.logs.reader import read_recording
from firmware_iface.recording import CHANNELS, CommandMode, Environment, Recording, Samples
from firmware_iface.stored_test import resolve_test

EFFECTS = "truth-effects.csv"
NEIGHBOURS = 4
"""Codes on either side of the simulated position that a missing sample may have had, 1."""


@dataclass(frozen=True, slots=True)
class Truth:
    """A recording, its stored test and unit where the table says them, and its severities."""

    path: str
    test: str
    unit: str
    faults: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class RecordedCase:
    """A recording, and whether commands are exact."""

    truth: Truth
    exact_command: bool


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, help="recordings, truth.csv; with effects truth-effects.csv, too")
    add("--exact-command", action="store_true", help="do not round it to the bus's resolution")


def _cases(options: Options) -> list[RecordedCase]:
    units = _units(options.folder)
    return [
        RecordedCase(truth, options.exact_command)
        for truth in read_truth(options.folder)
        if truth.unit in units
    ]


def _units(folder: Path) -> dict[str, Unit]:
    if (folder / EFFECTS).exists():
        return read_units(folder / EFFECTS, default_actuator())
    return {truth.unit: Unit() for truth in read_truth(folder)}


def perform(case: RecordedCase) -> Record:
    """Replay one recording on the simulator; residuals in LSB."""
    truth, path = case.truth, Path(case.truth.path)
    recording, samples = read_tested(path)
    test, unit = resolve_test(truth.test), _units(path.parent)[truth.unit]
    command = test.command() if case.exact_command else bus_command(test)
    if samples.ticks != test.ticks:
        raise InputOutputError(f"log {path.name}: not as long as test {test.name!r}")
    effects = effects_of(recording.environment, unit.effects)
    gap = residuals(
        unit.actuator, samples, command, Faults(*truth.faults), effects, DEFAULT_STEP_S,
        unit.sensors,
    )  # fmt: skip
    good = gap[:, np.isfinite(gap).all(axis=0)]
    rms, largest = np.sqrt(np.mean(good**2, axis=1)), np.abs(good).max(axis=1)
    return {"samples": good.shape[1], "rms": rms.tolist(), "largest": largest.tolist()}


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    floor = np.sqrt(Sensors().noise_lsb ** 2 + 1.0 / 12.0)
    yield f"Residual recording - simulator, LSB rms (largest); noise floor {floor:.3f}\n"
    rows = []
    for item in records:
        pairs = zip(item["rms"], item["largest"], strict=True)
        cells = [f"{rms:.3f} ({largest:.1f})" for rms, largest in pairs]
        rows.append((Path(item["truth"]["path"]).name, item["samples"], *cells))
    yield from markdown(("file", "samples", *(channel.name for channel in CHANNELS)), rows)


def read_tested(path: Path) -> tuple[Recording, Samples]:
    """Read a recording that has samples."""
    recording = read_recording(path)
    if recording.samples is None:
        raise InputOutputError(f"log {path.name}: no telemetry of a test in it")
    return recording, recording.samples


def read_truth(folder: Path) -> list[Truth]:
    """Read truth.csv of a folder of recordings."""
    return [
        Truth(
            str(folder / row["file"]), row.get("test", ""), row.get("unit", ""),
            tuple(row[name] for name in FAULT_NAMES),
        )
        for row in read_rows(folder / "truth.csv", ("file",), FAULT_NAMES)
    ]  # fmt: skip


def effects_of(environment: Environment, effects: Effects | None = None) -> Effects:
    """Effects under the oil and pressures of a recording; as they are where the bus did not say."""
    names = ("oil_temperature", "supply_pressure", "return_pressure")
    measured = {name: getattr(environment, name) for name in names}
    known = {name: value for name, value in measured.items() if value is not None}
    return replace(effects or Effects(), **known)


def residuals(
    actuator: Actuator,
    samples: Samples,
    command: NDArray[np.float64],
    faults: Faults,
    effects: Effects,
    step: float,
    sensors: Sensors | None = None,
) -> NDArray[np.float64]:
    """Recorded minus simulated, LSB, NaN where nothing was recorded, shape (4, ticks)."""
    truth = replay(actuator, samples, command, faults, effects, step, sensors)
    seen = np.vstack([samples.current, samples.spool, samples.pressure, samples.position])
    gap: NDArray[np.float64] = (seen - truth) / np.array([[channel.lsb] for channel in CHANNELS])
    return gap


def replay(
    actuator: Actuator,
    samples: Samples,
    command: NDArray[np.float64],
    faults: Faults,
    effects: Effects,
    step: float = DEFAULT_STEP_S,
    sensors: Sensors | None = None,
) -> NDArray[np.float64]:
    """Drive the simulated plant with commands in A or m, as the control computer had them.

    A missing jack sample (also the one before the test) is the code near the simulated position
    whose current is nearest to the recorded one; without that either, the code of the simulated
    position. Sensors err as they say, but for noise. Returns current (A), spool (m), pressure (Pa),
    jack (m) as read without noise, shape (4, ticks).
    """
    sensors = sensors or Sensors()
    plant = PlantDynamics(
        actuator, faults, effects, step, filter_time=sensors.filter_time, early=sensors.early
    )
    electronics = SimulatedConverters(actuator, sensors, effects.unmodelled, seed=0)
    law = PositionController(actuator.controller)
    truth = np.empty((4, samples.ticks))
    measured = math.nan
    # Readings at rest: of the current by its offset alone, of the jack before the test.
    zero, _, _, shown = electronics.read(plant.seen).tolist()
    for tick, wanted in enumerate(command.tolist()):
        if samples.mode is CommandMode.POSITION and math.isnan(measured):
            measured = _missing(law, wanted, float(samples.current[tick]) - zero, shown)
        plant.advance(law.current(wanted, samples.mode, measured))
        truth[:, tick] = electronics.read(plant.seen)
        shown = float(truth[3, tick])
        measured = float(samples.position[tick])
    return truth


def _missing(law: PositionController, command: float, current: float, simulated: float) -> float:
    """Jack position that the converter may have shown, m."""
    nearest = round(simulated / CHANNELS.position.lsb)
    if math.isnan(current):
        return nearest * CHANNELS.position.lsb

    def misfit(code: int) -> tuple[int, int]:
        trial = copy.copy(law).current(command, CommandMode.POSITION, code * CHANNELS.position.lsb)
        # In saturation many codes give one current: take the nearest position then.
        return round(abs(trial - current) / CHANNELS.current.lsb), abs(code - nearest)

    codes = range(nearest - NEIGHBOURS, nearest + NEIGHBOURS + 1)
    return min(codes, key=misfit) * CHANNELS.position.lsb


def read_rows(path: Path, texts: Sequence[str], numbers: Sequence[str]) -> list[dict[str, Any]]:
    """Read a table of comma-separated text; ConfigurationError: columns or numbers are missing."""
    with path.open(encoding="utf-8", newline="") as file:
        table = csv.DictReader(file)
        if lacking := [name for name in (*texts, *numbers) if name not in (table.fieldnames or ())]:
            raise ConfigurationError(f"{path}: without column {', '.join(lacking)}")
        rows: list[dict[str, Any]] = list(table)
    for row, name in product(rows, numbers):
        try:
            row[name] = float(row[name] or "")
        except ValueError:
            raise ConfigurationError(f"{path}: {name} {row[name]!r} is not a number") from None
    return rows


def read_units(path: Path, actuator: Actuator) -> dict[str, Unit]:
    """Read `truth-effects.csv`, columns unit, effect, value: units of an actuator by name."""
    units: dict[str, Unit] = {}
    for row in read_rows(path, ("unit", "effect"), ("value",)):
        unit = units.get(row["unit"], Unit(actuator))
        units[row["unit"]] = _with_effect(unit, row["effect"], row["value"])
    return units


def _with_effect(unit: Unit, effect: str, value: float) -> Unit:
    """Give a unit one effect of the table."""
    effects, sensors, actuator = unit.effects, unit.sensors, unit.actuator
    changes: dict[str, dict[str, Any]] = {
        "torque motor gain": {"gain_change": value - 1.0},
        "hysteresis": {"hysteresis": value},
        "backlash half-width": {"backlash": value},
        "null bias": {"null_bias": value * 1e-3},
        "number of plays": {"plays": round(value)},
        "Stribeck velocity spool": {"spool_stribeck": value},
        "Stribeck velocity jack": {"jack_stribeck": value},
    }
    stages: dict[str, dict[str, Any]] = {
        "second stage": {"kind": "orifice" if value == 2.0 else "linear"},
        "bulk modulus": {"beta": value},
    }
    offsets = {f"{channel.name} offset": place for place, channel in enumerate(CHANNELS)}
    if effect in {item.name for item in fields(DataErrors)}:
        part = actuator.jack if hasattr(actuator.jack, effect) else actuator.servovalve
        share = value / getattr(part, effect) - 1.0
        changes[effect] = {"data": replace(effects.data, **{effect: share})}
    if effect in changes:
        return replace(unit, effects=replace(effects, **changes[effect]))
    if effect in stages:
        stage = msgspec.structs.replace(actuator.second_stage, **stages[effect])
        return replace(unit, actuator=msgspec.structs.replace(actuator, second_stage=stage))
    if effect in offsets:
        place, codes = offsets[effect], list(sensors.offsets_lsb)
        codes[place] = value * CHANNELS[place].per_unit / CHANNELS[place].lsb
        a, b, c, d = codes
        return replace(unit, sensors=replace(sensors, offsets_lsb=(a, b, c, d)))
    if effect == "analogue filter time constant":
        return replace(unit, sensors=replace(sensors, filter_time=value))
    raise ConfigurationError(f"effect {effect!r} is not known")


RECORDINGS = Study(
    "recordings",
    "The simulator against recordings with known faults: residuals of each channel.",
    _cases, perform, _report, _options, count=None,
)  # fmt: skip
