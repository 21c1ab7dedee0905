"""Simulated units that wear by a law, diagnosed with the noise of real diagnoses."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, MaintenanceEvent, SourceRecord, Usage
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_tools.prognosis.laws import GRID_H, LAWS, LONGEST_H

Array = NDArray[np.float64]
TABLE = Path(__file__).with_name("noise.csv")
"""Truth, estimate and stated deviation of 67 diagnoses of simulated tests."""
LIMIT = 0.75
"""Severity at which a life ends, 1."""
INTERVAL_H = (50.0, 150.0)
"""Shortest and longest time between two diagnoses, h."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Diagnoses with known truth, of one severity; shape (diagnoses,) each."""

    truth: NDArray[np.float64]
    error: NDArray[np.float64]
    std: NDArray[np.float64]

    def draw(self, severity: float, rng: np.random.Generator) -> tuple[float, float]:
        """Return error and stated deviation of a diagnosis near a severity: one of the table's."""
        near = np.argsort(np.abs(self.truth - severity))[:12]
        index = int(rng.choice(near))
        return float(self.error[index] * rng.choice((-1.0, 1.0))), float(self.std[index])


def read_noise() -> dict[str, Noise]:
    """Read the table, by severity."""
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    out = {}
    for name in FAULT_NAMES:
        mine = [row for row in rows if row["severity"] == name]
        truth, value, std = (
            np.array([float(row[key]) for row in mine]) for key in ("truth", "estimate", "std")
        )
        out[name] = Noise(truth, value - truth, std)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class WornUnit:
    """One unit: its history, and when its severity truly is at the limit.

    Its last life lasts from `born` to `end`, hours.
    """

    law: str
    name: str
    entries: tuple[Entry, ...]
    events: tuple[MaintenanceEvent, ...]
    born: float
    end: float


def simulate_unit(law: str, serial: int, noise: dict[str, Noise], seed: int) -> WornUnit:
    """Simulate a unit from new until a severity is at the limit in its last life.

    Units with a filter have it changed once or twice before; half of the events do not name what
    they renewed. Units of `gaps` miss a third of their life's diagnoses in a row.
    """
    rng = np.random.default_rng((seed, serial, list(LAWS).index(law)))
    name, path_of = LAWS[law]
    entries: list[Entry] = []
    events: list[MaintenanceEvent] = []
    born = 0.0
    changes = int(rng.integers(1, 3)) if name == "Kintas" else 0
    for number in range(changes + 1):
        path = path_of(rng)
        stop = rng.uniform(0.4, 0.7) if number < changes else LIMIT
        age = _crossing(path, stop)
        at = rng.uniform(*INTERVAL_H)
        gap = rng.uniform(0.1, 0.6) * age if law == "gaps" else np.inf
        while at < age:
            if gap < at < gap + age / 3.0:
                at = gap + age / 3.0
                continue
            entries.append(_entry(serial, name, born + at, _level(path, at), noise[name], rng))
            at += rng.uniform(*INTERVAL_H)
        if number < changes:
            born += age
            resets = ("Kintas",) if rng.random() < 0.5 else ()
            events.append(_event(serial, born, resets))
    return WornUnit(law, name, tuple(entries), tuple(events), born, born + age)


def _crossing(path: Array, level: float) -> float:
    """Age at which a path first reaches a level."""
    index = int(np.argmax(path >= level))
    if path[index] < level:
        return LONGEST_H
    before = path[index - 1] if index else 0.0
    share = float((level - before) / max(path[index] - before, 1e-12))
    return (index + share) * GRID_H


def _level(path: Array, age: float) -> float:
    return float(np.interp(age, GRID_H * np.arange(1, len(path) + 1), path))


def _entry(
    serial: int, name: str, hours: float, level: float, noise: Noise, rng: np.random.Generator
) -> Entry:
    error, std = noise.draw(level, rng)
    value = min(max(level + error, 0.0), 1.0)
    severity = Severity(
        name=name, estimate=value, std=std, interval95=(value - 2 * std, value + 2 * std)
    )
    return Entry(
        appended="", tested=None, actuator="reference-31", serial=serial, test="open",
        verdict="HEALTHY", reasons=(), usage=Usage(hours), sources=(SourceRecord("", None, None),),
        severities=(severity,), covariance=((std**2,),), effects=(), version="", simulated=True,
        result="{}",
    )  # fmt: skip


def _event(serial: int, hours: float, resets: tuple[str, ...]) -> MaintenanceEvent:
    return MaintenanceEvent("", "", serial, None, Usage(hours), "filter changed", resets)
