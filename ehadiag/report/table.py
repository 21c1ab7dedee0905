"""The result for people: verdict, reasons, a table of the severities, data quality."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ehadiag.assess.verdict import Verdict
from ehadiag.core.printable import printable
from ehadiag.report.faults import faults_of
from ehadiag.report.json_line import source_name, test_name
from ehadiag.report.onboard import alone, in_words

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.report.spent import Spent

__all__ = ["html_of", "print_diagnosis", "text_of"]

STYLES = {
    Verdict.HEALTHY: "bold green",
    Verdict.DEGRADED: "bold yellow",
    Verdict.FAULT: "bold red",
    Verdict.NOT_TESTED: "bold magenta",
}
WIDTH = 200
"""Columns of a text that no terminal bounds: nothing of ours is cut."""
HTML = '<pre style="white-space:pre;overflow-x:auto;line-height:normal">{code}</pre>'
REMARKS = {"at_bound": ", at its bound", "not_shown": ", not shown by the test"}
"""What the table says of a fault's flags."""


def text_of(diagnosis: Diagnosis, spent: Spent | None = None) -> str:
    """Return a diagnosis as plain lines of text, the last one without its end."""
    console = _page()
    print_diagnosis(diagnosis, console, spent)
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())


def html_of(diagnosis: Diagnosis, spent: Spent | None = None) -> str:
    """Return a diagnosis as a piece of HTML, its text escaped."""
    console = _page()
    print_diagnosis(diagnosis, console, spent)
    return console.export_html(inline_styles=True, code_format=HTML)


def print_diagnosis(diagnosis: Diagnosis, console: Console, spent: Spent | None = None) -> None:
    """Print a diagnosis.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    console : Console
        Console to print to.
    spent : Spent | None
        Around the diagnosis; where nothing is known of it the diagnosis' own time is told.
    """
    serials = [str(item.serial) for item in diagnosis.recordings if item.serial is not None]
    verdict = diagnosis.verdict
    head = Text()
    head.append(verdict.name.replace("_", " "), style=STYLES[verdict])
    head.append(f"  {printable(source_name(diagnosis))}")
    console.print(head, soft_wrap=True)
    serial = f", serial {serials[0]}" if serials else ""
    test = test_name(diagnosis) or "unknown"
    _line(console, f"test {test}, actuator {diagnosis.actuator.name}{serial}")
    for reason in diagnosis.reasons:
        _line(console, f"- {reason}")
    for line in diagnosis.culprit.lines if diagnosis.culprit else ():
        _line(console, f"  {line}")
    if diagnosis.identification is not None:
        console.print(_constants(diagnosis), crop=False)
    onboard = alone(diagnosis)
    if onboard is not None:
        known = diagnosis.identification is not None
        own = {name: fault.value for name, fault in faults_of(diagnosis).items()} if known else {}
        _line(console, in_words(onboard, own))
    if diagnosis.other:
        console.print(_others(diagnosis), crop=False)
    _line(console, _quality(diagnosis))
    for note in diagnosis.notes:
        _line(console, f"note: {note}")
    if diagnosis.identification is not None:
        _line(console, _effort(diagnosis, spent))


def _line(console: Console, text: str) -> None:
    """Print a line as it is: what others named is neither markup nor a terminal's command."""
    console.print(
        f"  {printable(text)}", soft_wrap=True, highlight=False, markup=False, emoji=False
    )


def _page() -> Console:
    """Return what prints to memory only, in a notebook too."""
    return Console(
        file=io.StringIO(), width=WIDTH, highlight=False, record=True, force_jupyter=False
    )


def _constants(diagnosis: Diagnosis) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("severity", no_wrap=True)
    for name in ("first", "search", "estimate", "std", "95 % interval"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("fault", no_wrap=True)
    for fault in faults_of(diagnosis).values():
        low, high = fault.interval
        table.add_row(
            fault.name,
            f"{fault.first:.4f}",
            f"{fault.search:.4f}",
            f"{fault.value:.5f}",
            f"{fault.std:.5f}",
            f"{low:.5f} … {high:.5f}",
            fault.meaning + "".join(REMARKS[flag] for flag in fault.flags),
        )
    return table


def _others(diagnosis: Diagnosis) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("effect", no_wrap=True)
    for name in ("estimate", "std", "95 % interval", "limit"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for item in diagnosis.other:
        low, high = item.interval95
        table.add_row(
            item.meaning,
            f"{item.shown(item.value):.4g} {item.shown_unit}",
            f"{item.shown(item.std):.2g}",
            f"{item.shown(low):.4g} … {item.shown(high):.4g}",
            f"{item.shown(item.limit):.3g} {item.shown_unit}",
            "beyond its limit" if item.beyond else "",
        )
    return table


def _quality(diagnosis: Diagnosis) -> str:
    def total(count: str) -> int:
        return sum(recording.quality.total(count) for recording in diagnosis.recordings)

    return (
        f"frames {total('received')}, lost {total('lost')}, repeated {total('repeated')}, "
        f"conflicts {total('conflicts')}, CRC errors {total('crc_errors')}"
    )


def _effort(diagnosis: Diagnosis, spent: Spent | None) -> str:
    found = diagnosis.identification
    assert found is not None
    after = spent.after_test if spent else None
    took = f"{diagnosis.elapsed:.2f} s" if after is None else f"{after:.2f} s after the test"
    return (
        f"residual rms spool {found.fit.spool_rms:.2f}, pressure {found.fit.pressure_rms:.2f} "
        f"of the noise, {found.fit.outliers:.2%} outliers; solver {found.solver}, "
        f"seed {found.seed}, {found.evaluations} model runs, {took}"
    )
