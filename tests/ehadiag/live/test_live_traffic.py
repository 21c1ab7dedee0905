import pytest

from ehadiag.core.recording import CommandMode
from ehadiag.live import traffic
from ehadiag.live.trace import Trace
from ehadiag.live.traffic import Traffic

NAN = float("nan")


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(traffic, "time", clock)
    return clock


def test_rate_and_load_are_those_of_the_time_since_they_were_asked_for(clock: Clock) -> None:
    counted = Traffic(bitrate=1e6)
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
    counted = Traffic()
    counted.take(8, extended=True)
    clock.now += 1.0
    assert counted.measure() == (pytest.approx(1.0), None, False)


def test_a_trace_thins_out_and_keeps_ten_seconds() -> None:
    trace = Trace()
    for tick in range(20_000):
        mode = CommandMode.POSITION if tick < 15_000 else CommandMode.CURRENT
        spool = NAN if tick >= 19_900 else 1e-4
        trace.take(tick / 1e3, mode, 2e-3, (1e-3, spool, 2e6, -3e-3))
    seen = trace.signals()
    assert 190 <= len(seen.time_s) <= 200
    assert seen.time_s[-1] - seen.time_s[0] == pytest.approx(10.0, abs=0.6)
    assert (seen.command_mm[0], seen.command_mA[0]) == (pytest.approx(2.0), None)
    assert (seen.command_mm[-1], seen.command_mA[-1]) == (None, pytest.approx(2.0))
    assert seen.spool_mm[-1] is None
    assert seen.spool_mm[0] == pytest.approx(0.1)
    assert seen.current_mA[0] == pytest.approx(1.0)
    assert seen.pressure_MPa[0] == pytest.approx(2.0)
    assert seen.position_mm[0] == pytest.approx(-3.0)
