""""""

from __future__ import annotations

import json
import math
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag import CommandMode, live
from ehadiag.core.conventions import finite
from ehadiag.estimate import Severity
from ehadiag.live import (
    Alarm,
    BusState,
    BusTraffic,
    Ending,
    Publisher,
    Residuals,
    RunningTest,
    Signals,
    SignalTrace,
    Snapshot,
)


def look(number: int) -> Snapshot:
    return Snapshot(
        number=number,
        time="2026-03-01T12:00:00.000Z",
        command="bit",
        actuator="left",
        serial=None,
        bus=BusState(name="virtual", state="open"),
    )


def numbers(publisher: Publisher, out: list[int]) -> None:
    seen = 0
    while (snapshot := publisher.wait(seen, 10.0)) is not None:
        seen = snapshot.number
        out.append(seen)


def test_several_readers_see_ever_newer_snapshots_and_the_last_one() -> None:
    publisher = Publisher(look, period_s=0.001)
    heard: list[list[int]] = [[], [], []]
    readers = [threading.Thread(target=numbers, args=(publisher, out)) for out in heard]
    with publisher:
        for reader in readers:
            reader.start()
        publisher.wait(20, 10.0)
    for reader in readers:
        reader.join(10.0)
        assert not reader.is_alive()
    last = publisher.latest
    assert last is not None
    for out in heard:
        assert out == sorted(set(out))
        assert out[-1] == last.number


def test_nothing_comes_after_the_last() -> None:
    publisher = Publisher(look, period_s=60.0)
    assert publisher.latest is None
    with publisher:
        pass
    assert publisher.ended
    last = publisher.latest
    assert last is not None
    publisher.refresh()
    publisher.close()
    assert publisher.latest is last
    assert publisher.wait(last.number, 10.0) is None


def test_a_reader_waits_no_longer_than_it_said() -> None:
    assert Publisher(look).wait(0, 0.0) is None


def test_what_happens_can_be_shown_at_once() -> None:
    with Publisher(look, period_s=60.0) as publisher:
        publisher.refresh()
        first = publisher.latest
        assert first is not None
        assert first.number == 1


def full(text: str = "left aileron") -> Snapshot:
    values = (1.0, None, 3.0)
    return Snapshot(
        number=7,
        time="2026-03-01T12:00:00.000Z",
        command="bit",
        actuator=text,
        serial=12,
        bus=BusState(name=text, state="open", frames=4000, rate_per_s=2070.0, load=0.23, lost=1),
        test=RunningTest(name=text, number=1, phase="running", elapsed_s=2.0, duration_s=5.5),
        mode="position",
        signals=Signals(
            time_s=(0.0, 0.05, 0.1),
            command_mA=(None, None, None),
            command_mm=values,
            current_mA=values,
            spool_mm=values,
            pressure_MPa=values,
            position_mm=values,
        ),
        residuals=Residuals(spool=0.1, pressure=None, spool_above=0.5),
        alarms=(Alarm(time="2026-03-01T12:00:00.000Z", signal="spool", side="above"),),
        alarm_count=1,
        severities=(Severity(name="FSS", estimate=0.3, std=0.01, source=text),),
        ending=Ending(verdict="HEALTHY", reasons=(text,)),
        notes=(text,),
    )


def test_a_snapshot_survives_json() -> None:
    assert Snapshot.from_json(full().to_json()) == full()


@given(st.text(max_size=40))
def test_whatever_a_name_holds_the_json_is_one_line_fit_for_a_terminal(text: str) -> None:
    line = full(text).to_json().decode()
    assert line.isprintable()
    tree = json.loads(line)
    assert tree == full(text).to_dict()
    assert all(item.isprintable() for item in tree["notes"])


def test_a_name_of_bytes_that_are_no_utf_8_can_be_sent() -> None:
    assert full("left\udcff").to_dict()["actuator"] == "left\\xff"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, None])
def test_what_is_no_number_is_not_known(value: float | None) -> None:
    assert finite(value) is None


@pytest.mark.parametrize("line", [b"", b"[]", b'{"number": 1}', b"\xff"])
def test_what_is_no_snapshot_is_refused(line: bytes) -> None:
    with pytest.raises(ValueError, match="no snapshot"):
        Snapshot.from_json(line)


NAN = float("nan")


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(live, "time", clock)
    return clock


def test_rate_and_load_are_those_of_the_time_since_they_were_asked_for(clock: Clock) -> None:
    counted = BusTraffic(bitrate=1e6)
    assert counted.measure() == (None, None, False)
    for _ in range(2000):
        counted.take(8)
    clock.now += 1.0
    rate, load, silent = counted.measure()
    assert (rate, load, silent) == (pytest.approx(2000.0), pytest.approx(0.222), False)
    clock.now += 0.1
    assert counted.measure()[0] == rate
    clock.now += 1.9
    assert counted.measure() == (0.0, 0.0, True)


def test_no_load_is_told_of_a_bus_whose_bit_rate_nobody_knows(clock: Clock) -> None:
    counted = BusTraffic()
    counted.take(8, extended=True)
    clock.now += 1.0
    assert counted.measure() == (pytest.approx(1.0), None, False)


def test_a_trace_thins_out_and_keeps_ten_seconds() -> None:
    trace = SignalTrace()
    for tick in range(20_000):
        mode = CommandMode.POSITION if tick < 15_000 else CommandMode.CURRENT
        spool = NAN if tick >= 19_900 else 1e-4
        trace.take(tick / 1e3, mode, 2e-3, (1e-3, spool, 2e6, -3e-3))
    seen = trace.signals()
    assert 390 <= len(seen.time_s) <= 401
    assert seen.time_s[-1] - seen.time_s[0] == pytest.approx(10.0, abs=0.6)
    assert (seen.command_mm[0], seen.command_mA[0]) == (pytest.approx(2.0), None)
    assert (seen.command_mm[-1], seen.command_mA[-1]) == (None, pytest.approx(2.0))
    assert seen.spool_mm[-1] is None
    assert seen.spool_mm[0] == pytest.approx(0.1)
    assert seen.current_mA[0] == pytest.approx(1.0)
    assert seen.pressure_MPa[0] == pytest.approx(2.0)
    assert seen.position_mm[0] == pytest.approx(-3.0)


def test_a_fast_sine_shows_its_extremes_and_the_newest_value() -> None:
    trace = SignalTrace()
    for tick in range(2000):
        at = tick / 1e3
        current = 8e-3 * math.sin(2 * math.pi * 40.0 * at)
        trace.take(at, CommandMode.CURRENT, 0.0, (current, 0.0, 0.0, 1e-3 * at))
    seen = trace.signals()
    shown = [value for value in seen.current_mA[:-1] if value is not None]
    for place in range(0, len(shown), 2):
        assert sorted(shown[place : place + 2]) == pytest.approx([-8.0, 8.0], rel=0.02)
    assert seen.position_mm[-1] == pytest.approx(1.999)
    assert list(seen.time_s) == sorted(seen.time_s)
