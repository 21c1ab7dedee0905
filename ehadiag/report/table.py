"""The result for people: verdict, reasons, a table of the fault constants, data quality."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ehadiag.assess.verdict import Verdict
from ehadiag.model.parameters import FAULTS
from ehadiag.report.json_line import source_name, test_name

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.report.spent import Spent

__all__ = ["print_diagnosis"]

STYLES = {
    Verdict.HEALTHY: "bold green",
    Verdict.DEGRADED: "bold yellow",
    Verdict.FAULT: "bold red",
    Verdict.NOT_TESTED: "bold magenta",
}


def print_diagnosis(diagnosis: Diagnosis, console: Console, spent: Spent) -> None:
    """Print a diagnosis."""
    serials = [str(item.serial) for item in diagnosis.recordings if item.serial is not None]
    verdict = diagnosis.verdict
    head = Text()
    head.append(verdict.name.replace("_", " "), style=STYLES[verdict])
    head.append(f"  {source_name(diagnosis)}")
    console.print(head, soft_wrap=True)
    serial = f", serial {serials[0]}" if serials else ""
    console.print(
        f"  test {test_name(diagnosis) or 'unknown'}, actuator {diagnosis.actuator.name}{serial}",
        soft_wrap=True,
        highlight=False,
    )
    for reason in diagnosis.reasons:
        console.print(f"  - {reason}", soft_wrap=True, highlight=False)
    if diagnosis.identification is not None:
        console.print(_constants(diagnosis), crop=False)
    console.print(f"  {_quality(diagnosis)}", soft_wrap=True, highlight=False)
    for note in diagnosis.notes:
        console.print(f"  note: {note}", soft_wrap=True, highlight=False)
    if diagnosis.identification is not None:
        console.print(f"  {_effort(diagnosis, spent)}", soft_wrap=True, highlight=False)


def _constants(diagnosis: Diagnosis) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2))
    table.add_column("constant", no_wrap=True)
    for name in ("first", "search", "estimate", "std", "95 % interval"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("fault", no_wrap=True)
    assert diagnosis.identification is not None
    meaning = {parameter.name: parameter.short for parameter in FAULTS}
    for item in diagnosis.identification.estimates:
        low, high = item.interval95
        remark = ", at its bound" * item.at_bound + ", not shown by the test" * (not item.shown)
        table.add_row(
            item.name,
            f"{item.first:.4f}",
            f"{item.search:.4f}",
            f"{item.value:.5f}",
            f"{item.std:.5f}",
            f"{low:.5f} … {high:.5f}",
            meaning[item.name] + remark,
        )
    return table


def _quality(diagnosis: Diagnosis) -> str:
    def total(count: str) -> int:
        return sum(recording.quality.total(count) for recording in diagnosis.recordings)

    return (
        f"frames {total('received')}, lost {total('lost')}, repeated {total('repeated')}, "
        f"conflicts {total('conflicts')}, CRC errors {total('crc_errors')}"
    )


def _effort(diagnosis: Diagnosis, spent: Spent) -> str:
    found = diagnosis.identification
    assert found is not None
    after = spent.after_test
    took = f"{diagnosis.elapsed:.2f} s" if after is None else f"{after:.2f} s after the test"
    return (
        f"gap rms spool {found.fit.spool_rms:.2f}, pressure {found.fit.pressure_rms:.2f} of the "
        f"noise, {found.fit.outliers:.2%} outliers; solver {found.solver}, seed {found.seed}, "
        f"{found.evaluations} model runs, {took}"
    )
