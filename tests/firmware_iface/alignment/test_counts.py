"""Counts of lost, repeated and late frames, at their exact limits."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from bus_synth import ENVIRONMENT, START, TICK, flip, make_truth, play, recordings
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from firmware_iface.alignment.frame_faults import (
    _expected,
    _sequence,
    count_frames,
    count_within,
    slow_values,
)
from firmware_iface.bus_map import default_map
from firmware_iface.recording import MessageCounts
from firmware_iface.transport.frames import Frame


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
    [([1, 2, 3], 0), ([1, 1, 2, 2], 0), ([1, 3, 2, 4], 1), ([4, 1, 2, 4, 1], 2)],
)
def test_late(position, late):
    ticks = [TEST.first + item for item in position]
    got = count_frames(counted(range(len(ticks))), on_axis(ticks), TEST, 0, len(ticks))
    assert (got.out_of_order, got.accepted) == (late, len(set(position)))


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


def test_expected_frames_of_a_slow_page_beside_a_fast_one():
    """A page of 10 Hz was expected at every tick: thousands of lost frames, and none was."""
    slow, fast = np.arange(7, 5500, 100), np.arange(5500)
    at = np.sort(np.concatenate([fast, slow]), kind="stable")
    stream = np.zeros(len(at), dtype=np.int64)
    stream[np.searchsorted(at, slow)] = 1
    assert _expected(at, stream, 5500, 1) == len(at)
    kept = np.delete(np.arange(len(at)), [40, np.flatnonzero(stream)[9]])
    assert _expected(at[kept], stream[kept], 5500, 1) == len(at)


@pytest.mark.parametrize(("pages", "senders"), [(2, 0), (1, 1)])
def test_the_counter_of_a_slow_page_goes_on_with_the_fast_ones(pages, senders):
    """A page of 10 Hz was taken for a second sender: its counter leaps by what lies between."""
    bus = default_map()
    roles = bus.messages["Environment"].roles + bus.messages["ServoTelemetry"].roles
    count = 60
    frames = SimpleNamespace(
        message=replace(bus.messages["Environment"], roles=roles),
        row=np.arange(count),
        stream=np.arange(count) % pages,
        data=np.arange(8 * count, dtype=np.uint8).reshape(count, 8),
        time_ns=np.arange(count) * 50_000_000,
        counter=np.arange(count) * 101 % 256,
        modulus=256,
        counted=None,
        values={"environment.oil_temperature": np.full(count, 40.0)},
    )
    assert len(slow_values(frames, 0, count, 3_000_000_000)[1]) == senders


def test_within():
    rows = np.array([2, 5, 9])
    assert [count_within(rows, a, b) for a, b in ((0, 10), (2, 9), (3, 5), (5, 6))] == [3, 2, 0, 1]


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


def counted(row, counter=None, stream=None, **bad):
    """What counting reads of a decoded message of 256 counts."""
    empty = np.empty(0, dtype=np.int64)
    return SimpleNamespace(
        message=SimpleNamespace(name="M"),
        modulus=256,
        row=np.array(row),
        counter=None if counter is None else np.array(counter),
        stream=np.zeros(len(row), dtype=np.int64) if stream is None else np.array(stream),
        received=np.sort(np.concatenate([row, *bad.values()])).astype(np.int64),
        crc_bad=np.array(bad.get("crc", empty)),
        length_bad=np.array(bad.get("length", empty)),
        range_bad=np.array([row[0]]),
    )


def on_axis(ticks, every=None):
    ticks = {} if ticks is None else {"M": np.array(ticks)}
    return SimpleNamespace(ticks=ticks, every=every or {})


TEST = SimpleNamespace(first=100, ticks=10)


def test_frames_on_the_grid_are_counted_by_their_ticks():
    frames = counted(range(10, 20), crc=[3, 22], length=[23, 24])
    ticks = [99, 100, 101, 103, 102, 102, 106, 109, 110, 111]
    got = count_frames(frames, on_axis(ticks), TEST, 10, 23)
    assert got == MessageCounts(
        received=11,
        accepted=6,
        lost=3,
        repeated=1,
        out_of_order=1,
        crc_errors=1,
        length_errors=0,
        range_errors=1,
    )
    assert count_frames(frames, on_axis(ticks), TEST, 11, 25).received == 12
    assert count_frames(frames, on_axis(ticks), TEST, 11, 25).length_errors == 2
    assert count_frames(frames, on_axis(ticks), TEST, 11, 25).lost == 1
    assert count_frames(frames, on_axis(ticks), TEST, 14, 16).accepted == 1


def test_frames_of_a_slow_message_are_expected_at_its_pace():
    got = count_frames(counted([0, 1]), on_axis([101, 107], {"M": 3}), TEST, 0, 2)
    assert (got.accepted, got.lost) == (2, 1)
    assert count_frames(counted([0]), on_axis([101]), TEST, 0, 1).lost == 9
    nothing = count_frames(counted([0]), on_axis([99], {"M": 3}), TEST, 0, 1)
    assert (nothing.accepted, nothing.lost) == (0, 4)


def test_a_test_of_one_tick_holds_one_frame():
    once = SimpleNamespace(first=100, ticks=1)
    got = count_frames(counted([0, 1, 2], [1, 2, 3]), on_axis([99, 100, 101]), once, 0, 3)
    assert (got.accepted, got.lost) == (1, 0)


def test_two_streams_may_share_a_tick():
    frames = counted([0, 1, 2, 3, 4], stream=[1, 2, 1, 2, 2])
    got = count_frames(frames, on_axis([100, 100, 101, 101, 101]), TEST, 0, 5)
    assert (got.accepted, got.repeated, got.lost, got.out_of_order) == (4, 1, 16, 0)


def test_frames_on_event_are_counted_by_their_numbers():
    frames = counted([0, 1, 2, 3, 4, 5], [254, 255, 2, 1, 1, 3], crc=[6])
    for axis in (None, on_axis(None)):
        got = count_frames(frames, axis, TEST, 0, 7)
        assert (got.accepted, got.lost, got.repeated, got.out_of_order) == (5, 0, 1, 1)
    got = count_frames(frames, None, TEST, 0, 4)
    assert (got.received, got.accepted, got.lost, got.out_of_order) == (4, 4, 1, 1)
    assert count_frames(frames, None, TEST, 7, 9).lost == 0
    late_first = count_frames(counted([0, 1, 2], [5, 3, 6]), None, TEST, 0, 3)
    assert (late_first.accepted, late_first.lost) == (3, 1)
    never = SimpleNamespace(first=0, ticks=0)
    assert count_frames(frames, on_axis([0] * 6), never, 0, 7).accepted == 5


def test_without_counter_and_ticks_only_damage_is_known():
    frames = counted([0, 2, 4], crc=[1], length=[3])
    got = count_frames(frames, None, TEST, 0, 4)
    assert (got.received, got.accepted, got.lost, got.repeated) == (4, 2, 0, 0)
    assert count_frames(frames, None, TEST, 2, 5).accepted == 2
    nothing = count_frames(frames, None, TEST, 6, 9)
    assert (nothing.accepted, nothing.lost) == (0, 0)
    assert (got.crc_errors, got.length_errors) == (1, 1)
