"""Check sums against another implementation, counters against a known sequence.

Counters that stand still, and runs of frames that arrive much too late. Counter steps at their
exact limits, and steps of the host clock.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from crc import Calculator, Configuration
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface import protection
from firmware_iface.alignment.ticks import _counted_axis, _own_ticks, _standing
from firmware_iface.protection import COUNTERS, NO_POSITION, crc8, crc8_rows, unwrap

ORACLE = Calculator(Configuration(width=8, polynomial=0x1D, init_value=0xFF, final_xor_value=0xFF))
TICK = 1_000_000


def test_crc8_check_value():
    assert crc8(b"123456789") == 0x4B


@given(st.binary(max_size=66))
def test_crc8_agrees_with_another_implementation(data):
    assert crc8(data) == ORACLE.checksum(data)


@given(
    st.integers(0, 0x1FFFFFFF),
    st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=5),
    st.integers(1, 8).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1))),
)
def test_rows_cover_identifier_and_payload_but_not_the_check_sum(can_id, rows, shape):
    length, at = shape
    data = np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(-1, 8)
    expected = [
        ORACLE.checksum(
            bytes((can_id & 0xFF, can_id >> 8 & 0xFF)) + row[:at] + row[at + 1 : length]
        )
        for row in rows
    ]
    assert crc8_rows(can_id, data, at, length).tolist() == expected


def test_rows_of_the_reference_bus():
    data = np.frombuffer(bytes.fromhex("0008800108800dcd02010000010000d4"), np.uint8)
    assert crc8_rows(0x110, data[:8].reshape(1, 8), 7, 8)[0] == 0xCD
    assert crc8_rows(0x201, data[8:].reshape(1, 8), 7, 8)[0] == 0xD4


def test_no_rows():
    assert len(crc8_rows(0x110, np.empty((0, 8), np.uint8), 7, 8)) == 0
    position, notes = unwrap(np.empty(0, np.int64), np.empty(0, np.int64), TICK)
    assert len(position) == 0
    assert notes == ()


def follow(position, time=None, modulus=256, period=TICK):
    position = np.asarray(position, dtype=np.int64)
    time = position * period if time is None else np.asarray(time, dtype=np.int64)
    got, notes = unwrap(position % modulus, time, period, modulus)
    return (got - got[0] + position[0]).tolist(), notes


def test_the_first_position_is_the_counter():
    got, _ = unwrap(np.array([250, 251, 0]), np.array([0, 1, 6]) * TICK, TICK)
    assert got.tolist() == [250, 251, 256]


def test_wrap_around():
    position = list(range(240, 300))
    assert follow(position) == (position, ())


@pytest.mark.parametrize("gap", [1, 2, 15, 16, 17, 127, 128, 129, 255, 256, 257, 512, 5000, 65536])
@pytest.mark.parametrize("late", [-2_000_000, 0, 2_000_000])
def test_gap_with_jitter(gap, late):
    position = [*range(30), *range(30 + gap, 60 + gap)]
    time = np.array(position) * TICK
    time[30] += late
    got, notes = follow(position, time)
    assert got == position
    assert notes == ()


def test_repeat_and_exact_turn_differ_by_time_alone():
    counter = np.array([7, 7, 8], dtype=np.int64)
    assert unwrap(counter, np.array([0, 0, 1]) * TICK, TICK)[0].tolist() == [7, 7, 8]
    assert unwrap(counter, np.array([0, 256, 257]) * TICK, TICK)[0].tolist() == [7, 263, 264]


@given(st.integers(0, 255), st.integers(0, 2**32), st.lists(st.integers(1, 900), min_size=2))
def test_any_gaps_on_a_true_clock(start, epoch, steps):
    position = start + np.concatenate(([0], np.cumsum(steps)))
    assert follow(position, position * TICK + epoch)[0] == position.tolist()


@given(st.data())
def test_late_stamps_never_move_a_complete_sequence(data):
    """Every frame arrives, in order, and up to a second late."""
    count = data.draw(st.integers(2, 1500))
    position = np.arange(count)
    stalls = data.draw(
        st.lists(st.tuples(st.integers(0, count - 1), st.integers(1, 1000)), max_size=3)
    )
    time = position * TICK
    for at, length in stalls:
        if at + length > count - 5:
            continue  # only what follows tells a stall from a gap
        time[at:] = np.maximum(time[at:], (at + length) * TICK)
    assert follow(position, time)[0] == position.tolist()


@pytest.mark.parametrize("modulus", [4, 16, 256, 65536])
def test_other_counter_widths(modulus):
    position = [*range(20), *range(21, 60), *range(61, 200)]
    assert follow(position, modulus=modulus)[0] == position


@pytest.mark.parametrize("step", [-50_000, -300, 700, 20_050])
def test_clock_step_is_noted_once_and_moves_nothing(step):
    position = np.arange(1000)
    time = (position + np.where(position >= 500, step, 0)) * TICK
    got, notes = follow(position, time)
    assert got == position.tolist()
    assert len(notes) == 1
    assert f"{abs(step) * 1e-3:.3f} s" in notes[0]
    assert ("set back" in notes[0]) is (step < 0)


def test_gap_after_a_clock_step_is_measured_from_there():
    position = np.concatenate((np.arange(500), np.arange(900, 1400)))
    time = (position + np.where(position >= 300, 4000 + 64, 0)) * TICK
    assert follow(position, time)[0] == position.tolist()


def test_swapped_neighbours():
    position = [*range(250), 251, 250, *range(252, 270), 271, 270]
    time = np.sort(position) * TICK
    assert follow(position, time)[0] == position


@pytest.mark.parametrize("wrong", [17, 60, 128, 200, 239])
def test_single_corrupt_counter_is_left_out_and_moves_nothing(wrong):
    position = np.arange(600)
    counter = position % 256
    counter[300] = (counter[300] + wrong) % 256
    got, notes = unwrap(counter, position * TICK, TICK)
    assert got[300] == NO_POSITION
    assert np.delete(got, 300).tolist() == np.delete(position, 300).tolist()
    assert notes == ("1 frames with a counter out of line",)


@pytest.mark.parametrize("restart", [0, 17, 40, 100, 200, 255])
def test_counter_that_starts_again_goes_on(restart):
    """Positions after a restart never fall back among those before it."""
    counter = np.concatenate((np.arange(300) % 256, (restart + np.arange(300)) % 256))
    got, _ = unwrap(counter, np.arange(600) * TICK, TICK)
    assert np.diff(got).min() == 1 or restart in range(28, 44)
    assert (got % 256 == counter).all()
    assert got[300] >= got[299] - 16


def test_frames_that_change_places_across_a_gap():
    """Stamps that go back with the counter tell disorder from a restart."""
    position = np.concatenate((np.arange(300), [500], [300], np.arange(501, 800)))
    assert follow(position, position * TICK)[0] == position.tolist()


MS = 1_000_000


def item(time_ms: list[float], counter: list[int], stream: list[int] | None = None) -> Any:
    """What placing reads of a decoded message; its rows are its milliseconds."""
    return SimpleNamespace(
        row=np.rint(np.array(time_ms) * 10).astype(np.int64),
        time_ns=np.rint(np.array(time_ms) * MS).astype(np.int64),
        counter=np.array(counter),
        message=SimpleNamespace(name="M"),
        modulus=256,
        stream=np.array(stream or [0] * len(time_ms)),
    )


@pytest.mark.parametrize(
    ("wait_ms", "counter", "standing"),
    [
        (1.0, 7, True),
        (0.4, 7, False),  # a repeat
        (0.5, 7, False),
        (128.0, 7, False),
        (1.0, 8, False),
        (127.0, 7, True),
        (256.0, 7, False),  # a whole turn was lost
    ],
)
def test_a_counter_stands_when_time_moves_and_it_does_not(
    wait_ms: float, counter: int, standing: bool
) -> None:
    assert _standing(item([0.0, wait_ms], [7, counter]), MS).tolist() == [False, standing]


def test_multiplexed_frames_may_share_a_counter() -> None:
    frames = item([0.0, 0.6, 1.0, 1.6, 2.0, 2.6], [5, 5, 6, 6, 6, 7], [0, 1, 0, 1, 0, 1])
    assert _standing(frames, MS).tolist() == [False, False, False, False, True, False]


def test_a_stuck_counter_places_no_sample_even_when_it_looks_right() -> None:
    count = 700
    telemetry = item([k + 0.5 for k in range(count)], [min(k, 100) for k in range(count)])
    command = item([float(k) for k in range(count)], [k % 256 for k in range(count)])
    axis = _counted_axis({"telemetry": telemetry, "command": command}, MS)
    assert axis.ticks["command"].tolist() == list(range(count))
    assert axis.ticks["telemetry"].tolist() == [*range(101)] + [NO_POSITION] * (count - 101)


def test_a_message_with_a_counter_of_its_own_is_treated_alike() -> None:
    ticks, every, _ = _own_ticks(item([float(k) for k in range(60)], [*range(40), *[39] * 20]), MS)
    assert every == 1
    assert ticks.tolist() == [*range(40)] + [NO_POSITION] * 20


@pytest.mark.parametrize("run", [2, 3, COUNTERS.stray_run])
def test_a_short_run_that_comes_much_too_late_has_no_position(run: int) -> None:
    counter = np.arange(300) % 256
    late = slice(150, 150 + run)
    order = np.concatenate([np.r_[0:150], np.r_[150 + run : 200], np.r_[late], np.r_[200:300]])
    position, notes = unwrap(counter[order], np.arange(300) * MS, MS)
    expected = np.where((order >= 150) & (order < 150 + run), NO_POSITION, order)
    assert position.tolist() == expected.tolist()
    assert notes == (f"{run} frames with a counter out of line",)


def test_a_counter_that_starts_again_goes_on() -> None:
    counter = np.concatenate([np.arange(200), np.arange(100)])
    position, _ = unwrap(counter, np.arange(300) * MS, MS)
    assert (np.diff(position) > 0).all()
    assert (position != NO_POSITION).all()


def test_noise_ends() -> None:
    rng = np.random.default_rng(1)
    counter = rng.integers(0, 256, 20_000)
    position, _ = unwrap(counter, np.arange(20_000) * MS, MS)
    placed = position != NO_POSITION
    assert ((position[placed] - counter[placed]) % 256 == 0).all()


@pytest.mark.parametrize(
    ("counter", "ticks", "modulus", "jump", "trusted"),
    [
        ([10, 11], 1, 256, 1, False),
        ([10, 4], 250, 256, 250, False),  # time agrees: nearly a turn was lost
        ([10, 4], 300, 256, -6, True),  # it does not: a frame that comes late
        ([10, 10 - COUNTERS.trusted_step + 256], 300, 256, -COUNTERS.trusted_step, True),
        ([10, 10 - COUNTERS.trusted_step + 255], 300, 256, 255 - COUNTERS.trusted_step, False),
        ([10, 10 + COUNTERS.trusted_step], 60, 256, COUNTERS.trusted_step, True),
        ([10, 11 + COUNTERS.trusted_step], 60, 256, COUNTERS.trusted_step + 1, False),
        ([3, 15], 27, 32, 12, True),
        ([0, 6], 10_000, 256, 9_990, False),
        ([0, 6], 10_001, 256, 6, True),
    ],
)
def test_a_step_follows_time_unless_the_counter_is_near(
    counter: list[int], ticks: int, modulus: int, jump: int, trusted: bool
) -> None:
    """10 000 ticks may be off by the slack and two more."""
    assert COUNTERS.clock_slack + COUNTERS.clock_drift * 10_000 == 10.0
    got = protection._counter_steps(
        np.array(counter) % modulus, np.array([7, 7 + ticks]) * MS, MS, modulus
    )
    assert got[0].tolist() == [jump]
    assert got[1].tolist() == [ticks - jump]
    assert got[2].tolist() == [ticks]
    assert got[3].tolist() == [trusted]


def clock(size: float, following: list[float]) -> tuple[list[float], tuple[str, ...]]:
    """A strange step of the host's time, and the time of the steps of one count that follow."""
    ticks = np.array([1.0, size + 1.0, *following])
    jump = np.ones(len(ticks), dtype=np.int64)
    rebase, notes = protection._clock_steps(np.array([1]), ticks, jump, ticks - jump, 2 * MS)
    assert np.delete(rebase, 1).tolist() == [0.0] * (len(ticks) - 1)
    return [float(rebase[1])], notes


