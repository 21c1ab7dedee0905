"""Forecasts of one unit, or of all, from the diagnoses and events of a health history."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from os import PathLike
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.assess.verdict import Levels
from ehadiag.core.criteria import VERDICT
from ehadiag.history.records import (
    Entry,
    MaintenanceEvent,
    Usage,
    continued_usage,
    counted_entries,
    current_utc_text,
    is_swap,
)
from ehadiag.history.store import History
from ehadiag.prognosis.averaging import learn_fleet
from ehadiag.prognosis.forecast import Forecast, RemainingLife
from ehadiag.prognosis.forecast import forecast as severity_forecast
from ehadiag.prognosis.lives import USAGE_UNITS, Life, days_of, lives_of, usage_of
from firmware_iface.errors import ConfigurationError

MIN_DAYS_FOR_DATES = 7.0
"""Days between first and last diagnosis, from which on use a day is known well enough for dates."""


class Prognosis(msgspec.Struct, frozen=True):
    """Forecasts of one unit."""

    serial: int
    actuator: str | None
    """None: the history does not know the unit."""
    unit: str
    """One of `USAGE_UNITS`."""
    diagnoses: int
    """That count, of this unit."""
    used: int
    """Of these, those of the same actuator as the last that say hours (or cycles)."""
    levels: tuple[float, ...]
    forecasts: tuple[Forecast, ...]
    seed: int
    per_day: float | None
    """Hours or cycles a calendar day, between first and last diagnosis; None where not known."""
    now: str
    """Begin of the day that it was made: UTC, ISO 8601; the same digits all day."""
    usage_now: float | None = None
    """Hours or cycles by now, which times left are counted from: stated, else by the use a day;
    None: not known, they are counted from the last diagnosis."""
    usage_stated: bool = False
    """Whether the caller stated `usage_now`."""
    last_test: str | None = None
    """Date of the last dated test; None without any."""
    usage_before: float = 0.0
    """Hours or cycles of units that were swapped before this one."""
    usage_tested: float | None = None
    """Hours or cycles at the last diagnosis; None: none says, or the unit was swapped since."""

    def first(self, place: int = -1) -> tuple[Forecast, RemainingLife] | None:
        """Return the severity whose median reaches a level first; None without a number."""
        found = [
            (item, item.remaining[place])
            for item in self.forecasts
            if item.remaining[place].median is not None
        ]
        return min(found, key=lambda i: (not i[1].reached, i[1].median or 0.0), default=None)

    def chance_within(self, time: float, place: int = -1) -> float | None:
        """Chance that any severity reaches a level within a time; those without a number apart."""
        chances = [item.remaining[place].chance_within(time) for item in self.forecasts]
        known = [chance for chance in chances if chance is not None]
        return float(1.0 - np.prod(1.0 - np.array(known))) if known else None

    def date_after(self, time: float) -> str | None:
        """Return the day a time from now at the unit's use a day; None where that is not known."""
        if not self.per_day or abs(time / self.per_day) > 36500.0:
            return None
        moment = datetime.fromisoformat(self.now) + timedelta(days=time / self.per_day)
        return moment.date().isoformat()

    def time_until(self, date: str) -> float:
        """Return hours, cycles or days until a date at the unit's use a day.

        Parameters
        ----------
        date : str
            ISO 8601.

        Returns
        -------
        float
            Not below 0.

        Raises
        ------
        ConfigurationError
            It is no date, or past, or the unit's use a day is not known.
        """
        try:
            moment = datetime.fromisoformat(date)
        except ValueError:
            raise ConfigurationError(f"{date}: need a date, ISO 8601, or a number") from None
        ahead = days_of((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).isoformat())
        if ahead < days_of(self.now):
            raise ConfigurationError(f"{date}: is past")
        if not self.per_day:
            raise ConfigurationError(
                f"{date}: the use a day of serial {self.serial} is not known; name {self.unit}"
            )
        return max(ahead - days_of(self.now), 0.0) * self.per_day


