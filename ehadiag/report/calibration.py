"""A calibration for people and for programs: a table, and one JSON object."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ehadiag.core.printable import printable, valid_text
from ehadiag.core.shown_in import factor_and_unit

if TYPE_CHECKING:
    from ehadiag.calibration.result import Calibrated, Value

__all__ = ["SCHEMA", "calibration_json", "print_calibration"]

SCHEMA = "ehadiag.calibration/1"


def calibration_json(found: Calibrated) -> str:
    """Return one line without its end, strict JSON.

    Parameters
    ----------
    found : Calibrated
        What was learned, or why nothing.

    Returns
    -------
    str
        The object (docs/reference/json.md).
    """
    unit = found.actuator
    calibration = unit.calibration if unit else None
    tree: dict[str, Any] = {
        "schema": SCHEMA,
        "sources": [valid_text(item.source) for item in found.recordings],
        "tests": [item.name if item else None for item in found.tests],
        "actuator": found.start.name,
        "serial": calibration.serial if calibration else None,
        "calibrated": unit is not None,
        "reasons": [valid_text(reason) for reason in found.reasons],
        "notes": [valid_text(note) for note in found.notes],
        "severities": {
            item.name: {"estimate": item.value, "std": item.std} for item in found.severities
        },
        "values": {
            item.name: {
                "symbol": item.symbol,
                "start": item.start,
                "value": item.value,
                "std": item.std,
                "shown": item.shown,
            }
            for item in found.values
        },
        "models": [
            {"model": item.words, "excess": item.excess, "criterion": item.criterion}
            for item in found.tried
        ],
        "second_stage": unit.second_stage.kind if unit else None,
        "plays": calibration.plays if calibration else None,
        "fit": (
            {
                "excess": calibration.fit.excess,
                "outliers": calibration.fit.outliers,
                "spool_rms": calibration.fit.spool_rms,
                "pressure_rms": calibration.fit.pressure_rms,
            }
            if calibration
            else None
        ),
        "seed": found.seed,
        "evaluations": found.evaluations,
        "elapsed_s": round(found.elapsed, 3),
    }
    return json.dumps(tree, allow_nan=False)


def print_calibration(found: Calibrated, console: Console) -> None:
    """Print a calibration.

    Parameters
    ----------
    found : Calibrated
        What was learned, or why nothing.
    console : Console
        Console to print to.
    """
    unit = found.actuator
    calibration = unit.calibration if unit else None
    head = "CALIBRATED" if unit else "NOT CALIBRATED"
    names = " + ".join(printable(item.source) for item in found.recordings)
    console.print(head, style="bold green" if unit else "bold magenta", end="")
    console.print(f"  {names}", soft_wrap=True, highlight=False, markup=False, emoji=False)
    serial = (
        ""
        if calibration is None or calibration.serial is None
        else f", serial {calibration.serial}"
    )
    _line(console, f"actuator {found.start.name}{serial}")
    for reason in found.reasons:
        _line(console, f"- {reason}")
    if found.severities:
        words = ", ".join(
            f"{item.name} {item.value:.4f} ± {item.std:.4f}" for item in found.severities
        )
        _line(console, f"severities that the recordings show: {words}")
    if found.values:
        console.print(_values(found.values), crop=False)
    if len(found.tried) > 1:
        console.print(_models(found), crop=False)
    for note in found.notes:
        _line(console, f"note: {note}")
    if calibration is not None:
        fit = calibration.fit
        _line(
            console,
            f"residuals {fit.excess:.2f} times the noise, rms spool {fit.spool_rms:.2f}, pressure "
            f"{fit.pressure_rms:.2f} of it, {fit.outliers:.2%} outliers; seed {found.seed}, "
            f"{found.evaluations} model runs, {found.elapsed:.1f} s",
        )


def _line(console: Console, text: str) -> None:
    """Print a line as it is: what others named is neither markup nor a terminal's command."""
    console.print(
        f"  {printable(text)}", soft_wrap=True, highlight=False, markup=False, emoji=False
    )


def _values(values: tuple[Value, ...]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("learned", no_wrap=True)
    for name in ("start", "value", "std", "unit"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for item in values:
        factor, unit = factor_and_unit(item.unit, max(abs(item.start), abs(item.value)))
        table.add_row(
            item.symbol,
            f"{item.start * factor:.6g}",
            f"{item.value * factor:.6g}",
            f"{item.std * factor:.2g}",
            unit,
            item.meaning
            + ("" if item.shown else ", hardly shown: little more is known than before"),
        )
    return table


def _models(found: Calibrated) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("model", no_wrap=True)
    for name in ("residuals / noise", "evidence against it (BIC)"):
        table.add_column(name, justify="right", no_wrap=True)
    for item in found.tried:
        table.add_row(item.words, f"{item.excess:.2f}", f"{item.criterion:.0f}")
    return table
