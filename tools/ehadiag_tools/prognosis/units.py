"""Study of the prognosis of remaining life on simulated units that wear by a law.

They are diagnosed with the noise of real diagnoses.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, MaintenanceEvent, SourceRecord, Usage
from ehadiag.model.registry import FAULT_NAMES
from ehadiag.prognosis.averaging import Fleet, learn_fleet
from ehadiag.prognosis.forecast import forecast
from ehadiag.prognosis.lives import Life, lives_of
from ehadiag_tools.prognosis.laws import GRID_H, HELD_OUT, LAWS, LONGEST_H, TUNED
from ehadiag_tools.study import Options, Record, Study, markdown

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


SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares of the last life at which remaining life is forecast, 1."""
SETS = {"tuned": tuple(TUNED), "held-out": tuple(HELD_OUT), "all": tuple(LAWS)}
UNITS_PER_FLEET = 4
"""Number of units of a law that are forecast beside the same fleet."""
CENSORED_SHARE = (0.3, 0.8)
"""Shares of its last life at which a unit of a censored fleet is taken out, 1."""


@dataclass(frozen=True, slots=True)
class LifeCase:
    """A simulated unit, its law of wear, size and number of its fleet, seed of all."""

    unit: int
    law: str
    fleet: int
    group: int
    censored: bool
    seed: int


def perform(case: LifeCase) -> Record:
    """Forecast a unit's remaining life at each of `SHARES`.

    Of each: the share, the true remaining life over the life's length, whether the check raised an
    alarm, and the quantiles of the forecast; None where there is no number.
    """
    unit = simulate_unit(case.law, case.unit, read_noise(), case.seed)
    lives, fleet = _fleet(case.law, case.fleet, case.group, case.censored, case.seed)
    length = unit.end - unit.born
    asked = []
    for share in SHARES:
        life, earlier = _lives_until(unit, share)
        if len(life.age) < 2:
            continue
        own = learn_fleet([*lives, *earlier], fleet.scale, case.seed) if earlier else fleet
        found = forecast(unit.name, "hours", life, own, (LIMIT,), case.seed)
        (left,) = found.remaining
        ends = None if left.median is None else np.array([left.low, left.median, left.high])
        numbers = None if ends is None else (ends / length).tolist()
        true = (unit.end - life.born - life.age[-1]) / length
        asked.append((share, true, bool(found.alarm), numbers))
    return {"asked": asked}


@lru_cache(maxsize=1)
def _fleet(law: str, size: int, group: int, censored: bool, seed: int) -> tuple[list[Life], Fleet]:
    """Lives of further units of a law, and what is learned from them."""
    noise, lives = read_noise(), []
    for number in range(10_000 * (group + 1), 10_000 * (group + 1) + size):
        unit = simulate_unit(law, number, noise, seed)
        share = np.random.default_rng((seed, number)).uniform(*CENSORED_SHARE) if censored else 1.0
        life, earlier = _lives_until(unit, float(share))
        lives += [item for item in (*earlier, life) if len(item.age) > 1]
    scale = float(np.median([life.age[-1] for life in lives])) if lives else 1000.0
    return lives, learn_fleet(lives, scale, seed)


def _lives_until(unit: WornUnit, share: float) -> tuple[Life, list[Life]]:
    """Last life as the history has it at a share of it, and the earlier ones."""
    now = unit.born + share * (unit.end - unit.born)
    entries = [item for item in unit.entries if (item.usage.hours or 0.0) <= now]
    found = lives_of(entries, unit.events, unit.name, "hours").values()
    none = np.empty(0)
    lives = next(iter(found), [Life(0, none, none, none, 0.0)])
    return lives[-1], lives[:-1]


def _cases(options: Options) -> list[LifeCase]:
    laws = SETS[options.laws]
    each = -(-options.cases // len(laws))
    return [
        LifeCase(
            place, law, options.fleet, place // UNITS_PER_FLEET, options.censored, options.seed
        )
        for law in laws
        for place in range(each)
    ]


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--laws", choices=SETS, default="all", help="(%(default)s)")
    parser.add_argument("--fleet", type=int, default=20, help="units of the fleet (%(default)d)")
    parser.add_argument("--censored", action="store_true", help="taken out before the limit")


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    fleet = f"fleet of {options.fleet}{' taken out early' if options.censored else ''}"
    yield f"{len(records)} units, laws {options.laws}, seed {options.seed}, {fleet}\n"
    rows: list[tuple[str, ...]] = [("all", *_cells(records))]
    for law in SETS[options.laws]:
        part = [item for item in records if item["law"] == law]
        rows += [(law, *_cells(part))] if part else []
    for share in SHARES:
        rows.append((f"{share:.0%} of the life", *_cells(records, share)))
    heads = ("", "questions", "answered", "covered", "too late", "score", "alarms")
    yield from markdown(heads, rows)


def _cells(records: Sequence[Record], share: float | None = None) -> tuple[str, ...]:
    """Cells of the answers at a share of the life; None: at all of them."""
    asked = [item for record in records for item in record["asked"] if share in (None, item[0])]
    given = [(true, np.array(found)) for _, true, _, found in asked if found is not None]
    if not given:
        return (str(len(asked)), "0.0%", "–", "–", "–", "–")
    covered = np.mean([found[0] <= true <= found[2] for true, found in given])
    late = np.mean([true < found[0] for true, found in given])
    score = np.mean([quantile_score(true, found) for true, found in given])
    alarms = np.mean([alarm for _, _, alarm, _ in asked])
    return (
        str(len(asked)), f"{len(given) / len(asked):.1%}", f"{covered:.3f}", f"{late:.3f}",
        f"{score:.4f}", f"{alarms:.1%}",
    )  # fmt: skip


def quantile_score(true: float, found: NDArray[np.float64]) -> float:
    """Continuous ranked probability score by three quantiles: twice their mean pinball loss."""
    levels = np.array((0.1, 0.5, 0.9))
    return float(2.0 * np.mean(np.maximum(levels * (true - found), (levels - 1) * (true - found))))


PROGNOSIS = Study(
    "prognosis",
    "Remaining life of simulated units that wear by laws unknown to the forecast.",
    _cases, perform, _report, add_options=_add_options, counted="units",
)  # fmt: skip
