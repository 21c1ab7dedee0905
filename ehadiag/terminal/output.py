"""Output of a call: results to standard output, all else to standard error, and the exit code.

The summary of a call with many recordings too.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TextIO, cast

from firmware_iface.errors import (
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    printable,
    printable_lines,
    reason_of,
    valid_text,
)

if TYPE_CHECKING:
    from rich.console import Console

    from ehadiag.result import ListedTest, Result
    from firmware_iface.transport.base import Transport

INPUT_OUTPUT_EXIT_CODE = InputOutputError.exit_code
EXIT_CODES_WORST_FIRST = (20, 40, INPUT_OUTPUT_EXIT_CODE, 30, 10, 0)
"""Exit codes, the worst first."""


def worst_exit_code(codes: Iterable[int]) -> int:
    """Return the worst of several exit codes; 0 of none.

    FAULT (20), an alarm (40), an input or output that failed (3, 2), NOT TESTED (30), DEGRADED
    (10), HEALTHY.
    """
    known = {
        INPUT_OUTPUT_EXIT_CODE if code == ConfigurationError.exit_code else code for code in codes
    }
    return next((code for code in EXIT_CODES_WORST_FIRST if code in known), 0)


def exit_code_of_inputs(codes: Sequence[int]) -> int:
    """Return the exit code of a call by those of its inputs: that of one, the worst of several."""
    return codes[0] if len(codes) == 1 else worst_exit_code(codes)


TABLE_COLUMNS = 100
"""Columns that our widest tables need; a narrower terminal breaks their lines."""


def print_status(text: str) -> None:
    """Print one line to standard error, on a terminal broken between words; it may be closed."""
    line = f"ehadiag: {printable(text)}"
    try:
        if sys.stderr.isatty():
            import shutil  # noqa: PLC0415 - loads compression
            import textwrap  # noqa: PLC0415

            width = shutil.get_terminal_size().columns
            line = textwrap.fill(
                line, width, break_long_words=False, break_on_hyphens=False, subsequent_indent="  "
            )
        print(line, file=sys.stderr, flush=True)
    except OSError:
        discard_stream(sys.stderr)


def print_text(text: str) -> None:
    """Print lines of plain text to standard output. InputOutputError: it is closed, or full."""
    write_output(printable_lines(text) + "\n")


def write_output(text: str) -> None:
    """Write text to standard output; its control characters are replaced already."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        discard_stream(sys.stdout)
        raise InputOutputError(f"standard output: {reason_of(error)}") from None


@contextmanager
def report_failure(codes: list[int], of: type[EhadiagError] = InputOutputError) -> Iterator[None]:
    """Print an error of the block, which ends there; add its exit code, or 0 without an error."""
    try:
        yield
    except of as error:
        print_status(str(error))
        codes.append(error.exit_code)
    else:
        codes.append(0)


def discard_stream(stream: TextIO) -> None:
    """Let the rest of a stream go to the null device: it would fail again at the exit."""
    with contextlib.suppress(OSError, ValueError):  # a stream of a test has no number
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def transport_losses(transport: Transport) -> str:
    """Return the losses of a transport, for the end of a sentence; empty without one."""
    return f"; {transport.detail}" if transport.detail else ""


def print_compiling_notice(*, simulation: bool = False, identification: bool = True) -> None:
    """Compile kernels that are needed and not there, and print which."""
    from ehadiag.compile.libraries import compile_kernels  # noqa: PLC0415 - not for help texts

    compile_kernels(print_status, simulation=simulation, identification=identification)


class _EncodedText(io.StringIO):
    """Text that is to be encoded as standard output is."""

    encoding = "utf-8"


def terminal_console(*, least: int = 0) -> Console:
    """Return a console like standard output's, of which `write_drawn` writes what is drawn on it.

    It does not write by itself: that would end the program where a pipe is closed.

    least: columns also on a narrower terminal.
    """
    from rich.console import Console  # noqa: PLC0415 - only who prints tables needs it

    from ehadiag.core.conventions import PIPE_COLUMNS  # noqa: PLC0415 - not for help texts

    there = Console()
    width = max(there.width, least) if there.is_terminal else PIPE_COLUMNS
    out = _EncodedText()
    out.encoding = sys.stdout.encoding or "utf-8"
    # Names of others are no markup.
    return Console(
        file=out,
        force_terminal=there.is_terminal,
        highlight=False,
        markup=False,
        emoji=False,
        width=width,
    )


