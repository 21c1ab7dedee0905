"""Reads tables of decoded signals: CSV, Parquet; each signal with time stamps of its own.

Stamps that scatter about the even clock of a logger are replaced by that clock.
"""

from __future__ import annotations

import csv
import itertools
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from firmware_iface.errors import (
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    install_command,
    printable,
)
from firmware_iface.logs.log_files import (
    MAX_TEXT_HEADER_BYTES,
    UTF16_MARKS,
    Budget,
    beginning_of,
    find_reader,
    log_size,
    unpacked_log,
)
from firmware_iface.recording import FloatArray, RecordedSignal
from firmware_iface.signals.columns import TIME_ROLE, ColumnMap, column_unit, missing_channels


class EvenClockLimits(msgspec.Struct, frozen=True):
    """Limits that tell whether stamps are replaced by an even clock."""

    block: int = 200
    """Rows in a block; the medians of the blocks show whether the stamps keep to one line."""
    blocks: int = 5
    """Least number of blocks."""
    scatter: float = 0.02
    """Least standard deviation of stamps that are replaced, in intervals."""
    offset: float = 0.5
    """Range of the blocks' medians that is allowed, in intervals: one missing row shifts by 1."""
    deviation: float = 6.0
    """The same in standard deviations of a median; the larger range is allowed."""


EVEN_CLOCK = EvenClockLimits()


def even_times(time: FloatArray) -> tuple[FloatArray, float]:
    """Replace stamps that scatter about an even clock by the clock's times.

    time: stamps in the order of the rows, s, shape (n,). Returns times, shape (n,), and the
    deviation of the stamps from them, s. Returns the stamps as they are and 0 where they are even
    already, or keep to no line: rows are missing, or each row has an instant of its own.
    """
    blocks = len(time) // EVEN_CLOCK.block
    if blocks < EVEN_CLOCK.blocks or not np.isfinite(time).all():
        return time, 0.0
    index = np.arange(len(time), dtype=np.float64)
    step, level = np.polyfit(index, time - time[0], 1)
    rest = time - time[0] - level - step * index
    scatter = float(np.std(rest))
    if step <= 0.0 or scatter < EVEN_CLOCK.scatter * step:
        return time, 0.0
    medians = np.median(rest[: blocks * EVEN_CLOCK.block].reshape(blocks, EVEN_CLOCK.block), axis=1)
    # A median of stamps scatters by a quarter more than their mean.
    allowed = max(
        EVEN_CLOCK.offset * step,
        EVEN_CLOCK.deviation * 1.25 * scatter / float(np.sqrt(EVEN_CLOCK.block)),
    )
    if float(np.ptp(medians)) > allowed or float(np.abs(rest).max()) > EVEN_CLOCK.block * step:
        return time, 0.0
    return time[0] + level + step * index, scatter


