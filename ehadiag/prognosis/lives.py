"""How a severity grew from one renewal of the part to the next, in the health history."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ehadiag.history.records import Entry, Event, Usage

__all__ = ["RESOLVED", "UNITS", "Increments", "Life", "increments_of", "lives_of"]

UNITS = ("hours", "cycles")
RESOLVED = 5.0
"""Least change between two diagnoses that is looked at, in deviations of their noise: the noise
then has at most 4 % of the change's mean square, and no correlation that matters."""
FELL = 3.0
"""Deviations by which a severity falls where an event that names none renewed it."""


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """Diagnoses of one severity of a unit since it was new or renewed; shape (diagnoses,) each."""

    serial: int
    age: NDArray[np.float64]
    """Hours or cycles since then, rising strictly."""
    value: NDArray[np.float64]
    std: NDArray[np.float64]
    born: float
    """Hours or cycles of the unit at its beginning."""


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """Growth of a severity between diagnoses that tell it from noise; shape (increments,) each."""

    start: NDArray[np.float64]
    """Age at the first of the two diagnoses."""
    end: NDArray[np.float64]
    low: NDArray[np.float64]
    """Severity at the first of the two."""
    high: NDArray[np.float64]
    low_std: NDArray[np.float64]
    high_std: NDArray[np.float64]
    life: NDArray[np.int64]
    """Which life each one is of, from 0."""
    lives: int

    def __len__(self) -> int:
        """Number of increments."""
        return len(self.low)

    def pick(self, which: NDArray[np.intp]) -> Increments:
        """Return some of them, by their places."""
        return Increments(
            self.start[which],
            self.end[which],
            self.low[which],
            self.high[which],
            self.low_std[which],
            self.high_std[which],
            self.life[which],
            self.lives,
        )


def lives_of(
    entries: Sequence[Entry], events: Sequence[Event], name: str, unit: str
) -> dict[int, list[Life]]:
    """Cut the history of one severity into lives, by unit.

    Parameters
    ----------
    entries : Sequence[Entry]
        Diagnoses that count. Those without a verdict, without a serial number, without hours (or
        cycles) or whose test does not show the severity are left out.
    events : Sequence[Event]
        Maintenance: one that names the severity begins a new life; one that names none does where
        the severity fell across it. One without hours (or cycles) is placed by its date, right
        after the last diagnosis before it.
    name : str
        Of the severity.
    unit : str
        `hours` or `cycles`.

    Returns
    -------
    dict[int, list[Life]]
        Lives of each serial number, the present one last; empty ones are left out, but not the
        present one.
    """
    found: dict[int, list[tuple[float, float, float]]] = {}
    dated: dict[int, list[tuple[str, float]]] = {}
    for entry in entries:
        at = _amount(entry.usage, unit)
        if entry.serial is None or at is None or entry.verdict == "NOT_TESTED":
            continue
        dated.setdefault(entry.serial, []).append((entry.when, at))
        for item in entry.severities:
            if item.name == name and item.shown and item.estimate is not None and item.std:
                found.setdefault(entry.serial, []).append((at, item.estimate, item.std))
    out = {}
    for serial, read in found.items():
        rows = _merged(sorted(read))
        mine = [
            (item, _placed(item, dated[serial], unit)) for item in events if item.serial == serial
        ]
        births = [0.0, *sorted(_births(rows, mine, name))]
        out[serial] = [life for life in _cut(serial, rows, births) if len(life.age)]
        if not out[serial] or births[-1] > out[serial][-1].born:
            out[serial].append(_life(serial, [], births[-1]))
    return out


def increments_of(lives: Sequence[Life]) -> Increments:
    """Return the growth between diagnoses that are far enough apart to tell it from noise.

    Parameters
    ----------
    lives : Sequence[Life]
        Of one severity.

    Returns
    -------
    Increments
        Of all of them; a life without any has no row.
    """
    rows = [(*row, index) for index, life in enumerate(lives) for row in _resolved(life)]
    columns = np.array(rows, dtype=np.float64).reshape(-1, 7).T
    start, end, low, high, low_std, high_std, life = columns
    return Increments(start, end, low, high, low_std, high_std, life.astype(np.int64), len(lives))


def _resolved(life: Life) -> Iterator[tuple[float, ...]]:
    """Join increments until each is more than noise; what is left over goes to the last one."""
    kept = [0]
    for index in range(1, len(life.age)):
        if _clear(life, kept[-1], index):
            kept.append(index)
    if len(kept) > 1:
        kept[-1] = len(life.age) - 1 if _clear(life, kept[-2], len(life.age) - 1) else kept[-1]
    for first, second in itertools.pairwise(kept):
        columns = (life.age, life.value, life.std)
        yield tuple(float(column[at]) for column in columns for at in (first, second))


def _clear(life: Life, first: int, second: int) -> bool:
    spread = float(np.hypot(life.std[first], life.std[second]))
    return bool(abs(life.value[second] - life.value[first]) >= RESOLVED * spread)


def _placed(event: Event, dated: Sequence[tuple[str, float]], unit: str) -> float | None:
    """Hours or cycles at which an event was; by its date where it does not say."""
    said = _amount(event.usage, unit)
    if said is not None:
        return said
    return max((at for when, at in dated if when <= event.when), default=None)


def _births(
    rows: Sequence[tuple[float, float, float]],
    events: Sequence[tuple[Event, float | None]],
    name: str,
) -> Iterator[float]:
    """Hours or cycles at which the severity began anew."""
    for event, at in events:
        if at is None:
            continue
        before = [row for row in rows if row[0] <= at]
        after = [row for row in rows if row[0] > at]
        if event.resets:
            if name in event.resets:
                yield at
        elif before and after and _fell(before[-1], after[0]):
            yield at


def _fell(before: tuple[float, float, float], after: tuple[float, float, float]) -> bool:
    return before[1] - after[1] > FELL * float(np.hypot(before[2], after[2]))


def _cut(
    serial: int, rows: Sequence[tuple[float, float, float]], births: Sequence[float]
) -> Iterator[Life]:
    ends = [*births[1:], np.inf]
    for number, (born, end) in enumerate(zip(births, ends, strict=True)):
        # A diagnosis at the very hour of an event was made before the work.
        mine = [row for row in rows if (born < row[0] or number == 0) and row[0] <= end]
        yield _life(serial, mine, born)


def _life(serial: int, rows: Sequence[tuple[float, float, float]], born: float) -> Life:
    age, value, std = np.array(rows, dtype=np.float64).reshape(-1, 3).T
    return Life(serial, age - born, value, std, born)


def _merged(rows: Sequence[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Join diagnoses of the same hour by their weights."""
    out: list[tuple[float, float, float]] = []
    for at, value, std in rows:
        if out and out[-1][0] == at:
            _, other, spread = out[-1]
            one, two = 1.0 / spread**2, 1.0 / std**2
            out[-1] = (at, (other * one + value * two) / (one + two), (one + two) ** -0.5)
        else:
            out.append((at, value, std))
    return out


def _amount(usage: Usage, unit: str) -> float | None:
    return usage.hours if unit == "hours" else usage.cycles
