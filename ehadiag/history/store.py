"""The history file: SQLite in WAL mode, several writers, each row on the disk before it counts."""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.history.records import (
    DIAGNOSIS,
    EVENT,
    Effect,
    Entry,
    Event,
    Severity,
    Source,
    Usage,
)
from ehadiag.history.schema import STEPS, migrate, version_of

__all__ = ["History"]

PATIENCE_S = 30.0
"""How long one writer waits for the others."""
POLL_S = 0.02
WHY = {
    "SQLITE_FULL": "no room left on the disk",
    "SQLITE_BUSY": "other programs have held it too long; try again",
    "SQLITE_LOCKED": "other programs have held it too long; try again",
    "SQLITE_NOTADB": "is no history: not an SQLite file",
    "SQLITE_CORRUPT": "is damaged: move it away, and keep it for whoever can mend it",
    "SQLITE_CANTOPEN": "cannot be opened: no such folder, or no right to it",
    "SQLITE_READONLY": "cannot be written to",
    "SQLITE_IOERR": "the disk is full or failing",
    "SQLITE_CONSTRAINT": "only ever appended to",
}
"""By the first two words of SQLite's own name of an error."""
DIAGNOSIS_ROW = (
    "appended", "tested", "actuator", "serial", "test", "verdict", "reasons", "hours", "cycles",
    "covariance", "version", "simulated", "result",
)  # fmt: skip
EVENT_ROW = ("appended", "done", "serial", "actuator", "hours", "cycles", "text", "resets")
WITHDRAWAL = ("appended", "kind", "number", "text")


