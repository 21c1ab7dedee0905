"""Tables and JSON objects of results: diagnosis, calibration, score of a test.

The JSON of a diagnosis is made in `ehadiag.result`; the other three are small and stand beside
their tables.
"""

from __future__ import annotations

import io
import json
import math
import textwrap
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.core.conventions import PIPE_COLUMNS, display_unit, to_precision
from ehadiag.estimate import AT_BOUND, NOT_SHOWN
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS
from ehadiag.report.head import CUT_NOTE, CUT_OFF, head_of, percent
from firmware_iface.errors import printable, valid_text

if TYPE_CHECKING:
    from ehadiag.calibration.unit_models import Calibrated, CalibratedValue
    from ehadiag.design.score import Bound, Score
    from ehadiag.estimate import Effect
    from ehadiag.prognosis.units import Prognosis
    from ehadiag.report.head import Bar, Head
    from ehadiag.result import Onboard, Result
    from firmware_iface.stored_test import StoredTest

STATE_STYLES = {
    "HEALTHY": "bold green",
    "DEGRADED": "bold yellow",
    "FAULT": "bold red",
    "NOT_TESTED": "bold",
}
NAMED_COLUMNS = 76
"""Columns from which on the table of the severities has their plain names too."""
FLAG_REMARKS = {AT_BOUND: "at its bound", NOT_SHOWN: "not shown by the test"}
"""What the table says of a severity's flags."""


def diagnosis_text(result: Result, *, verbose: bool = False) -> str:
    """Return a result as plain lines of text, the last one without its end."""
    console = Console(
        file=io.StringIO(), width=PIPE_COLUMNS, highlight=False, record=True, force_jupyter=False
    )
    print_result(result, console, verbose=verbose)
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())


def diagnosis_html(result: Result) -> str:
    """Return a result as a piece of HTML for a notebook, its text escaped."""
    from ehadiag.report.page_parts import templates_of  # noqa: PLC0415 - bokeh is slow

    head = head_of(result, Levels(result.request.advisory, result.request.limit))
    template = templates_of("ehadiag.report").get_template("notebook.html.j2")
    shown = result.as_shown.severities
    severities = [shown[bar.symbol] for bar in head.bars]
    return template.render(head=head, severities=severities, percent=percent)


def print_result(
    result: Result, console: Console, prognosis: Prognosis | None = None, *, verbose: bool = False
) -> None:
    """Print a result: its head, then the numbers.

    verbose: the course of the search, reasons in terms of the field, numbers beside no verdict, and
    every effect that was estimated, not only those that are not 0 beyond doubt.
    """
    head = head_of(result, Levels(result.request.advisory, result.request.limit), prognosis)
    _print_head(head, result, console)
    if verbose:
        for reason in result.reasons:
            _line(console, f"- {reason}")
    relied_on = verbose or result.relied_on
    if not relied_on:
        _line(console, head.best_fit)
    elif result.estimated:
        console.print(_severities(head, result, console), crop=False)
    if result.identified and verbose:
        for name in ("first", "search"):
            values = (f"{k} {_number(getattr(v, name), 4)}" for k, v in result.severities.items())
            _line(console, f"after the {name}: {', '.join(values)}")
    onboard = result.origins[0].onboard if len(result.origins) == 1 else None
    if onboard is not None:
        unexplained = onboard.verdict == Verdict.NOT_TESTED.name
        _line(console, _on_board(onboard, result, verbose or (relied_on and not unexplained)))
    if result.other and relied_on:
        console.print(_limited(result), crop=False)
    effects = [item for item in result.effects if verbose or _is_shown(item)]
    effects = [item for item in effects if item.limit is None]
    if effects and relied_on:
        _line(console, f"also estimated: {', '.join(map(_size, effects))}")
    _line(console, _quality_text(result))
    cut_off = any(item.cause.startswith(CUT_OFF) for item in head.reasons)
    for note in result.notes:
        if verbose or not (cut_off and CUT_NOTE.match(note)):  # the head says it
            _line(console, f"note: {note}")
    if result.identified:
        _line(console, _effort_text(result))


