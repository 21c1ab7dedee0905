"""A prognosis for people and for programs: a table, and the JSON object `ehadiag.rul/1`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table

from ehadiag.core.printable import printable

if TYPE_CHECKING:
    from rich.console import Console

    from ehadiag.prognosis.forecast import Forecast, Remaining
    from ehadiag.prognosis.unit import Prognosis

__all__ = ["SCHEMA", "levels_named", "print_prognosis", "prognosis_object", "remaining_text"]

SCHEMA = "ehadiag.rul/1"
NAMES = ("advisory", "limit")


def print_prognosis(prognosis: Prognosis, console: Console) -> None:
    """Print a prognosis.

    Parameters
    ----------
    prognosis : Prognosis
        What the history says.
    console : Console
        Console to print to.
    """
    head = f"serial {prognosis.serial}, actuator {printable(prognosis.actuator or 'unknown')}"
    told = f"{prognosis.used} of {prognosis.diagnoses} diagnoses say {prognosis.unit}"
    console.print(f"{head}: {told}", soft_wrap=True)
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("severity", no_wrap=True)
    table.add_column("now", justify="right", no_wrap=True)
    for name, level in levels_named(prognosis):
        table.add_column(f"{prognosis.unit} to {name} {level:g}", overflow="fold")
    table.add_column("wear", overflow="fold")
    for item in prognosis.forecasts:
        cells = [remaining_text(left) for left in item.remaining]
        now = "-" if item.value is None else f"{item.value:.4f}"
        table.add_row(item.name, now, *cells, _wear(item))
    console.print(table, crop=False)
    for item in prognosis.forecasts:
        if item.alarm:
            console.print(f"  ALARM: {item.name} {item.alarm}", soft_wrap=True)


def remaining_text(left: Remaining) -> str:
    """Write hours or cycles to a level, or why there is no number."""
    if left.median is None or left.low is None or left.high is None:
        return f"no number: {left.why}"
    if left.high == 0.0:
        return "reached"
    return f"{left.median:.4g} (80 %: {left.low:.4g} … {left.high:.4g})"


def levels_named(prognosis: Prognosis) -> list[tuple[str, float]]:
    """Levels with their names."""
    return list(zip(NAMES, prognosis.levels, strict=True))


def prognosis_object(prognosis: Prognosis) -> dict[str, Any]:
    """Return a prognosis as a JSON object.

    Parameters
    ----------
    prognosis : Prognosis
        What the history says.

    Returns
    -------
    dict[str, Any]
        Plain values, null where there is no number.
    """
    return {
        "schema": SCHEMA,
        "serial": prognosis.serial,
        "actuator": prognosis.actuator,
        "unit": prognosis.unit,
        "diagnoses": prognosis.diagnoses,
        "used": prognosis.used,
        "seed": prognosis.seed,
        "severities": {
            item.name: {
                "at": item.at,
                "estimate": item.value,
                "diagnoses": item.diagnoses,
                "fleet": item.fleet,
                "process": item.process,
                "alarm": item.alarm or None,
                "remaining": {
                    name: {
                        "level": left.level,
                        "median": left.median,
                        "interval80": None if left.median is None else [left.low, left.high],
                        "why": left.why or None,
                    }
                    for name, left in zip(NAMES, item.remaining, strict=True)
                },
            }
            for item in prognosis.forecasts
        },
    }


def _wear(item: Forecast) -> str:
    if item.process is None:
        return "-"
    lives = f"{item.fleet} other li{'fe' if item.fleet == 1 else 'ves'}"
    return f"{item.process}, {item.diagnoses} diagnoses, {lives}"
