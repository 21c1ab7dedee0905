"""What a recording says of itself, and what the policies refuse."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from bus_synth import (
    START,
    TELEMETRY,
    TICK,
    flip,
    make_truth,
    one,
    play,
    tick_of,
)

from firmware_iface.alignment.align import assemble
from firmware_iface.mapping.file import Policy, PolicyLimits
from firmware_iface.transport.frames import FrameTable

TICKS = 500


@pytest.fixture(scope="module")
def truth():
    return make_truth(TICKS)


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
    assert recording.quality.notes == (
        *known,
        "time stamps run 2.000 s ahead of the counters: the computer paused, or the host clock"
        " was set",
    )
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
        why = (
            "ServoTelemetry: 1 of 500 frames with a wrong check sum (the mapping's policy allows 0)"
        )
        assert recording.quality.refused == ((why,) if refused else ())
        assert one(damaged, bus_map).quality.refused == ()
        if refused:
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
    (why,) = recording.quality.refused
    assert re.match(r"ServoTelemetry: \d+ of 500 frames with values outside their range", why)
    assert one(frames, replace(strict, policy=Policy())).quality.refused == ()
    assert one(frames, with_policy(bus_map, range="refuse")).quality.refused == ()
    used = one(frames, replace(strict, policy=Policy(range="flag")))
    (note,) = used.quality.notes
    assert "outside their range, used as the mapping's policy says" in note
    assert np.isfinite(used.samples.spool).all()


@pytest.mark.parametrize(
    ("kind", "spoil", "words"),
    [
        ("lost", lambda _: [], "frames lost"),
        ("repeated", lambda f: [f, f], "frames repeated"),
        ("length", lambda f: [replace(f, data=f.data[:5])], "frames of a wrong length"),
        ("crc", lambda f: [flip(f, 3)], "frames with a wrong check sum"),
    ],
)
def test_a_fault_is_refused_beyond_its_share_only(frames, bus_map, kind, spoil, words):
    """5 of 500 telemetry frames are spoiled."""
    place = [i for i, frame in enumerate(frames) if frame.can_id == TELEMETRY]
    chosen = set(place[100:350:50])
    spoilt = [x for i, f in enumerate(frames) for x in (spoil(f) if i in chosen else [f])]
    assert one(spoilt, bus_map).quality.refused == ()
    (why,) = one(spoilt, with_policy(bus_map, **{kind: "refuse"})).quality.refused
    assert why.startswith(f"ServoTelemetry: 5 of {len(place) + 5 * (kind == 'repeated')} {words}")
    for limit, refused in ((0.009, True), (0.01, False)):
        shared = with_policy(bus_map, **{kind: "refuse", "limits": PolicyLimits(**{kind: limit})})
        assert bool(one(spoilt, shared).quality.refused) is refused, limit


def test_frames_out_of_order_may_be_refused(frames, bus_map):
    place = [i for i, frame in enumerate(frames) if frame.can_id == TELEMETRY]
    late = list(frames)
    late[place[100]], late[place[101]] = late[place[101]], late[place[100]]
    (why,) = one(late, with_policy(bus_map, out_of_order="refuse")).quality.refused
    assert why.startswith("ServoTelemetry: 1 of 500 frames out of order")
    assert one(late, bus_map).quality.refused == ()


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
