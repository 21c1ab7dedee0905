"""Reads tables of decoded signals: CSV, Parquet, MF4; each signal with time stamps of its own."""

from __future__ import annotations

import codecs
import csv
import itertools
import stat
import warnings
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.printable import printable
from firmware_iface.logs.budget import Budget
from firmware_iface.logs.packed import beginning_of, kind_of, unpacked
from firmware_iface.signals.columns import TIME, ColumnMap, missing, unit_of
from firmware_iface.signals.row_clock import even_times

__all__ = ["DECODED_SUFFIXES", "Signal", "holds_signals", "joined", "read_signals"]

DECODED_SUFFIXES = (".csv", ".parquet", ".mf4")
FRAMES_HEADER = "timestamp,arbitration_id"
"""Begins the CSV log of python-can: frames, not signals."""
HEADER_BYTES = 1 << 16
DELIMITERS = ";\t,"
LEAST_ROWS = 10
UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
MOST_ROWS = 800_000
"""Of a table, which is held at once in some 300 MB: 13 minutes at 1 kHz, 40 s at 20 kHz."""
MOST_CELLS = 10_000_000
"""Of a Parquet file, of which all columns are unpacked."""
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Resolutions in which pandas holds dates."""
EXTRA = "pip install 'ehadiag[daq]'"


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """One signal as recorded.

    Attributes
    ----------
    time : NDArray[np.float64]
        s, ascending, shape (n,).
    value : NDArray[np.float64]
        SI, finite, shape (n,).
    jitter : float
        Deviation of the stamps from the even clock that took their place, s; 0: they are as read.
    """

    time: NDArray[np.float64]
    value: NDArray[np.float64]
    jitter: float = 0.0


def holds_signals(path: Path | str, *, mapped: bool) -> bool:
    """Whether a log holds decoded signals rather than frames.

    Parameters
    ----------
    path : Path | str
        The log.
    mapped : bool
        Its columns are mapped: an MF4 file is then one of signals.

    Returns
    -------
    bool
        True too where its beginning cannot be read: the reader of signals says why.
    """
    path, kind = Path(path), kind_of(Path(path))
    if kind == ".parquet":
        return True
    if kind == ".mf4":
        return mapped
    if kind != ".csv" or not path.is_file():
        return False
    try:
        header = _head(path)
    except InputOutputError:
        return True
    is_text = header != "" and all(c.isprintable() or c.isspace() for c in header)
    return is_text and not header.startswith(FRAMES_HEADER)


def _head(path: Path) -> str:
    try:
        text = beginning_of(path, HEADER_BYTES)
    except OSError as error:
        raise InputOutputError(f"log {path}: {reason_of(error)}") from None
    if text.startswith(UTF16):
        raise InputOutputError(f"log {path}: is in UTF-16: save it as UTF-8")
    return text.decode("utf-8-sig", "replace").lstrip()


def read_signals(
    path: Path | str, columns: ColumnMap, budget: Budget, *, complete: bool = True
) -> dict[str, Signal]:
    """Read the signals that have a role.

    Parameters
    ----------
    path : Path | str
        CSV, Parquet or MF4; packed by gzip too.
    columns : ColumnMap
        Which column is what.
    budget : Budget
        Bytes and rows that reading may cost.
    complete : bool
        All channels must be in this one file.

    Returns
    -------
    dict[str, Signal]
        By role, SI.

    Raises
    ------
    InputOutputError
        Missing, unreadable, too large, without a library, without numbers.
    ConfigurationError
        A mapped column is missing, a unit is none of its quantity.
    """
    path = Path(path)
    try:
        info = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        reason = reason_of(error)
        raise InputOutputError(f"log {path}: {reason}") from None
    if not stat.S_ISREG(info.st_mode):
        raise InputOutputError(f"log {path}: not a file")
    size = info.st_size
    if size > budget.size:
        raise InputOutputError(f"log {path}: larger than --max-log-size allows")
    if size == 0:
        raise InputOutputError(f"log {path}: the file is empty")
    with unpacked(path, budget.size) as plain:
        if kind_of(path) == ".mf4":
            return _read_mf4(plain.path, path, columns, complete=complete)
        table, units, present = _read_table(plain.path, path, columns, budget)
    return _signals(table, units, present, columns, path, complete=complete)


def _read_table(
    plain: Path, path: Path, columns: ColumnMap, budget: Budget
) -> tuple[Any, dict[str, str], list[str]]:
    """Read a data frame, the units that the file says by column, and the names of all columns."""
    try:
        import pandas  # noqa: PLC0415 - optional, and slow
    except ImportError:
        raise InputOutputError(f"log {path}: decoded signals need pandas: {EXTRA}") from None
    if kind_of(path) == ".parquet":
        try:
            import pyarrow.parquet  # noqa: PLC0415 - optional, and slow

            _check_size(pyarrow.parquet.read_metadata(plain), path)
            table = pandas.read_parquet(plain)
        except ImportError:
            raise InputOutputError(f"log {path}: Parquet needs pyarrow: {EXTRA}") from None
        except InputOutputError:
            raise
        except Exception:  # pyarrow raises what it likes, and quotes the file
            raise InputOutputError(f"log {path}: not a readable Parquet file") from None
        if table.index.name is not None:
            table = table.reset_index()
        table.columns = [str(name) for name in table.columns]
        return table, {}, list(table.columns)
    lines = [line for line in _head(plain).splitlines()[:4] if line.strip()]
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
        # pandas warns of rows longer than the header, and of columns of mixed kinds: both are told
        # by what is missing afterwards.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = pandas.read_csv(
                plain,
                sep=delimiter,
                decimal=decimal,
                skiprows=skipped,
                header=None,
                names=names,
                usecols=wanted,
                index_col=False,
                nrows=min(budget.frames, MOST_ROWS) + 1,
                skip_blank_lines=True,
                encoding="utf-8",
                encoding_errors="replace",
                on_bad_lines="skip",
            )
    except (ValueError, OSError):
        raise InputOutputError(f"log {path}: not a readable table of signals") from None
    if len(table) > MOST_ROWS:
        raise _too_long(path)
    return table, units, names


def _check_size(about: Any, path: Path) -> None:
    """Refuse a Parquet file by what it says of itself, before any of it is unpacked."""
    if about.num_rows > MOST_ROWS or about.num_rows * about.num_columns > MOST_CELLS:
        raise _too_long(path)


def _too_long(path: Path) -> InputOutputError:
    return InputOutputError(
        f"log {path}: more than {MOST_ROWS} rows, or {MOST_CELLS} values, are too many to hold at"
        " once; cut it about the test"
    )


def _is_number(text: str) -> bool:
    try:
        float(text.strip().replace(",", "."))
    except ValueError:
        return False
    return True


def _signals(
    table: Any,
    units: dict[str, str],
    present: list[str],
    columns: ColumnMap,
    path: Path,
    *,
    complete: bool,
) -> dict[str, Signal]:
    import pandas  # noqa: PLC0415 - read by now

    found = columns.resolve(present, f"log {path}")
    if complete and (lacking := missing(found, present)):
        raise ConfigurationError(f"log {path}: {lacking}")
    if TIME not in found:
        raise ConfigurationError(
            f"log {path}: no column of time stamps: name it by --column time=NAME:UNIT"
        )

    def numbers(role: str) -> NDArray[np.float64]:
        column = found[role]
        gain, bias = unit_of(column, units.get(column.column, ""), role, f"log {path}")
        plain = pandas.to_numeric(table[column.column], errors="coerce")
        return np.asarray(plain, dtype=np.float64) * gain + bias

    series = table[found[TIME].column]
    instants = _instants(series)
    time = numbers(TIME) if instants is None else instants
    if not np.isfinite(time).any():
        begins = "" if series.dropna().empty else f" ({printable(str(series.dropna().iloc[0]))}, …)"
        raise InputOutputError(
            f"log {path}: no time stamp in column {printable(found[TIME].column)!r}{begins}: need"
            " numbers, in s or the unit that --column time=NAME:UNIT says, or ISO 8601 such as"
            " 2026-03-01T12:00:00.001"
        )
    return _checked(((role, (time, numbers(role))) for role in found if role != TIME), path)


def _instants(series: Any) -> NDArray[np.float64] | None:
    """Return dates and times of day, or spans of time, in s; None for numbers.

    Dates count from 1970, UTC; without a zone they are taken for UTC.
    """
    import pandas  # noqa: PLC0415 - read by now

    kinds = pandas.api.types
    if kinds.is_object_dtype(series) or kinds.is_string_dtype(series):
        if np.isfinite(np.asarray(pandas.to_numeric(series, errors="coerce"), np.float64)).any():
            return None
        text = series.astype("string").str.replace(",", ".")  # of decimals
        series = pandas.to_datetime(text, format="ISO8601", errors="coerce", utc=True)
    if kinds.is_datetime64_any_dtype(series):
        series = series.dt.tz_convert(None) if series.dt.tz is not None else series
    elif not kinds.is_timedelta64_dtype(series):
        return None
    values = series.to_numpy()
    unit, many = np.datetime_data(values.dtype)
    whole = values.astype(np.int64).astype(np.float64)
    return np.where(np.isnat(values), np.nan, whole * (many / PER_SECOND[unit]))


def _checked(
    found: Iterable[tuple[str, tuple[NDArray[np.float64], NDArray[np.float64]]]], path: Path
) -> dict[str, Signal]:
    """In order of time, once for each instant, numbers alone."""
    out: dict[str, Signal] = {}
    for role, (stamps, value) in found:
        time, jitter = even_times(stamps)
        known = np.isfinite(time) & np.isfinite(value)
        at, values = time[known], value[known]
        order = np.argsort(at, kind="stable")
        at, values = at[order], values[order]
        once = np.diff(at, append=np.inf) > 0.0
        if once.sum() >= LEAST_ROWS or (role.startswith("environment.") and once.any()):
            out[role] = Signal(at[once], values[once], jitter)
        elif role.startswith("channels."):
            raise InputOutputError(
                f"log {path}: {role} has {int(known.sum())} numbers, but only {int(once.sum())}"
                f" different time stamps; at least {LEAST_ROWS} are needed"
            )
    return out


def _read_mf4(plain: Path, path: Path, columns: ColumnMap, *, complete: bool) -> dict[str, Signal]:
    try:
        from asammdf import MDF  # noqa: PLC0415 - optional, and slow
    except ImportError:
        raise InputOutputError(f"log {path}: MF4 needs asammdf: {EXTRA}") from None
    try:
        with closing(MDF(plain)) as file:
            present = sorted(file.channels_db)
            found = columns.resolve(present, f"log {path}")
            if complete and (lacking := missing(found, present)):
                raise ConfigurationError(f"log {path}: {lacking}")
            out = {}
            for role, column in found.items():
                if role == TIME:
                    continue
                got = file.get(column.column)
                gain, bias = unit_of(column, str(got.unit or ""), role, f"log {path}")
                values = np.asarray(got.samples, dtype=np.float64) * gain + bias
                out[role] = (np.asarray(got.timestamps, dtype=np.float64), values)
    except (ConfigurationError, InputOutputError):
        raise
    except Exception:  # asammdf raises what it likes, and quotes the file
        raise InputOutputError(f"log {path}: not a readable MF4 file of signals") from None
    return _checked(out.items(), path)


def joined(parts: Iterable[dict[str, Signal]]) -> dict[str, Signal]:
    """Put the files of one recording together: one after another, or beside each other.

    Parameters
    ----------
    parts : Iterable[dict[str, Signal]]
        Signals of each file, by role.

    Returns
    -------
    dict[str, Signal]
        All of them; of one role in order of time.
    """
    whole: dict[str, list[Signal]] = {}
    for role, signal in itertools.chain.from_iterable(part.items() for part in parts):
        whole.setdefault(role, []).append(signal)
    out = {}
    for role, pieces in whole.items():
        time = np.concatenate([piece.time for piece in pieces])
        value = np.concatenate([piece.value for piece in pieces])
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
        once = np.concatenate([np.diff(time) > 0.0, [True]])
        out[role] = Signal(time[once], value[once], max(piece.jitter for piece in pieces))
    return out
