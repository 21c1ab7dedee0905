"""The history file: SQLite in WAL mode, several writers, each row on the disk before it counts.

It is a named file, or the user's own in the data folder of the platform.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import stat
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import msgspec

from ehadiag.estimate import AT_BOUND, NOT_SHOWN
from ehadiag.history.records import (
    DIAGNOSIS_TABLE,
    EVENT_TABLE,
    Entry,
    MaintenanceEvent,
    counted_entries,
)
from ehadiag.history.schema import MIGRATION_STEPS, migrate, refuse_foreign_schema, schema_version
from ehadiag.records import hash_of_samples
from ehadiag.result import Result
from firmware_iface.errors import ConfigurationError, EhadiagError, InputOutputError, reason_of
from firmware_iface.recording import Recording

WRITER_TIMEOUT_S = 30.0
"""Time, s, that one writer waits for the others."""
MIN_FLEET_UNITS, MAX_FLEET_UNITS = 10, 60
"""Number of other units that a forecast reads, whatever their diagnoses: a fleet, and half as many
again as it learns from, since some show no growth."""
MAX_LISTED_SERIALS = 20
"""Number of serial numbers that an error lists."""
MAX_FLEET_DIAGNOSES = 1200
"""Number of diagnoses that a forecast reads of other units, about: 0.05 s."""
QUERY_TIMEOUT_S = 60.0
"""Seconds of one query, at most: a damaged or hostile file must not hold anybody up."""
QUERY_CHECK_STEPS = 100_000
"""Steps of SQLite's machine between two looks at the clock, and at signals."""
SIDE_FILE_SUFFIXES = ("-wal", "-shm", "-journal")
"""Files beside a history that SQLite takes as a part of it."""
SQLITE_ERROR_TEXTS = {
    "SQLITE_FULL": "no room left on the disk",
    "SQLITE_BUSY": "other programs have held it too long; try again",
    "SQLITE_LOCKED": "other programs have held it too long; try again",
    "SQLITE_NOTADB": "is no history: not an SQLite file",
    "SQLITE_CORRUPT": "is damaged: move it away, and keep it for whoever can mend it",
    "SQLITE_CANTOPEN": "cannot be opened: no such folder, or no right to it",
    "SQLITE_READONLY": "cannot be written to",
    "SQLITE_IOERR": "the disk is full or failing",
    "SQLITE_CONSTRAINT": "only ever appended to",
    "SQLITE_INTERRUPT": f"not read within {QUERY_TIMEOUT_S:g} s, or interrupted",
}
"""By the first two words of SQLite's own name of an error."""
DIAGNOSIS_COLUMNS = (
    "appended", "tested", "actuator", "serial", "test", "verdict", "reasons", "hours", "cycles",
    "covariance", "version", "simulated", "result",
)  # fmt: skip
LONG_COLUMNS = ("covariance", "result")
EVENT_COLUMNS = ("appended", "done", "serial", "actuator", "hours", "cycles", "text", "resets")
WITHDRAWAL_COLUMNS = ("appended", "kind", "number", "text")


T = TypeVar("T")