DELIMITERS = ";\t,"
MIN_TABLE_ROWS = 10
MAX_TABLE_ROWS = 800_000
"""Most rows of a table, all held at once in some 300 MB: 13 minutes at 1 kHz, 40 s at 20 kHz."""
MAX_TABLE_CELLS = 10_000_000
"""Most values of a Parquet file, of which all columns are unpacked."""
DATE_RESOLUTIONS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Resolutions in which pandas holds dates."""


class SignalReader(Protocol):
    """Reads the decoded signals of one kind of log; made without arguments, one for each file.

    It may be the class of an entry point of `ehadiag.log_readers`, as `LogReader` of
    `firmware_iface.logs.log_files` is for frames; `LogReader` describes `signature`.
    """

    signature: bytes

    def signals(
        self, path: Path, columns: ColumnMap, budget: Budget, *, complete: bool
    ) -> dict[str, RecordedSignal]:
        """Read the signals that have a role; `table_signals` does most of this for a table.

        path: the file, unpacked already; it exists and is not empty; budget: bytes and rows that
        reading may cost; complete: all channels must be in this one file. Returns by role, SI.
        """


def read_signals(
    path: Path | str, columns: ColumnMap, budget: Budget, *, complete: bool = True
) -> dict[str, RecordedSignal]:
    """Read the signals that have a role.

    path: CSV, Parquet or MF4; packed by gzip too; columns: which column is what; budget: bytes and
    rows that reading may cost; complete: all channels must be in this one file. Returns by role,
    SI. InputOutputError: missing, unreadable, too large, without a library, without numbers;
    ConfigurationError: a mapped column is missing, a unit does not fit its quantity.
    """
    path = Path(path)
    size = log_size(path)
    found = find_reader(path, decodes=True)
    if found is None:
        raise ConfigurationError(f"log {path}: no kind of decoded signals")
    if size > budget.size:
        raise InputOutputError(f"log {path}: larger than --max-log-size allows")
    if size == 0:
        raise InputOutputError(f"log {path}: the file is empty")
    reader: SignalReader = found.reader
    with unpacked_log(path, budget.size) as plain:
        try:
            return reader.signals(plain.path, columns, budget, complete=complete)
        except EhadiagError:
            raise
        except Exception:
            if not found.origin:
                raise
            raise InputOutputError(f"log {path}: not readable by {found.origin}") from None


class ParquetReader:
    """Tables of Apache Parquet."""

    signature = b""

    def signals(
        self,
        path: Path,
        columns: ColumnMap,
        budget: Budget,  # noqa: ARG002
        *,
        complete: bool,
    ) -> dict[str, RecordedSignal]:
        """Read a file, see `SignalReader`."""
        _pandas(path)
        try:
            import pyarrow.parquet  # noqa: PLC0415 - optional, and slow

            about = pyarrow.parquet.read_metadata(path)
            # The metadata state the size before anything is unpacked.
            cells = about.num_rows * about.num_columns
            if about.num_rows > MAX_TABLE_ROWS or cells > MAX_TABLE_CELLS:
                raise _too_long(path)
            table = pyarrow.parquet.read_table(
                path, columns=_plain_columns(about), use_pandas_metadata=False
            ).to_pandas(ignore_metadata=True)
        except ImportError:
            raise InputOutputError(
                f"log {path}: Parquet needs pyarrow: {install_command('daq')}"
            ) from None
        except InputOutputError:
            raise
        except Exception:  # pyarrow raises what it likes, and quotes the file
            raise InputOutputError(f"log {path}: not a readable Parquet file") from None
        table.columns = [str(name) for name in table.columns]
        return table_signals(table, {}, list(table.columns), columns, path, complete=complete)


def _plain_columns(about: Any) -> list[str]:
    """Columns of plain numbers; a text column of a few bytes may unpack to any size."""
    schema = about.schema
    columns = (schema.column(index) for index in range(about.num_columns))
    return [
        item.path
        for item in columns
        if item.max_repetition_level == 0 and item.physical_type != "BYTE_ARRAY"
    ]


class CsvTableReader:
    """Tables in text: a row of names, perhaps one of units, then numbers."""

    signature = b""

    def signals(
        self, path: Path, columns: ColumnMap, budget: Budget, *, complete: bool
    ) -> dict[str, RecordedSignal]:
        """Read a file, see `SignalReader`."""
        table, units, names = _read_csv(path, columns, budget)
        return table_signals(table, units, names, columns, path, complete=complete)


def _pandas(path: Path) -> Any:
    try:
        import pandas  # noqa: PLC0415 - optional, and slow
    except ImportError:
        raise InputOutputError(
            f"log {path}: decoded signals need pandas: {install_command('daq')}"
        ) from None
    return pandas


def _read_csv(
    path: Path, columns: ColumnMap, budget: Budget
) -> tuple[Any, dict[str, str], list[str]]:
    """Read a data frame, the units that the file says by column, and the names of all columns."""
    pandas = _pandas(path)
    begin = beginning_of(path, MAX_TEXT_HEADER_BYTES)
    if begin.startswith(UTF16_MARKS):
        raise InputOutputError(f"log {path}: is in UTF-16: save it as UTF-8")
    text = begin.decode("utf-8-sig", "replace").lstrip()
    lines = [line for line in text.splitlines()[:4] if line.strip()]
    delimiter = max(DELIMITERS, key=lines[0].count)
    rows = list(csv.reader(lines, delimiter=delimiter))
    names = [name.strip() for name in rows[0]]
    skipped = 1
    units: dict[str, str] = {}
    if len(rows) > 1 and not any(_is_number(cell) for cell in rows[1]):
        skipped = 2
        units = {name: cell.strip(" []()") for name, cell in zip(names, rows[1], strict=False)}
    wanted = {item.column for item in columns.resolve(names, f"log {path}").values()}
    if not wanted:
        return pandas.DataFrame(columns=names), units, names
    twice = [name for name in names if name in wanted and names.count(name) > 1]
    if twice:
        raise InputOutputError(
            f"log {path}: several columns are named {printable(twice[0])!r}: rename all but one"
        )
    decimal = "," if delimiter != "," and "," in lines[-1] else "."
    try:
        # pandas warns of rows longer than the header, and of columns of mixed kinds: both show
        # by missing values afterwards.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = pandas.read_csv(
                path,
                sep=delimiter,
                decimal=decimal,
                skiprows=skipped,
                header=None,
                names=names,
                usecols=wanted,
                index_col=False,
                nrows=min(budget.frames, MAX_TABLE_ROWS) + 1,
                skip_blank_lines=True,
                encoding="utf-8",
                encoding_errors="replace",
                on_bad_lines="skip",
            )
    except (ValueError, OSError):
        raise InputOutputError(f"log {path}: not a readable table of signals") from None
    if len(table) > MAX_TABLE_ROWS:
        raise _too_long(path)
    return table, units, names


def _too_long(path: Path) -> InputOutputError:
    return InputOutputError(
        f"log {path}: more than {MAX_TABLE_ROWS} rows, or {MAX_TABLE_CELLS} values, are too"
        " many to hold at once; cut it about the test"
    )


def _is_number(text: str) -> bool:
    try:
        float(text.strip().replace(",", "."))
    except ValueError:
        return False
    return True


def table_signals(
    table: Any,
    units: dict[str, str],
    present: list[str],
    columns: ColumnMap,
    path: Path,
    *,
    complete: bool,
) -> dict[str, RecordedSignal]:
    """Take the signals that have a role out of a table.

    table: a data frame of pandas, with the columns that are needed at least; units: units that the
    file gives, by column; present: names of all columns of the file; path: file, for errors;
    complete: all channels must be there. Returns by role, SI. InputOutputError: without numbers, or
    time stamps; ConfigurationError: a mapped column is missing, a unit does not fit its quantity.
    """
    import pandas  # noqa: PLC0415 - read by now

    found = columns.resolve(present, f"log {path}")
    if complete and (lacking := missing_channels(found, present)):
        raise ConfigurationError(f"log {path}: {lacking}")
    if TIME_ROLE not in found:
        raise ConfigurationError(
            f"log {path}: no column of time stamps: name it by --column time=NAME:UNIT"
        )

    def numbers(role: str) -> FloatArray:
        column = found[role]
        gain, bias = column_unit(column, units.get(column.column, ""), role, f"log {path}")
        plain = pandas.to_numeric(table[column.column], errors="coerce")
        return np.asarray(plain, dtype=np.float64) * gain + bias

    series = table[found[TIME_ROLE].column]
    instants = _seconds(series)
    time = numbers(TIME_ROLE) if instants is None else instants
    if not np.isfinite(time).any():
        begins = "" if series.dropna().empty else f" ({printable(str(series.dropna().iloc[0]))}, …)"
        raise InputOutputError(
            f"log {path}: no time stamp in column "
            f"{printable(found[TIME_ROLE].column)!r}{begins}: need"
            " numbers, in s or the unit that --column time=NAME:UNIT says, or ISO 8601 such as"
            " 2026-03-01T12:00:00.001"
        )
    return checked_signals(
        ((role, (time, numbers(role))) for role in found if role != TIME_ROLE), path
    )


def _seconds(series: Any) -> FloatArray | None:
    """Return dates and times of day, or spans of time, in s; None for numbers.

    Dates count from 1970, UTC; without a zone they are taken for UTC.
    """
    import pandas  # noqa: PLC0415 - read by now

    kinds = pandas.api.types
    if kinds.is_object_dtype(series) or kinds.is_string_dtype(series):
        if np.isfinite(np.asarray(pandas.to_numeric(series, errors="coerce"), np.float64)).any():
            return None
        text = series.astype("string").str.replace(",", ".")  # decimal comma
        series = pandas.to_datetime(text, format="ISO8601", errors="coerce", utc=True)
    if kinds.is_datetime64_any_dtype(series):
        series = series.dt.tz_convert(None) if series.dt.tz is not None else series
    elif not kinds.is_timedelta64_dtype(series):
        return None
    values = series.to_numpy()
    unit, many = np.datetime_data(values.dtype)
    whole = values.astype(np.int64).astype(np.float64)
    return np.where(np.isnat(values), np.nan, whole * (many / DATE_RESOLUTIONS[unit]))


def checked_signals(
    found: Iterable[tuple[str, tuple[FloatArray, FloatArray]]], path: Path
) -> dict[str, RecordedSignal]:
    """Sort samples by time, and keep one of each instant, if a number.

    found: role, time stamps (s) and values (SI) of each; path: file, for errors. Returns by role.
    InputOutputError: too few numbers of a channel.
    """
    out: dict[str, RecordedSignal] = {}
    for role, (stamps, value) in found:
        time, jitter = even_times(stamps)
        known = np.isfinite(time) & np.isfinite(value)
        at, values = time[known], value[known]
        order = np.argsort(at, kind="stable")
        at, values = at[order], values[order]
        once = np.diff(at, append=np.inf) > 0.0
        if once.sum() >= MIN_TABLE_ROWS or (role.startswith("environment.") and once.any()):
            out[role] = RecordedSignal(at[once], values[once], jitter)
        elif role.startswith("channels."):
            raise InputOutputError(
                f"log {path}: {role} has {int(known.sum())} numbers, but only {int(once.sum())}"
                f" different time stamps; at least {MIN_TABLE_ROWS} are needed"
            )
    return out


def join_tables(parts: Iterable[dict[str, RecordedSignal]]) -> dict[str, RecordedSignal]:
    """Put the files of one recording together: one after another, or beside each other.

    parts: signals of each file, by role. Returns all of them; of one role in order of time.
    """
    whole: dict[str, list[RecordedSignal]] = {}
    for role, signal in itertools.chain.from_iterable(part.items() for part in parts):
        whole.setdefault(role, []).append(signal)
    out = {}
    for role, pieces in whole.items():
        time = np.concatenate([piece.time for piece in pieces])
        value = np.concatenate([piece.value for piece in pieces])
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
        once = np.concatenate([np.diff(time) > 0.0, [True]])
        out[role] = RecordedSignal(time[once], value[once], max(piece.jitter for piece in pieces))
    return out