def write_drawn(console: Console) -> None:
    """Write to standard output what was drawn on a `terminal_console`."""
    write_output(cast("_EncodedText", console.file).getvalue())


class _ProgressLines:
    """Progress as lines: stage, share done, time left."""

    def __init__(self) -> None:
        self._began = self._printed = time.monotonic()

    def update(self, stage: str, share: float) -> None:
        """Print a line if it is time for one."""
        now = time.monotonic()
        # Seldom, so that a log stays short.
        if now - self._printed < 30.0 or share <= 0.0:
            return
        self._printed = now
        spent = now - self._began
        print_status(f"{stage} {share:.0%}, about {spent * (1.0 - share) / share:.0f} s left")


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show stage, share done and time left on standard error, in a log as lines."""
    if not sys.stderr.isatty():
        yield _ProgressLines().update
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    terminal = Console(file=cast("TextIO", _TolerantStream(sys.stderr)))
    with Progress(*columns, console=terminal, transient=True) as display:
        task = display.add_task("", total=1.0)
        yield lambda stage, share: display.update(task, description=stage, completed=share)


@contextmanager
def counting_bar(total: int, what: str = "recording") -> Iterator[Callable[[], None]]:
    """Show how many of so many are done, and how fast, on standard error, in a log as lines."""
    if not sys.stderr.isatty():
        lines, done = _ProgressLines(), itertools.count(1)
        yield lambda: lines.update(f"{total} {what}{'s' * (total != 1)}:", next(done) / total)
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    terminal = Console(file=cast("TextIO", _TolerantStream(sys.stderr)))
    columns = (
        MofNCompleteColumn(),
        BarColumn(),
        TextColumn("{task.fields[rate]}", markup=False),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=terminal, transient=True) as display:
        task = display.add_task("", total=total, rate="")

        def advance() -> None:
            speed = display.tasks[0].speed
            rate = "" if speed is None else f"{speed:.1f} {what}s/s"
            display.update(task, advance=1, rate=rate)

        yield advance


class _TolerantStream:
    """Terminal that may be closed: a test goes on without its progress."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.encoding = stream.encoding

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._stream.fileno()


TESTS_SCHEMA = "ehadiag.tests/1"
TEST_LIST_COLUMNS = ("no.", "test", "start", "length s", "outcome", "serial", "channel", "remarks")


def print_test_list(source: str, tests: Iterable[ListedTest], *, as_json: bool) -> None:
    """Print number, test, start, length, outcome, serial number and channel of each test.

    tests: its tests, taken one at a time; as_json: one JSON object a line instead of a table.
    """
    from msgspec.structs import asdict, astuple  # noqa: PLC0415 - not for help texts

    if as_json:
        for test in tests:
            row = asdict(test)
            print_text(json.dumps({"schema": TESTS_SCHEMA, "source": valid_text(source), **row}))
        return
    from rich.table import Table  # noqa: PLC0415 - only who prints tables needs it

    table = Table(box=None, pad_edge=False)
    for name in TEST_LIST_COLUMNS:
        table.add_column(name, overflow="fold")
    for test in tests:
        shown = (*astuple(test)[:-1], "; ".join(test.remarks))
        table.add_row(*("-" if cell in (None, "") else printable(str(cell)) for cell in shown))
    print_text(source)
    console = terminal_console()
    console.print(table, crop=False)
    write_drawn(console)


SUMMARY_SCHEMA = "ehadiag.summary/1"
MAX_FAILURES_NAMED = 100
"""Failures that are kept with their reasons."""
MAX_WORST_UNITS = 10


