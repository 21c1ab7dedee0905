"""Files of a whole call's results: CSV and Parquet tables, JUnit XML, the summary."""

from __future__ import annotations

import io
import json
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import msgspec

from ehadiag.assess.verdict import Verdict
from ehadiag.estimate import Effect, Severity
from ehadiag.result import Result
from firmware_iface.errors import (
    ConfigurationError,
    InputOutputError,
    install_command,
    printable,
    reason_of,
)
from firmware_iface.files import RESULT_MODE, Folder

if TYPE_CHECKING:
    from junitparser import TestCase

Cell = str | int | float | None
PATHS = {
    "source": ("source", str),
    "date": ("date", str),
    "test": ("test", str),
    "actuator": ("actuator", str),
    "serial": ("serial", int),
    "verdict": ("state", str),
    "spool_rms": ("fit.spool_rms", float),
    "pressure_rms": ("fit.pressure_rms", float),
    "oil_temperature_degC": ("origins.oil_temperature_degC", float),
    "supply_pressure_MPa": ("origins.supply_pressure_MPa", float),
    "frames": ("quality.frames", int),
    "lost": ("quality.lost", int),
    "total_s": ("timing_s.total", float),
    "reasons": ("reasons", str),
    "notes": ("quality.notes", str),
    "error": ("error.text", str),
}
"""Of a column the place in the result, and its kind; of several recordings the first counts."""
HEAD = list(PATHS).index("spool_rms")
"""Columns before the severities."""
OF_SEVERITY: dict[str, Callable[[Severity], Cell]] = {
    "": lambda item: item.estimate,
    "_std": lambda item: item.std,
    "_low95": lambda item: item.interval95 and item.interval95[0],
    "_high95": lambda item: item.interval95 and item.interval95[1],
}
"""Ends of the columns of a severity."""
OF_EFFECT: dict[str, Callable[[Effect], Cell]] = {
    "": lambda item: item.value,
    "_std": lambda item: item.std,
}
"""Ends of the columns of an effect, SI."""


@cache
def result_columns() -> dict[str, type[str] | type[int] | type[float]]:
    """Return names and kinds of the columns, with the severities and effects of the registry."""
    from ehadiag.model.registry import FAULTS, REGISTRY  # noqa: PLC0415 - loads kernels

    kinds = [(name, kind) for name, (_, kind) in PATHS.items()]
    effects = [item.name for item in REGISTRY if item not in FAULTS]
    return {
        **dict(kinds[:HEAD]),
        **{f"{item.name}{end}": float for item in FAULTS for end in OF_SEVERITY},
        **dict(kinds[HEAD:]),
        **{f"{name}{end}": float for name in effects for end in OF_EFFECT},
    }


def result_row(result: Result) -> dict[str, Cell]:
    """Flatten a result; text in it is printable, several reasons are joined by `; `.

    result: a result. Returns a value for each of `result_columns`.
    """
    row: dict[str, Cell] = dict.fromkeys(result_columns())
    row |= {name: _value(result, path) for name, (path, _) in PATHS.items()}
    shown = result.as_shown
    for name, severity in shown.severities.items():
        row |= {f"{name}{end}": of(severity) for end, of in OF_SEVERITY.items()}
    for effect in shown.effects:
        row |= {f"{effect.name}{end}": of_effect(effect) for end, of_effect in OF_EFFECT.items()}
    return row


def _value(result: Result, path: str) -> Cell:
    node: object = result
    for name in path.split("."):
        if isinstance(node, tuple):
            node = node[0] if node else None
        node = None if node is None else getattr(node, name)
    if isinstance(node, tuple):
        node = "; ".join(map(str, node))
    if isinstance(node, str):
        return printable(node)
    assert node is None or isinstance(node, int | float)
    return node


RESULTS_SCHEMA_MARK = b"ehadiag.results/1"
"""Stands in the footer of our Parquet files."""
PARQUET_FOOTER_BYTES = 1 << 16
CSV_HEADER_START = ",".join(list(PATHS)[:HEAD]).encode()
"""Begins our CSV files."""


ResultSink = Callable[[Result], None]
"""Is handed each result."""
FORMULA_PREFIXES = ("=", "+", "-", "@")
"""What a spreadsheet takes for a formula at the beginning of a text."""


@contextmanager
def atomic_file(name: str, what: str) -> Iterator[BinaryIO]:
    """Give a file to write that is there under its name when the block ends well, else not.

    name: of the file; one that is there is replaced; what: its kind, for errors. Yields open for
    writing. InputOutputError: it cannot be written.
    """
    path = Path(name)
    try:
        with (
            Folder.at(path.parent, RESULT_MODE, follow=True) as folder,
            folder.drafted(path.name) as file,
        ):
            yield file
    except (OSError, ValueError) as error:
        why = reason_of(error)
        raise InputOutputError(f"{what} {name}: {why}") from None


@contextmanager
def csv_table(name: str) -> Iterator[ResultSink]:
    """Write one row a result as CSV; see `atomic_file`."""
    with atomic_file(name, "results") as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
        import csv  # noqa: PLC0415 - only where a table is written

        writer = csv.DictWriter(text, result_columns())
        writer.writeheader()

        def take(result: Result) -> None:
            writer.writerow({key: _csv_cell(value) for key, value in result_row(result).items()})

        yield take
        text.detach()


