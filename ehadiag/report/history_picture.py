"""Draws a unit's health history: each severity over hours, cycles or time, with its events."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial

import matplotlib
import numpy as np

from ehadiag.core.printable import printable
from ehadiag.history.records import Entry, Event, Usage
from ehadiag.report.picture import Picture

__all__ = ["draw_history"]

COLOURS = ("#0072b2", "#d55e00", "#009e73")
"""Okabe and Ito's, which colour-blind people tell apart; the markers differ too."""
MARKERS = "os^"
LEAST_RANGE = 0.05
"""Of the axis of severities: what differs by less is mostly noise."""


def draw_history(entries: Sequence[Entry], events: Sequence[Event]) -> bytes:
    """Return the picture of one unit's history as a PNG.

    Parameters
    ----------
    entries : Sequence[Entry]
        Its diagnoses; at least one has severities.
    events : Sequence[Event]
        Its maintenance events.

    Returns
    -------
    bytes
        The file's content.
    """
    with matplotlib.rc_context(matplotlib.rcParamsDefault), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)  # in texts of others
        label, place = _axis(entries)
        figure = Picture(figsize=(10.0, 5.0), layout="constrained")
        axes = figure.add_subplot()
        names = next(tuple(s.name for s in item.severities) for item in entries if item.severities)
        for index, name in enumerate(names):
            found = [
                (place(entry.usage, entry.when), item.estimate, item.low, item.high)
                for entry in entries
                for item in entry.severities
                if item.name == name
                and item.estimate is not None
                and item.low is not None
                and item.high is not None
            ]
            if not found:
                continue
            at, values, lows, highs = np.array(sorted(found)).T
            errors = np.maximum([values - lows, highs - values], 0.0)
            colour, marker = COLOURS[index % 3], MARKERS[index % 3]
            axes.errorbar(
                at, values, errors, label=name, color=colour, marker=marker, lw=1.0, ms=4.0,
                capsize=2.0,
            )  # fmt: skip
        for event in events:
            if label != "time" and _amount(event.usage, label) is None:
                continue
            x = place(event.usage, event.when)
            axes.axvline(x, color="#555555", lw=0.8, ls="--")
            axes.text(
                x, 1.0, f" {printable(event.text)[:40]}", rotation=90, va="top", fontsize=8,
                transform=axes.get_xaxis_transform(), parse_math=False,
            )  # fmt: skip
        if label == "time":
            axes.xaxis_date()
        top = max(LEAST_RANGE, axes.get_ylim()[1])
        axes.set_ylim(-0.02 * top, top)
        axes.set_xlabel(label)
        axes.set_ylabel("severity, 95 % interval")
        axes.legend(loc="upper left")
        title = f"{printable(entries[-1].actuator)}, serial {entries[-1].serial}"
        axes.set_title(title, parse_math=False)
        return figure.png()


def _axis(entries: Sequence[Entry]) -> tuple[str, Callable[[Usage, str], float]]:
    """Hours where every diagnosis says them, else cycles, else the time of day (days)."""
    for label in ("hours", "cycles"):
        if all(_amount(entry.usage, label) is not None for entry in entries):
            return label, partial(_usage, label)
    return "time", _days


def _days(_usage: Usage, when: str) -> float:
    """Days since 1970, which is how matplotlib holds dates."""
    return datetime.fromisoformat(when).timestamp() / 86400.0


def _usage(label: str, usage: Usage, _when: str) -> float:
    return _amount(usage, label) or 0.0


def _amount(usage: Usage, label: str) -> float | None:
    return usage.hours if label == "hours" else usage.cycles
