"""Files that hold the results of a whole call: CSV, Parquet, JUnit XML."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from ehadiag.cli.batch.own_tables import MARK
from ehadiag.cli.batch.row import COLUMNS, row_of
from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.printable import printable

if TYPE_CHECKING:
    from junitparser import TestCase

__all__ = ["Take", "csv_table", "junit_report", "kind_of_table", "parquet_table", "whole_file"]

Take = Callable[[dict[str, Any]], None]
"""Is handed each result, `ehadiag.diagnosis/2`."""
GROUP = 256
"""Rows that a Parquet file has in one group: so many are held at once."""
FORMULA = ("=", "+", "-", "@")
"""What a spreadsheet takes for a formula at the beginning of a text."""


def kind_of_table(name: str) -> str:
    """Suffix of a file of results; ConfigurationError for one that none is written as."""
    suffix = Path(name).suffix.lower()
    if suffix not in (".jsonl", ".csv", ".parquet"):
        raise ConfigurationError(f"results {name}: need a name in .jsonl, .csv or .parquet")
    return suffix


@contextmanager
def whole_file(name: str, what: str) -> Iterator[BinaryIO]:
    """Give a file to write that is there under its name when the block ends well, else not.

    Parameters
    ----------
    name : str
        Of the file; one that is there is replaced.
    what : str
        Its kind, for errors.

    Yields
    ------
    BinaryIO
        Open for writing.

    Raises
    ------
    InputOutputError
        It cannot be written.
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
def csv_table(name: str) -> Iterator[Take]:
    """Write one row a result as CSV; see `whole_file`."""
    with whole_file(name, "results") as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
        writer = csv.DictWriter(text, COLUMNS)
        writer.writeheader()

        def take(tree: dict[str, Any]) -> None:
            writer.writerow({key: _cell(value) for key, value in row_of(tree).items()})

        yield take
        text.detach()


@contextmanager
def parquet_table(name: str) -> Iterator[Take]:
    """Write one row a result as Parquet; see `whole_file`.

    Parameters
    ----------
    name : str
        Of the file; one that is there is replaced.

    Yields
    ------
    Take
        Is handed each result.

    Raises
    ------
    ConfigurationError
        pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: PLC0415 - optional, and slow
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError:
        raise ConfigurationError(
            f"results {name}: Parquet needs pyarrow, pip install 'ehadiag[parquet]'"
        ) from None
    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    fields = [(key, kinds[kind]) for key, kind in COLUMNS.items()]
    schema = pyarrow.schema(fields, metadata={b"schema": MARK})
    with (
        whole_file(name, "results") as file,
        parquet.ParquetWriter(file, schema) as writer,
    ):
        rows: list[dict[str, Any]] = []

        def take(tree: dict[str, Any]) -> None:
            rows.append(row_of(tree))
            if len(rows) == GROUP:
                flush()

        def flush() -> None:
            writer.write_table(pyarrow.Table.from_pylist(rows, schema=schema))
            rows.clear()

        yield take
        flush()


@contextmanager
def junit_report(name: str) -> Iterator[Take]:
    """Write a report in the form of test frameworks, which build servers show; see `whole_file`.

    A case for each result: DEGRADED and FAULT are failures, NOT TESTED is skipped, an input that
    could not be read is an error. Some 2 KB of memory a case.
    """
    from junitparser import JUnitXml, TestSuite  # noqa: PLC0415 - only who asks for it

    suite = TestSuite("ehadiag diagnose")
    with whole_file(name, "report") as file:
        yield lambda tree: suite.add_testcase(_case(tree))
        report = JUnitXml("ehadiag")
        report.add_testsuite(suite)
        out = io.BytesIO()
        report.write(out)
        file.write(out.getvalue())


def _case(tree: dict[str, Any]) -> TestCase:
    from junitparser import Error, Failure, Skipped, TestCase  # noqa: PLC0415

    serial = "" if tree["serial"] is None else f".{tree['serial']}"
    timing = tree["timing_s"] or {}
    case = TestCase(
        printable(tree["source"]), printable(f"{tree['actuator']}{serial}"), timing.get("total")
    )
    values = {name: fault["estimate"] for name, fault in tree["faults"].items()}
    case.system_out = ", ".join(
        f"{name} {value:.5f}" for name, value in values.items() if value is not None
    )
    reasons = printable("; ".join(tree["reasons"]))
    if tree["error"] is not None:
        case.result = [Error(printable(tree["error"]["text"]), "unreadable")]
    elif tree["verdict"] == "NOT_TESTED":
        case.result = [Skipped(reasons, "NOT_TESTED")]
    elif tree["verdict"] != "HEALTHY":
        case.result = [Failure(reasons, tree["verdict"])]
    return case


def _cell(value: object) -> object:
    """Keep a spreadsheet from taking a text of others for a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value