def _print_head(head: Head, result: Result, console: Console) -> None:
    indent = " " * (len(head.word) + 2)
    first, *rest = head.sentences or ("",)
    lines = _wrapped(first, console, len(indent))
    text = Text(head.word, style=STATE_STYLES[head.verdict])
    text.append(f"  {lines[0]}", style="not bold default")
    console.print(text, soft_wrap=True)
    arrow = "→" if _unicode(console) else ">"
    actions = [f"{arrow} {action}" for action in head.actions]
    for sentence in ("\n".join(lines[1:]), *rest, *actions):
        for line in _wrapped(sentence, console, len(indent)) if sentence else ():
            console.print(indent + line, soft_wrap=True)
    facts = ", ".join(f"{label} {printable(value)}".lstrip() for label, value in head.facts)
    _line(console, facts)
    _line(console, f"recording {printable(result.source)}")
    for item in (item for reason in head.reasons for item in reason.evidence):
        _line(console, f"- {item}")
    if result.identified and head.drawn:
        for bar in head.drawn:
            console.print(_bar(bar, head, console), soft_wrap=True)
        advisory, limit = _marks(console)
        levels = (
            f"{advisory} advisory {percent(head.advisory)}, {limit} limit {percent(head.limit)}"
        )
        start = max(min(27, console.width - len(levels)), 0)
        console.print(" " * start + levels, soft_wrap=True)


def _bar(bar: Bar, head: Head, console: Console) -> Text:
    """Draw a severity: plain name, percent, bar with a mark at each level."""
    # At most 2 % a column.
    length = max(min(console.width - 30, 48), 8)
    full, empty = ("█", "·") if _unicode(console) else ("#", ".")
    value = bar.value or 0.0
    done = round(min(value, 1.0) * length)
    cells = [full] * done + [empty] * (length - done)
    for level, mark in zip((head.advisory, head.limit), _marks(console), strict=True):
        cells[min(round(level * length), length - 1)] = mark
    known = "unknown" if bar.value is None else percent(bar.value, head.advisory, head.limit)
    text = Text(f"  {bar.name:16}{known:>8} ")
    text.append("".join(cells), style=STATE_STYLES.get(bar.state, ""))
    return text


def _marks(console: Console) -> tuple[str, str]:
    """Marks of advisory level and limit."""
    return ("┊", "┃") if _unicode(console) else (":", "|")


def _unicode(console: Console) -> bool:
    return (console.encoding or "utf-8").lower().startswith("utf")


def _wrapped(text: str, console: Console, indent: int) -> list[str]:
    """Break a text between words, for what is left of a line."""
    width = max(console.width - indent, 20)
    plain = printable(text.replace("\n", " "))
    return textwrap.wrap(plain, width, break_long_words=False, break_on_hyphens=False) or [""]


def _line(console: Console, text: str) -> None:
    """Print a line as it is: what others named is neither markup nor a terminal's command."""
    for number, line in enumerate(_wrapped(text, console, 4)):
        indent = "    " if number else "  "
        console.print(f"{indent}{line}", soft_wrap=True, highlight=False, markup=False, emoji=False)