AHEAD = "time stamps run {} s ahead of the counters: the computer paused, or the host clock was set"
STEPPED = (AHEAD.format("0.058"),)


@pytest.mark.parametrize(
    ("size", "following", "step", "notes"),
    [
        (29.0, [1.0] * 30, 29.0, STEPPED),
        (29.0, [0.1] * 30, 0.0, ()),  # a burst: the receiver had stalled
        (29.0, [0.49] * 20 + [50.0] * 5, 0.0, ()),  # twenty frames tell
        (29.0, [0.1] * 19 + [50.0] * 5, 29.0, STEPPED),
        (29.0, [0.5] * 30, 29.0, STEPPED),
        (29.0, [], 0.0, ()),
        (29.0, [0.4], 0.0, ()),
        (29.0, [0.6], 29.0, STEPPED),
        (-29.0, [0.1] * 30, -29.0, ("host clock was set back by 0.058 s",)),
        (2 * COUNTERS.clock_slack, [1.0] * 30, 16.0, (AHEAD.format("0.032"),)),
        (2 * COUNTERS.clock_slack - 0.5, [1.0] * 30, 0.0, ()),
        (-2 * COUNTERS.clock_slack + 0.5, [1.0] * 30, 0.0, ()),
    ],
)
def test_a_clock_step_is_told_from_a_stall_by_what_follows(
    size: float, following: list[float], step: float, notes: tuple[str, ...]
) -> None:
    assert clock(size, following) == ([step], notes)


