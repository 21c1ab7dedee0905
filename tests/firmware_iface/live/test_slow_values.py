"""A second sender of oil and supply, with counters of its own: named, in a recording and live."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bus_synth import ENVIRONMENT, START, TICK, make_truth, one, play
from msgspec.structs import replace
from numpy.typing import NDArray
from test_live_session_limits import outcome_of

import ehadiag
from ehadiag import default_actuator
from ehadiag.session.alarm_outlets import AlarmLog
from ehadiag.session.bus_monitor import BusMonitor
from ehadiag.session.monitor_session import AlarmOutlets
from ehadiag.session.unit_state import new_unit_state
from firmware_iface.bus_map import BusMap, default_map
from firmware_iface.codec import Encoder
from firmware_iface.logs.recorder import ReplayTransport
from firmware_iface.recording import Environment
from firmware_iface.slow_values import SlowValueWatch, spread_conflict
from firmware_iface.transport.frames import ColumnBuilder, Frame

BUS = default_map()
TEST_TICKS = 5500
SENDER = "a second sender of Environment (0x120)"


def unguarded(*, counter: bool, cycle: bool) -> BusMap:
    """The default bus with less that guards its environment."""
    message = BUS.messages["Environment"]
    message = replace(
        message,
        counter=message.counter if counter else None,
        cycle_ns=message.cycle_ns if cycle else 0,
    )
    return replace(BUS, messages={**BUS.messages, "Environment": message})


def second(times_ms: Iterable[float], first: int, degc: float, supply: float) -> list[Frame]:
    """Frames of another sender, whose counter begins anywhere."""
    other = Encoder(BUS)
    other._counters["Environment"] = first
    return [
        frame
        for at in times_ms
        for frame in other.environment(supply, 0.7e6, degc, START + round(at * TICK) + 30_000)
    ]


@cache
def ours() -> tuple[Frame, ...]:
    return tuple(play(Encoder(BUS), make_truth(TEST_TICKS)))


def mixed(theirs: list[Frame]) -> list[Frame]:
    return sorted([*ours(), *theirs], key=lambda item: item.time_ns)


ATTACKS = {
    "more than ours": (np.linspace(3.0, 5490.0, 140), 90),
    "as many as ours": (np.arange(50.0, 5500.0, 100.0), 120),
    "fewer than ours": (np.arange(60.0, 5500.0, 300.0), 60),
    "a burst": (np.linspace(2000.1, 2090.0, 140), 100),
    "a burst of a whole turn": (np.linspace(2000.2, 2090.0, 256), 21),
}


@pytest.mark.parametrize(
    ("attack", "degc", "supply"),
    [
        ("more than ours", 15.0, 20.7e6),
        ("more than ours", 40.0, 17.0e6),
        *((attack, 37.0, 20.0e6) for attack in ATTACKS),
    ],
)
def test_a_second_sender_is_named(attack: str, degc: float, supply: float) -> None:
    theirs = second(*ATTACKS[attack], degc, supply)
    recording = one(mixed(theirs), BUS)
    assert any(SENDER in item for item in recording.quality.refused), recording.quality.refused


@pytest.mark.parametrize(
    ("attack", "counter", "cycle"),
    [
        ("more than ours", True, True),
        ("more than ours", True, False),
        ("more than ours", False, True),
        *((attack, False, False) for attack in ("more than ours", "as many as ours", "a burst")),
    ],
)
def test_values_apart_name_it_on_a_bus_that_says_less(
    attack: str, counter: bool, cycle: bool
) -> None:
    theirs = second(*ATTACKS[attack], 15.0, 20.7e6)
    recording = one(mixed(theirs), unguarded(counter=counter, cycle=cycle))
    assert any(SENDER in item for item in recording.quality.refused), recording.quality.refused


def damaged(frames: list[Frame], how: str) -> list[Frame]:
    """What happens to a single sender's frames."""
    of_environment = [item for item in frames if item.can_id == ENVIRONMENT]
    if how == "doubled":
        return [item for frame in frames for item in (frame, frame)]
    if how == "lost":
        gone = of_environment[10:40]
        return [frame for frame in frames if frame not in gone]
    if how == "late":
        stamp = of_environment[40].time_ns
        return [
            replace(item, time_ns=max(item.time_ns, stamp)) if item in of_environment else item
            for item in frames
        ]
    return frames


@pytest.mark.parametrize("how", ["untouched", "doubled", "lost", "late"])
@pytest.mark.parametrize("counter", [False, True])
def test_one_sender_is_none(how: str, counter: bool) -> None:
    bus = unguarded(counter=counter, cycle=True)
    recording = one(damaged(mixed([]), how), bus)
    assert recording.quality.refused == ()
    assert recording.environment.oil_temperature == pytest.approx(40.0)


