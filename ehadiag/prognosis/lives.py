"""How a severity grew from one renewal of the part to the next, in the health history."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ehadiag.history.records import Entry, MaintenanceEvent

USAGE_UNITS = ("hours", "cycles", "days")
"""What age is counted in; days are those of the calendar."""
DAY_S = 86400.0
MIN_RENEWAL_FALL_STDS = 3.0
"""Deviations by which a severity falls where an event that names none renewed it."""


class Life(msgspec.Struct, frozen=True, eq=False):
    """Diagnoses of one severity of a unit since it was new or renewed; shape (diagnoses,) each."""

    serial: int
    age: NDArray[np.float64]
    """Hours, cycles or days since then, rising strictly."""
    value: NDArray[np.float64]
    std: NDArray[np.float64]
    born: float
    """Hours or cycles of the unit at its beginning; days since 1970."""


def days_of(when: str) -> float:
    """Return days since 1970 of a time, ISO 8601."""
    return datetime.fromisoformat(when).timestamp() / DAY_S


def usage_of(item: Entry | MaintenanceEvent, unit: str) -> float | None:
    """Return hours, cycles or days of a diagnosis or event; None where it does not say."""
    return days_of(item.when) if unit == "days" else item.usage.amount(unit)


def lives_of(
    entries: Sequence[Entry], events: Sequence[MaintenanceEvent], name: str, unit: str
) -> dict[int, list[Life]]:
    """Cut the history of one severity into lives, by unit.

    entries: diagnoses that count, of units of one actuator. Those without a verdict, without a
    serial number, without hours (or cycles) or whose test does not show the severity are left out.
    events: maintenance: one that names the severity begins a new life; one that names none does
    where the severity fell across it. One without hours (or cycles) is placed by its date, right
    after the last diagnosis before it. Those of another actuator are left out. unit: one of
    `USAGE_UNITS`. Returns lives of each serial number, the present one last; empty ones are left
    out, but not the present one.
    """
    found: dict[int, list[tuple[float, float, float]]] = {}
    dated: dict[int, list[tuple[str, float]]] = {}
    for entry in entries:
        at = usage_of(entry, unit)
        if entry.serial is None or at is None or not entry.relied_on:
            continue
        dated.setdefault(entry.serial, []).append((entry.when, at))
        for item in entry.severities:
            if item.name == name and item.shown and item.estimate is not None and item.std:
                found.setdefault(entry.serial, []).append((at, item.estimate, item.std))
    actuators = {None, *(entry.actuator for entry in entries)}
    out = {}
    for serial, read in found.items():
        rows = _merged(sorted(read))
        mine = [
            (item, _event_usage(item, dated[serial], unit))
            for item in events
            if item.serial == serial and item.actuator in actuators
        ]
        births = [rows[0][0] if unit == "days" else 0.0, *sorted(_renewals(rows, mine, name))]
        out[serial] = [life for life in _split_lives(serial, rows, births) if len(life.age)]
        if not out[serial] or births[-1] > out[serial][-1].born:
            out[serial].append(_life(serial, [], births[-1]))
    return out


def _event_usage(
    event: MaintenanceEvent, dated: Sequence[tuple[str, float]], unit: str
) -> float | None:
    """Hours or cycles at which an event was; by its date where it does not say."""
    at_event = usage_of(event, unit)
    if at_event is not None:
        return at_event
    return max((at for when, at in dated if when <= event.when), default=None)


def _renewals(
    rows: Sequence[tuple[float, float, float]],
    events: Sequence[tuple[MaintenanceEvent, float | None]],
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
        elif before and after and _is_renewed(before[-1], after[0]):
            yield at


def _is_renewed(before: tuple[float, float, float], after: tuple[float, float, float]) -> bool:
    return before[1] - after[1] > MIN_RENEWAL_FALL_STDS * float(np.hypot(before[2], after[2]))


def _split_lives(
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
