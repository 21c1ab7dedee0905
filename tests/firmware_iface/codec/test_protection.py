"""Check sums against another implementation, counters against a known sequence."""

from __future__ import annotations

import numpy as np
import pytest
from crc import Calculator, Configuration
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.codec.protection import OUTSIDE, crc8, crc8_rows, unwrap

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
    assert got[300] == OUTSIDE
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
