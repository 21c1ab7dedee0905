"""A test's score for people and for programs: a table, and a JSON object."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table

from ehadiag.core.printable import printable
from ehadiag.model.parameters import FAULTS

if TYPE_CHECKING:
    from rich.console import Console

    from ehadiag.core.stored_test import StoredTest
    from ehadiag.design.score import Bound, Score

__all__ = ["SCHEMA", "json_of", "print_score"]

SCHEMA = "ehadiag.design/1"


def print_score(test: StoredTest, score: Score, console: Console) -> None:
    """Print what a test shows and asks.

    Parameters
    ----------
    test : StoredTest
    score : Score
    console : Console
    """
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
            *(f"{100.0 * value:.4f}" for value in (*bound.std, *bound.alone)),
            ", ".join(f"{a} from {b} ({r:+.2f})" for a, b, r in bound.alike) or "-",
        )
    console.print(table, crop=False)
    unseen = sorted({name for bound in score.bounds for name in bound.unseen})
    if unseen:
        console.print(f"  not shown by the test: {', '.join(unseen)}")
    console.print(
        f"  travel {1e3 * score.travel:.1f} mm, rate {1e3 * score.rate:.0f} mm/s, "
        f"pressure {1e-6 * score.pressure:.1f} MPa, duration {test.duration:g} s"
    )


def json_of(test: StoredTest, score: Score) -> dict[str, Any]:
    """Return the same as an object of plain values, SI.

    Parameters
    ----------
    test : StoredTest
        The test.
    score : Score
        What it shows.

    Returns
    -------
    dict[str, Any]
        For JSON.
    """
    return {
        "test": test.name,
        "figure": score.figure,
        "travel_m": score.travel,
        "rate_m_per_s": score.rate,
        "pressure_Pa": score.pressure,
        "duration_s": test.duration,
        "bounds": [_bound(item) for item in score.bounds],
    }


def _bound(bound: Bound) -> dict[str, Any]:
    names = [item.name for item in FAULTS]
    return {
        "severities": dict(zip(names, bound.severities, strict=True)),
        "std": dict(zip(names, bound.std.tolist(), strict=True)),
        "std_alone": dict(zip(names, bound.alone.tolist(), strict=True)),
        "hardly_told_apart": [
            {"severity": a, "from": b, "correlation": r} for a, b, r in bound.alike
        ],
        "not_shown": list(bound.unseen),
    }
