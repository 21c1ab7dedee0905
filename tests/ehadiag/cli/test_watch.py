"""The monitor beside a test: alarms by what was known of the unit before, and nothing it stops.

The watcher between tests: motion of a unit that is as it was told, and of one that is not. The log
of a monitor: appended to, through no link, and to nothing that is no file.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from places import LOGS

from ehadiag import (
    CommandMode,
    ConfigurationError,
    InputOutputError,
    bundled_tests,
    default_actuator,
)
from ehadiag.estimate import Severity
from ehadiag.request import Request
from ehadiag.session.alarm_outlets import AlarmLog
from ehadiag.session.bit_run import BitView
from ehadiag.session.bus_monitor import BusMonitor, MonitorAlarm
from ehadiag.session.monitor_session import BitMonitor
from ehadiag.session.unit_state import UnitState, new_unit_state
from ehadiag.setup import Setup
from ehadiag_tools.free_motion.motion import Motion, free_motion
from firmware_iface.bus_map import BusMap, default_map
from firmware_iface.codec import Encoder
from firmware_iface.handshake import Phase
from firmware_iface.live_decode import BitStatus, Sample
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import CHANNELS, BitReason, BitState
from firmware_iface.stored_test import resolve_test
from firmware_iface.tester import BitProgress
from firmware_iface.transport.frames import Frame

ACTUATOR, TEST = default_actuator(), resolve_test("open")
TRUE = {"Kintas": 0.6, "FSS": 0.6, "FDJ": 0.6}


def unit_with(**severities: float) -> UnitState:
    return UnitState(
        "diagnosis 3",
        tuple(Severity(name=name, estimate=item) for name, item in severities.items()),
    )


def monitor_in_test(
    find: Callable[[int], UnitState | None] | None, bus_map: BusMap | None = None
) -> BitMonitor:
    """The recording of an open-loop test, watched; the history answers before the test begins."""
    made = BitMonitor(ACTUATOR, bus_map or default_map(), [TEST], find)
    table = read_frames(LOGS / "paper-open-4.blf")
    status = int(np.flatnonzero(table.can_id == 0x201)[0])
    for row in range(len(table.can_id)):
        data = table.data[row, : table.length[row]].tobytes()
        made.take(Frame(int(table.time_ns[row]), can_id=int(table.can_id[row]), data=data))
        if row == status:
            for thread in threading.enumerate():
                if thread.name == "ehadiag-known":
                    thread.join()
    return made


def test_a_unit_of_which_nothing_is_known_is_compared_with_a_new_one() -> None:
    made = monitor_in_test(None)
    count, alarms = made.alarms
    assert count == len(alarms) > 0
    assert {item.during for item in alarms} == {"open"}
    assert made.residuals is not None
    assert made.residuals.against == "a unit as new"
    assert made.why == ""


@pytest.mark.parametrize("by_status", [True, False])
def test_where_no_message_has_the_state_of_the_test_its_progress_does(by_status: bool) -> None:
    made, setup = BitMonitor(ACTUATOR, default_map(), [TEST]), Setup(Request(test="open"))
    view = BitView(ACTUATOR, TEST, setup.session([TEST]), None, made, by_status=by_status)
    view.progress(BitProgress(Phase.SETTLING, 0.0, 5.5, 0, None))
    table = read_frames(LOGS / "paper-open-4.blf")
    for row in np.flatnonzero(table.can_id != 0x201).tolist():
        if row == 100:
            view.progress(BitProgress(Phase.RUNNING, 0.0, 5.5, row, None))
        data = table.data[row, : table.length[row]].tobytes()
        view.take(Frame(int(table.time_ns[row]), can_id=int(table.can_id[row]), data=data))
    seen = view.look(1)
    assert {item.during for item in seen.alarms} == (set() if by_status else {"open"})
    assert seen.residuals is not None


def test_a_unit_that_is_as_its_history_says_raises_no_alarm() -> None:
    asked = []

    def find(serial: int) -> UnitState:
        asked.append(serial)
        return unit_with(**TRUE)

    made = monitor_in_test(find)
    assert made.alarms == (0, ())
    assert made.residuals is not None
    assert made.residuals.against == "diagnosis 3"
    assert asked == [made.serial]


@pytest.mark.parametrize("wrong", [0.65, 0.0])
def test_a_unit_that_has_changed_since_raises_one(wrong: float) -> None:
    assert monitor_in_test(lambda _serial: unit_with(**TRUE | {"FSS": wrong})).alarms[0] > 0


def test_a_history_that_cannot_be_asked_is_said_and_the_test_goes_on() -> None:
    def find(_serial: int) -> UnitState:
        raise ConfigurationError("history x: is none")

    made = monitor_in_test(find)
    assert made.why == "earlier diagnoses are not looked at: history x: is none"
    assert made.residuals is not None


def without_counters() -> BusMap:
    bare = {
        name: replace(item, counter=None, counts_ticks=False)
        for name, item in default_map().messages.items()
    }
    return replace(default_map(), messages=bare)


def test_a_bus_without_single_ticks_has_no_residuals_and_says_why() -> None:
    slow = without_counters()
    made = monitor_in_test(None, slow)
    assert made.residuals is None
    assert made.why.startswith("no residuals: ")
    assert "counter" in made.why


REFERENCE = default_actuator()
MS = 1_000_000


def watched(
    true: float, seconds: float, *, testing: bool, bus_map: BusMap | None = None
) -> tuple[BusMonitor, list[MonitorAlarm]]:
    """A unit with this jack friction, known as one with 0.3, moved at random in current mode."""
    unit_with = [Severity(name=name, estimate=0.3) for name in ("Kintas", "FSS", "FDJ")]
    alarms: list[MonitorAlarm] = []
    tests = bundled_tests().values()
    unit = UnitState("here", tuple(unit_with))
    bus_map = bus_map or default_map()
    watcher = BusMonitor(REFERENCE, bus_map, unit, tests, 100.0, alarms.append)
    encoder, state = Encoder(), BitState.RUNNING if testing else BitState.IDLE
    for frame in encoder.environment(20.7e6, 0.7e6, 40.0, 0):
        watcher.take(frame)
    for frame in encoder.status(state, BitReason.NONE, int(testing), 0.0, 9, 0):
        watcher.take(frame)
    motion = Motion("gusts", "current", seconds, (0.3, 0.3, true), 3)
    rows = free_motion(REFERENCE, motion).rows
    codes = [channel.encode(rows[:, place + 1]) for place, channel in enumerate(CHANNELS)]
    for tick, command in enumerate(rows[:, 0].tolist()):
        stamp = tick * MS
        frames = encoder.command(CommandMode.CURRENT, command, 0, stamp)
        frames += encoder.telemetry([int(code[tick]) for code in codes], stamp)
        for frame in frames:
            watcher.take(frame)
    watcher.finish()
    return watcher, alarms


def test_what_is_new_for_seconds_is_no_alarm_between_tests() -> None:
    watcher, alarms = watched(0.6, 3.0, testing=False)
    assert alarms == []
    assert (watcher.ticks, watcher.lost, watcher.mode) == (3000, 0, CommandMode.CURRENT)


def test_ticks_without_counters_are_those_with_them() -> None:
    """The commands are not off by a tick."""
    counted, _ = watched(0.3, 3.0, testing=False)
    placed, alarms = watched(0.3, 3.0, testing=False, bus_map=without_counters())
    assert (placed.ticks, placed.lost, alarms) == (counted.ticks, 0, [])
    assert placed.pushed == counted.pushed
    found, other = placed.residuals(), counted.residuals()
    assert found is not None
    assert other is not None
    assert found.spool == pytest.approx(other.spool, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("bus_map", [default_map(), without_counters()], ids=["counted", "bare"])
def test_a_change_that_lasts_is_an_alarm_that_says_what_changed(bus_map: BusMap) -> None:
    watcher, alarms = watched(0.4, 23.0, testing=False, bus_map=bus_map)
    assert [item.causes[0].name for item in alarms] == ["FDJ"]
    assert alarms[0].causes[0].size == pytest.approx(0.1, abs=0.02)
    assert str(alarms[0].causes[0]).startswith("jack friction +0.1")
    assert (alarms[0].during, alarms[0].signal) == ("", "")
    assert alarms[0].tick == 16_000
    assert watcher.alarms == len(alarms)


def bus_monitor(unit: UnitState) -> BusMonitor:
    return BusMonitor(REFERENCE, default_map(), unit, (), 100.0, lambda _: None)


def why_none(watcher: BusMonitor) -> str:
    severities, (why,) = watcher.severities()
    assert not any(item.shown for item in severities)
    return why


def test_no_severities_by_free_motion_of_a_unit_without_a_diagnosis() -> None:
    """Its offsets and effects are not known as well as the intervals take them to be."""
    watcher = bus_monitor(new_unit_state(REFERENCE))
    assert why_none(watcher) == "the unit has no diagnosis: run a test"
    watcher.take_over(unit_with(**TRUE))
    assert why_none(watcher) == "less than 5 min of free motion: run a test"


def test_no_severities_by_free_motion_of_two_units() -> None:
    seven = replace(unit_with(**TRUE), serial=7)
    watcher = bus_monitor(seven)
    watcher.take_status(BitStatus(BitState.IDLE, serial=7))
    assert why_none(watcher) == "less than 5 min of free motion: run a test"
    for serial in (8, 7):
        watcher.take_status(BitStatus(BitState.IDLE, serial=serial))
        assert why_none(watcher) == "serial number 8 on the bus, not 7: run a test"
    watcher.take_over(seven)
    assert why_none(watcher) == "less than 5 min of free motion: run a test"


def test_while_a_test_runs_each_alarm_is_raised_at_once() -> None:
    watcher, alarms = watched(0.6, 3.0, testing=True)
    assert alarms
    assert {item.during for item in alarms} == {"open"}
    assert watcher.serial == 9
    assert {item.signal for item in alarms} <= {"spool", "pressure"}


def test_what_is_seen_is_there_for_a_snapshot() -> None:
    watcher, _ = watched(0.3, 1.0, testing=True)
    found, test = watcher.residuals(), watcher.test()
    assert found is not None
    assert max(found.spool_above, found.pressure_above) <= 1.0
    assert test is not None
    assert (test.name, test.phase, test.duration_s) == ("open", "running", 5.5)
    assert len(watcher.trace.signals().time_s) >= 19


posix = pytest.mark.skipif(os.name != "posix", reason="links, pipes and permissions of POSIX")


def events(path: Path) -> list[str]:
    return [json.loads(line)["event"] for line in path.read_text().splitlines()]


def test_calls_are_appended(tmp_path: Path) -> None:
    path = tmp_path / "watch.jsonl"
    for event in ("begin", "end"):
        log = AlarmLog(path)
        log.write(event, name="a\x1b[31m\udcff")
        log.close()
    assert events(path) == ["begin", "end"]


@posix
def test_permissions(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        AlarmLog(tmp_path / "log").close()
    finally:
        os.umask(before)
    assert (tmp_path / "log").stat().st_mode & 0o777 == 0o640


@posix
@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "device", "folder"])
def test_what_is_no_file_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    path, other = tmp_path / "log", tmp_path / "other"
    match kind:
        case "link":
            other.write_text("mine")
            path.symlink_to(other)
        case "dangling link":
            path.symlink_to(other)
        case "pipe":
            os.mkfifo(path)
        case "device":
            path = Path(os.devnull)
        case "folder":
            path.mkdir()
    with pytest.raises(InputOutputError, match=r"^log .*: "):
        AlarmLog(path)
    assert not other.exists() or other.read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device")
def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "ehadiag.session.alarm_outlets.append_to_file",
        lambda _path: os.open("/dev/full", os.O_WRONLY),
    )
    log = AlarmLog(tmp_path / "log")
    with pytest.raises(InputOutputError, match="No space left on device"):
        log.write("begin")
    log.close()


def test_the_live_command_is_that_of_the_frames_not_of_the_clock() -> None:
    """On a busy machine the clock is ahead of the telemetry, and the command must not be."""
    monitor = monitor_in_test(None)
    setup = Setup(Request(test="open"))
    view = BitView(ACTUATOR, TEST, setup.session([TEST]), None, monitor)
    late_s = 1.0
    sample = Sample(0.0, 0.0, 0.0, 0.0)
    for tick in range(0, 5500, 50):
        view.progress(BitProgress(Phase.RUNNING, tick / 1e3 + late_s, 5.5, tick, sample))
    seen = view.look(1).signals
    pairs = zip(seen.command_mA, seen.current_mA, strict=True)
    apart = [abs(a - b) for a, b in pairs if a is not None and b is not None]
    assert len(apart) > 200
    # The current follows the command within a tick; extremes of a fast sine may swap their order.
    assert np.median(apart) < 0.1
