"""What a recording says of itself, and what the policies refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bus_synth import (
    START,
    TELEMETRY,
    TICK,
    flip,
    make_truth,
    play,
    recordings,
    tick_of,
)

from firmware_iface.align import assemble
from firmware_iface.frames import FrameTable
from firmware_iface.mapping import Policy

TICKS = 500


@pytest.fixture(scope="module")
def truth():
    return make_truth(TICKS)


@pytest.fixture
def frames(encoder, truth):
    return play(encoder, truth)


def one(frames, bus_map):
    (recording,) = recordings(frames, bus_map)
    return recording


def without_check_sum(bus_map, name):
    messages = dict(bus_map.messages)
    messages[name] = replace(messages[name], crc=None)
    return replace(bus_map, messages=messages)


def test_notes_of_every_step_are_handed_on(frames, bus_map):
    """A message without samples may do without a check sum."""
    bare = without_check_sum(without_check_sum(bus_map, "ServoTelemetry"), "Environment")
    stepped = [
        replace(frame, time_ns=frame.time_ns + 2_000_000_000) if tick_of(frame) >= 400 else frame
        for frame in frames
    ]
    known = ("a fact", "ServoTelemetry: no check sum; a corrupt frame cannot be told")
    (recording,) = assemble(FrameTable.from_frames(stepped), bare, "a log", ("a fact",))
    assert recording.quality.notes == (*known, "host clock stepped by +2.000 s")
    assert recording.source == "a log"
    silent = [frame for frame in frames if frame.can_id != TELEMETRY]
    (recording,) = assemble(FrameTable.from_frames(silent), bare, "a log", ("a fact",))
    assert recording.quality.notes[:3] == (*known, "no telemetry in the recording")


def with_policy(bus_map, **policy):
    return replace(bus_map, policy=Policy(**policy))


def test_the_policy_may_refuse_wrong_check_sums_inside_the_test(encoder, bus_map, truth):
    frames = play(encoder, truth, idle_before=100)
    strict = with_policy(bus_map, crc="refuse")
    place = [i for i, frame in enumerate(frames) if frame.can_id == TELEMETRY]
    for index, refused in ((50, False), (300, True)):
        damaged = list(frames)
        damaged[place[index]] = flip(frames[place[index]], 3)
        recording = one(damaged, strict)
        assert (recording.samples is None) is refused
        note = "frames with a wrong check sum: refused by the policy"
        assert (note in recording.quality.notes) is refused
        assert one(damaged, bus_map).samples is not None
        if refused:
            assert recording.quality.saturated == {}
            assert recording.quality.messages["ServoTelemetry"].crc_errors == 1


def test_the_policy_may_refuse_values_outside_their_range(frames, bus_map):
    found = bus_map.messages["ServoTelemetry"]
    spool = next(role for role in found.roles if role.name == "channels.spool")
    narrow = replace(spool, signal=replace(spool.signal, minimum=-1e-9, maximum=1e-9))
    messages = dict(bus_map.messages)
    messages["ServoTelemetry"] = replace(
        found, roles=tuple(narrow if role is spool else role for role in found.roles)
    )
    strict = with_policy(replace(bus_map, messages=messages), range="refuse")
    recording = one(frames, strict)
    assert recording.samples is None
    assert recording.quality.notes[-1] == "values outside their range: refused by the policy"
    assert one(frames, replace(strict, policy=Policy())).samples is not None
    assert one(frames, with_policy(bus_map, range="refuse")).quality.notes == ()


def test_a_stuck_counter_outside_the_test_is_not_noted(encoder, bus_map, truth):
    frames = play(encoder, truth, idle_after=200)
    stuck = [
        encoder.environment(20.7e6, 0.7e6, 40.0, START + (TICKS + 20 + 3 * k) * TICK)[0]
        for k in range(60)
    ]
    same = [replace(stuck[0], time_ns=frame.time_ns) for frame in stuck]
    rows = sorted([*frames, *same], key=lambda frame: frame.time_ns)
    assert one(rows, bus_map).quality.notes == ()
    early = [replace(frame, time_ns=frame.time_ns - 300 * TICK) for frame in same]
    rows = sorted([*frames, *early], key=lambda frame: frame.time_ns)
    (note,) = one(rows, bus_map).quality.notes
    assert note == "Environment: the counter stands still in 58 frames"


def test_a_recording_counts_from_its_first_row_to_its_last(frames, bus_map):
    alone = [frame for frame in frames if frame.can_id == TELEMETRY]
    recording = one(alone, bus_map)
    assert recording.quality.messages["ServoTelemetry"].received == TICKS
    assert np.isfinite(recording.samples.spool).all()
    silent = [frame for frame in frames if frame.can_id != TELEMETRY]
    messages = one(silent, bus_map).quality.messages
    assert sum(item.received for item in messages.values()) == len(silent)


def test_a_test_of_one_tick(encoder, bus_map):
    recording = one(play(encoder, make_truth(1), idle_before=60, idle_after=60), bus_map)
    assert recording.samples.ticks == 1
    assert np.isfinite(recording.samples.spool).all()
    assert recording.quality.messages["ServoTelemetry"].received == 1
