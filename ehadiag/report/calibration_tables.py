"""Tables and JSON objects of a calibration and of the score of a test."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ehadiag.core.conventions import display_unit
from ehadiag.model.registry import FAULTS
from ehadiag.report.head import print_line
from firmware_iface.errors import printable, valid_text

if TYPE_CHECKING:
    from ehadiag.calibration.unit_models import Calibrated, CalibratedValue
    from ehadiag.design.score import Bound, Score
    from firmware_iface.stored_test import StoredTest


CALIBRATION_SCHEMA = "ehadiag.calibration/1"


def calibration_json(found: Calibrated) -> str:
    """Return one line without its end, strict JSON (docs/reference/json.md)."""
    unit = found.actuator
    calibration = unit.calibration if unit else None
    tree: dict[str, Any] = {
        "schema": CALIBRATION_SCHEMA,
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
    """Print a calibration."""
    unit = found.actuator
    calibration = unit.calibration if unit else None
    head = "CALIBRATED" if unit else "NOT CALIBRATED"
    names = " + ".join(printable(item.source) for item in found.recordings)
    console.print(head, style="bold green" if unit else "bold", end="")
    console.print(f"  {names}", soft_wrap=True, highlight=False, markup=False, emoji=False)
    serial = (
        ""
        if calibration is None or calibration.serial is None
        else f", serial {calibration.serial}"
    )
    print_line(console, f"actuator {found.start.name}{serial}")
    for reason in found.reasons:
        print_line(console, f"- {reason}")
    if found.severities:
        words = ", ".join(
            f"{item.name} {item.value:.4f} ± {item.std:.4f}" for item in found.severities
        )
        print_line(console, f"severities that the recordings show: {words}")
    if found.values:
        console.print(_calibrated_values(found.values), crop=False)
    if len(found.tried) > 1:
        console.print(_compared_models(found), crop=False)
    for note in found.notes:
        print_line(console, f"note: {note}")
    if calibration is not None:
        fit = calibration.fit
        print_line(
            console,
            f"residuals {fit.excess:.2f} times the noise, rms spool {fit.spool_rms:.2f}, pressure "
            f"{fit.pressure_rms:.2f} of it, {fit.outliers:.2%} outliers; seed {found.seed}, "
            f"{found.evaluations} model runs, {found.elapsed:.1f} s",
        )


def _calibrated_values(values: tuple[CalibratedValue, ...]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("learned", no_wrap=True)
    for name in ("start", "value", "std", "unit"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for item in values:
        factor, unit = display_unit(item.unit, max(abs(item.start), abs(item.value)))
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


def _compared_models(found: Calibrated) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("model", no_wrap=True)
    for name in ("residuals / noise", "evidence against it (BIC)"):
        table.add_column(name, justify="right", no_wrap=True)
    for item in found.tried:
        table.add_row(item.words, f"{item.excess:.2f}", f"{item.criterion:.0f}")
    return table


DESIGN_SCHEMA = "ehadiag.design/1"


def print_score(test: StoredTest, score: Score, console: Console) -> None:
    """Print what a test shows and asks."""
    console.print(
        f"test {printable(test.name)}: {100.0 * score.figure:.4f} % "
        "(geometric mean of all bounds; less is better)"
    )
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 2))
    table.add_column("severities")
    for item in FAULTS:
        table.add_column(f"{item.name}, %", justify="right")
    for item in FAULTS:
        table.add_column(f"{item.name} alone, %", justify="right")
    table.add_column("hardly told apart")
    for bound in score.bounds:
        table.add_row(
            " ".join(f"{value:g}" for value in bound.severities),
            *(f"{100.0 * value:.4f}" for value in (*bound.total, *bound.alone)),
            ", ".join(f"{a} from {b} ({r:+.2f})" for a, b, r in bound.alike) or "-",
        )
    console.print(table, crop=False)
    laws = [max((bound.laws[k] for bound in score.bounds), default=0.0) for k in range(len(FAULTS))]
    if any(laws):
        parts = ", ".join(
            f"{item.name} {100.0 * value:.2f} %" for item, value in zip(FAULTS, laws, strict=True)
        )
        console.print(
            f"  of it by doubt about the faults' laws ([discrepancy], clogging_exponent), whatever"
            f" the test: up to {parts}; the mean is without it"
        )
    unseen = sorted({name for bound in score.bounds for name in bound.unseen})
    if unseen:
        console.print(f"  not shown by the test: {', '.join(unseen)}")
    console.print(
        f"  travel {1e3 * score.travel:.1f} mm, rate {1e3 * score.rate:.0f} mm/s, "
        f"pressure {1e-6 * score.pressure:.1f} MPa, duration {test.duration:g} s"
    )


def score_tree(test: StoredTest, score: Score) -> dict[str, Any]:
    """Return the same as an object of plain values for JSON, SI."""
    return {
        "test": test.name,
        "figure": score.figure,
        "travel_m": score.travel,
        "rate_m_per_s": score.rate,
        "pressure_Pa": score.pressure,
        "duration_s": test.duration,
        "bounds": [_bound_tree(item) for item in score.bounds],
    }


def _bound_tree(bound: Bound) -> dict[str, Any]:
    names = [item.name for item in FAULTS]
    return {
        "severities": dict(zip(names, bound.severities, strict=True)),
        "std": dict(zip(names, bound.total.tolist(), strict=True)),
        "std_by_laws": dict(zip(names, bound.laws.tolist(), strict=True)),
        "std_alone": dict(zip(names, bound.alone.tolist(), strict=True)),
        "hardly_told_apart": [
            {"severity": a, "from": b, "correlation": r} for a, b, r in bound.alike
        ],
        "not_shown": list(bound.unseen),
    }