def test_frames_lost_in_a_stall_are_no_step_of_the_clock() -> None:
    """Late by 30 ticks, then 30 frames are missing: the next comes in time."""
    ticks, jump = np.array([1.0, 2.0, *[1.0] * 25]), np.array([1, 31, *[1] * 25])
    rebase, notes = protection._clock_steps(np.array([1]), ticks, jump, ticks - jump, MS)
    assert rebase[1] == -29.0
    assert notes == ()


def test_three_clock_steps_are_noted_and_all_are_taken_out() -> None:
    ticks = np.tile([1.0, 31.0, 1.0], 5)
    jump = np.ones(15, dtype=np.int64)
    places = np.arange(1, 15, 3)
    rebase, notes = protection._clock_steps(places, ticks, jump, ticks - jump, MS)
    assert rebase.tolist() == [0.0, 30.0, 0.0] * 5
    assert notes == (AHEAD.format("0.030"),) * 3


def test_a_stall_does_not_end_the_search_for_clock_steps() -> None:
    ticks = np.array([31.0, *[0.1] * 25, *[1.0] * 30, 31.0, *[1.0] * 25])
    jump = np.ones(len(ticks), dtype=np.int64)
    rebase, notes = protection._clock_steps(np.array([0, 56]), ticks, jump, ticks - jump, MS)
    assert np.flatnonzero(rebase).tolist() == [56]
    assert notes == (AHEAD.format("0.030"),)


