"""Describes the pictures of a unit's health history and of the channels on a bus."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from operator import itemgetter
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.core.conversion import Conversion
from ehadiag.history.records import Entry, MaintenanceEvent, continued_usage
from ehadiag.report.head import advised, percent, plain_name
from ehadiag.report.picture import (
    Area,
    Curve,
    Panel,
    Picture,
    PictureColumn,
    ReferenceLine,
)
from ehadiag.report.prognosis_tables import remaining_sentences
from firmware_iface.errors import EhadiagError, printable
from firmware_iface.recording import CommandMode, Samples

if TYPE_CHECKING:
    from ehadiag.prognosis.forecast import Forecast
    from ehadiag.prognosis.units import Prognosis

LEVEL_WORDS = (("advisory", "advisory level"), ("limit", "limit"))
X_LABELS = {"hours": "operating hours"}
"""What the horizontal axis says of a unit of use, where that is more than its name."""


def history_picture(
    entries: Sequence[Entry], events: Sequence[MaintenanceEvent], prognosis: Prognosis
) -> Picture:
    """Describe one unit's history over the prognosis' unit, else over time.

    There is a trend, see `has_trend`.
    """
    column = trend_column(entries, events, prognosis, numbered=False)
    last = entries[-1]
    column = replace(column, title=f"actuator type {printable(last.actuator)}")
    texts = [f"Unit {last.serial}", *first_to_the_limit(prognosis, kept_advice(last.result))]
    return Picture(
        ": ".join(texts[:2]) + "".join(f"\n{item}" for item in texts[2:]), (column,), True
    )


def first_to_the_limit(prognosis: Prognosis, advice: Mapping[str, str]) -> list[str]:
    """Say which severity reaches the limit first, and what to do where it is above the advisory."""
    advisory, limit = prognosis.levels
    if (found := prognosis.first()) is None:
        return []
    item, value = found[0], found[0].value or 0.0
    said = remaining_sentences(prognosis)[:1]
    if value >= limit:
        size = percent(value, advisory, limit)
        said = [f"{plain_name(item.name)} is at {size}, its limit is {percent(limit)}."]
    said = [f"{text[0].upper()}{text[1:]}" for text in said]
    action = advised(advice.get(item.name, ""), at_once=value >= limit)
    return [*said, action] if said and action and value >= advisory else said


def has_trend(entries: Sequence[Entry]) -> bool:
    """Whether any entry has severities that are relied on, which `trend_column` draws."""
    return any(entry.severities and entry.relied_on for entry in entries)


def trend_column(
    entries: Sequence[Entry],
    events: Sequence[MaintenanceEvent],
    prognosis: Prognosis,
    *,
    numbered: bool = True,
) -> PictureColumn:
    """Describe a unit's severities over hours or cycles, where the prognosis uses them, else time.

    Entries without hours (or cycles) are left out, and so are best fits of unexplained tests. Both
    levels are drawn, and of each forecast the median and the 80 % interval, up to some time after
    the first severity reaches the limit. Curves are broken at events, which are marked by their
    numbers from 1, or by their texts.
    """
    unit = prognosis.unit if prognosis.used else None
    levels = prognosis.levels
    known = [item.name for item in prognosis.forecasts]
    entries, events, _ = continued_usage(entries, events, known)
    changes = [(at, item) for item in events if (at := _abscissa(item, unit)) is not None]
    placed = [(at, item) for item in entries if (at := _abscissa(item, unit)) is not None]
    placed.sort(key=lambda pair: pair[0])
    names = dict.fromkeys(item.name for entry in entries for item in entry.severities)
    curves, low, high = [], 0.0, 100.0 * max(0.05, *levels, 0.0)
    for index, name in enumerate(names):
        rows = [
            (at, item.estimate, *item.interval95)
            for at, entry in placed
            if entry.relied_on
            for item in entry.severities
            if item.name == name and item.estimate is not None and item.interval95 is not None
        ]
        if rows:
            rows += [(at, *3 * (math.nan,)) for at, _ in changes]
            x, y, lows, highs = np.array(sorted(rows, key=itemgetter(0)), dtype=np.float64).T
            y, lows, highs = 100.0 * y, 100.0 * lows, 100.0 * highs
            curves.append(Curve(plain_name(name), f"severity {index % 3}", y, x, lows, highs))
            low, high = min(low, np.nanmin(lows)), max(high, np.nanmax(highs))
    lines = [
        ReferenceLine(100.0 * level, role, f"{words} {percent(level)}")
        for level, (role, words) in zip(levels, LEVEL_WORDS, strict=True)
    ]
    numbers = {id(event): number for number, event in enumerate(events, start=1)}
    lines += [
        ReferenceLine(
            at, "event", str(numbers[id(event)]) if numbered else printable(event.text)[:40],
            upright=True,
        )
        for at, event in changes
    ]  # fmt: skip
    tested = [at for at, entry in placed if entry.by_test]
    lines += [ReferenceLine(at, "last test", "last test", upright=True) for at in tested[-1:]]
    fans = [_fan(item, prognosis.usage_before, f"forecast {list(names).index(item.name) % 3}")
            for item in prognosis.forecasts if unit is not None and item.name in names]  # fmt: skip
    areas = tuple(area for fan in fans for area in fan[0])
    curves += [curve for fan in fans for curve in fan[1]]
    panel = Panel(
        "severity with 95 % interval", "%", np.array([at for at, _ in placed]), tuple(curves),
        lines=tuple(lines), areas=areas, y_range=(low - 0.02 * high, 1.12 * high),
    )  # fmt: skip
    until = None if unit is None else _until(prognosis, [at for at, _ in placed])
    x_range = None if until is None else (placed[0][0] - 0.02 * (until - placed[0][0]), until)
    x_label = "date" if unit is None else X_LABELS.get(unit, unit)
    x_label += ", with those of units swapped before" * bool(prognosis.usage_before)
    return PictureColumn("", (panel,), x_label, dates=unit is None, x_range=x_range)


def _until(prognosis: Prognosis, known: Sequence[float]) -> float | None:
    """End of the picture: the slower severities' forecasts may reach far beyond what matters."""
    ahead = [max(item.elapsed + median, 0.0) for item in prognosis.forecasts
             if (median := item.remaining[-1].median) is not None]  # fmt: skip
    if not ahead or len(known) < 2:
        return None
    until = known[-1] + max(1.5 * min(ahead), 0.5 * (known[-1] - known[0]))
    return until if until > known[0] else None