class History:
    """An open history file; use as a context.

    Parameters
    ----------
    path : Path
        The file.
    create : bool
        Make the file where there is none.

    Raises
    ------
    ConfigurationError
        There is no file, or it is another program's or a later version's.
    InputOutputError
        It cannot be opened, or is a link: SQLite would follow it.
    """

    def __init__(self, path: Path, *, create: bool = False) -> None:
        self.path = path
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
        with self._told():
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
                (s.name, s.estimate, s.std, s.low, s.high, s.at_bound, s.shown)
                for s in entry.severities
            ],
            "effect": [(e.name, e.value, e.std, e.at_bound) for e in entry.effects],
        }
        with self._told(), self._transaction():
            number = self._insert("diagnosis", DIAGNOSIS_ROW, row)
            for table, rows in parts.items():
                for place, cells in enumerate(rows):
                    marks = ", ".join("?" * (len(cells) + 2))
                    self._connection.execute(
                        f"INSERT INTO {table} VALUES ({marks})", (number, place, *cells)
                    )
        return number

    def append_event(self, event: Event) -> int:
        """Append a maintenance event; it is on the disk when this returns.

        Parameters
        ----------
        event : Event
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
        with self._told(), self._transaction():
            return self._insert("event", EVENT_ROW, row)

    def withdraw(self, kind: str, number: int, when: str, text: str) -> None:
        """Append that a diagnosis or an event counts no more; it stays where it is.

        Parameters
        ----------
        kind : str
            `DIAGNOSIS` or `EVENT` of `ehadiag.history.records`.
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
        with self._told(), self._transaction():
            if not self._rows(f"SELECT 1 FROM {kind} WHERE id = ?", (number,)):
                raise ConfigurationError(f"has no {kind} {number}; see ehadiag history list")
            if number in self._withdrawn(kind):
                raise ConfigurationError(f"has {kind} {number} withdrawn already")
            self._insert("withdrawal", WITHDRAWAL, (when, kind, number, text))

    def entries(self, serial: int | None = None, *, withdrawn: bool = False) -> list[Entry]:
        """Return the diagnoses, in the order in which they were appended.

        Parameters
        ----------
        serial : int | None
            Of one unit only; None: all.
        withdrawn : bool
            Also those that were withdrawn.

        Returns
        -------
        list[Entry]
            Also those of recordings that were diagnosed again, see `counted`.
        """
        with self._told():
            where, values = _of(serial)
            rows = self._rows(f"SELECT * FROM diagnosis {where} ORDER BY id", values)
            parts = {name: self._parts(name) for name in ("source", "severity", "effect")}
            why = self._withdrawn(DIAGNOSIS)
        return [
            Entry(
                number=row["id"],
                appended=row["appended"],
                tested=row["tested"],
                actuator=row["actuator"],
                serial=row["serial"],
                test=row["test"],
                verdict=row["verdict"],
                reasons=tuple(json.loads(row["reasons"])),
                usage=Usage(row["hours"], row["cycles"]),
                sources=tuple(
                    Source(item["path"], item["sha256"], item["samples"])
                    for item in parts["source"].get(row["id"], ())
                ),
                severities=tuple(
                    Severity(
                        item["name"],
                        item["estimate"],
                        item["std"],
                        item["low"],
                        item["high"],
                        bool(item["at_bound"]),
                        bool(item["shown"]),
                    )
                    for item in parts["severity"].get(row["id"], ())
                ),
                covariance=None
                if row["covariance"] is None
                else tuple(tuple(line) for line in json.loads(row["covariance"])),
                effects=tuple(
                    Effect(item["name"], item["value"], item["std"], bool(item["at_bound"]))
                    for item in parts["effect"].get(row["id"], ())
                ),
                version=row["version"],
                simulated=bool(row["simulated"]),
                result=row["result"],
                withdrawn=why.get(row["id"]),
            )
            for row in rows
            if withdrawn or row["id"] not in why
        ]

    def results(self) -> Iterator[str]:
        """Give the JSON result of each diagnosis, in the order in which they were appended.

        Yields
        ------
        str
            One line, without its end.
        """
        with self._told():
            for row in self._connection.execute("SELECT result FROM diagnosis ORDER BY id"):
                yield row["result"]

    def events(self, serial: int | None = None, *, withdrawn: bool = False) -> list[Event]:
        """Return the maintenance events, in the order in which they were appended.

        Parameters
        ----------
        serial : int | None
            Of one unit only; None: all.
        withdrawn : bool
            Also those that were withdrawn.

        Returns
        -------
        list[Event]
            The events.
        """
        with self._told():
            where, values = _of(serial)
            rows = self._rows(f"SELECT * FROM event {where} ORDER BY id", values)
            why = self._withdrawn(EVENT)
        return [
            Event(
                number=row["id"],
                appended=row["appended"],
                when=row["done"],
                serial=row["serial"],
                actuator=row["actuator"],
                usage=Usage(row["hours"], row["cycles"]),
                text=row["text"],
                resets=tuple(json.loads(row["resets"])),
                withdrawn=why.get(row["id"]),
            )
            for row in rows
            if withdrawn or row["id"] not in why
        ]

    def close(self) -> None:
        """Close the file."""
        with self._told():
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
            f"{path.as_uri()}?mode={query}", uri=True, timeout=PATIENCE_S, isolation_level=None
        )

    def _prepare(self) -> None:
        self._connection.row_factory = sqlite3.Row
        version = version_of(self._connection)
        if self._writable:
            self._enter_wal()
            self._connection.execute("PRAGMA synchronous = FULL")
            self._connection.execute("PRAGMA foreign_keys = ON")
            migrate(self._connection)
        elif version != len(STEPS):
            raise ConfigurationError(
                f"has version {version} of the tables, this program has {len(STEPS)}:"
                " open it once where it can be written to"
            )

    def _enter_wal(self) -> None:
        """Switch a new file to WAL; SQLite does not wait for others here."""
        end = time.monotonic() + PATIENCE_S
        while True:
            try:
                (mode,) = self._connection.execute("PRAGMA journal_mode = WAL").fetchone()
                break
            except sqlite3.OperationalError as error:
                if _name(error) != "SQLITE_BUSY" or time.monotonic() > end:
                    raise
                time.sleep(POLL_S)
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

    def _parts(self, table: str) -> dict[int, list[sqlite3.Row]]:
        out: dict[int, list[sqlite3.Row]] = {}
        for row in self._rows(f"SELECT * FROM {table} ORDER BY diagnosis, place"):
            out.setdefault(row["diagnosis"], []).append(row)
        return out

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """Turn what SQLite says into one line."""
        try:
            yield
        except sqlite3.Error as error:
            why = WHY.get(_name(error), str(error))
            raise InputOutputError(f"history {self.path}: {why}") from None
        except OverflowError:
            raise InputOutputError(
                f"history {self.path}: a number beyond what SQLite holds, 64 bits"
            ) from None
        except ConfigurationError as error:
            raise ConfigurationError(f"history {self.path} {error}") from None


def _name(error: sqlite3.Error) -> str:
    """SQLite's name of an error without its details, such as SQLITE_IOERR."""
    full = getattr(error, "sqlite_errorname", "")
    return "_".join(full.split("_")[:2])


def _of(serial: int | None) -> tuple[str, tuple[Any, ...]]:
    return ("", ()) if serial is None else ("WHERE serial = ?", (serial,))


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False)
