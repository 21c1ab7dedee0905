"""Units and their recordings: random ones that are simulated, others' that are replayed.

A unit keeps its effects over its life (PHY-28 to 39); its faults, the oil and the noise are
those of a recording:

    unit = random_unit(np.random.default_rng(7), data=True)
    recording = record(unit, resolve_test("open"), Faults(0.2, 0.1, 0.4), seed=1)

Free-running loops with different noise part ways, so in closed loop the control law of a replay
gets the *recorded* (digitised) jack position. What was not recorded follows from the next current.
"""

from __future__ import annotations

import argparse
import copy
import csv
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.model.plant import PlantConstants, plant_constants
from ehadiag.model.registry import FAULT_NAMES, FAULTS, Unknowns
from ehadiag_sim.conditions import DataErrors, Effects, Faults, Sensors, UnmodelledEffects
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S, PlantDynamics
from ehadiag_sim.plant_laws import PositionController
from ehadiag_sim.sensing import SimulatedConverters
from ehadiag_sim.simulation import bus_command, simulate
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.errors import ConfigurationError, InputOutputError
from firmware_iface.recording import CHANNELS, CommandMode, Environment, Recording, Samples
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import StoredTest, resolve_test

COARSE_STEP = 1e-6
"""Integration step of studies, s; four times as fast as the default, errors below the noise."""
GROUPS = ("sensing", "friction", "orifice", "strangers")
"""Of effects beside the data's errors, see `random_unit`."""


@dataclass(frozen=True, slots=True)
class Unit:
    """One actuator on a bench; effects and errors of its sensors are kept over its life."""

    actuator: Actuator = field(default_factory=default_actuator)
    effects: Effects = field(default_factory=Effects)
    sensors: Sensors = field(default_factory=Sensors)
    serial: int | None = None


def random_unit(
    rng: np.random.Generator,
    actuator: Actuator | None = None,
    *,
    data: bool = False,
    sensing: bool = False,
    friction: bool = False,
    orifice: bool = False,
    strangers: bool = False,
    serial: int | None = None,
) -> Unit:
    """Draw a unit, each effect evenly within its usual size (PHY-28 to 39).

    Always: offsets ±1 % of range, gain ±5 %, null bias ±2 % of rated current, hysteresis 0 to 4 %
    by one play, backlash 0 to 5 µm. `data`: ten data-sheet values ±5 %. `sensing`: gains ±0.5 %,
    filter and sampling instant 0 to 0.2 ms, probes ±2 K and ±0.1 MPa. `friction`: Stribeck
    velocities 1 to 50 mm/s (evenly in the logarithm), hysteresis of 1 to 16 plays, load ±50 N.
    `orifice`: as second stage, oil of 6 to 9·10⁸ Pa. `strangers`: each effect that the
    identification does not know, by even chance. Each group has a stream of its own: switching one
    on does not change what the others draw. The generator is advanced by one `spawn`.
    """
    base, second, third, fourth, fifth, sixth = rng.spawn(6)
    actuator = actuator or default_actuator()
    effects = Effects(
        null_bias=_even(base, 0.02) * actuator.controller.IM,
        hysteresis=float(base.uniform(0.0, 0.04)),
        gain_change=_even(base, 0.05),
        backlash=float(base.uniform(0.0, 5e-6)),
    )
    a, b, c, d = (0.01 * 2048 * base.uniform(-1.0, 1.0, len(CHANNELS))).tolist()
    sensors = Sensors(offsets_lsb=(a, b, c, d))
    if data:
        errors = {item.name: _even(second, 0.05) for item in fields(DataErrors)}
        effects = replace(effects, data=DataErrors(**errors))
    if sensing:
        sensors = replace(
            sensors,
            gains=(0.0, _even(third, 0.005), _even(third, 0.005), _even(third, 0.005)),
            filter_time=float(third.uniform(0.0, 0.2e-3)),
            early=float(third.uniform(0.0, 0.2e-3)),
            temperature_error=_even(third, 2.0),
            supply_error=_even(third, 0.1e6),
        )
    if friction:
        effects = replace(
            effects,
            spool_stribeck=_log_even(fourth, 1e-3, 50e-3),
            jack_stribeck=_log_even(fourth, 1e-3, 50e-3),
            plays=int(fourth.integers(1, 17)),
            load=_even(fourth, 50.0),
        )
    if orifice:
        stage = msgspec.structs.replace(
            actuator.second_stage, kind="orifice", beta=float(fifth.uniform(6e8, 9e8))
        )
        actuator = msgspec.structs.replace(actuator, second_stage=stage)
    if strangers:
        effects = replace(effects, plays=8, unmodelled=_random_strangers(sixth))
    return Unit(actuator, effects, sensors, serial)


