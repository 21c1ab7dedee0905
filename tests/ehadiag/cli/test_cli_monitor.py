"""`ehadiag monitor`: on recordings, on a bus that lives, and what bad input gets."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import can
import pytest
from cli_result import REPOSITORY, Run
from msgspec.structs import replace
from places import LOGS
from stored_results import former_result

import ehadiag
from ehadiag import bundled_tests, default_actuator
from ehadiag.history.records import counted_entries
from ehadiag.history.store import History
from ehadiag.result import Result
from ehadiag.session import bus_calls
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import FccCore
from firmware_iface.codec import Encoder
from firmware_iface.errors import InputOutputError
from firmware_iface.logs.reader import read_frames
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.python_can import PythonCanTransport

HEALTHY, WORN = LOGS / "healthy-open.blf", LOGS / "paper-open-2.blf"


def events(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture
def result(run: Run, tmp_path: Path) -> Path:
    """The diagnosis of a worn unit."""
    run("diagnose", WORN, "--out", "known", "--no-picture")
    return tmp_path / "known" / "paper-open-2.json"


def test_a_unit_as_new_gives_no_alarm(run: Run) -> None:
    found = run("monitor", "--log", HEALTHY)
    assert found.code == 0
    assert found.out == ""
    assert "NO ALARM" in found.err
    assert "0 alarms" in found.err


def test_a_worn_unit_is_no_news_to_a_monitor_that_knows_it(run: Run, result: Path) -> None:
    found = run("monitor", "--log", WORN, "--from", result)
    assert (found.code, "NO ALARM" in found.err) == (0, True)
    assert "FSS 0.6" in found.err


def test_an_alarm_is_logged_recorded_told_and_the_exit_code(run: Run, tmp_path: Path) -> None:
    call = "python3 -c \"import sys; open('told.json', 'w').write(sys.stdin.read())\""
    options = ("--log-file", "a.jsonl", "--record", "around", "--around", "0.2")
    found = run("monitor", "--log", WORN, *options, "--on-alarm", call)
    assert found.code == 40
    begin, first, *_, end = events(tmp_path / "a.jsonl")
    assert [begin["event"], first["event"], end["event"]] == ["begin", "alarm", "end"]
    assert begin["severities"] == {"Kintas": 0.0, "FSS": 0.0, "FDJ": 0.0}
    assert (first["during"], first["mode"], first["signal"]) == ("open", "current", "spool")
    assert first["time"].endswith("Z")
    assert end["alarms"] == len(events(tmp_path / "a.jsonl")) - 2
    assert end["again"] > 0
    recorded = read_frames(tmp_path / "around" / first["recorded"])
    before = first["frame_ns"] - int(recorded.time_ns[0])
    after = int(recorded.time_ns[-1]) - first["frame_ns"]
    assert 0.19e9 < before <= 0.2e9
    assert after >= 0.2e9 - 5e6
    told = json.loads((tmp_path / "told.json").read_text())
    assert told in events(tmp_path / "a.jsonl")[1:-1]
    assert f"recorded in {first['recorded']}" in found.err


def test_a_log_is_appended_to(run: Run, tmp_path: Path) -> None:
    for _ in range(2):
        run("monitor", "--log", HEALTHY, "--log-file", "a.jsonl")
    names = [item["event"] for item in events(tmp_path / "a.jsonl")]
    assert names == ["begin", "end", "begin", "end"]


def test_a_history_knows_the_unit_by_the_serial_number_on_the_bus(run: Run, tmp_path: Path) -> None:
    run("diagnose", WORN, "--history", "h.sqlite")
    found = run("monitor", "--log", WORN, "--history", "h.sqlite", "--log-file", "a.jsonl")
    assert found.code == 0
    _, unit, _ = events(tmp_path / "a.jsonl")
    assert unit["event"] == "unit"
    assert unit["severities"]["FSS"] == pytest.approx(0.6, abs=0.02)
    serial = unit["serial"]
    named = run("monitor", "--log", WORN, "--history", "h.sqlite", "--unit", serial)
    assert named.code == 0
    other = run("monitor", "--log", WORN, "--history", "h.sqlite", "--unit", 999)
    assert (other.code, "no diagnosis of serial number 999" in other.err) == (2, True)


def test_severities_by_free_motion_are_kept_and_taken_for_no_diagnosis(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each block is a part here: the recording has some seconds only."""
    monkeypatch.setattr("ehadiag.monitor.flight.PART_BLOCKS", 1)
    monkeypatch.setattr("ehadiag.monitor.flight.PARTS", (4, 120))
    run("diagnose", WORN, "--history", "h.sqlite")
    for _ in range(2):
        found = run(
            "monitor", "--log", WORN, "--history", "h.sqlite", "--log-file", "a.jsonl",
            "--unit-hours", "100",
        )  # fmt: skip
        assert "severities by free motion: " in found.err
    end = events(tmp_path / "a.jsonl")[-1]
    with History(tmp_path / "h.sqlite") as history:
        first, _, last = history.entries()
        assert [item.number for item in counted_entries(history.entries())] == [1, 3]
    assert (last.test, last.verdict, last.by_test) == ("free motion", "NOT_TESTED", False)
    assert (last.serial, last.usage.hours) == (first.serial, 100.0)
    assert last.when[:19] == first.when[:19]
    stated = {item.name: item for item in last.severities if item.shown}
    assert stated["FSS"].value == pytest.approx(0.6, abs=0.02)
    assert end["severities"]["FSS"]["std"] == stated["FSS"].std
    assert str(Result.from_json(last.result)).startswith("NOT TESTED")
    assert events(tmp_path / "a.jsonl")[-2]["known"].startswith("diagnosis 1 of ")
    assert " free motion " in run("history", "list", "--history", "h.sqlite").out