@contextmanager
def parquet_table(name: str) -> Iterator[ResultSink]:
    """Write one row a result as Parquet; see `atomic_file`.

    name: of the file; one that is there is replaced. Yields is handed each result.
    ConfigurationError: pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: PLC0415 - optional, and slow
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError:
        raise ConfigurationError(
            f"results {name}: Parquet needs pyarrow: {install_command('parquet')}"
        ) from None
    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    fields = [(key, kinds[kind]) for key, kind in result_columns().items()]
    schema = pyarrow.schema(fields, metadata={b"schema": RESULTS_SCHEMA_MARK})
    with (
        atomic_file(name, "results") as file,
        parquet.ParquetWriter(file, schema) as writer,
    ):
        rows: list[dict[str, Any]] = []

        def take(result: Result) -> None:
            rows.append(result_row(result))
            # A group of rows of the file: so many are held at once.
            if len(rows) == 256:
                flush()

        def flush() -> None:
            writer.write_table(pyarrow.Table.from_pylist(rows, schema=schema))
            rows.clear()

        yield take
        flush()


def _begins_as_csv(file: BinaryIO, _size: int) -> bool:
    return file.read(len(CSV_HEADER_START)) == CSV_HEADER_START


def _ends_as_parquet(file: BinaryIO, size: int) -> bool:
    file.seek(max(size - PARQUET_FOOTER_BYTES, 0))
    return RESULTS_SCHEMA_MARK in file.read(PARQUET_FOOTER_BYTES)


class TableFormat(msgspec.Struct, frozen=True):
    """A format of tables with one row a result."""

    write: Callable[[str], AbstractContextManager[ResultSink]]
    """Opens a file of that name for the results of a call."""
    is_ours: Callable[[BinaryIO, int], bool]
    """Whether an open file of a size in bytes is such a table: it is no recording."""


TABLE_FORMATS: Mapping[str, TableFormat] = {
    ".csv": TableFormat(csv_table, _begins_as_csv),
    ".parquet": TableFormat(parquet_table, _ends_as_parquet),
}
"""Formats of `--results` by suffix, besides lines of JSON."""
RESULT_SUFFIXES = (".jsonl", *TABLE_FORMATS)


def is_result_table(path: Path) -> bool:
    """Whether a file was written by `--results`; False too where it cannot be read."""
    kind = TABLE_FORMATS.get(path.suffix.lower())
    try:
        if kind is None or not path.is_file():
            return False
        with path.open("rb") as file:
            return kind.is_ours(file, path.stat().st_size)
    except OSError:
        return False


def result_file_suffix(name: str) -> str:
    """Suffix of a file of results; ConfigurationError for one that none is written as."""
    suffix = Path(name).suffix.lower()
    if suffix not in RESULT_SUFFIXES:
        raise ConfigurationError(f"results {name}: need a name in {', '.join(RESULT_SUFFIXES)}")
    return suffix


JUNIT_NOT_TESTED = ("skipped", "error")
"""What a case NOT TESTED can be; the first unless named."""


@contextmanager
def junit_report(name: str, not_tested: str = JUNIT_NOT_TESTED[0]) -> Iterator[ResultSink]:
    """Write a report in the form of test frameworks, which build servers show; see `atomic_file`.

    A case for each result: DEGRADED and FAULT are failures, NOT TESTED is `not_tested`, an input
    that could not be read is an error. Some 2 KB of memory a case.
    """
    from junitparser import JUnitXml, TestSuite  # noqa: PLC0415 - only who asks for it

    suite = TestSuite("ehadiag diagnose")
    suite.timestamp = datetime.now(UTC).replace(tzinfo=None).isoformat(timespec="seconds")
    suite.hostname = printable(platform.node())
    with atomic_file(name, "report") as file:
        yield lambda result: suite.add_testcase(_junit_case(result, not_tested))
        report = JUnitXml("ehadiag")
        report.add_testsuite(suite)
        out = io.BytesIO()
        report.write(out)
        file.write(out.getvalue())


def _junit_case(result: Result, not_tested: str) -> TestCase:
    from junitparser import Error, Failure, Skipped, TestCase  # noqa: PLC0415

    serial = "" if result.serial is None else f".{result.serial}"
    seconds = None if result.timing_s is None else result.timing_s.total
    case = TestCase(printable(result.source), printable(f"{result.actuator}{serial}"), seconds)
    found = [
        f"{item.name} {item.estimate:.5f}"
        for item in result.severities.values()
        if item.estimate is not None
    ]
    found += [
        f"{item.name} {item.shown(item.value):.4g} {item.shown_unit}"
        for item in result.effects
        if item.value is not None
    ]
    case.system_out = ", ".join(found)
    reasons = printable("; ".join(result.reasons))
    if result.error is not None:
        case.result = [Error(printable(result.error.text), "unreadable")]
    elif result.verdict is Verdict.NOT_TESTED:
        kind = Error if not_tested == "error" else Skipped
        case.result = [kind(reasons, result.verdict.name)]
    elif result.verdict is not Verdict.HEALTHY:
        case.result = [Failure(reasons, result.verdict.name)]
    return case


def _csv_cell(value: object) -> object:
    """Keep a spreadsheet from taking a text of others for a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA_PREFIXES) else value


def write_summary(tree: dict[str, Any], name: str) -> None:
    """Write the object to a file; InputOutputError where that fails."""
    with atomic_file(name, "summary") as file:
        file.write(json.dumps(tree, indent=2, allow_nan=False).encode() + b"\n")