def unit_with(
    rng: np.random.Generator, groups: Collection[str], serial: int, *, data: bool = True
) -> Unit:
    """Draw a unit with errors of its data, and groups of effects by name, see `random_unit`."""
    chosen = {name: name in groups for name in GROUPS}
    return random_unit(rng, None, data=data, serial=serial, **chosen)


def add_group(parser: argparse.ArgumentParser) -> None:
    """Add an option for groups of effects, see `random_unit`."""
    words = "further effects of the units; may be repeated (none)"
    parser.add_argument("--group", action="append", default=[], choices=GROUPS, help=words)


def record(
    unit: Unit,
    test: StoredTest,
    faults: Faults | None = None,
    *,
    seed: int = 0,
    step: float = DEFAULT_STEP_S,
    oil_temperature: float | None = None,
    supply_pressure: float | None = None,
) -> Recording:
    """Record a stored test of a unit as an acquisition without a fault would deliver it.

    The step is the longest of the integration, s; oil temperature (degC) and supply pressure (Pa)
    are those of the unit's effects unless given.
    """
    effects = unit.effects
    if oil_temperature is not None:
        effects = replace(effects, oil_temperature=oil_temperature)
    if supply_pressure is not None:
        effects = replace(effects, supply_pressure=supply_pressure)
    done = simulate(unit.actuator, test, faults, effects, unit.sensors, seed=seed, step=step)
    return done.recording("simulated", unit.serial)


def damaged(
    constants: PlantConstants, severities: Sequence[float] | NDArray[np.float64]
) -> PlantConstants:
    """Constants of a unit, given those as new, with severities 0 … 1 in the order of `FAULTS`."""
    point = np.asarray(severities, dtype=np.float64)
    return Unknowns(FAULTS, (constants,), {}).constants(point)


def damaged_unit(
    severities: Sequence[float] | NDArray[np.float64],
    actuator: Actuator | None = None,
    environment: Environment | None = None,
) -> PlantConstants:
    """Constants of an actuator, the reference one unless given, with these severities."""
    return damaged(plant_constants(actuator or default_actuator(), environment), severities)


STRANGE_SIZES = {
    "torque_cubic": 0.05,
    "play_skew": 3.0,
    "driver_lag": 0.3e-3,
    "land_asymmetry": 0.03,
    "land_shift": 2e-6,
    "spool_bend_2": 0.005,
    "spool_bend_3": 0.01,
    "jack_bend_2": 0.005,
    "jack_bend_3": 0.01,
    "oil_drift": 1.0,
    "friction_asymmetry": 0.05,
    "spool_friction_slope": 0.05,
}
"""Largest sizes of the strangers in a random unit, each as its field of `UnmodelledEffects`."""


def _random_strangers(rng: np.random.Generator) -> UnmodelledEffects:
    drawn: dict[str, Any] = {}
    for name, size in STRANGE_SIZES.items():
        there, value = rng.random() < 0.5, _even(rng, size)
        if there:
            drawn[name] = abs(value) if name == "driver_lag" else value
    return UnmodelledEffects(**drawn)


def _even(rng: np.random.Generator, size: float) -> float:
    return float(rng.uniform(-size, size))


def _log_even(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


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
    found = []
    for row in read_rows(folder / "truth.csv", ("file",), FAULT_NAMES):
        faults = tuple(row[name] for name in FAULT_NAMES)
        Faults(*faults)  # refuses what is outside 0 … 1
        test, unit = row.get("test", ""), row.get("unit", "")
        found.append(Truth(str(folder / row["file"]), test, unit, faults))
    return found


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
