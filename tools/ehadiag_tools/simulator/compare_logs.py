"""Simulator against recordings with known faults: residuals per file and channel, in LSB.

Where `truth-effects.csv` lies beside `truth.csv` the units have those effects besides; units of
`truth.csv` that it does not name are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.errors import ConfigurationError, EhadiagError, InputOutputError
from ehadiag.core.recording import Environment, Samples
from ehadiag.core.stored_test import StoredTest, resolve_test
from ehadiag_sim.plant.conditions import Effects, Faults, Sensors
from ehadiag_sim.plant.dynamics import DEFAULT_STEP
from ehadiag_sim.plant.simulator import bus_command
from ehadiag_tools.simulator.recorded_units import read_rows, read_units
from ehadiag_tools.simulator.replay import replay
from ehadiag_tools.simulator.units import Unit
from firmware_iface.logs.reader import read_recording

__all__ = ["main"]

EFFECTS = "truth-effects.csv"
FLOOR = float(np.sqrt(0.5**2 + 1.0 / 12.0))
"""LSB rms of a perfect simulator: electrical noise and quantisation."""


@dataclass(frozen=True, slots=True)
class Truth:
    """One row of truth.csv."""

    file: str
    test: str
    faults: Faults
    unit: str = ""


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, or that of the error."""
    parser = argparse.ArgumentParser(prog="compare_logs", description=__doc__)
    parser.add_argument("folder", type=Path, help="recordings and their truth.csv")
    parser.add_argument("--actuator", type=Path, help="actuator file (default: the bundled one)")
    parser.add_argument(
        "--step", type=float, default=DEFAULT_STEP * 1e6, help="integration step, µs (%(default)g)"
    )
    parser.add_argument(
        "--exact-command",
        action="store_true",
        help="do not round the command to the bus's resolution, to show what that does",
    )
    options = parser.parse_args(argv)
    try:
        actuator = load_actuator(options.actuator) if options.actuator else default_actuator()
        rows = read_truth(options.folder / "truth.csv")
        units = {"": Unit(actuator)}
        if (options.folder / EFFECTS).exists():
            units = read_units(options.folder / EFFECTS, actuator)
            rows = [row for row in rows if row.unit in units]
        print(f"Residual recording - simulator, LSB rms (largest); noise floor {FLOOR:.3f}\n")
        print("| file | samples | " + " | ".join(channel.name for channel in CHANNELS) + " |")
        print("| --- | --- |" + " --- |" * len(CHANNELS))
        for row in rows:
            recording = read_recording(options.folder / row.file)
            if recording.samples is None:
                raise InputOutputError(f"log {row.file}: no telemetry of a test in it")
            test = resolve_test(row.test)
            command = test.command() if options.exact_command else bus_command(test)
            unit = units[row.unit]
            gap = residuals(
                unit.actuator,
                recording.samples,
                _fitting(row.file, test, recording.samples, command),
                row.faults,
                effects_of(recording.environment, unit.effects),
                options.step * 1e-6,
                unit.sensors,
            )
            good = np.isfinite(gap).all(axis=0)
            cells = [f"{_rms(part):.3f} ({np.abs(part).max():.1f})" for part in gap[:, good]]
            print(f"| {row.file} | {good.sum()} | {' | '.join(cells)} |", flush=True)
    except EhadiagError as error:
        print(f"compare_logs: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def read_truth(path: Path) -> list[Truth]:
    """Read file names, tests and severities.

    Raises
    ------
    InputOutputError: no such file.
    ConfigurationError: a column is missing, a value is not a number from 0 to 1.
    """
    found = []
    for number, row in enumerate(read_rows(path), start=2):
        try:
            faults = Faults(*(float(row[name]) for name in ("Kintas", "FSS", "FDJ")))
            found.append(Truth(row["file"], row["test"], faults, row.get("unit", "")))
        except KeyError as error:
            raise ConfigurationError(f"{path}: column {error} is missing") from None
        except (TypeError, ValueError, ConfigurationError) as error:
            raise ConfigurationError(f"{path} line {number}: {error}") from None
    return found


def effects_of(environment: Environment, effects: Effects | None = None) -> Effects:
    """Effects under the oil and pressures of a recording; as they are where the bus did not say."""
    default = effects or Effects()

    def known(value: float | None, otherwise: float) -> float:
        return otherwise if value is None else value

    return replace(
        default,
        oil_temperature=known(environment.oil_temperature, default.oil_temperature),
        supply_pressure=known(environment.supply_pressure, default.supply_pressure),
        return_pressure=known(environment.return_pressure, default.return_pressure),
    )


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


def _fitting(
    file: str, test: StoredTest, samples: Samples, command: NDArray[np.float64]
) -> NDArray[np.float64]:
    if samples.ticks != test.ticks:
        raise InputOutputError(
            f"log {file}: {samples.ticks} ticks, test {test.name!r} has {test.ticks}"
        )
    known = np.isfinite(samples.command)
    off = np.abs(samples.command[known] - command[known])
    if off.size and off.max() > 1e-3 * np.abs(command).max():
        raise InputOutputError(f"log {file}: its command is not that of test {test.name!r}")
    return command


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
