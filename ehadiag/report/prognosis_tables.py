"""Tables, sentences and JSON objects of remaining life."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ehadiag.model.severities import FAULT_LAWS
from firmware_iface.errors import printable

if TYPE_CHECKING:
    from ehadiag.prognosis.forecast import Forecast, RemainingLife
    from ehadiag.prognosis.units import Prognosis

PROGNOSIS_SCHEMA = "ehadiag.rul/2"
LEVEL_NAMES = ("advisory", "limit")
SHORT_NAMES = {name: law.short for name, law in FAULT_LAWS.items()}
AT_LIMIT = "at its limit"
FIGURES = 2
"""Figures of a time that is printed, 1: an interval of 80 % carries no more."""
LEAST_CHANCE = 0.01
"""Chance, 1, that is worth a word and a number."""
WIDE_RANGE = 10.0
"""Ratio of the ends of an interval, 1, beyond which no time is given, only the earliest one."""


def print_prognosis(
    prognosis: Prognosis, console: Console, before: tuple[str, float | None] | None = None
) -> None:
    """Print a prognosis.

    before: the next inspection: as it was named, and hours, cycles or days until it.
    """
    head = f"unit {prognosis.serial}, actuator type {printable(prognosis.actuator or 'unknown')}"
    used = f"{prognosis.used} of {prognosis.diagnoses} diagnoses say {prognosis.unit}"
    console.print(f"{head}: {used}")
    for line in _sentences(prognosis, before):
        console.print(f"  {line}")
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("severity", no_wrap=True)
    table.add_column("now", justify="right", no_wrap=True)
    for name, level in named_levels(prognosis):
        table.add_column(f"{prognosis.unit} to {name} {level:g} (80 % interval)", overflow="fold")
    table.add_column("wear", overflow="fold")
    for item in prognosis.forecasts:
        cells = [remaining_text(left) for left in item.remaining]
        now = "-" if item.value is None else f"{item.value:.4f}"
        table.add_row(item.name, now, *cells, _wear_text(item))
    console.print(table, crop=False)
    for item in prognosis.forecasts:
        if item.note:
            console.print(f"  {item.name}: {item.note}")
        if item.alarm:
            console.print(f"  ALARM: {item.name} {item.alarm}")


def print_urgencies(
    found: Sequence[Prognosis], console: Console, before: Sequence[float | None] | None = None
) -> None:
    """Print one line for each unit, those that reach the limit first at the top.

    found: of the units, in the order of the table; console: console to print to; before: hours,
    cycles or days of each until the next inspection; None: its use a day is not known.
    """
    firsts = [item.first() for item in found]
    dates = [
        _date(item, first[1]) if first and not first[1].reached else None
        for item, first in zip(found, firsts, strict=True)
    ]
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    heads = ["serial", "actuator", "first", "now", "to the limit (80 % interval)"]
    heads += ["about (date)"] * any(dates) + ["chance before"] * bool(before) + ["alarms"]
    for name in heads:
        table.add_column(name, overflow="fold", no_wrap=name in ("actuator", "about (date)"))
    for place, (item, first) in enumerate(zip(found, firsts, strict=True)):
        severity, left = ("-", _no_number(item)) if first is None else _urgency_texts(item, first)
        kind = printable(item.actuator or "unknown")
        cells = [str(item.serial), kind, severity, _usage_text(item), left]
        if any(dates):
            cells.append(dates[place] or "-")
        if before:
            ahead = before[place]
            chance = "its use a day is not known" if ahead is None else _chance(item, ahead)
            cells.append(left if left == AT_LIMIT else chance)
        alarms = [SHORT_NAMES[part.name] for part in item.forecasts if part.alarm]
        table.add_row(*cells, ", ".join(alarms) or "-")
    console.print(table, crop=False)


def _urgency_texts(prognosis: Prognosis, first: tuple[Forecast, RemainingLife]) -> tuple[str, str]:
    """Plain name of the severity that is first, and time until then."""
    severity, left = first
    time = AT_LIMIT if left.reached else remaining_text(left, f" {prognosis.unit}")
    return SHORT_NAMES[severity.name], time


def _no_number(prognosis: Prognosis) -> str:
    """Why no severity has a number, in short: of several reasons that of the most worn one."""
    if all(item.too_few for item in prognosis.forecasts):
        return "too few diagnoses"
    return remaining_text(max(prognosis.forecasts, key=lambda i: i.value or 0.0).remaining[-1])


def _usage_text(prognosis: Prognosis) -> str:
    """Usage that the times left are counted from, in short."""
    if prognosis.unit == "days":
        return "-"
    if prognosis.usage_stated:
        return f"{prognosis.usage_now:g} {prognosis.unit}"
    if prognosis.usage_now is not None:
        return f"about {_rounded(prognosis.usage_now)} {prognosis.unit}"
    ages = [item.at for item in prognosis.forecasts if item.at is not None]
    if (at := max(ages, default=prognosis.usage_tested)) is None:
        return "-"
    when = f" on {prognosis.last_test[:10]}" if prognosis.last_test else ""
    return f"{at:g} {prognosis.unit}{when}"


def counted_from(prognosis: Prognosis) -> str:
    """Say from when on times left are counted."""
    test = f"test of {prognosis.last_test[:10]}" if prognosis.last_test else "last diagnosis"
    if prognosis.usage_now is None:
        return f"from the {test}; the usage since then is not known"
    if prognosis.unit == "days":
        return "from now"
    if prognosis.usage_stated:
        return f"from now, {_usage_text(prognosis)}"
    rate = f"{_rounded(prognosis.per_day or 0.0)} {prognosis.unit} a day"
    return f"from now, {_usage_text(prognosis)} by {rate} since the {test}"


def _sentences(prognosis: Prognosis, before: tuple[str, float | None] | None) -> list[str]:
    """What a planner wants to know, in sentences."""
    out, reached = [], False
    if (first := prognosis.first()) is not None:
        item, left = first
        assert left.median is not None
        assert left.low is not None
        assert left.high is not None
        reached = left.reached
        chance = left.chance_within(0.0) or 0.0
        past = chance_text(chance)
        if reached:
            out.append(f"First: {SHORT_NAMES[item.name]} is {AT_LIMIT}.")
        elif left.median <= 0.0:
            out.append(f"First: {SHORT_NAMES[item.name]} may have reached its limit: {past}.")
        else:
            when = f" ({date})" if (date := _date(prognosis, left)) else ""
            out.append(
                f"First: {SHORT_NAMES[item.name]} reaches its limit in about"
                f" {_rounded(left.median)} {prognosis.unit}{when},"
                f" {_rounded(left.low)} to {_rounded(left.high)} with 80 %."
                + f" It may be past its limit: {past}."
                * (chance >= LEAST_CHANCE)
            )
        if not reached:
            out.append(f"Counted {counted_from(prognosis)}.")
    if before is not None and not reached:
        name, time = before
        assert time is not None  # or there is an error
        if is_number(name):
            name = f"{name} {prognosis.unit}"
        without = [i.name for i in prognosis.forecasts if i.remaining[-1].median is None]
        rest = f"; without {', '.join(without)}: no number" if without else ""
        out.append(
            f"Chance of a severity at its limit before {name}: {_chance(prognosis, time)}{rest}."
        )
    return out


def is_number(text: str) -> bool:
    """Whether the next inspection was named by a number; 20261231 is a date."""
    for kind in (datetime.fromisoformat, float):
        with contextlib.suppress(ValueError):
            return isinstance(kind(text), float)
    return False


def remaining_text(left: RemainingLife, unit: str = "") -> str:
    """Write hours, cycles or days to a level, 80 % interval in brackets, or why there are none."""
    if left.median is None or left.low is None or left.high is None:
        return f"no number: {left.why}"
    if left.reached:
        return "reached"
    past = left.chance_within(0.0) or 0.0
    may = f"may be past: {chance_text(past)}" if past >= LEAST_CHANCE else ""
    if left.median <= 0.0:
        return may
    time = f"{_rounded(left.median)} ({_rounded(left.low)} … {_rounded(left.high)}){unit}"
    return f"{time}, {may}" if may else time


def _rounded(value: float) -> str:
    if value <= 0.0:
        return "0"
    digits = 1 + math.floor(math.log10(value))
    return f"{round(value, FIGURES - digits):.{max(FIGURES - digits, 0)}f}"


def _chance(prognosis: Prognosis, time: float) -> str:
    chance = prognosis.chance_within(time)
    return "no number" if chance is None else chance_text(chance)


def _date(prognosis: Prognosis, left: RemainingLife) -> str | None:
    return None if left.median is None else prognosis.date_after(left.median)


def named_levels(prognosis: Prognosis) -> list[tuple[str, float]]:
    """Levels with their names."""
    return list(zip(LEVEL_NAMES, prognosis.levels, strict=True))


def prognosis_tree(
    prognosis: Prognosis, before: tuple[str, float | None] | None = None
) -> dict[str, Any]:
    """Return a prognosis as a JSON object.

    prognosis: what the history says; before: the next inspection: as it was named, and hours,
    cycles or days until it; None: not known. Returns plain values, null where there is no number.
    """
    first, ahead = prognosis.first(), before[1] if before else None
    return {
        "schema": PROGNOSIS_SCHEMA,
        "serial": prognosis.serial,
        "actuator": prognosis.actuator,
        "unit": prognosis.unit,
        "diagnoses": prognosis.diagnoses,
        "used": prognosis.used,
        "seed": prognosis.seed,
        "first": first and first[0].name,
        "per_day": prognosis.per_day,
        "today": prognosis.now[:10],
        "usage_now": prognosis.usage_now,
        "usage_stated": prognosis.usage_stated,
        "last_test": prognosis.last_test,
        "before": before and before[0],
        "chance_before": None if ahead is None else prognosis.chance_within(ahead),
        "severities": {
            item.name: {
                "at": item.at,
                "estimate": item.value,
                "diagnoses": item.diagnoses,
                "fleet": item.fleet,
                "weights": item.weights,
                "note": item.note or None,
                "alarm": item.alarm or None,
                "remaining": {
                    name: {
                        "level": left.level,
                        "median": left.median,
                        "interval80": None if left.median is None else [left.low, left.high],
                        "date": _date(prognosis, left),
                        "reached": left.reached,
                        "chance_past": left.chance_within(0.0),
                        "chance_before": None if ahead is None else left.chance_within(ahead),
                        "why": left.why or None,
                    }
                    for name, left in zip(LEVEL_NAMES, item.remaining, strict=True)
                },
            }
            for item in prognosis.forecasts
        },
    }


def _wear_text(item: Forecast) -> str:
    if not item.weights:
        return "-"
    lives = f"{item.fleet} other li{'fe' if item.fleet == 1 else 'ves'}"
    return f"mostly {item.process}, {item.diagnoses} diagnoses, {lives}"


def remaining_sentences(prognosis: Prognosis, names: Collection[str] | None = None) -> list[str]:
    """Return when severities reach the limit, the soonest first; only those with a number.

    prognosis: what the history says; names: of the severities; None: all. Returns sentences; one
    whose interval is wide says only the earliest time.
    """
    found = []
    for item in prognosis.forecasts:
        left = item.remaining[-1]
        if names is not None and item.name not in names:
            continue
        if left.median is None or left.low is None or left.high is None or left.reached:
            continue
        unit = "h" if prognosis.unit == "hours" else prognosis.unit
        low, high = two_digits(max(left.low, 0.0)), two_digits(left.high)
        when = f"reaches its limit in about {two_digits(left.median)} {unit}"
        when += f" (80 %: {low} to {high} {unit})"
        if left.low > 0.0 and left.high > WIDE_RANGE * left.low:
            when = f"reaches its limit not before about {low} {unit}"
        past = left.chance_within(0.0) or 0.0
        if left.median <= 0.0:
            when = f"may have reached its limit: {chance_text(past)}"
        elif left.low <= 0.0:
            when += f"; it may be past it: {chance_text(past)}"
        text = f"{SHORT_NAMES[item.name]} {when}{_counted(prognosis)}."
        found.append((left.median, text[0].upper() + text[1:]))
    return [text for _, text in sorted(found)]


def _counted(prognosis: Prognosis) -> str:
    """Say from when on times left are counted, where that is not the day of the last test."""
    last = (prognosis.last_test or prognosis.now)[:10]
    if last == prognosis.now[:10]:
        return ""
    if prognosis.usage_now is None:
        return f", from the test of {last}"
    unit = "h" if prognosis.unit == "hours" else prognosis.unit
    return "" if unit == "days" else f", from now at about {two_digits(prognosis.usage_now)} {unit}"


def two_digits(value: float) -> str:
    """Write a number with two digits that count."""
    return f"{float(f'{value:.2g}'):g}"


def chance_text(chance: float) -> str:
    """Write a chance in percent; none is promised or ruled out."""
    if not LEAST_CHANCE <= chance <= 1.0 - LEAST_CHANCE:
        return "below 1 %" if chance < LEAST_CHANCE else "above 99 %"
    return f"{100.0 * chance:.0f} %"