class History:
    """An open history file; use as a context.

    Parameters
    ----------
    path : str | PathLike[str]
        The file.
    create : bool
        Make the file where there is none.

    Raises
    ------
    ConfigurationError
        There is no file, or it is another program's or a later version's.
    InputOutputError
        It cannot be opened, or is a link: SQLite would follow it; another user could put files
        beside it that SQLite takes as a part of it, or has done so; it is damaged.
    """

    def __init__(self, path: str | PathLike[str], *, create: bool = False) -> None:
        self.path = path = Path(path)
        try:
            link, exists = path.is_symlink(), path.exists()
            other = exists and not path.is_file()
        except (OSError, ValueError) as error:
            why = reason_of(error)
            raise InputOutputError(f"history {path}: {why}") from None
        if link:
            raise InputOutputError(f"history {path}: is a link; name the file it leads to")
        if other:
            raise InputOutputError(f"history {path}: not a regular file")
        full = Path(os.path.abspath(path))
        self._writable = create or (os.access(full, os.W_OK) and os.access(full.parent, os.W_OK))
        if not create and not exists:
            raise ConfigurationError(
                f"no history {path}: name one by --history, or begin one by ehadiag history init"
            )
        _refuse_planted(path, full)
        self._deadline = 0.0
        with self._one_line_errors():
            self._connection = self._connect(create)
            try:
                self._prepare()
            except BaseException:
                self._connection.close()
                raise

    def append(self, entry: Entry) -> int:
        """Append a diagnosis; it is on the disk when this returns.

        Parameters
        ----------
        entry : Entry
            What is kept of it.

        Returns
        -------
        int
            Its number in this history.

        Raises
        ------
        InputOutputError
            It could not be written: nothing of it was.
        """
        (number,) = self.append_all([entry])
        return number

    def append_all(self, entries: Sequence[Entry]) -> list[int]:
        """Append diagnoses, all or none; they are on the disk when this returns.

        Parameters
        ----------
        entries : Sequence[Entry]
            What is kept of them.

        Returns
        -------
        list[int]
            Their numbers in this history.

        Raises
        ------
        InputOutputError
            They could not be written: nothing of them was.
        """
        with self._one_line_errors(), self._transaction():
            return [self._append(entry) for entry in entries]

    def append_new(self, entries: Sequence[Entry]) -> int:
        """Append those diagnoses that are not there yet, all or none.

        Parameters
        ----------
        entries : Sequence[Entry]
            What is kept of them; one of a time, actuator and serial number that count is there.
            Tests, verdicts, usage and severities are compared.

        Returns
        -------
        int
            Number of those appended.

        Raises
        ------
        ConfigurationError
            One is there with other contents.
        InputOutputError
            They could not be written: nothing of them was.
        """
        with self._one_line_errors(), self._transaction():
            kept = self.entries(brief=True)
            there: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
            for item in (*kept, *counted_entries(kept)):
                there.setdefault(_identity(item), []).append(_contents(item))
            others = [
                f"{item.when} (serial {item.serial})"
                for item in entries
                if _contents(item) not in there.get(_identity(item), [_contents(item)])
            ]
            if others:
                raise ConfigurationError(
                    f"has other diagnoses of {', '.join(others[:MAX_LISTED_SERIALS])}"
                )
            new = [item for item in entries if _identity(item) not in there]
            for entry in new:
                self._append(entry)
        return len(new)

    def _append(self, entry: Entry) -> int:
        usage, covariance = entry.usage, entry.covariance
        row = (
            entry.appended, entry.tested, entry.actuator, entry.serial, entry.test, entry.verdict,
            _json(entry.reasons), usage.hours, usage.cycles,
            None if covariance is None else _json(covariance), entry.version, entry.simulated,
            entry.result,
        )  # fmt: skip
        parts: dict[str, list[tuple[Any, ...]]] = {
            "source": [(item.path, item.sha256, item.samples) for item in entry.sources],
            "severity": [
                (s.name, s.estimate, s.std, *(s.interval95 or (None, None)), s.at_bound, s.shown)
                for s in entry.severities
            ],
            "effect": [(e.name, e.value, e.std, e.at_bound) for e in entry.effects],
        }
        number = self._insert("diagnosis", DIAGNOSIS_COLUMNS, row)
        for table, rows in parts.items():
            for place, cells in enumerate(rows):
                marks = ", ".join("?" * (len(cells) + 2))
                self._connection.execute(
                    f"INSERT INTO {table} VALUES ({marks})", (number, place, *cells)
                )
        return number

    def append_event(self, event: MaintenanceEvent) -> int:
        """Append a maintenance event; it is on the disk when this returns.

        Parameters
        ----------
        event : MaintenanceEvent
            What was done.

        Returns
        -------
        int
            Its number in this history.

        Raises
        ------
        InputOutputError
            It could not be written.
        """
        row = (
            event.appended, event.when, event.serial, event.actuator, event.usage.hours,
            event.usage.cycles, event.text, _json(event.resets),
        )  # fmt: skip
        with self._one_line_errors(), self._transaction():
            return self._insert("event", EVENT_COLUMNS, row)

    def withdraw(self, kind: str, number: int, when: str, text: str) -> None:
        """Append that a diagnosis or an event counts no more; it stays where it is.

        Parameters
        ----------
        kind : str
            `DIAGNOSIS_TABLE` or `EVENT_TABLE` of `ehadiag.history.records`.
        number : int
            Of the diagnosis or event.
        when : str
            Time of day: UTC, ISO 8601.
        text : str
            Why.

        Raises
        ------
        ConfigurationError
            There is none of this number, or it is withdrawn already.
        InputOutputError
            It could not be written.
        """
        with self._one_line_errors(), self._transaction():
            if not self._rows(f"SELECT 1 FROM {kind} WHERE id = ?", (number,)):
                raise ConfigurationError(f"has no {kind} {number}; see ehadiag history list")
            if number in self._withdrawn(kind):
                raise ConfigurationError(f"has {kind} {number} withdrawn already")
            self._insert("withdrawal", WITHDRAWAL_COLUMNS, (when, kind, number, text))

    def entries(
        self,
        serial: int | Collection[int] | None = None,
        *,
        withdrawn: bool = False,
        brief: bool = False,
    ) -> list[Entry]:
        """Return the diagnoses, in the order in which they were appended.

        Parameters
        ----------
        serial : int | Collection[int] | None
            Of one unit, or some; None: all.
        withdrawn : bool
            Also those that were withdrawn.
        brief : bool
            Without effects, covariance and result, which are most of the file.

        Returns
        -------
        list[Entry]
            Also those of recordings that were diagnosed again, see `counted_entries`.
        """
        return self._entries(*_where_serial(serial), withdrawn, brief)

    def entry(self, number: int) -> Entry:
        """Return one diagnosis, also a withdrawn one; ConfigurationError where there is none."""
        found = self._entries("WHERE id = ?", (number,), True, False)
        if not found:
            raise ConfigurationError(
                f"history {self.path}: has no diagnosis {number}; see ehadiag history list"
            )
        return found[0]

    def last_identified(
        self, serial: int, actuator: str, other_than: Collection[str], until: int
    ) -> Entry | None:
        """Return the last diagnosis of a unit that a new one may begin from.

        Parameters
        ----------
        serial : int
            Of the unit.
        actuator : str
            Of the unit.
        other_than : Collection[str]
            Hashes of the samples of the new recordings.
        until : int
            Largest number of a diagnosis that counts.

        Returns
        -------
        Entry | None
            With a verdict, and no maintenance of the unit since; None where there is none.
        """
        with self._one_line_errors():
            rows = self._rows(
                "SELECT id FROM diagnosis WHERE serial = ? AND actuator = ? AND id <= ?"
                " AND verdict <> 'NOT_TESTED' ORDER BY id DESC LIMIT 10",
                (serial, actuator, until),
            )
        for row in rows:
            entry = self.entry(row["id"])
            if entry.withdrawn or any(item.samples in other_than for item in entry.sources):
                continue
            events = [i for i in self.events(serial) if i.actuator in (None, actuator)]
            return None if any(event.when >= entry.when for event in events) else entry
        return None

    @property
    def last_number(self) -> int:
        """Number of the last diagnosis; 0 where there is none."""
        with self._one_line_errors():
            (row,) = self._rows("SELECT MAX(id) AS number FROM diagnosis")
        return int(row["number"] or 0)

    def units(self, serial: int | None = None) -> list[tuple[str, int]]:
        """Return actuator and serial number of each unit, or of those with a serial number."""
        where = "serial NOT NULL" if serial is None else "serial = ?"
        with self._one_line_errors():
            rows = self._rows(
                f"SELECT DISTINCT actuator, serial FROM diagnosis WHERE {where}"
                " ORDER BY actuator, serial",
                () if serial is None else (serial,),
            )
        return [(str(row["actuator"]), int(row["serial"])) for row in rows]

    def actuator_of(self, serial: int, named: str | None = None) -> str:
        """Return the actuator of a serial number.

        Parameters
        ----------
        serial : int
            Of the unit.
        named : str | None
            Its actuator, where several have this serial number.

        Returns
        -------
        str
            The one named, else the only one.

        Raises
        ------
        ConfigurationError
            There is no diagnosis of it, several have it and none was named, or not the one named.
        """
        known = [actuator for actuator, _ in self.units(serial)]
        if not known:
            serials = sorted({number for _, number in self.units()})
            text = ", ".join(map(str, serials[:MAX_LISTED_SERIALS])) or "none"
            more = len(serials) - MAX_LISTED_SERIALS
            raise ConfigurationError(
                f"serial {serial}: the history has no diagnosis of it; there are {text}"
                + f" and {more} more" * (more > 0)
            )
        if named is not None and named not in known:
            raise ConfigurationError(f"actuator {named}: serial {serial} is of {', '.join(known)}")
        if named is None and len(known) > 1:
            raise ConfigurationError(
                f"serial {serial} is of {', '.join(known)}: name its actuator (--actuator)"
            )
        return named or known[0]

    def alike(
        self, serial: int, actuator: str | None = None
    ) -> tuple[list[Entry], list[MaintenanceEvent]]:
        """Return diagnoses, in brief, and events of a unit and some units of its actuator.

        Parameters
        ----------
        serial : int
            Of the unit.
        actuator : str | None
            Its actuator; None: that of its last diagnosis.

        Returns
        -------
        tuple[list[Entry], list[MaintenanceEvent]]
            Of the unit all; of the others as many, evenly by serial number, as a forecast uses.
        """
        own = self.entries(serial, brief=True)
        kinds = [(item.actuator, item.simulated) for item in own]
        kinds = [kind for kind in kinds if actuator in (None, kind[0])]
        if not kinds:
            return own, self.events(serial)
        with self._one_line_errors():
            rows = self._rows(
                "SELECT serial, COUNT(*) AS number FROM diagnosis WHERE actuator = ? AND"
                " simulated = ? AND serial NOT NULL AND serial <> ? GROUP BY serial",
                (*kinds[-1], serial),
            )
        counts = sorted((int(row["serial"]), int(row["number"])) for row in rows)
        mean = sum(number for _, number in counts) / max(len(counts), 1)
        most = max(MIN_FLEET_UNITS, min(MAX_FLEET_UNITS, int(MAX_FLEET_DIAGNOSES / max(mean, 1))))
        step = max(len(counts) / most, 1.0)
        picked = [counts[int(at * step)][0] for at in range(min(most, len(counts)))]
        serials = {serial, *picked}
        return self.entries(serials, brief=True), self.events(serials)

    def _entries(
        self, where: str, values: tuple[Any, ...], withdrawn: bool, brief: bool
    ) -> list[Entry]:
        columns = [name for name in DIAGNOSIS_COLUMNS if not (brief and name in LONG_COLUMNS)]
        tables = ("source", "severity") if brief else ("source", "severity", "effect")
        with self._one_line_errors():
            rows = self._rows(
                f"SELECT id, {', '.join(columns)} FROM diagnosis {where} ORDER BY id", values
            )
            only = f"WHERE diagnosis IN (SELECT id FROM diagnosis {where})" if where else ""
            parts = {name: self._parts(name, only, values) for name in tables}
            why = self._withdrawn(DIAGNOSIS_TABLE)

        def trees() -> list[dict[str, Any]]:
            return [
                _entry(row, parts, why.get(row["id"]), brief=brief)
                for row in rows
                if withdrawn or row["id"] not in why
            ]

        return self._sound(list[Entry], trees)

    def results(self) -> Iterator[str]:
        """Give the JSON result of each diagnosis, in the order in which they were appended.

        Yields
        ------
        str
            One line, without its end.
        """
        with self._one_line_errors():
            for row in self._connection.execute("SELECT result FROM diagnosis ORDER BY id"):
                self._sound(dict[str, Any], partial(msgspec.json.decode, row["result"]))
                yield row["result"]
                self._deadline = time.monotonic() + QUERY_TIMEOUT_S

    def events(
        self, serial: int | Collection[int] | None = None, *, withdrawn: bool = False
    ) -> list[MaintenanceEvent]:
        """Return the maintenance events, in the order in which they were appended.

        Parameters
        ----------
        serial : int | Collection[int] | None
            Of one unit, or some; None: all.
        withdrawn : bool
            Also those that were withdrawn.

        Returns
        -------
        list[MaintenanceEvent]
            The events.
        """
        with self._one_line_errors():
            where, values = _where_serial(serial)
            rows = self._rows(f"SELECT * FROM event {where} ORDER BY id", values)
            why = self._withdrawn(EVENT_TABLE)
        return [
            self._sound(MaintenanceEvent, partial(_event, row, why.get(row["id"])))
            for row in rows
            if withdrawn or row["id"] not in why
        ]

    def close(self) -> None:
        """Close the file."""
        with self._one_line_errors():
            self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _connect(self, create: bool) -> sqlite3.Connection:
        path = Path(os.path.abspath(self.path))
        query = "rwc" if create else "rw" if self._writable else "ro"
        if not self._writable and not Path(f"{path}-wal").exists():
            query = "ro&immutable=1"  # no writer is there
        return sqlite3.connect(
            f"{path.as_uri()}?mode={query}",
            uri=True,
            timeout=WRITER_TIMEOUT_S,
            isolation_level=None,
        )

    def _prepare(self) -> None:
        self._connection.row_factory = sqlite3.Row
        self._connection.set_progress_handler(self._is_late, QUERY_CHECK_STEPS)
        self._connection.execute("PRAGMA trusted_schema = OFF")
        # In one transaction: another process may make the tables meanwhile.
        self._connection.execute("BEGIN")
        try:
            version = schema_version(self._connection)
            refuse_foreign_schema(self._connection, version)
        finally:
            self._connection.execute("ROLLBACK")
        if self._writable:
            self._enter_wal()
            self._connection.execute("PRAGMA synchronous = FULL")
            self._connection.execute("PRAGMA foreign_keys = ON")
            migrate(self._connection)
        elif version != len(MIGRATION_STEPS):
            raise ConfigurationError(
                f"has version {version} of the tables, this program has {len(MIGRATION_STEPS)}:"
                " open it once where it can be written to"
            )

    def _enter_wal(self) -> None:
        """Switch a new file to WAL; SQLite does not wait for others here."""
        end = time.monotonic() + WRITER_TIMEOUT_S
        while True:
            try:
                (mode,) = self._connection.execute("PRAGMA journal_mode = WAL").fetchone()
                break
            except sqlite3.OperationalError as error:
                if _error_name(error) != "SQLITE_BUSY" or time.monotonic() > end:
                    raise
                time.sleep(0.02)
        if mode != "wal":
            raise InputOutputError(f"history {self.path}: its file system cannot do WAL")

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """All or nothing, and never beside another writer."""
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._connection.execute("COMMIT")
        except BaseException:
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            raise

    def _insert(self, table: str, columns: Sequence[str], row: tuple[Any, ...]) -> int:
        marks = ", ".join("?" * len(columns))
        done = self._connection.execute(
            f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({marks})", row
        )
        assert done.lastrowid is not None
        return done.lastrowid

    def _rows(self, query: str, values: tuple[Any, ...] = ()) -> list[sqlite3.Row]:
        return self._connection.execute(query, values).fetchall()

    def _withdrawn(self, kind: str) -> dict[int, str]:
        """Why each of a kind counts no more, by number."""
        rows = self._rows("SELECT number, text FROM withdrawal WHERE kind = ?", (kind,))
        return {row["number"]: row["text"] for row in rows}

    def _parts(
        self, table: str, where: str, values: tuple[Any, ...]
    ) -> dict[int, list[sqlite3.Row]]:
        out: dict[int, list[sqlite3.Row]] = {}
        query = f"SELECT * FROM {table} {where} ORDER BY diagnosis, place"
        for row in self._rows(query, values):
            out.setdefault(row["diagnosis"], []).append(row)
        return out

    @contextlib.contextmanager
    def _one_line_errors(self) -> Iterator[None]:
        """Raise errors of SQLite as one line; each query ends in time."""
        self._deadline = time.monotonic() + QUERY_TIMEOUT_S
        try:
            yield
        except sqlite3.Error as error:
            why = SQLITE_ERROR_TEXTS.get(_error_name(error), str(error))
            raise InputOutputError(f"history {self.path}: {why}") from None
        except OverflowError:
            raise InputOutputError(
                f"history {self.path}: a number beyond what SQLite holds, 64 bits"
            ) from None
        except ConfigurationError as error:
            raise ConfigurationError(f"history {self.path} {error}") from None

    def _is_late(self) -> bool:
        """Whether a query takes too long; SQLite asks, and ends it."""
        return time.monotonic() > self._deadline

    def _sound(self, kind: type[T], tree: Callable[[], Any]) -> T:
        """Make what rows hold; any other program may have written them."""
        try:
            return msgspec.convert(tree(), kind)
        except (ValueError, TypeError, RecursionError, ConfigurationError):
            why = SQLITE_ERROR_TEXTS["SQLITE_CORRUPT"]
            raise InputOutputError(f"history {self.path}: {why}") from None