def prognosis_of(
    serial: int,
    entries: Sequence[Entry],
    events: Sequence[MaintenanceEvent],
    levels: Sequence[float],
    unit: str | None = None,
    seed: int = 0,
    *,
    today: Usage | None = None,
    actuator: str | None = None,
    now: str | None = None,
) -> Prognosis:
    """Forecast each severity of a unit.

    entries: diagnoses of the unit and its fleet, in the order in which they were appended. Units of
    the same actuator are the fleet; simulated ones are none of a real unit's. events: their
    maintenance events; levels, unit, seed: see `prognosis_in`; the same seed gives the same digits;
    today: hours and cycles of the unit by now; None: by its use a day since its last dated test,
    where that is known, else those at its last diagnosis; actuator: of the unit, where its serial
    number is another actuator's too; None: that of the last diagnosis; now: day: UTC, ISO 8601;
    None: today. ConfigurationError: it is used less today than at its last diagnosis, or in another
    unit of usage.
    """
    counted = counted_entries(entries)
    own = [i for i in counted if i.serial == serial and actuator in (None, i.actuator)]
    if unit is None:
        unit = max(
            ("hours", "cycles"), key=lambda n: sum(i.usage.amount(n) is not None for i in own)
        )
    last = own[-1] if own else None
    kind = (last.actuator, last.simulated) if last else (None, False)
    alike = [item for item in counted if (item.actuator, item.simulated) == kind]
    now = f"{(now or current_utc_text())[:10]}T00:00:00.000Z"
    names = dict.fromkeys(part.name for item in alike for part in item.severities)
    alike, changes, bases = continued_usage(
        alike, [item for item in events if item.actuator in (None, kind[0])], names
    )
    before = bases.get(serial, Usage()).amount(unit) or 0.0
    same = [item for item in alike if item.serial == serial]
    used = [item for item in same if usage_of(item, unit) is not None]
    rate, dated = _use_a_day(used, unit)
    if dated and dated[0] >= days_of(now) + 1.0:
        rate = None  # the clock is wrong
    last_at = max((usage_of(item, unit) or 0.0 for item in used), default=None)
    tested = max((item.when for item in used), default="")
    if any(i.serial == serial and i.when >= tested and is_swap(i, names) for i in changes):
        last_at = rate = None  # those of the unit that was taken out
    stated = _stated_usage(today, unit, (last_at or 0.0) - before)
    at = None
    if stated is not None:
        at = before + stated
    elif rate and dated:
        at = max(last_at or 0.0, dated[1] + rate * max(days_of(now) - dated[0], 0.0))
    forecasts, none = [], np.empty(0)
    for name in names:
        lives = lives_of(alike, changes, name, unit)
        mine = lives.pop(serial, [])
        present = mine[-1] if mine else Life(serial, none, none, none, 0.0)
        others = [*mine[:-1], *(life for several in lives.values() for life in several)]
        ages = [life.age[-1] for life in (present, *others) if len(life.age)]
        fleet = learn_fleet(others, float(np.quantile(ages, 0.5)) if ages else 1.0, seed)
        elapsed = 0.0
        if at is not None and len(present.age):
            elapsed = max(at - present.born - float(present.age[-1]), 0.0)
        present = replace(present, born=present.born - before)  # the swapped one's own hours
        forecasts.append(severity_forecast(name, unit, present, fleet, levels, seed, elapsed))
    return Prognosis(
        serial, kind[0], unit, len(own), len(used), tuple(levels), tuple(forecasts), seed,
        rate, now, None if at is None else at - before, stated is not None,
        max((item.tested for item in used if item.tested), default=None), before,
        None if last_at is None else last_at - before,
    )  # fmt: skip


def _stated_usage(today: Usage | None, unit: str, least: float) -> float | None:
    """Stated hours or cycles of today; ConfigurationError where they cannot be."""
    if today is None or not today.known:
        return None
    if (stated := today.amount(unit)) is None:
        raise ConfigurationError(f"usage of today: not stated in {unit}, those of the answer")
    if stated < least:
        raise ConfigurationError(f"{unit} {stated:g}: were {least:g} at the last diagnosis already")
    return stated


def _use_a_day(
    entries: Sequence[Entry], unit: str
) -> tuple[float | None, tuple[float, float] | None]:
    """Hours or cycles a calendar day by dated diagnoses; day and usage of the last one."""
    dated = sorted(
        (days_of(item.tested or item.when), usage_of(item, unit) or 0.0)
        for item in entries
        if item.tested or unit == "days"
    )
    if not dated:
        return None, None
    if unit == "days":
        return 1.0, dated[-1]
    apart = dated[-1][0] - dated[0][0]
    rate = (dated[-1][1] - dated[0][1]) / apart if apart >= MIN_DAYS_FOR_DATES else 0.0
    return (rate if rate > 0.0 else None), dated[-1]


def forecast(
    history: History | str | PathLike[str],
    serial: int,
    *,
    advisory: float = VERDICT.advisory,
    limit: float = VERDICT.limit,
    unit: str | None = None,
    today: Usage | None = None,
    actuator: str | None = None,
    seed: int = 0,
) -> Prognosis:
    """Forecast each severity of a unit of a health history.

    Parameters
    ----------
    history : History | str | PathLike[str]
        An open history, or its file.
    serial : int
        Of the unit.
    advisory : float
        Severity of the first level, 1.
    limit : float
        Severity of the second level, 1.
    unit : str | None
        `hours`, `cycles` or `days`; None: what more of the unit's diagnoses say.
    today : Usage | None
        Hours and cycles of the unit by now; None: by its use a day since its last dated test, where
        that is known, else those at its last diagnosis.
    actuator : str | None
        Of the unit, where its serial number is another actuator's too.
    seed : int
        Of the draws; the same seed gives the same digits.

    Returns
    -------
    Prognosis
        One forecast for each severity, each with a number or why there is none.

    Raises
    ------
    ConfigurationError
        The history does not know the unit, several actuators have its serial number, or a value is
        none.
    """
    if unit not in (None, *USAGE_UNITS):
        raise ConfigurationError(f"unit {unit}: there is {', '.join(USAGE_UNITS)}")
    if not (isinstance(seed, int) and seed >= 0):
        raise ConfigurationError(f"seed {seed}: need a whole number of at least 0")
    Levels(advisory, limit)
    if not isinstance(history, History):
        with History(Path(history)) as opened:
            return forecast(
                opened, serial, advisory=advisory, limit=limit, unit=unit, today=today,
                actuator=actuator, seed=seed,
            )  # fmt: skip
    actuator = history.actuator_of(serial, actuator)
    entries, events = history.alike(serial, actuator)
    return prognosis_of(
        serial, entries, events, (advisory, limit), unit, seed, today=today, actuator=actuator
    )


def prognosis_in(
    path: Path,
    levels: Sequence[float],
    unit: str | None,
    seed: int,
    now: str,
    which: tuple[str, int],
) -> Prognosis:
    """Forecast one unit of a history file, here or in another process.

    levels: that are to be reached, 0 … 1, rising; unit: one of `USAGE_UNITS`; None: the one that
    more of the unit's diagnoses say; now: day: UTC, ISO 8601; the same for all units; which:
    actuator and serial number.
    """
    actuator, serial = which
    with History(path) as history:
        entries, events = history.alike(serial, actuator)
    return prognosis_of(serial, entries, events, levels, unit, seed, actuator=actuator, now=now)
