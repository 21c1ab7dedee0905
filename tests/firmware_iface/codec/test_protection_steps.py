"""Counter steps at their exact limits, and steps of the host clock."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface.codec import protection
from firmware_iface.codec.protection import (
    LONGEST_RUN,
    MOST_ROUNDS,
    NEAR,
    OUTSIDE,
    SLACK_RATE,
    SLACK_TICKS,
    crc8_rows,
)

MS = 1_000_000


@pytest.mark.parametrize(
    ("counter", "ticks", "modulus", "jump", "trusted"),
    [
        ([10, 11], 1, 256, 1, False),
        ([10, 4], 250, 256, 250, False),  # time agrees: nearly a turn was lost
        ([10, 4], 300, 256, -6, True),  # it does not: a frame that comes late
        ([10, 10 - NEAR + 256], 300, 256, -NEAR, True),
        ([10, 10 - NEAR + 255], 300, 256, 255 - NEAR, False),
        ([10, 10 + NEAR], 60, 256, NEAR, True),
        ([10, 11 + NEAR], 60, 256, NEAR + 1, False),
        ([3, 15], 27, 32, 12, True),
        ([0, 6], 10_000, 256, 9_990, False),
        ([0, 6], 10_001, 256, 6, True),
    ],
)
def test_a_step_follows_time_unless_the_counter_is_near(
    counter: list[int], ticks: int, modulus: int, jump: int, trusted: bool
) -> None:
    """10 000 ticks may be off by the slack and two more."""
    assert SLACK_TICKS + SLACK_RATE * 10_000 == 10.0
    got = protection._steps(np.array(counter) % modulus, np.array([7, 7 + ticks]) * MS, MS, modulus)
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
        (2 * SLACK_TICKS, [1.0] * 30, 16.0, (AHEAD.format("0.032"),)),
        (2 * SLACK_TICKS - 0.5, [1.0] * 30, 0.0, ()),
        (-2 * SLACK_TICKS + 0.5, [1.0] * 30, 0.0, ()),
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
    astray = protection._astray(np.array([100, back]), np.array([-99.0, 0.0]), 256)
    assert astray.tolist() == [False, single, False]
    later = protection._astray(np.array([1, 100, back]), np.array([0.0, -99.0, 0.0]), 256)
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
        (NEAR - 102, [2, 3, 4]),
        (NEAR - 101, []),
        (-NEAR - 102, [2, 3, 4]),
        (-NEAR - 103, []),
    ],
)
def test_a_run_ends_where_the_counter_leaps_back(back: int, frames: list[int]) -> None:
    assert marked([1, 100, 1, 1, back, 1], [1, 4]) == frames


@pytest.mark.parametrize(
    ("length", "found"), [(1, True), (LONGEST_RUN, True), (LONGEST_RUN + 1, False)]
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

    monkeypatch.setattr(protection, "_astray", never_content)
    position, notes = protection.unwrap(np.arange(200), np.arange(200) * MS, MS)
    assert searched == list(range(200, 199 - MOST_ROUNDS, -1))
    assert position.tolist() == [*range(200 - MOST_ROUNDS), *[OUTSIDE] * MOST_ROUNDS]
    assert notes == (f"{MOST_ROUNDS} frames with a counter out of line",)


def test_no_frames_have_whole_numbers_as_positions() -> None:
    nothing = np.empty(0, dtype=np.int64)
    assert protection.unwrap(nothing, nothing, MS)[0].dtype == np.int64


def test_frames_lost_in_a_stall_show_when_the_burst_is_over() -> None:
    """The gap lies within the burst, where time says nothing; what follows is a turn late."""
    position = np.array([*range(350), *range(650, 1000)])
    time = np.where((position >= 150) & (position < 700), 700, position)
    assert protection.unwrap(position % 256, time * MS, MS)[0].tolist() == position.tolist()


@pytest.mark.parametrize(
    ("leap", "goes_on"), [(100, 100), (-NEAR - 1, -NEAR - 1), (-NEAR - 2, 254 - NEAR), (-100, 156)]
)
def test_a_counter_that_starts_anew_never_falls_back_by_more_than_disorder(
    leap: int, goes_on: int
) -> None:
    count = np.arange(120)
    counter = (300 + count + np.where(count >= 60, leap, 0)) % 256
    got, _ = protection.unwrap(counter, count * MS, MS)
    assert (got - got[0]).tolist() == (count + np.where(count >= 60, goes_on, 0)).tolist()