def _severities(head: Head, result: Result, console: Console) -> Table:
    """Numbers of the severities, grey where there is no verdict."""
    untested = not head.drawn and result.identified
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 1), style="dim" if untested else "")
    table.add_column("severity", no_wrap=True)
    for name in ("estimate", "std", "95 % interval"):
        table.add_column(name, justify="right", no_wrap=True)
    severities = [result.severities[bar.symbol] for bar in head.bars]
    remarks = [
        ["no verdict"] if untested else [FLAG_REMARKS[flag] for flag in item.flags]
        for item in severities
    ]
    if any(remarks):
        table.add_column("", no_wrap=True)
    for bar, item, remark in zip(head.bars, severities, remarks, strict=True):
        low, high = item.interval
        table.add_row(
            f"{bar.name} ({bar.symbol})" if console.width >= NAMED_COLUMNS else bar.symbol,
            _number(item.estimate, 5),
            _number(item.std, 5),
            f"{low:.5f} … {high:.5f}",
            *([", ".join(remark)] if any(remarks) else []),
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "nan" if value is None else f"{value:.{digits}f}"


def _limited(result: Result) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("effect", no_wrap=True)
    for name in ("estimate", "std", "95 % interval", "limit"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for item in result.other:
        std = item.shown(_known(item.std))
        numbers = (_known(item.value), *(item.interval95 or (math.nan, math.nan)))
        value, low, high = to_precision(std, *map(item.shown, numbers))
        table.add_row(
            item.meaning,
            f"{value} {item.shown_unit}",
            *to_precision(std, std),
            f"{low} … {high}",
            f"{item.shown(_known(item.limit)):.3g} {item.shown_unit}",
            "beyond its limit" if item.beyond else "",
        )
    return table


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def _is_shown(item: Effect) -> bool:
    """Whether an effect is told unasked: no offset, which the fit has, nor what was learned."""
    offsets = {offset.name for offset in SENSOR_OFFSETS}
    return item.significant and item.name not in offsets and item.source != "calibration"


def _size(item: Effect) -> str:
    value, std = item.shown(_known(item.value)), item.shown(_known(item.std))
    return f"{item.meaning} {' ± '.join(to_precision(std, value, std))} {item.shown_unit}"


def _on_board(found: Onboard, result: Result, relied_on: bool) -> str:
    """What the flight-control computer found, beside what was found here."""
    parts = [f"on board: {(found.verdict or 'no verdict').replace('_', ' ')}"]
    parts += [
        f"{name} {_known(item.estimate):.7f}" + f" ± {_known(item.std):.7f}" * relied_on
        for name, item in found.faults.items()
    ]
    if found.evaluations is not None:
        parts.append(f"{found.evaluations} model runs")
    apart = [
        abs(item.estimate - own.value) / item.std
        for name, item in found.faults.items()
        if item.estimate is not None and item.std
        if (own := result.severities.get(name)) is not None and own.estimate is not None
    ]
    if apart and relied_on:
        parts.append(f"at most {max(apart):.2f} of its deviations from what was found here")
    return ", ".join(parts)


def _quality_text(result: Result) -> str:
    item = result.quality
    if item is None:
        return "no frames"
    return (
        f"frames {item.frames}, lost {item.lost}, repeated {item.repeated}, "
        f"conflicts {item.conflicts}, CRC errors {item.crc_errors}"
    )


def _effort_text(result: Result) -> str:
    fit, timing, search = result.fit, result.timing_s, result.search
    assert fit is not None
    assert timing is not None
    took = f"{timing.total - timing.read:.2f} s"
    if timing.after_test is not None:
        took = f"{timing.after_test:.2f} s after the test"
    begun = f"; begun from {search.begun_from}" if search.begun_from else ""
    return (
        f"residual rms spool {_known(fit.spool_rms):.2f}, pressure {_known(fit.pressure_rms):.2f} "
        f"of the noise, {_known(fit.outliers):.2%} outliers; solver {search.name}, "
        f"seed {search.seed}, {search.evaluations} model runs, {took}{begun}"
    )


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
    _line(console, f"actuator {found.start.name}{serial}")
    for reason in found.reasons:
        _line(console, f"- {reason}")
    if found.severities:
        words = ", ".join(
            f"{item.name} {item.value:.4f} ± {item.std:.4f}" for item in found.severities
        )
        _line(console, f"severities that the recordings show: {words}")
    if found.values:
        console.print(_calibrated_values(found.values), crop=False)
    if len(found.tried) > 1:
        console.print(_compared_models(found), crop=False)
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
