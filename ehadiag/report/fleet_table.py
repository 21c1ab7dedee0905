"""The table of a fleet, worst unit first: front page of `serve`, and index of a batch's reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
from markupsafe import Markup

from ehadiag.assess.verdict import Verdict
from ehadiag.core.conventions import shown_date
from ehadiag.report.head import advised, percent, plain_name
from ehadiag.report.prognosis_tables import two_digits
from firmware_iface.errors import printable

if TYPE_CHECKING:
    from ehadiag.assess.verdict import Levels
    from ehadiag.estimate import Severity
    from ehadiag.prognosis.units import Prognosis

FLEET_HEAD = (
    "unit", "verdict", "worst severity", "what to do", "time left", "trend", "last test",
    "actuator type",
)  # fmt: skip
WORST_FIRST = ("FAULT", "DEGRADED", "NOT_TESTED", "HEALTHY")


class Cell(msgspec.Struct, frozen=True):
    """One cell of a list."""

    text: str
    """Markup, such as a drawing, stays markup."""
    link: str = ""
    kind: str = ""


class FleetUnit(msgspec.Struct, frozen=True):
    """One line of the table."""

    serial: int | None
    actuator: str
    verdict: str
    """Name of the newest verdict."""
    word: str
    """Word for it that people see."""
    severities: Sequence[Severity]
    """Newest ones."""
    past: Sequence[float]
    """Worst severity of each diagnosis, oldest first."""
    tested: str
    """Date of the newest test."""
    link: str
    """Of the unit's page or report."""
    prognosis: Prognosis | None = None


def fleet_summary(units: Sequence[FleetUnit]) -> str:
    """Say how many units have which verdict, worst first."""
    ordered = sorted(units, key=lambda unit: WORST_FIRST.index(unit.verdict))
    counts = Counter(unit.word for unit in ordered)
    return ", ".join(f"{n} {word}" for word, n in counts.items())


def fleet_table(
    units: Sequence[FleetUnit], levels: Levels
) -> tuple[tuple[str, ...], list[list[Cell]]]:
    """Return head and lines of the table, worst first, without columns that nothing fills."""
    ordered = sorted(units, key=lambda unit: (WORST_FIRST.index(unit.verdict), -_worst(unit)[1]))
    rows = [_row(unit, levels) for unit in ordered]
    filled = [n for n in range(len(FLEET_HEAD)) if any(row[n].text for row in rows)]
    shown = [[row[n] if row[n].text else Cell("–") for n in filled] for row in rows]
    return tuple(FLEET_HEAD[n] for n in filled), shown


def levels_text(levels: Levels) -> str:
    """Say what the severities are compared with."""
    return (
        "Severity in percent of full damage:"
        f" advisory level {percent(levels.advisory)}, limit {percent(levels.limit)}."
    )


def _row(unit: FleetUnit, levels: Levels) -> list[Cell]:
    name, value = _worst(unit)
    worst = "none" if value < 0.0 else f"{plain_name(name)} {100.0 * value:.0f} %"
    serial = "unknown" if unit.serial is None else str(unit.serial)
    return [
        Cell(serial, unit.link),
        Cell(unit.word, kind=unit.verdict),
        Cell(worst),
        Cell(_action(unit, levels)),
        Cell(_left(unit.prognosis)),
        Cell(_sparkline(unit.past, levels)),
        Cell(shown_date(unit.tested) if unit.tested else "unknown"),
        Cell(printable(unit.actuator)),
    ]


def _worst(unit: FleetUnit) -> tuple[str, float]:
    """Name and value of the worst severity; below 0 where none has a verdict."""
    judged = unit.severities if unit.verdict != Verdict.NOT_TESTED.name else ()
    known = [(item.name, item.estimate) for item in judged if item.estimate is not None]
    return max(known, key=lambda pair: pair[1], default=("", -1.0))


def _action(unit: FleetUnit, levels: Levels) -> str:
    """What to do about the worst severity, if it has reached a level."""
    name, value = _worst(unit)
    advice = next((item.advice for item in unit.severities if item.name == name), "")
    if value < levels.advisory or not advice:
        return "Nothing" if unit.verdict == Verdict.HEALTHY.name else ""
    fault = unit.verdict == Verdict.FAULT.name or value >= levels.limit
    return advised(advice, at_once=fault).rstrip(".")


def _left(prognosis: Prognosis | None) -> str:
    """Time until the first severity reaches the limit."""
    if prognosis is None:
        return ""
    unit = "h" if prognosis.unit == "hours" else prognosis.unit
    if (found := prognosis.first()) and (left := found[1]).median is not None:
        if left.reached:
            return f"0 {unit}, limit reached"
        time = f"{two_digits(left.median)} {unit}"
        return time if left.median > 0.0 else "may be past its limit"
    few = all(item.too_few for item in prognosis.forecasts)
    return "too few diagnoses" if few else "no number"


def _sparkline(values: Sequence[float], levels: Levels) -> str:
    """Draw severities between 0 and 1 with both levels; numbers only, so no text of others."""
    shown = values[-30:]
    if len(shown) < 2:
        return ""
    step = 100.0 / (len(shown) - 1)
    points = " ".join(
        f"{n * step:.1f},{30.0 * (1.0 - min(v, 1.0)):.1f}" for n, v in enumerate(shown)
    )
    lines = "".join(
        f'<line class="{name}" x1="0" x2="100" y1="{y:.1f}" y2="{y:.1f}"/>'
        for name, y in (
            ("advisory", 30.0 * (1.0 - levels.advisory)),
            ("limit", 30.0 * (1.0 - levels.limit)),
        )
    )
    return Markup(
        f'<svg class="spark" viewBox="0 0 100 30" width="100" height="30" role="img"'
        f' aria-label="worst severity, {len(shown)} tests">{lines}'
        f'<polyline points="{points}"/></svg>'
    )
