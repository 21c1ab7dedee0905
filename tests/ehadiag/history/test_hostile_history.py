"""Histories that other users or programs have changed: one line, in time, and nothing is run."""

from __future__ import annotations

import os
import shutil
import sqlite3
import threading
import time
from pathlib import Path

import pytest
from history_cases import an_entry, an_event

from ehadiag.cli.main import main
from ehadiag.history import store
from ehadiag.history.schema import SQLITE_APPLICATION_ID
from ehadiag.history.store import History
from firmware_iface.errors import ConfigurationError, InputOutputError

ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x AS id FROM n"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A history with a diagnosis and an event."""
    with History(tmp_path / "h", create=True) as history:
        history.append(an_entry(7, 12.5))
        history.append_event(an_event(hours=20.0, resets=("Kintas",)))
    return tmp_path / "h"


def changed(place: Path, *statements: str) -> Path:
    """Change a history as its guards do not allow, and put the guards back."""
    with sqlite3.connect(place) as connection:
        guards = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'")
        guards = guards.fetchall()
        for name, _ in guards:
            connection.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            connection.execute(statement)
        for _, sql in guards:
            connection.execute(sql)
    connection.close()
    return place


@pytest.mark.parametrize(
    "change",
    [
        "diagnosis SET reasons = 'no JSON'",
        "diagnosis SET reasons = 5",
        "diagnosis SET reasons = '[1]'",
        "diagnosis SET reasons = '" + "[" * 100_000 + "'",
        "diagnosis SET covariance = '[1]'",
        "diagnosis SET covariance = '[['",
        "diagnosis SET result = 'no JSON'",
        "diagnosis SET result = '[]'",
        "diagnosis SET hours = 'many'",
        "diagnosis SET hours = -1.0",
        "diagnosis SET verdict = x'ff'",
        "diagnosis SET actuator = CAST(x'ff' AS TEXT)",
        "severity SET estimate = 'high'",
        "severity SET at_bound = 'x'",
        "event SET resets = 'no JSON'",
        "event SET resets = '[[]]'",
        "event SET cycles = x'00'",
        "event SET serial = 'seven'",
    ],
)
def test_a_row_that_is_none_of_ours_is_one_line(place: Path, change: str) -> None:
    changed(place, f"UPDATE {change}")
    with History(place) as history, pytest.raises(InputOutputError) as caught:
        _ = history.entries(), history.events()
    assert str(caught.value).startswith(f"history {place}: ")
    assert "\n" not in str(caught.value)


def test_a_result_that_is_no_json_is_not_exported(place: Path) -> None:
    changed(place, "UPDATE diagnosis SET result = 'no JSON'")
    with History(place) as history, pytest.raises(InputOutputError, match="is damaged"):
        list(history.results())


@pytest.mark.parametrize(
    "statements",
    [
        ("DROP TABLE withdrawal", f"CREATE VIEW withdrawal AS {ENDLESS}"),
        ("DROP TABLE source", f"CREATE VIEW source AS {ENDLESS}"),
        ("CREATE TABLE more (x)",),
        (
            "CREATE TRIGGER evil AFTER INSERT ON diagnosis BEGIN"
            " INSERT INTO event SELECT * FROM event; END",
        ),
        ("DROP TABLE effect", "CREATE TABLE effect (diagnosis, place, name)"),
    ],
)
def test_only_our_own_tables_are_read(place: Path, statements: tuple[str, ...]) -> None:
    with sqlite3.connect(place) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()
    begin = time.monotonic()
    with pytest.raises(ConfigurationError, match="otherwise than this program makes it"):
        History(place)
    assert time.monotonic() - begin < 30.0


def test_tables_of_the_optimiser_are_no_change(place: Path) -> None:
    with sqlite3.connect(place) as connection:
        connection.execute("ANALYZE")
    connection.close()
    with History(place) as history:
        assert len(history.entries()) == 1


def test_a_view_in_a_new_file_that_pretends_to_be_a_history(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "h") as connection:
        connection.execute(f"PRAGMA application_id = {SQLITE_APPLICATION_ID}")
        connection.execute(f"CREATE VIEW diagnosis AS {ENDLESS}")
    connection.close()
    with pytest.raises(ConfigurationError, match="'diagnosis' otherwise"):
        History(tmp_path / "h")


def test_a_query_without_end_is_ended(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "QUERY_TIMEOUT_S", 0.2)
    late, begin = pytest.raises(InputOutputError, match="not read within"), time.monotonic()
    with History(place) as history, late, history._one_line_errors():
        history._rows(f"SELECT max(id) FROM ({ENDLESS})")
    assert time.monotonic() - begin < 60.0  # a time limit of pytest's would end it, too


def test_several_that_begin_a_history_at_once_all_open_it(tmp_path: Path) -> None:
    failed = []

    def begin() -> None:
        try:
            History(tmp_path / "h", create=True).close()
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=begin) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120.0)
    assert failed == []


@pytest.mark.parametrize("mode", [0o777, 0o1777])
def test_a_folder_that_others_may_write_to_is_refused(place: Path, mode: int) -> None:
    place.parent.chmod(mode)
    try:
        for create in (False, True):
            with pytest.raises(InputOutputError, match="others may write to its folder"):
                History(place, create=create)
    finally:
        place.parent.chmod(0o700)
    History(place).close()


root = pytest.mark.skipif(
    not hasattr(os, "getuid") or os.getuid() != 0, reason="only root gives files away"
)


@root
@pytest.mark.parametrize("suffix", ["-wal", "-shm", "-journal"])
def test_a_file_of_another_user_beside_a_history_is_refused(place: Path, suffix: str) -> None:
    planted = Path(f"{place}{suffix}")
    planted.write_bytes(b"")
    History(place).close()
    planted.write_bytes(b"")
    os.chown(planted, 65534, 65534)
    with pytest.raises(InputOutputError, match=f"h{suffix} beside it is of another user"):
        History(place)
    planted.unlink()
    planted.symlink_to(place)
    with pytest.raises(InputOutputError, match="or a link"):
        History(place)


@root
def test_a_folder_of_a_shared_group_is_refused(place: Path) -> None:
    place.parent.chmod(0o775)
    History(place).close()  # the group of root alone
    os.chown(place.parent, 0, 65534)
    with pytest.raises(InputOutputError, match="others may write to its folder"):
        History(place)


def test_a_history_begun_under_a_loose_umask_can_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    before = os.umask(0o000)
    try:
        assert main(["history", "init"]) == 0
        assert main(["history", "list"]) == 0
    finally:
        os.umask(before)


@root
def test_a_folder_of_another_user_is_refused(place: Path) -> None:
    os.chown(place.parent, 65534, 65534)
    try:
        with pytest.raises(InputOutputError, match="others may write to its folder"):
            History(place)
        os.chown(place, 65534, 65534)  # theirs, with all that is beside it
        History(place).close()
    finally:
        os.chown(place.parent, 0, 0)


@root
def test_a_planted_log_does_not_rewrite_a_history(place: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copy(place, other)
    connection = sqlite3.connect(other)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("DROP TRIGGER diagnosis_no_update")
    connection.execute("UPDATE diagnosis SET verdict = 'HEALTHY'")
    connection.commit()
    shutil.copy(f"{other}-wal", f"{place}-wal")
    connection.close()
    os.chown(f"{place}-wal", 65534, 65534)
    with pytest.raises(InputOutputError, match="of another user"):
        History(place)