class HistorySnapshot(NamedTuple):
    """A history file as it was at some time; it can be sent to workers."""

    path: Path
    until: int
    """Number of the last diagnosis that counts: digits of a call's results are then independent of
    their order."""

    def last_result(
        self, serial: int, actuator: str, recordings: Sequence[Recording]
    ) -> tuple[Result | None, str]:
        """Return what a new diagnosis of a unit may begin from, and what it is, in words.

        recordings: the new ones. None where there is nothing, or the file cannot be read.
        """
        hashes = {hash_of_samples(item) or "" for item in recordings}
        try:
            with History(self.path) as history:
                entry = history.last_identified(serial, actuator, hashes, self.until)
            result = None if entry is None else Result.from_json(entry.result)
        except (EhadiagError, ValueError):
            return None, ""
        words = "" if entry is None else f"diagnosis {entry.number} of history {self.path}"
        return result, words


def _identity(entry: Entry) -> tuple[Any, ...]:
    return entry.when, entry.actuator, entry.serial


def _contents(entry: Entry) -> tuple[Any, ...]:
    """What tells apart diagnoses of a time and unit."""
    severities = {(item.name, item.estimate, item.std) for item in entry.severities}
    return entry.test, entry.verdict, entry.usage, severities


def _severity(row: sqlite3.Row) -> dict[str, Any]:
    """Severity as its row keeps it; the result beside it has the rest."""
    _, _, name, estimate, std, low, high, at_bound, shown = row
    return {
        "name": name,
        "estimate": estimate,
        "std": std,
        "interval95": None if low is None or high is None else (low, high),
        "flags": (AT_BOUND,) * at_bound + (NOT_SHOWN,) * (not shown),
    }