def test_noise_of_a_probe_is_no_second_sender() -> None:
    rng = np.random.default_rng(5)
    ours = [item for item in mixed([]) if item.can_id != ENVIRONMENT]
    encoder = Encoder(BUS)
    for at in range(0, TEST_TICKS, 100):
        values = 20.7e6 + 2e5 * rng.normal(), 0.7e6, 40.0 + 0.3 * rng.normal()
        ours += encoder.environment(*values, START + at * TICK)
    recording = one(sorted(ours, key=lambda item: item.time_ns), BUS)
    assert recording.quality.refused == ()


def beside_ours(frame: Frame) -> Iterator[Frame]:
    """Two and a half frames of the environment to each of the computer's."""
    if frame.can_id == ENVIRONMENT:
        for index in range(2 + frame.data[6] % 2):
            later = frame.time_ns + 200_000 * (index + 1)
            count = (3 * frame.data[6] + index + 90) % 256
            yield Encoder(BUS)._send(
                "environment",
                {
                    "environment.supply_pressure": 20.7e6,
                    "environment.return_pressure": 0.7e6,
                    "environment.oil_temperature": 37.0,
                },
                later,
                count,
            )[0]


def test_live_it_ends_the_test(make_core) -> None:
    outcome = outcome_of(make_core, beside_ours)
    assert not outcome.complete
    assert SENDER in outcome.why
    assert outcome.abort_confirmed


def test_a_monitor_believes_neither() -> None:
    unit = default_actuator()
    monitor = BusMonitor(unit, BUS, new_unit_state(unit), (), 100.0, lambda _: None)
    ours = [item for item in mixed([]) if item.can_id == ENVIRONMENT]
    theirs = second(np.arange(3050.0, 5400.0, 25.0), 90, 15.0, 20.7e6)
    for frame in sorted([*ours, *theirs], key=lambda item: item.time_ns):
        monitor.take(frame)
    assert monitor.conflicts > 50
    assert monitor._environment_values == {}


def test_a_monitor_says_what_it_did_not_believe(tmp_path: Path) -> None:
    collected, snapshots = ColumnBuilder(), []
    for frame in mixed(second(np.arange(50.0, 5400.0, 25.0), 90, 15.0, 20.7e6)):
        collected.add_frame(frame)
    found = ehadiag.watch(
        ReplayTransport(collected.table(), "mixed"),
        outlets=AlarmOutlets(AlarmLog(tmp_path / "a.jsonl")),
        snapshots=snapshots.append,
    )
    assert 0.5 < found.environment_left_out < 1.0
    end = json.loads((tmp_path / "a.jsonl").read_text().splitlines()[-1])
    assert end["environment_left_out"] / end["environment_messages"] == found.environment_left_out
    said = f"{found.environment_left_out:.0%} of the messages with oil and supply left out"
    assert any(said in reason for reason in snapshots[-1].ending.reasons)


@pytest.mark.parametrize(
    ("supply", "degc", "kept"),
    [
        (0.0, 60.0, Environment(20.7e6, 0.7e6, 60.0)),
        (2e9, 60.0, Environment(20.7e6, 0.7e6, 60.0)),
        (math.nan, 60.0, Environment(20.7e6, 0.7e6, 60.0)),
        (19e6, -300.0, Environment(19e6, 0.7e6, 40.0)),
        (19e6, 5000.0, Environment(19e6, 0.7e6, 40.0)),
    ],
)
def test_a_monitor_keeps_the_last_values_in_range(
    supply: float, degc: float, kept: Environment
) -> None:
    unit = default_actuator()
    monitor = BusMonitor(unit, BUS, new_unit_state(unit), (), 100.0, lambda _: None)
    for environment in (Environment(20.7e6, 0.7e6, 40.0), Environment(supply, 0.7e6, degc)):
        monitor.take_decoded(environment, 0)
        for tick in range(1500):
            monitor.take_decoded((0.0, 0.0, 0.0, 0.0, 0.0), tick * TICK)
    assert monitor.environment == kept
    assert (monitor.environment_count, monitor.environment_left_out, monitor.conflicts) == (2, 1, 0)


def test_a_monitor_outlives_the_hydraulics() -> None:
    unit, encoder = default_actuator(), Encoder(BUS)
    monitor = BusMonitor(unit, BUS, new_unit_state(unit), (), 100.0, lambda _: None)
    others = [item for item in mixed([]) if item.can_id != ENVIRONMENT]
    for at in range(0, TEST_TICKS, 100):
        supply = 20.7e6 if at < 3000 else 0.0
        others += encoder.environment(supply, 0.7e6, 40.0, START + at * TICK)
    for frame in sorted(others, key=lambda item: item.time_ns):
        monitor.take(frame)
    assert monitor.environment.supply_pressure == pytest.approx(20.7e6, rel=1e-3)
    assert (monitor.environment_left_out, monitor.conflicts) == (25, 0)


