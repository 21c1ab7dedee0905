"""Kernels that place frames on ticks, one at a time, at their limits."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_iface.alignment import ticks
from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.codec import protection
from firmware_iface.codec.protection import NEAR, OUTSIDE, SLACK_TICKS

MS = 1_000_000


def item(
    time_ms: list[float], counter: list[int] | None = None, modulus: int = 256, first_row: int = 0
) -> Any:
    """What the kernels read of a decoded message."""
    return SimpleNamespace(
        row=first_row + np.arange(len(time_ms)),
        time_ns=np.rint(np.array(time_ms) * MS).astype(np.int64),
        counter=None if counter is None else np.array(counter),
        message=SimpleNamespace(name="M", modulus=modulus, cycle_ns=0),
        stream=np.zeros(len(time_ms), dtype=np.int64),
        saturated={},
        values={},
    )


def test_the_table_of_the_check_sum_is_the_polynomials() -> None:
    def divided(byte: int) -> int:
        rest = byte << 8
        for bit in range(15, 7, -1):
            if rest >> bit & 1:
                rest ^= 0x11D << (bit - 8)
        return rest

    assert protection._table() == tuple(divided(byte) for byte in range(256))
    assert protection._table() == protection.TABLE
    assert protection.TABLE_COLUMN.tolist() == list(protection.TABLE)
    assert not protection.TABLE_COLUMN.flags.writeable


@pytest.mark.parametrize(
    ("leap", "late", "single"),
    [
        (NEAR // 2 + 1, SLACK_TICKS + 1, True),
        (NEAR // 2, SLACK_TICKS + 1, False),
        (NEAR // 2 - 2, SLACK_TICKS + 1, False),
        (NEAR // 2 + 1, SLACK_TICKS, False),
        (100, SLACK_TICKS + 1, True),
    ],
)
def test_a_counter_that_leaps_and_leaps_back_is_out_of_line(
    leap: int, late: float, single: bool
) -> None:
    jump = np.array([1, leap, 2 - leap, 1])
    # A leap backwards one step smaller than its size: both must pass the limit.
    jump[2] = -leap
    residue = np.array([0.0, -late, late, 0.0])
    assert protection._astray(jump, residue, 256).tolist() == [False, False, single, False, False]
    assert protection._astray(-jump, -residue, 256).tolist() == [False, False, single, False, False]


@pytest.mark.parametrize(("back", "single"), [(-100 + NEAR, True), (-100 + NEAR + 1, False)])
def test_a_frame_is_out_of_line_only_if_its_neighbours_are_in_line(back: int, single: bool) -> None:
    jump = np.array([100, back])
    astray = protection._astray(jump, np.array([-99.0, 99.0]), 256)
    assert astray.tolist() == [False, single, False]


def test_of_two_strange_frames_in_a_row_only_the_first_is_judged() -> None:
    jump = np.array([100, -100, 100, -99])
    residue = np.array([-99.0, 99.0, -99.0, 99.0])
    assert protection._astray(jump, residue, 256).tolist() == [False, True, False, False, False]


def test_a_message_of_one_frame_stands_at_tick_zero() -> None:
    for count in (0, 1):
        alone, every, notes = ticks._own_ticks(item([5.0] * count, [9] * count), MS)
        assert alone.tolist() == [0] * count
        assert alone.dtype == np.int64
        assert (every, notes) == (1, ())


def test_two_frames_are_placed_by_their_counter() -> None:
    alone, every, notes = ticks._own_ticks(item([5.0, 8.0], [9, 10]), MS)
    assert (alone.tolist(), every, notes) == ([0, 3], 3, ())


def test_ticks_begin_at_the_first_frame_whatever_its_counter() -> None:
    alone, every, _ = ticks._own_ticks(item([0.0, 1.0, 2.0, 3.0], [254, 255, 0, 1]), MS)
    assert (alone.tolist(), every) == ([0, 1, 2, 3], 1)
    sparse, every, _ = ticks._own_ticks(item([0.0, 20.0, 40.0, 80.0], [7, 8, 9, 11]), MS)
    assert (sparse.tolist(), every) == ([0, 20, 40, 80], 20)


def test_a_frame_out_of_line_has_no_tick() -> None:
    counter = [*range(7, 17), 150, *range(18, 27)]
    alone, every, notes = ticks._own_ticks(item([2.0 * k for k in range(20)], counter), MS)
    assert alone[10] == OUTSIDE
    assert np.delete(alone, 10).tolist() == [*range(0, 20, 2), *range(22, 40, 2)]
    assert every == 2
    assert notes == ("1 frames with a counter out of line",)


def test_without_a_counter_time_places_frames_and_says_so() -> None:
    time = [0.3, *(float(k) for k in range(1, 200))]
    alone, every, notes = ticks._own_ticks(item(time), MS)
    assert alone.tolist() == list(range(200))
    assert every == 1
    assert notes == ("M: no counter to place samples by; host time stamps do",)


def test_frames_that_come_late_in_a_burst_go_back_to_their_ticks() -> None:
    time = [float(k) for k in range(100)]
    time[40:50] = [50.0 + 0.01 * k for k in range(10)]
    alone, _, _ = ticks._own_ticks(item(time), MS)
    assert alone.tolist() == list(range(100))


@pytest.mark.parametrize(
    ("time", "counter", "spacing"),
    [
        ([0.0, 1.0, 2.0], None, 1),
        ([0.0, 20.0, 40.0], None, 20),
        ([0.0, 0.2, 0.4], None, 0),
        ([0.0, 5.0, 10.0, 11.0], [1, 6, 11, 12], 1),
        ([0.0, 2.0, 4.0], [5, 5, 5], 2),
        ([0.0, 0.999e6, 1.998e6], None, 999_000),
        ([0.0, 1e6, 2e6], None, 1),
    ],
)
def test_ticks_between_two_frames(
    time: list[float], counter: list[int] | None, spacing: int
) -> None:
    assert ticks._frame_spacing(item(time, counter), MS) == spacing


@pytest.mark.parametrize("offset", [-0.4, 0.0, 0.1, 0.3, 0.45])
def test_the_phase_of_a_steady_stream(offset: float) -> None:
    fraction = np.arange(1300) + offset
    assert ticks._phase(fraction) == pytest.approx(np.full(1300, offset), abs=1e-9)


def test_the_phase_follows_a_drift_over_several_turns() -> None:
    drift = np.linspace(0.0, 3.0, 20_000)
    phase = ticks._phase(np.arange(20_000) + drift)
    inner = slice(500, -500)
    assert np.abs(phase[inner] - drift[inner]).max() < 0.01


def test_one_counted_message_with_a_counter_of_its_own_width() -> None:
    counter = [(k + 3) % 16 for k in range(100)]
    axis = ticks._counted_axis({"M": item([float(k) for k in range(100)], counter, 16)}, MS)
    assert axis.tick.tolist() == list(range(3, 103))
    assert axis.ticks["M"].tolist() == list(range(3, 103))
    assert (axis.turn, dict(axis.every), axis.notes) == (16, {"M": 1}, ())


def test_an_axis_tells_the_tick_of_other_frames() -> None:
    axis = TickAxis(
        ticks={},
        rows={},
        row=np.array([2, 4, 6]),
        tick=np.array([10, 11, 15]),
        time_ns=(np.array([0, 1.5, 5]) * MS).astype(np.int64),
        every={},
        turn=256,
        notes=(),
    )
    row = np.array([0, 3, 5, 9])
    time_ns = np.array([-0.5, 0.25, 2.0, 6.0]) * MS
    fraction, following = axis.at(row, time_ns.astype(np.int64), MS)
    assert fraction.tolist() == [9.5, 10.25, 11.5, 16.0]
    assert following.tolist() == [10, 11, 15, 16]