def _refuse_planted(path: Path, full: Path) -> None:
    """Raise InputOutputError where another user could put a file beside a history, or has.

    Owners that are trusted with it: the caller, root, and the owner of the history itself.
    """
    if not hasattr(os, "getuid"):
        return
    trusted = {os.getuid(), 0}
    try:
        with contextlib.suppress(FileNotFoundError):
            trusted.add(full.stat().st_uid)
        folder = full.parent.stat()
        shared = folder.st_mode & stat.S_IWOTH or (
            folder.st_mode & stat.S_IWGRP and not _is_private_group(folder)
        )
        if folder.st_uid not in trusted or shared:
            raise InputOutputError(
                f"history {path}: others may write to its folder, and put files beside it that"
                " change it; move it to a folder of your own (chmod go-w)"
            )
        for suffix in SIDE_FILE_SUFFIXES:
            with contextlib.suppress(FileNotFoundError):
                state = os.lstat(f"{full}{suffix}")
                if state.st_uid not in trusted or not stat.S_ISREG(state.st_mode):
                    raise InputOutputError(
                        f"history {path}: {full.name}{suffix} beside it is of another user, or a"
                        " link; nobody knows what it changes"
                    )
    except OSError as error:
        raise InputOutputError(f"history {path}: {reason_of(error)}") from None