@pytest.mark.parametrize(("paged", "found"), [(True, False), (False, True)])
def test_the_counter_of_a_slow_page_goes_on_with_the_fast_ones(paged: bool, found: bool) -> None:
    """As in `alignment.frame_faults.slow_values`: a page of 10 Hz beside one of 1 kHz."""
    roles = BUS.messages["Environment"].roles + BUS.messages["ServoTelemetry"].roles
    watch = SlowValueWatch(replace(BUS.messages["Environment"], roles=roles))
    why = ""
    for number in range(60):
        at = number * 100_000_000
        slow = bytes((number % 256, 0, 1))
        values = {"environment.oil_temperature": 40.0}
        why = why or watch.take(at, number * 101 % 256, slow, values)
        for tick in range(2 if paged else 0):
            fast = bytes((number % 256, tick, 0))
            why = why or watch.take(at + tick, tick, fast, {"channels.spool": 0.0})
    assert bool(why) is found


OIL = "environment.oil_temperature"
SUPPLY = "environment.supply_pressure"


def told_conflicts(rows: list[tuple[float, float]], cycle_ms: float = 100.0) -> int:
    """Frames with oil (degC) and supply (Pa) in which two senders are seen."""
    watch = SlowValueWatch(BUS.messages["Environment"])
    return sum(
        watch.take(
            round(number * cycle_ms * 1e6),
            number % 256,
            number.to_bytes(4, "little"),
            {OIL: degc, SUPPLY: supply},
        )
        != ""
        for number, (degc, supply) in enumerate(rows)
    )


def noise(rng: np.random.Generator, how: str, count: int) -> NDArray[np.float64]:
    """Noise of a told oil temperature, K."""
    if how == "normal":
        return rng.normal(0.0, 1.5, count)
    return rng.uniform(-3.0, 3.0, count) + rng.normal(0.0, 0.5, count)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("how", ["uniform", "normal"])
@pytest.mark.parametrize("path", ["80 degC", "-20 to 80 degC in 140 s", "a step of 20 K"])
def test_noise_about_one_value_that_moves_is_no_second_sender(
    seed: int, how: str, path: str
) -> None:
    rng, count = np.random.default_rng(seed), 400
    level = {
        "80 degC": np.full(count, 80.0),
        "-20 to 80 degC in 140 s": -20.0 + np.arange(count) * 0.1 * 100.0 / 140.0,
        "a step of 20 K": np.where(np.arange(count) < 200, 40.0, 60.0),
    }[path]
    supply = 20.7e6 - 4e6 * (np.arange(count) > 250) + rng.uniform(-0.3e6, 0.3e6, count)
    oil = level + noise(rng, how, count)
    assert told_conflicts(list(zip(oil.tolist(), supply.tolist(), strict=True))) == 0


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("how", ["uniform", "normal"])
@pytest.mark.parametrize(("other", "drift"), [(8.0, 0.0), (-25.0, 0.0), (25.0, 0.7)])
@pytest.mark.parametrize("share", [0.5, 0.25])
def test_two_senders_farther_apart_than_their_noise_are_seen(
    seed: int, how: str, other: float, drift: float, share: float
) -> None:
    rng, count = np.random.default_rng(seed), 400
    theirs = rng.permutation(np.arange(count) < share * count)
    oil = 40.0 + drift * 0.1 * np.arange(count) + other * theirs + noise(rng, how, count)
    conflicts = told_conflicts([(value, 20.7e6) for value in oil.tolist()])
    assert conflicts > (0.5 if share == 0.5 else 0.3) * count


@pytest.mark.parametrize("seed", range(2))
def test_two_senders_within_their_noise_say_nothing(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 400
    oil = 40.0 + 3.0 * (np.arange(count) % 2) + noise(rng, "normal", count)
    assert told_conflicts([(value, 20.7e6) for value in oil.tolist()]) == 0


@pytest.mark.parametrize(("moved", "refused"), [(3.0, False), (12.0, True)])
def test_a_value_that_moves_within_a_test_is_refused(moved: float, refused: bool) -> None:
    """One value stands for the whole test."""
    rng = np.random.default_rng(4)
    for shape in (np.linspace(0.0, moved, 55), moved * (np.arange(55) > 30)):
        found = spread_conflict(OIL, 40.0 + shape + rng.normal(0.0, 0.5, 55))
        assert bool(found) is refused