class BatchSummary:
    """Takes each result, and keeps what is told at the end; of a size that does not grow."""

    def __init__(self, inputs: int) -> None:
        self._inputs = inputs
        self._begin = time.perf_counter()
        self._verdicts: Counter[str] = Counter()
        self._failures: list[dict[str, str]] = []
        self._failed = 0
        self._not_tested: list[dict[str, Any]] = []
        self._worst: dict[object, dict[str, Any]] = {}
        self.reused = 0
        """Results that an earlier call had found."""
        self.left = 0
        """Recordings that were not come to."""
        self.codes: set[int] = set()
        """Exit codes that came."""

    def take(self, result: Result) -> None:
        """Count a result."""
        if result.error is not None:
            self._failed += 1
            if len(self._failures) < MAX_FAILURES_NAMED:
                error = {"source": result.source, "error": result.error.text}
                self._failures.append(error)
            return
        verdict = result.state or "NOT_TESTED"
        self._verdicts[verdict] += 1
        if verdict == "NOT_TESTED":
            if len(self._not_tested) < MAX_FAILURES_NAMED:
                reasons = {"source": result.source, "reasons": list(result.reasons)}
                self._not_tested.append(reasons)
            return
        self._rank(result, verdict)

    def _rank(self, result: Result, verdict: str) -> None:
        """Keep it if it is among the worst units; of one unit the worst result."""
        found = [
            (item.estimate, item)
            for item in result.severities.values()
            if item.estimate is not None
        ]
        if not found:
            return
        severity, worst = max(found, key=itemgetter(0))
        unit = result.source if result.serial is None else ("serial", result.serial)
        before = self._worst.get(unit)
        if before is None or before["estimate"] < severity:
            self._worst[unit] = {
                "serial": result.serial,
                "source": result.source,
                "verdict": verdict,
                "fault": worst.name,
                "estimate": worst.estimate,
                "interval95": worst.interval95,
            }
        if len(self._worst) > MAX_WORST_UNITS:
            del self._worst[min(self._worst, key=lambda key: self._worst[key]["estimate"])]

    def tree(self, exit_code: int, workers: int) -> dict[str, Any]:
        """Return the object `ehadiag.summary/1`."""
        from msgspec import to_builtins  # noqa: PLC0415 - not for help texts

        from ehadiag.records import package  # noqa: PLC0415 - the same

        elapsed = time.perf_counter() - self._begin
        done = sum(self._verdicts.values()) + self._failed - self.reused
        names = ("HEALTHY", "DEGRADED", "FAULT", "NOT_TESTED")
        worst = sorted(self._worst.values(), key=lambda item: -item["estimate"])
        return {
            "schema": SUMMARY_SCHEMA,
            "inputs": self._inputs,
            "verdicts": {name: self._verdicts[name] for name in names},
            "failed": self._failed,
            "reused": self.reused,
            "not_diagnosed": self.left,
            "worst": worst,
            "failures": self._failures,
            "not_tested": self._not_tested,
            "workers": workers,
            "elapsed_s": round(elapsed, 3),
            "rate_per_s": round(done / elapsed, 3) if elapsed > 0 else None,
            "exit_code": exit_code,
            "package": to_builtins(package()),
        }


def summary_lines(tree: dict[str, Any]) -> list[str]:
    """Return the summary for people."""
    verdicts = ", ".join(
        f"{count} {name.replace('_', ' ')}" for name, count in tree["verdicts"].items() if count
    )
    failed = f", {tree['failed']} not readable" if tree["failed"] else ""
    reused = f", {tree['reused']} of them from an earlier call" if tree["reused"] else ""
    lines = [
        f"{tree['inputs']} recordings in {tree['elapsed_s']:.1f} s ({tree['rate_per_s']:.1f}/s): "
        f"{verdicts or 'none diagnosed'}{failed}{reused}"
    ]
    if tree["not_diagnosed"]:
        lines.append(f"not diagnosed: {tree['not_diagnosed']}")
    counts = tree["verdicts"]
    worst = [item for item in tree["worst"] if item["verdict"] in ("FAULT", "DEGRADED")]
    for item in worst:
        unit = "" if item["serial"] is None else f"serial {item['serial']}: "
        lines.append(
            f"{item['verdict']} {unit}{item['fault']} {item['estimate']:.3f}  {item['source']}"
        )
    lines += _more(counts["FAULT"] + counts["DEGRADED"] - len(worst), "FAULT or DEGRADED")
    lines += [f"NOT TESTED {item['source']}: {'; '.join(item['reasons'])}"
              for item in tree["not_tested"][:MAX_WORST_UNITS]]  # fmt: skip
    lines += _more(counts["NOT_TESTED"] - MAX_WORST_UNITS, "NOT TESTED")
    lines += [f"not readable: {item['error']}" for item in tree["failures"][:MAX_WORST_UNITS]]
    lines += _more(tree["failed"] - MAX_WORST_UNITS, "not readable")
    return [printable(line) for line in lines]


def _more(count: int, what: str) -> list[str]:
    """Line on those that are not listed."""
    return [f"and {count} more {what}"] if count > 0 else []