def _fan(item: Forecast, before: float, role: str) -> tuple[list[Area], list[Curve]]:
    """Area and median of a forecast, from the newest diagnosis to each level; none without one."""
    ahead = [
        (*(item.elapsed + x for x in (left.median, left.low, left.high)), left.level)
        for left in item.remaining
        if left.median is not None
        and left.low is not None
        and left.high is not None
        and math.isfinite(left.high)
        and not left.reached
    ]
    if not ahead or item.at is None or item.value is None:
        return [], []
    medians, lows, highs, levels = np.array([(0.0, 0.0, 0.0, item.value), *ahead]).T
    border, levels = np.concatenate([lows, highs[::-1]]), 100.0 * levels
    area = Area(role, before + item.at + border, np.concatenate([levels, levels[::-1]]))
    name = f"{plain_name(item.name)}, forecast"
    return [area], [Curve(name, role, levels, before + item.at + medians)]


def _abscissa(item: Entry | MaintenanceEvent, unit: str | None) -> float | None:
    if unit is None:
        return datetime.fromisoformat(item.when).timestamp()
    return item.usage.amount(unit)


def bus_picture(samples: Samples, conversion: Conversion, title: str) -> Picture:
    """Describe each channel, with the command of the commanded one and samples at range ends."""
    commanded = "position" if samples.mode is CommandMode.POSITION else "current"
    panels = []
    for channel, saturated in zip(conversion.channels, conversion.saturated, strict=True):
        values = np.asarray(getattr(samples, channel.name)) / channel.per_unit
        curves = [Curve("measured", "signal", values)]
        if channel.name == commanded and np.isfinite(samples.command).any():
            curves.append(Curve("command", "command", samples.command / channel.per_unit))
        if saturated.any():
            label = f"at the converter's end ({int(saturated.sum())})"
            at = np.flatnonzero(saturated)
            at = at[:: 1 + len(at) // 4000]
            curves.append(Curve(label, "saturated", values[at], samples.time[at]))
        full_scale = channel.full_scale / channel.per_unit
        panels.append(
            Panel(channel.name, channel.unit, samples.time, tuple(curves), full_scale=full_scale)
        )
    return Picture(printable(title), (PictureColumn("", tuple(panels), "time, s"),))


def kept_advice(line: str) -> dict[str, str]:
    """Return what to do about each severity by its name.

    line: JSON result that a history keeps; without one, as of a row that was imported, the advice
    is that of any actuator.
    """
    from ehadiag.core.actuator import Advice  # noqa: PLC0415 - not for help texts
    from ehadiag.result import Result  # noqa: PLC0415

    try:
        return {item.name: item.advice for item in Result.from_json(line).severities.values()}
    except (EhadiagError, ValueError):
        return msgspec.structs.asdict(Advice())