def _is_private_group(folder: os.stat_result) -> bool:
    """Whether the group of a folder is that of its owner alone, as many systems make one."""
    import grp  # noqa: PLC0415 - not on Windows
    import pwd  # noqa: PLC0415

    try:
        owner, group = pwd.getpwuid(folder.st_uid).pw_name, grp.getgrgid(folder.st_gid)
    except KeyError:
        return False
    return group.gr_name == owner and set(group.gr_mem) <= {owner}


def _error_name(error: sqlite3.Error) -> str:
    """SQLite's name of an error without its details, such as SQLITE_IOERR."""
    full = getattr(error, "sqlite_errorname", "")
    return "_".join(full.split("_")[:2])


def _where_serial(serial: int | Collection[int] | None) -> tuple[str, tuple[Any, ...]]:
    if serial is None:
        return "", ()
    serials = (serial,) if isinstance(serial, int) else tuple(sorted(serial))
    return f"WHERE serial IN ({', '.join('?' * len(serials))})", serials


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False)


def _entry(
    row: sqlite3.Row,
    parts: Mapping[str, Mapping[int, Sequence[sqlite3.Row]]],
    withdrawn: str | None,
    *,
    brief: bool,
) -> dict[str, Any]:
    if not brief:
        msgspec.json.decode(row["result"], type=dict)
    number = row["id"]
    return {
        **row,
        "number": number,
        "reasons": json.loads(row["reasons"]),
        "usage": {"hours": row["hours"], "cycles": row["cycles"]},
        "sources": [dict(item) for item in parts["source"].get(number, ())],
        "severities": [_severity(item) for item in parts["severity"].get(number, ())],
        "covariance": None if brief or row["covariance"] is None else json.loads(row["covariance"]),
        "effects": [
            {**item, "at_bound": bool(item["at_bound"])}
            for item in parts.get("effect", {}).get(number, ())
        ],
        "simulated": bool(row["simulated"]),
        "result": "" if brief else row["result"],
        "withdrawn": withdrawn,
    }


def _event(row: sqlite3.Row, withdrawn: str | None) -> dict[str, Any]:
    return {
        **row,
        "number": row["id"],
        "when": row["done"],
        "usage": {"hours": row["hours"], "cycles": row["cycles"]},
        "resets": json.loads(row["resets"]),
        "withdrawn": withdrawn,
    }