def test_an_alarm_is_said_though_the_history_takes_no_severities(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ehadiag.monitor.flight.PART_BLOCKS", 1)
    monkeypatch.setattr("ehadiag.monitor.flight.PARTS", (4, 120))
    run("diagnose", WORN, "--history", "h.sqlite")

    watch = bus_calls.watch

    def refuse(*_: object) -> None:
        raise InputOutputError("history h.sqlite: cannot be written")

    monkeypatch.setattr(History, "append", refuse)
    monkeypatch.setattr(
        bus_calls, "watch", lambda *args, **named: replace(watch(*args, **named), alarm_count=1)
    )
    found = run("monitor", "--log", WORN, "--history", "h.sqlite")
    assert found.code == 40
    assert "cannot be written" in found.err


def test_a_unit_that_the_history_does_not_know_is_taken_as_new_and_said(run: Run) -> None:
    run("history", "init", "--history", "h.sqlite")
    found = run("monitor", "--log", HEALTHY, "--history", "h.sqlite")
    assert found.code == 0
    assert "the history has no diagnosis of serial number" in found.err


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "is none of ehadiag's JSON results"),
        ("[]", "is none of ehadiag's JSON results"),
        ('{"schema": "other/1"}', "its schema is other/1"),
        (json.dumps(former_result(actuator="left")), "of actuator left"),
        (json.dumps(former_result(fit=None)), "holds no severities"),
        (json.dumps(former_result(fit={})), "is none of"),
    ],
)
def test_what_is_no_result_is_refused(run: Run, tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "r.json").write_text(content)
    found = run("monitor", "--log", HEALTHY, "--from", "r.json")
    assert found.code == 2
    assert said in found.err
    assert found.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "no bus named"),
        (("--log", HEALTHY, "--from", "r.json", "--history", "h"), "exclude each other"),
        (("--log", HEALTHY, "--no-history", "--history", "h"), "exclude each other"),
        (("--log", HEALTHY, "--unit-hours", 5), "no health history to keep them in"),
        (("--log", HEALTHY, "--unit", "3"), "no health history"),
        (("--log", HEALTHY, "--hours", "1e9"), "hours between false alarms"),
        (("--log", HEALTHY, "--least-monitored", "2"), "need a number above 0, 1 at most"),
        (("--log", HEALTHY, "--on-alarm", "'open"), "--on-alarm"),
        (("--log", HEALTHY, "--history", "missing.sqlite"), "no history"),
    ],
)
def test_wrong_usage_is_one_line(run: Run, arguments: tuple[object, ...], said: str) -> None:
    found = run("monitor", *arguments)
    assert found.code == 2
    assert said in found.err
    assert found.err.count("\n") == 1