def test_check_sums_are_bytes_even_of_nothing() -> None:
    sums = crc8_rows(0x110, np.zeros((3, 8), dtype=np.uint8), 0, 1)
    assert sums.dtype == np.uint8
    assert len(set(sums.tolist())) == 1


@pytest.mark.parametrize(("back", "single"), [(157, True), (172, True), (173, False), (140, True)])
def test_a_frame_out_of_line_may_be_followed_by_a_gap(back: int, single: bool) -> None:
    """The leap back is then as long as time says: nothing is strange about it."""
    astray = protection._stray_frames(np.array([100, back]), np.array([-99.0, 0.0]), 256)
    assert astray.tolist() == [False, single, False]
    later = protection._stray_frames(np.array([1, 100, back]), np.array([0.0, -99.0, 0.0]), 256)
    assert later.tolist() == [False, False, single, False]


def marked(jump: list[int], leaps: list[int]) -> list[int]:
    astray = np.zeros(len(jump) + 1, dtype=np.bool_)
    protection._mark_runs(astray, np.array(jump), np.array(leaps), 256)
    return np.flatnonzero(astray).tolist()


@pytest.mark.parametrize(
    ("back", "frames"),
    [
        (-101, [2, 3, 4]),
        (156, [2, 3, 4]),
        (COUNTERS.trusted_step - 102, [2, 3, 4]),
        (COUNTERS.trusted_step - 101, []),
        (-COUNTERS.trusted_step - 102, [2, 3, 4]),
        (-COUNTERS.trusted_step - 103, []),
    ],
)
def test_a_run_ends_where_the_counter_leaps_back(back: int, frames: list[int]) -> None:
    assert marked([1, 100, 1, 1, back, 1], [1, 4]) == frames


