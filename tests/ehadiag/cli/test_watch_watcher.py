"""The watcher between tests: motion of a unit that is as it was told, and of one that is not."""

from __future__ import annotations

import pytest

from ehadiag.cli.watch.known import KnownUnit
from ehadiag.cli.watch.watcher import Heard, Watcher
from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.recording import BitReason, BitState, CommandMode
from ehadiag.core.stored_test import bundled_tests
from ehadiag.live.snapshot import Severity
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.free_motion.motion import free_motion
from firmware_iface.codec.encode import Encoder
from firmware_iface.mapping.bus_map import default_map

ACTUATOR = default_actuator()
MS = 1_000_000


def watched(true: float, seconds: float, *, testing: bool) -> tuple[Watcher, list[Heard]]:
    """A unit with this jack friction, known as one with 0.3, moved at random in current mode."""
    known = [Severity(name=name, estimate=0.3) for name in ("Kintas", "FSS", "FDJ")]
    alarms: list[Heard] = []
    tests = bundled_tests().values()
    unit = KnownUnit("here", tuple(known))
    watcher = Watcher(ACTUATOR, default_map(), unit, tests, 100.0, alarms.append)
    encoder, state = Encoder(), BitState.RUNNING if testing else BitState.IDLE
    for frame in encoder.environment(20.7e6, 0.7e6, 40.0, 0):
        watcher.take(frame)
    for frame in encoder.status(state, BitReason.NONE, int(testing), 0.0, 9, 0):
        watcher.take(frame)
    rows = free_motion(ACTUATOR, Faults(0.3, 0.3, true), CommandMode.CURRENT, seconds, seed=3)
    codes = [channel.encode(rows[:, place + 1]) for place, channel in enumerate(CHANNELS)]
    for tick, command in enumerate(rows[:, 0].tolist()):
        stamp = tick * MS
        frames = encoder.command(CommandMode.CURRENT, command, 0, stamp)
        frames += encoder.telemetry([int(code[tick]) for code in codes], stamp)
        for frame in frames:
            watcher.take(frame)
    return watcher, alarms


def test_a_change_that_lasts_is_an_alarm_and_what_passes_is_counted() -> None:
    watcher, alarms = watched(0.6, 3.0, testing=False)
    assert alarms == []
    assert watcher.passing > 0
    assert (watcher.ticks, watcher.lost, watcher.mode) == (3000, 0, CommandMode.CURRENT)


@pytest.mark.slow
def test_alarms_that_go_on_between_tests_are_raised() -> None:
    watcher, alarms = watched(0.6, 32.0, testing=False)
    assert alarms
    assert alarms[0].during == ""
    assert alarms[0].tick > 10_000
    assert watcher.alarms == len(alarms)


def test_while_a_test_runs_each_alarm_is_raised_at_once() -> None:
    watcher, alarms = watched(0.6, 3.0, testing=True)
    assert alarms
    assert {item.during for item in alarms} == {"open"}
    assert watcher.serial == 9
    assert watcher.passing == 0
    assert {item.signal for item in alarms} <= {"spool", "pressure"}


def test_what_is_seen_is_there_for_a_snapshot() -> None:
    watcher, _ = watched(0.3, 1.0, testing=True)
    found, test = watcher.residuals(), watcher.test()
    assert found is not None
    assert max(found.spool_above, found.pressure_above) <= 1.0
    assert test is not None
    assert (test.name, test.phase, test.duration_s) == ("open", "running", 5.5)
    assert len(watcher.trace.signals().time_s) >= 19
