"""Counts at their exact boundaries."""

from __future__ import annotations

import numpy as np
import pytest
from bus_synth import ENVIRONMENT, START, TICK, flip, make_truth, play, recordings
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.counts import _expected, _late, _sequence, within
from firmware_iface.frames import Frame


@pytest.mark.parametrize(
    ("counter", "expected"),
    [
        ([], []),
        ([9], [0]),
        ([254, 255, 0, 1], [0, 1, 2, 3]),
        ([5, 5, 6], [0, 0, 1]),
        ([5, 7, 6, 8], [0, 2, 1, 3]),
        ([0, 128], [0, 128]),
        ([0, 129], [0, -127]),
    ],
)
def test_sequence_takes_the_nearest(counter, expected):
    assert _sequence(np.array(counter, dtype=np.int64), 256).tolist() == expected


@pytest.mark.parametrize(
    ("position", "late"),
    [([], 0), ([1, 2, 3], 0), ([1, 1, 2, 2], 0), ([1, 3, 2, 4], 1), ([4, 1, 2, 4, 1], 2)],
)
def test_late(position, late):
    assert _late(np.array(position, dtype=np.int64)) == late


@given(st.integers(1, 50), st.integers(1, 5), st.integers(0, 4))
def test_expected_frames_of_a_slow_message(ticks, every, phase):
    at = np.arange(phase % every, ticks, every)
    stream = np.zeros(len(at), dtype=np.int64)
    if len(at):
        assert _expected(at, stream, ticks, every) == len(at)
        assert _expected(at[-1:], stream[:1], ticks, every) == len(at)
    assert _expected(at[:0], stream[:0], ticks, every) == int(np.ceil(ticks / every))


def test_expected_frames_of_two_streams():
    at, stream = np.array([0, 1, 2, 3]), np.array([1, 2, 1, 2])
    assert _expected(at, stream, 10, 2) == 10
    assert _expected(at[:3], stream[:3], 9, 2) == 5 + 4


def test_within():
    rows = np.array([2, 5, 9])
    assert [within(rows, a, b) for a, b in ((0, 10), (2, 9), (3, 5), (5, 6))] == [3, 2, 0, 1]


def test_environment_frames_lost_repeated_late_and_damaged(encoder, bus_map):
    frames = play(encoder, make_truth(1600))
    where = [i for i, frame in enumerate(frames) if frame.can_id == ENVIRONMENT]
    changed = dict(enumerate(frames))
    changed[where[5]], changed[where[6]] = changed[where[6]], changed[where[5]]
    changed[where[9]] = flip(changed[where[9]], 11)
    damaged = changed[where[11]]
    changed[where[11]] = Frame(damaged.time_ns, damaged.can_id, damaged.data[:5])
    del changed[where[3]]
    rows = [changed[i] for i in sorted(changed)]
    last = max(i for i, frame in enumerate(rows) if frame.can_id == ENVIRONMENT)
    rows.insert(last + 1, rows[last])
    (recording,) = recordings(rows, bus_map)
    counts = recording.quality.messages["Environment"]
    assert (counts.received, counts.accepted, counts.lost) == (16, 13, 1)
    assert (counts.repeated, counts.out_of_order) == (1, 1)
    assert (counts.crc_errors, counts.length_errors) == (1, 1)


def test_values_at_the_very_end_of_their_range_are_not_outside(bus_map, encoder):
    frames = play(encoder, make_truth(200))
    (high,) = encoder.environment(40.95e6, 40.95e6, 309.5, START + 150 * TICK)
    (recording,) = recordings([*frames[:300], high, *frames[300:]], bus_map)
    assert recording.quality.messages["Environment"].range_errors == 0
