"""Simulated units that wear by three laws, diagnosed with the noise of real diagnoses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.history.records import Entry, Event, Severity, Source, Usage
from ehadiag_tools.prognosis.noise import Noise

__all__ = ["LAWS", "LIMIT", "Unit", "make_unit"]

Array = NDArray[np.float64]
GRID_H = 2.0
LONGEST_H = 20_000.0
LIMIT = 0.75
CALM = 1.0 / 3000.0
"""Growth of a steady unit, of the way to 1, per hour."""
INTERVAL_H = (50.0, 150.0)
"""Between two diagnoses."""


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
    """One unit: what its history says, and when its severity truly reaches the limit."""

    law: str
    name: str
    """Of the severity."""
    entries: tuple[Entry, ...]
    events: tuple[Event, ...]
    born: float
    """Hours at which its last life began."""
    end: float
    """Hours at which the severity reaches the limit in it."""


def steady(rng: np.random.Generator) -> Array:
    """Wiener process with drift; drifts differ by a lognormal factor."""
    rate = CALM * 0.8 * np.exp(0.3 * rng.standard_normal())
    steps = int(LONGEST_H / GRID_H)
    growth = rate * GRID_H + 0.1 * np.sqrt(CALM * GRID_H) * rng.standard_normal(steps)
    return np.cumsum(growth)


def speeding_up(rng: np.random.Generator) -> Array:
    """Gamma process whose mean grows by the 1.5th power of the hours; scales differ."""
    clock = np.diff((np.arange(LONGEST_H / GRID_H + 1) * GRID_H * CALM) ** 1.5)
    spread = 0.12
    rate = 0.6 * np.exp(0.25 * rng.standard_normal())
    return np.cumsum(rng.gamma(clock / spread**2, rate * spread**2))


def clogging(rng: np.random.Generator) -> Array:
    """Growth in proportion to what is there, with a rate that wanders: none of the model's laws."""
    rate = 1.5 * CALM * np.exp(0.2 * rng.standard_normal())
    steps = int(LONGEST_H / GRID_H)
    wander = 0.08 * np.sqrt(CALM * GRID_H) * rng.standard_normal(steps)
    exponent = np.minimum(np.cumsum(rate * GRID_H + wander), 9.0)
    return 0.1 * np.expm1(np.maximum.accumulate(exponent))


LAWS: dict[str, tuple[str, Callable[[np.random.Generator], Array]]] = {
    "steady": ("FSS", steady),
    "speeding up": ("FDJ", speeding_up),
    "clogging, filter changed": ("Kintas", clogging),
}
"""Severity and law."""


def make_unit(law: str, serial: int, noise: dict[str, Noise], seed: int) -> Unit:
    """Simulate a unit from new until a severity reaches the limit in its last life.

    law: one of `LAWS`; units of the last one have their filter changed once or twice before.
    """
    rng = np.random.default_rng((seed, serial, list(LAWS).index(law)))
    name, path_of = LAWS[law]
    entries: list[Entry] = []
    events: list[Event] = []
    born = 0.0
    changes = int(rng.integers(1, 3)) if name == "Kintas" else 0
    for number in range(changes + 1):
        path = path_of(rng)
        stop = rng.uniform(0.4, 0.7) if number < changes else LIMIT
        age = _crossing(path, stop)
        at = rng.uniform(*INTERVAL_H)
        while at < age:
            entries.append(_entry(serial, name, born + at, _level(path, at), noise[name], rng))
            at += rng.uniform(*INTERVAL_H)
        if number < changes:
            born += age
            resets = ("Kintas",) if rng.random() < 0.5 else ()
            events.append(_event(serial, born, resets))
    return Unit(law, name, tuple(entries), tuple(events), born, born + age)


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
    severity = Severity(name, value, std, value - 2 * std, value + 2 * std, False, True)
    return Entry(
        appended="", tested=None, actuator="reference-31", serial=serial, test="open",
        verdict="HEALTHY", reasons=(), usage=Usage(hours), sources=(Source("", None, None),),
        severities=(severity,), covariance=((std**2,),), effects=(), version="", simulated=True,
        result="{}",
    )  # fmt: skip


def _event(serial: int, hours: float, resets: tuple[str, ...]) -> Event:
    return Event("", "", serial, None, Usage(hours), "filter changed", resets)