@pytest.mark.parametrize(
    ("length", "found"), [(1, True), (COUNTERS.stray_run, True), (COUNTERS.stray_run + 1, False)]
)
def test_a_run_is_short(length: int, found: bool) -> None:
    jump = [1, 100, *[1] * (length - 1), -99, 1]
    assert marked(jump, [1, 1 + length]) == (list(range(2, 2 + length)) if found else [])


def test_a_leap_back_is_not_a_leap_into_another_run() -> None:
    assert marked([1, 100, 1, 1, -99, 1, 100, 1], [1, 4, 6]) == [2, 3, 4]
    far = [1] * 30
    far[0], far[20], far[23], far[25] = 90, 100, -99, 100
    assert marked(far, [0, 20, 23, 25]) == [21, 22, 23]
    far[23] = 70
    assert marked(far, [0, 20, 23]) == []


def test_the_search_for_frames_out_of_line_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def never_content(jump: np.ndarray, *_: object) -> np.ndarray:
        searched.append(len(jump) + 1)
        return np.arange(len(jump) + 1) == len(jump)

    monkeypatch.setattr(protection, "_stray_frames", never_content)
    position, notes = protection.unwrap(np.arange(200), np.arange(200) * MS, MS)
    assert searched == list(range(200, 199 - COUNTERS.stray_rounds, -1))
    assert position.tolist() == [
        *range(200 - COUNTERS.stray_rounds),
        *[NO_POSITION] * COUNTERS.stray_rounds,
    ]
    assert notes == (f"{COUNTERS.stray_rounds} frames with a counter out of line",)


def test_no_frames_have_whole_numbers_as_positions() -> None:
    nothing = np.empty(0, dtype=np.int64)
    assert protection.unwrap(nothing, nothing, MS)[0].dtype == np.int64


def test_frames_lost_in_a_stall_show_when_the_burst_is_over() -> None:
    """The gap lies within the burst, where time says nothing; what follows is a turn late."""
    position = np.array([*range(350), *range(650, 1000)])
    time = np.where((position >= 150) & (position < 700), 700, position)
    assert protection.unwrap(position % 256, time * MS, MS)[0].tolist() == position.tolist()


@pytest.mark.parametrize(
    ("leap", "goes_on"),
    [
        (100, 100),
        (-COUNTERS.trusted_step - 1, -COUNTERS.trusted_step - 1),
        (-COUNTERS.trusted_step - 2, 254 - COUNTERS.trusted_step),
        (-100, 156),
    ],
)
def test_a_counter_that_starts_anew_never_falls_back_by_more_than_disorder(
    leap: int, goes_on: int
) -> None:
    count = np.arange(120)
    counter = (300 + count + np.where(count >= 60, leap, 0)) % 256
    got, _ = protection.unwrap(counter, count * MS, MS)
    assert (got - got[0]).tolist() == (count + np.where(count >= 60, goes_on, 0)).tolist()
