"""Tables of the history file, step by step from the first version to today's.

`PRAGMA user_version` is the number of steps that a file has gone through. A step that was ever
released is never changed: what is new is a further step. Triggers refuse to change or delete a row,
and to put another in its place.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Mapping, Sequence

from firmware_iface.errors import ConfigurationError

SQLITE_APPLICATION_ID = 0x45484148
"""'EHAH' in the file's head: what tells a history from other SQLite files."""
APPEND_ONLY_TEXT = "a history is only ever appended to"

SQL_FIRST_TABLES = """
CREATE TABLE diagnosis (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    appended TEXT NOT NULL,      -- UTC, ISO 8601
    tested TEXT,                 -- UTC, ISO 8601
    actuator TEXT NOT NULL,
    serial INTEGER,
    test TEXT,
    verdict TEXT NOT NULL,
    reasons TEXT NOT NULL,       -- JSON list
    hours REAL,
    cycles REAL,
    covariance TEXT,             -- JSON matrix, in the order of severity.place
    version TEXT NOT NULL,
    simulated INTEGER NOT NULL,
    result TEXT NOT NULL         -- JSON result
);
CREATE INDEX diagnosis_of_unit ON diagnosis (serial);
CREATE TABLE source (
    diagnosis INTEGER NOT NULL REFERENCES diagnosis (id),
    place INTEGER NOT NULL,
    path TEXT NOT NULL,
    sha256 TEXT,
    samples TEXT,
    PRIMARY KEY (diagnosis, place)
);
CREATE TABLE severity (
    diagnosis INTEGER NOT NULL REFERENCES diagnosis (id),
    place INTEGER NOT NULL,
    name TEXT NOT NULL,
    estimate REAL,
    std REAL,
    low REAL,
    high REAL,
    at_bound INTEGER NOT NULL,
    shown INTEGER NOT NULL,
    PRIMARY KEY (diagnosis, place)
);
CREATE TABLE effect (
    diagnosis INTEGER NOT NULL REFERENCES diagnosis (id),
    place INTEGER NOT NULL,
    name TEXT NOT NULL,
    value REAL,
    std REAL,
    at_bound INTEGER NOT NULL,
    PRIMARY KEY (diagnosis, place)
);
CREATE TABLE event (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    appended TEXT NOT NULL,
    done TEXT NOT NULL,
    serial INTEGER NOT NULL,
    actuator TEXT,
    hours REAL,
    cycles REAL,
    text TEXT NOT NULL,
    resets TEXT NOT NULL         -- JSON list
);
"""

SQL_WITHDRAWALS = """
CREATE TABLE withdrawal (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    appended TEXT NOT NULL,
    kind TEXT NOT NULL,          -- table of what is withdrawn
    number INTEGER NOT NULL,     -- its id there
    text TEXT NOT NULL           -- why
);
"""

SQL_INDEX_OF_UNITS = """
CREATE INDEX diagnosis_of_actuator ON diagnosis (actuator, simulated, serial);
CREATE INDEX event_of_unit ON event (serial);
"""


def _guards(tables: Mapping[str, Sequence[str]]) -> str:
    """Triggers that keep the rows of tables, named with their keys."""
    out = []
    for table, key in tables.items():
        same = " AND ".join(f"{column} = NEW.{column}" for column in key)
        for what, when in (
            ("UPDATE", ""),
            ("DELETE", ""),
            # INSERT OR REPLACE deletes without asking the triggers of DELETE.
            ("INSERT", f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {same})"),
        ):
            out.append(
                f"CREATE TRIGGER {table}_no_{what.lower()} BEFORE {what} ON {table} {when} "
                f"BEGIN SELECT RAISE(ABORT, '{APPEND_ONLY_TEXT}'); END;"
            )
    return "\n".join(out)


_PART_KEYS = ("diagnosis", "place")
_TABLE_KEYS = {"diagnosis": ("id",), "event": ("id",)} | dict.fromkeys(
    ("source", "severity", "effect"), _PART_KEYS
)
MIGRATION_STEPS: tuple[str, ...] = (
    SQL_FIRST_TABLES + _guards(_TABLE_KEYS),
    SQL_WITHDRAWALS + _guards({"withdrawal": ("id",)}),
    SQL_INDEX_OF_UNITS,
)
"""SQL of each step, in order."""


def schema_version(connection: sqlite3.Connection) -> int:
    """Return the steps that a file has gone through, its `user_version`; 0: an empty file.

    Another program's file is a ConfigurationError.
    """
    # In this order: another process that makes the tables between two of these has marked them.
    (tables,) = connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if tables and application != SQLITE_APPLICATION_ID:
        raise ConfigurationError("is an SQLite file of another program: name another file")
    return int(version)


def migrate(connection: sqlite3.Connection, steps: Sequence[str] = MIGRATION_STEPS) -> None:
    """Bring a file to today's tables, whole or not at all; the rows that it has stay as they are.

    connection: in autocommit mode; steps: SQL of each step. ConfigurationError: the file is another
    program's, or a later version's.
    """
    if _refuse_later(schema_version(connection), steps) == len(steps):
        return
    connection.execute("BEGIN IMMEDIATE")
    try:
        # Another process may have been quicker.
        done = _refuse_later(schema_version(connection), steps)
        for step in steps[done:]:
            for statement in _statements(step):
                connection.execute(statement)
        connection.execute(f"PRAGMA application_id = {SQLITE_APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {len(steps)}")
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def refuse_foreign_schema(connection: sqlite3.Connection, version: int) -> None:
    """Refuse views, triggers and tables that this program has not made: none of them is run.

    version: steps that the file says it has gone through. ConfigurationError: its tables are not
    those of its version.
    """
    query = "SELECT type, name, tbl_name, sql FROM sqlite_master WHERE sql NOT NULL"
    query += " AND sql NOT LIKE 'CREATE TABLE sqlite\\_%' ESCAPE '\\'"  # such as ANALYZE makes
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as model:
        for step in MIGRATION_STEPS[:version]:
            for statement in _statements(step):
                model.execute(statement)
        own = {tuple(row) for row in model.execute(query)}
    found = {tuple(map(str, row)) for row in connection.execute(query)}
    if version <= len(MIGRATION_STEPS) and found != own:
        name = min(str(row[1]) for row in found ^ own)
        raise ConfigurationError(
            f"has {name!r} otherwise than this program makes it: the file was changed by another"
        )


def _refuse_later(version: int, steps: Sequence[str]) -> int:
    if version > len(steps):
        raise ConfigurationError(
            f"has version {version} of the tables, this program knows up to {len(steps)}:"
            " use a later ehadiag"
        )
    return version


def _statements(script: str) -> list[str]:
    """Split a script: `executescript` would end the transaction."""
    out, begun = [], ""
    for line in script.splitlines():
        begun += line + "\n"
        if sqlite3.complete_statement(begun):
            out.append(begun)
            begun = ""
    return out