def test_what_cannot_be_written_is_said(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    log = run("monitor", "--log", HEALTHY, "--log-file", "missing/a.jsonl")
    assert (log.code, "log missing/a.jsonl" in log.err) == (3, True)
    folder = run("monitor", "--log", HEALTHY, "--record", "file/around")
    assert (folder.code, "folder file/around" in folder.err) == (3, True)


def test_a_command_that_fails_is_said_and_changes_nothing(run: Run) -> None:
    found = run("monitor", "--log", WORN, "--on-alarm", "false")
    assert found.code == 40
    assert "--on-alarm false: ended with code 1" in found.err


def test_a_projects_file_cannot_have_a_command_called(run: Run, tmp_path: Path) -> None:
    (tmp_path / "ehadiag.toml").write_text('[monitor]\non_alarm = "touch stolen"\n')
    found = run("monitor", "--log", WORN)
    assert found.code == 2
    assert "on_alarm is not for a project's file" in found.err
    assert not (tmp_path / "stolen").exists()


def test_the_users_own_file_can(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "own" / "ehadiag"
    own.mkdir(parents=True)
    words = '["python3", "-c", "open(\'called\', \'w\').close()"]'
    (own / "ehadiag.toml").write_text(f"[monitor]\non_alarm = {words}\n")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(own.parent))
    assert run("monitor", "--log", WORN).code == 40
    assert (tmp_path / "called").exists()


def test_a_silent_bus_is_not_monitored_and_the_time_ends_it(run: Run) -> None:
    found = run("monitor", "-i", "virtual", "-c", "monitor-silent", "--duration", "0.3")
    assert found.code == 30
    assert "NOT MONITORED: the bus was silent" in found.err


def test_a_bus_whose_frames_do_not_tell_ticks_is_watched_too(run: Run) -> None:
    mapping = REPOSITORY / "docs" / "examples" / "buses" / "canaerospace.toml"
    options = ("--mapping", mapping, "--duration", "0.3")
    found = run("monitor", "-i", "virtual", "-c", "monitor-other", *options)
    assert found.code == 30
    assert "the bus was silent" in found.err


def test_too_few_monitored_ticks_are_an_exit_code(run: Run) -> None:
    found = run("monitor", "--log", HEALTHY, "--least-monitored", "0.999")
    assert found.code == 30
    assert "ticks monitored" in found.err
    assert "NOT MONITORED: 9" in found.err
    assert "% of the ticks only, 100% are needed" in found.err
    assert "NO ALARM" not in found.err


def test_a_column_of_decoded_signals_is_named_as_for_a_diagnosis(run: Run, tmp_path: Path) -> None:
    """A stored test, which an unknown unit's sums would alarm at, is motion like any other."""
    (recording,) = ehadiag.read(HEALTHY)
    table = recording.to_frame().rename(columns={"command": "cmd", "position": "Stroke"})
    table["Stroke"] *= 1e3
    table.to_csv(tmp_path / "rig.csv")
    columns = ("--column", "current_command=cmd", "--column", "position=Stroke:mm")
    found = run("monitor", "--log", "rig.csv", *columns, "--log-file", "a.jsonl")
    assert (found.code, "NO ALARM" in found.err) == (0, True), found.err
    _, end = events(tmp_path / "a.jsonl")
    # A second for oil and supply, which may come, and 300 ticks to settle.
    assert end["monitored"] > 0.75 * end["ticks"] > 4000
    assert end["lost"] < 5
    table.head(300).to_csv(tmp_path / "short.csv")
    short = run("monitor", "--log", "short.csv", *columns)
    assert "NOT MONITORED: 299 ticks of decoded signals, too few" in short.err
    unnamed = run("monitor", "--log", "rig.csv", "--column", "current_command=cmd")
    assert unnamed.code == 2
    assert "no column for channels.position" in unnamed.err


def test_ctrl_c_ends_it_in_order(tmp_path: Path, environment: dict[str, str]) -> None:
    log = tmp_path / "a.jsonl"
    command = [sys.executable, "-m", "ehadiag", "monitor", "--log-file", str(log)]
    with subprocess.Popen(
        [*command, "-i", "virtual", "-c", "monitor-stop"], env=environment, cwd=tmp_path,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        patience = time.monotonic() + 60.0
        while not (log.exists() and log.read_text()) and time.monotonic() < patience:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 30
    assert [item["event"] for item in events(log)] == ["begin", "end"]
    assert b"NOT MONITORED" in said
    assert b"Traceback" not in said


def test_it_follows_tests_and_modes_on_a_bus_and_sends_nothing(run: Run, tmp_path: Path) -> None:
    """A worn unit, held, then tested in current mode, then held; told of its wear, then not."""
    core = FccCore(default_actuator(), bundled_tests().values(), faults=Faults(0.0, 0.3, 0.0))
    channel, heard = "monitor-live", []
    (tmp_path / "worn.json").write_text(
        json.dumps(_result({"Kintas": 0.0, "FSS": 0.3, "FDJ": 0.0}))
    )
    with (
        PythonCanTransport(BusOptions("virtual", channel=channel), transmit=True) as fcc,
        can.Bus(interface="virtual", channel=channel) as witness,
    ):
        listening, ended = tmp_path / "a.jsonl", threading.Event()
        playing = threading.Thread(target=_play, args=(core, fcc, listening, ended), daemon=True)
        playing.start()
        found = run(
            "monitor", "-i", "virtual", "-c", channel, "--duration", "60", "--from", "worn.json",
            "--log-file", listening,
        )  # fmt: skip
        ended.set()
        playing.join(30.0)
        while (message := witness.recv(0.0)) is not None:
            heard.append(message.arbitration_id)
    begin, end = events(tmp_path / "a.jsonl")
    assert begin["severities"]["FSS"] == 0.3
    assert (found.code, end["alarms"]) == (0, 0)
    assert "test 'open': running" in found.err
    assert end["monitored"] > 1000
    assert 0x200 not in heard  # nobody requested anything


def _play(core: FccCore, fcc: PythonCanTransport, listening: Path, ended: threading.Event) -> None:
    """As soon as somebody listens half a second of rest, the first two seconds of a test: as fast
    as it goes, in order; then Ctrl-C."""
    patience = time.monotonic() + 50.0
    while not (listening.exists() and listening.read_text()) and time.monotonic() < patience:
        time.sleep(0.02)
    for tick in range(2500):
        if tick == 500:
            core.take(Encoder().request("start", 1, 0)[0])
        for frame in core.step():
            fcc.send(frame)
    if not ended.wait(1.0):
        signal.raise_signal(signal.SIGINT)


def _result(severities: dict[str, float]) -> dict[str, Any]:
    fit = former_result()["fit"] | {"spool_offset_mm": 0.0, "pressure_offset_MPa": 0.0}
    noise = {"spool_noise_mm": 1.4e-4, "pressure_noise_MPa": 7e-3}
    return former_result(severities, fit=fit | noise)
