"""Which diagnoses of a history count.

The history file: what is appended comes back, and nothing is ever changed.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest
from history_cases import an_entry, an_event
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from ehadiag import ConfigurationError, InputOutputError
from ehadiag.history.records import EVENT_TABLE, Entry, SourceRecord, Usage, counted_entries
from ehadiag.history.schema import MIGRATION_STEPS, migrate
from ehadiag.history.store import MAX_FLEET_UNITS, History


def of(*names: str, number: int = 0, hours: float | None = None) -> Entry:
    sources = tuple(SourceRecord(f"{name}.blf", None, name) for name in names)
    return an_entry(sources=sources, number=number, usage=Usage(hours))


def test_a_recording_diagnosed_again_counts_once() -> None:
    entries = [of("a", number=1), of("b", number=2), of("a", number=3)]
    assert [item.number for item in counted_entries(entries)] == [2, 3]


def test_hours_that_only_the_first_diagnosis_was_told_are_kept() -> None:
    (found,) = counted_entries([of("a", hours=5.0), of("a")])
    assert found.usage == Usage(5.0)
    (found,) = counted_entries([of("a", hours=5.0), of("a", hours=6.0)])
    assert found.usage == Usage(6.0)


def test_a_joint_diagnosis_replaces_those_of_its_recordings() -> None:
    entries = [of("a", number=1), of("b", number=2), of("a", "b", number=3)]
    assert [item.number for item in counted_entries(entries)] == [3]


@pytest.mark.parametrize(
    ("first", "second", "count"),
    [
        ("2026-03-01T12:00:00.000Z", "2026-03-01T12:00:00.001Z", 1),
        ("2026-03-01T12:00:00.000Z", "2026-03-01T14:00:00.001Z", 1),  # another zone
        ("2026-03-01T12:00:00.000Z", "2026-03-01T11:14:59.500Z", 1),
        ("2026-03-01T12:00:00.000Z", None, 1),
        (None, None, 1),
        ("2026-03-01T12:00:00.000Z", "2026-03-01T12:00:07.000Z", 2),
        ("2026-03-01T12:00:00.000Z", "2026-03-03T12:00:00.000Z", 2),
    ],
)
def test_two_tests_of_a_simulated_unit_are_two_whatever_their_samples(
    first: str | None, second: str | None, count: int
) -> None:
    entries = [replace(of("a", hours=5.0), tested=first), replace(of("a"), tested=second)]
    found = counted_entries(entries)
    assert len(found) == count
    assert found[-1].usage == Usage(5.0 if count == 1 else None)


def test_without_samples_each_counts() -> None:
    entry = an_entry(sources=(SourceRecord("bus", None, None),))
    assert len(counted_entries([entry, replace(entry, number=2)])) == 2


@given(st.lists(st.sampled_from("abc")))
def test_no_recording_counts_twice_and_none_is_lost(names: list[str]) -> None:
    found = counted_entries([of(name, number=i) for i, name in enumerate(names)])
    kept = [item.sources[0].samples for item in found]
    assert len(kept) == len(set(kept))
    assert set(kept) == set(names)


WRITERS, EACH = 8, 10


def fill(path: Path, serial: int, number: int) -> None:
    for hours in range(number):
        with History(path, create=True) as history:
            history.append(an_entry(serial, float(hours)))


def test_what_is_appended_comes_back(tmp_path: Path) -> None:
    entry, event = an_entry(7, 12.5, samples="ab"), an_event(hours=20.0, resets=("Kintas",))
    with History(tmp_path / "h", create=True) as history:
        assert history.append(entry) == 1
        assert history.append(an_entry(8)) == 2
        assert history.append_event(event) == 1
    with History(tmp_path / "h") as history:
        assert history.entries(7) == [replace(entry, number=1)]
        assert [item.serial for item in history.entries()] == [7, 8]
        assert history.events(7) == [replace(event, number=1)]
        assert history.events(8) == []


@settings(max_examples=10)
@given(text=st.text(st.characters(codec="utf-8")), serial=st.integers(0, 65535))
def test_any_text_comes_back(text: str, serial: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "?a=%20#.sqlite")
        with History(path, create=True) as history:
            history.append(an_entry(serial, actuator=text, reasons=(text,)))
            (found,) = history.entries()
        assert path.exists()
    assert (found.actuator, found.reasons, found.serial) == (text, (text,), serial)


@pytest.mark.parametrize(
    "table", ["diagnosis", "source", "severity", "effect", "event", "withdrawal"]
)
@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE {} SET rowid = rowid",
        "DELETE FROM {}",
        "INSERT OR REPLACE INTO {0} SELECT * FROM {0}",
    ],
)
def test_nothing_is_changed_in_place(tmp_path: Path, table: str, statement: str) -> None:
    with History(tmp_path / "h", create=True) as history:
        history.append(an_entry(samples="ab"))
        history.append_event(an_event())
        history.withdraw(EVENT_TABLE, 1, "2026-03-03T12:00:00.000Z", "why")
    connection = sqlite3.connect(tmp_path / "h")
    with pytest.raises(sqlite3.IntegrityError, match="only ever appended to"):
        connection.execute(statement.format(table))
    connection.close()


def test_it_waits_for_the_disk(tmp_path: Path) -> None:
    with History(tmp_path / "h", create=True) as history:
        (synchronous,) = history._connection.execute("PRAGMA synchronous").fetchone()
        (journal,) = history._connection.execute("PRAGMA journal_mode").fetchone()
    assert (synchronous, journal) == (2, "wal")


def test_eight_writers_lose_nothing(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork" if os.name == "posix" else "spawn")
    path = tmp_path / "h"
    writers = [context.Process(target=fill, args=(path, i, EACH)) for i in range(WRITERS)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0] * WRITERS
    with History(path) as history:
        for serial in range(WRITERS):
            hours = [item.usage.hours for item in history.entries(serial)]
            assert hours == list(map(float, range(EACH)))


def test_what_was_said_to_be_appended_survives_a_kill(tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from history_cases import an_entry\n"
        "from ehadiag.history.store import MAX_FLEET_UNITS, History\n"
        "for n in range(100000):\n"
        "    with History(Path(sys.argv[1]), create=True) as history:\n"
        "        print(history.append(an_entry(1, float(n))), flush=True)\n"
    )
    last = 0
    for wait in (0.0, 0.013, 0.031, 0.057):
        child = subprocess.Popen(
            [sys.executable, "-c", script, str(tmp_path / "h")],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert child.stdout is not None
        said = [int(child.stdout.readline())]
        time.sleep(wait)
        child.send_signal(signal.SIGKILL)
        said += [int(line) for line in child.stdout.read().split("\n")[:-1]]
        child.wait()
        child.stdout.close()
        last = max(said)
        with History(tmp_path / "h") as history:
            numbers = [item.number for item in history.entries()]
        assert set(said) <= set(numbers)
        assert numbers == sorted(numbers)
        assert len(numbers) - last in (0, 1)  # one may have been done and not told
    connection = sqlite3.connect(tmp_path / "h")
    assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    connection.close()


def test_a_full_disk_leaves_what_there_was(tiny_disk: Path) -> None:
    kept = 0
    with pytest.raises(InputOutputError) as told:  # noqa: PT012 - which one fails is the disk's
        for _ in range(100):
            with History(tiny_disk / "h", create=True) as history:
                history.append(an_entry(result="x" * 2000))
                kept += 1
    assert "\n" not in str(told.value)
    assert "disk" in str(told.value)
    connection = sqlite3.connect(f"file:{tiny_disk / 'h'}?mode=ro", uri=True)
    if kept:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert connection.execute("SELECT COUNT(*) FROM diagnosis").fetchone() == (kept,)
    connection.close()


def test_a_step_of_the_tables_keeps_the_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with History(tmp_path / "h", create=True) as history:
        history.append(an_entry())
    steps = (
        *MIGRATION_STEPS,
        "ALTER TABLE diagnosis ADD COLUMN further TEXT;\nCREATE TABLE t (a);\n",
    )
    connection = sqlite3.connect(tmp_path / "h", isolation_level=None)
    migrate(connection, steps)
    migrate(connection, steps)
    assert connection.execute("PRAGMA user_version").fetchone() == (len(steps),)
    assert connection.execute("SELECT further FROM diagnosis").fetchall() == [(None,)]
    connection.close()
    with pytest.raises(ConfigurationError, match="use a later ehadiag"):
        History(tmp_path / "h")


def test_a_history_of_the_first_version_takes_withdrawals(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as old:
        migrate(old, MIGRATION_STEPS[:1])
        old.execute(
            "INSERT INTO event (appended, done, serial, text, resets)"
            " VALUES ('x', 'y', 7, 'z', '[]')"
        )
    with History(path) as history:
        assert len(history.events()) == 1
        history.withdraw(EVENT_TABLE, 1, "2026-03-01T12:00:00.000Z", "why")
        assert history.events() == []
        assert [item.withdrawn for item in history.events(withdrawn=True)] == ["why"]
        with pytest.raises(ConfigurationError, match="already"):
            history.withdraw(EVENT_TABLE, 1, "2026-03-01T12:00:00.000Z", "why")


def test_a_step_that_fails_changes_nothing(tmp_path: Path) -> None:
    with History(tmp_path / "h", create=True) as history:
        history.append(an_entry())
    connection = sqlite3.connect(tmp_path / "h", isolation_level=None)
    with pytest.raises(sqlite3.OperationalError):
        migrate(connection, (*MIGRATION_STEPS, "CREATE TABLE t (a);\nCREATE TABLE t (a);\n"))
    connection.close()
    with History(tmp_path / "h") as history:
        assert len(history.entries()) == 1


@pytest.mark.parametrize(
    "content", [b"not a database at all " * 50, b"SQLite format 3\0" + b"x" * 900]
)
def test_a_file_of_another_kind_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "h").write_bytes(content)
    with pytest.raises(InputOutputError, match="not an SQLite file"):
        History(tmp_path / "h", create=True)
    assert (tmp_path / "h").read_bytes() == content


def test_another_programs_database_is_refused(tmp_path: Path) -> None:
    connection = sqlite3.connect(tmp_path / "h")
    connection.execute("CREATE TABLE mail (a)")
    connection.close()
    with pytest.raises(ConfigurationError, match="another program"):
        History(tmp_path / "h", create=True)


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputOutputError, match="too long"):
        History(tmp_path / ("a" * 300), create=True)


def test_no_file_is_no_history(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="ehadiag history init"):
        History(tmp_path / "h")
    assert not (tmp_path / "h").exists()


@pytest.mark.parametrize("hours", [-1.0, float("nan"), float("inf")])
def test_hours_are_numbers(hours: float) -> None:
    with pytest.raises(ConfigurationError, match="hours"):
        Usage(hours)


def test_a_number_beyond_64_bits_is_said(tmp_path: Path) -> None:
    with History(tmp_path / "h", create=True) as history:
        with pytest.raises(InputOutputError, match="beyond what SQLite holds"):
            history.append(an_entry(1 << 63))
        assert history.entries() == []
        with pytest.raises(InputOutputError, match="beyond what SQLite holds"):
            history.events(1 << 64)


def test_a_question_reads_its_own_rows(tmp_path: Path) -> None:
    with History(tmp_path / "h", create=True) as history:
        history.append_all([an_entry(serial, 100.0) for serial in range(1, 101)])
        history.append(an_entry(7, 200.0, actuator="other"))
        whole, brief = history.entries(7), history.entries(7, brief=True)
        assert [item.number for item in brief] == [item.number for item in whole] == [7, 101]
        assert brief[0].severities == whole[0].severities
        assert (brief[0].result, brief[0].effects, brief[0].covariance) == ("", (), None)
        assert history.entry(101) == whole[1]
        with pytest.raises(ConfigurationError, match="has no diagnosis 102"):
            history.entry(102)
        assert history.units()[:2] == [("other", 7), ("reference-31", 1)]
        assert history.units(1) == [("reference-31", 1)]
        entries, _ = history.alike(7, "reference-31")
        others = {item.serial for item in entries} - {7}
        assert len(others) == MAX_FLEET_UNITS
        assert min(others) < 10
        assert max(others) > 90
        asked = history._connection.execute(
            "EXPLAIN QUERY PLAN SELECT serial, COUNT(*) FROM diagnosis WHERE actuator = 'a' AND"
            " simulated = 0 GROUP BY serial"
        ).fetchall()
        assert "diagnosis_of_actuator" in asked[0]["detail"]
