"""What a recording says of itself, and what the policies refuse.

Policies: which counts refuse a recording, which are noted, and the wording. Serial number, test
number, state and time base must be one through a test.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from bus_synth import (
    START,
    STATUS,
    TELEMETRY,
    TICK,
    flip,
    make_truth,
    one,
    play,
    recordings,
    tick_of,
)
from msgspec.structs import replace

from firmware_iface.alignment.align import assemble
from firmware_iface.alignment.frame_faults import judge_frames
from firmware_iface.codec import Encoder
from firmware_iface.mapping_file import Policy, PolicyLimits
from firmware_iface.recording import BitState, MessageCounts
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


KINDS = {
    "crc": ("crc_errors", "frames with a wrong check sum"),
    "range": ("range_errors", "frames with values outside their range"),
    "length": ("length_errors", "frames of a wrong length"),
    "lost": ("lost", "frames lost"),
    "repeated": ("repeated", "frames repeated"),
    "out_of_order": ("out_of_order", "frames out of order"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_is_refused_where_its_own_policy_says_so(kind):
    """The share is that of all frames sent, as far as is known: those received and those lost."""
    count, words = KINDS[kind]
    counts = {"A": MessageCounts(**{"received": 100, "lost": 60, count: 40}), "B": MessageCounts()}
    frames = 140 if kind == "lost" else 160
    limit = 40 / frames
    assert judge_frames(Policy(), counts) == ((), ())
    refused, notes = judge_frames(Policy(**{kind: "refuse"}), counts)
    assert refused == (f"A: 40 of {frames} {words} (the mapping's policy allows 0)",)
    assert notes == ()
    at = Policy(**{kind: "refuse"}, limits=PolicyLimits(**{kind: limit}))
    assert judge_frames(at, counts) == ((), ())
    below = Policy(**{kind: "refuse"}, limits=PolicyLimits(**{kind: limit - 1e-6}))
    assert judge_frames(below, counts)[0] == (
        f"A: 40 of {frames} {words} (the mapping's policy allows {limit:.3g})",
    )


@pytest.mark.parametrize("kind", ["crc", "range"])
def test_faulty_frames_that_are_used_are_noted(kind):
    count, words = KINDS[kind]
    counts = {"A": MessageCounts(received=9), "B": MessageCounts(**{"received": 9, count: 1})}
    refused, notes = judge_frames(Policy(**{kind: "flag"}), counts)
    assert refused == ()
    assert notes == (f"B: 1 {words}, used as the mapping's policy says",)


@pytest.mark.parametrize("kind", ["lost", "out_of_order"])
def test_gaps_and_lateness_are_counted_anyway_and_need_no_note(kind):
    counts = {"A": MessageCounts(**{"received": 9, KINDS[kind][0]: 4})}
    assert judge_frames(Policy(**{kind: "flag"}), counts) == ((), ())


def test_every_message_and_every_kind_is_judged():
    """A sound message, or a kind within its share, ends nothing."""
    counts = {
        "A": MessageCounts(received=100, crc_errors=1, repeated=2, lost=1),
        "B": MessageCounts(received=100),
        "C": MessageCounts(received=10, crc_errors=1, length_errors=3),
    }
    policy = Policy(
        crc="refuse",
        range="flag",
        length="refuse",
        repeated="refuse",
        limits=PolicyLimits(crc=0.05, repeated=0.5),
    )
    refused, notes = judge_frames(policy, counts)
    assert [why.split(" (")[0] for why in refused] == [
        "C: 1 of 10 frames with a wrong check sum",
        "C: 3 of 10 frames of a wrong length",
    ]
    assert notes == ()


def test_no_frames_at_all_are_no_fault():
    policy = Policy(**dict.fromkeys(KINDS, "refuse"))
    assert judge_frames(policy, {"A": MessageCounts()}) == ((), ())
    assert judge_frames(policy, {}) == ((), ())


LENGTH = 1000


@pytest.fixture
def session(encoder):
    return play(encoder, make_truth(LENGTH), idle_before=100, idle_after=100)


def restated(session, chosen, **changes):
    """Status frames of the test, some of them told anew with other content."""
    encoder, out, number = Encoder(), [], 0
    for frame in session:
        if frame.can_id == STATUS and frame.data[0] not in (2, 3):
            out += encoder.status(0, 0, 0, 0.0, 77, frame.time_ns)
        elif frame.can_id == STATUS:
            tick = (frame.time_ns - START) // TICK - 100
            said = {"state": frame.data[0], "test": 1, "elapsed": tick * 1e-3, "serial": 77}
            if chosen(number, tick):
                said |= changes
            number += 1
            out += encoder.status(
                said["state"], 0, said["test"], said["elapsed"], said["serial"], frame.time_ns
            )
        else:
            out.append(frame)
    return out


def why(session, bus_map):
    return "; ".join(one(session, bus_map).quality.refused)


def test_a_sound_test_has_no_contradiction(session, bus_map):
    assert why(restated(session, lambda *_: False), bus_map) == ""


def test_a_serial_number_that_changes_is_refused(session, bus_map):
    told = restated(session, lambda _, tick: tick > 700, serial=78)
    assert "the serial number changes within the test: 77 and 78" in why(told, bus_map)


def test_a_serial_number_that_changes_with_the_last_word_is_refused(session, bus_map):
    told = restated(session, lambda _, tick: tick >= LENGTH, serial=78)
    assert "the serial number changes within the test: 77 and 78" in why(told, bus_map)


def test_two_serial_numbers_in_turn_are_a_second_sender(session, bus_map):
    told = restated(session, lambda number, _: number % 2 == 1, serial=78)
    assert "in turn: a second sender of the status" in why(told, bus_map)


def test_one_odd_serial_number_is_a_note(session, bus_map):
    (recording,) = recordings(restated(session, lambda number, _: number == 9, serial=99), bus_map)
    assert recording.quality.refused == ()
    assert recording.serial == 77
    assert "one status frame says serial number 99, all others 77" in recording.quality.notes


def test_the_status_of_another_test_is_refused(session, bus_map):
    told = restated(session, lambda *_: True, test=2)
    assert "commands say test number 1, the status 2" in why(told, bus_map)


def test_idle_amidst_a_test_is_refused(session, bus_map):
    told = restated(session, lambda _, tick: 400 < tick < 480, state=0, elapsed=0.0, test=0)
    assert "the status says idle 3 times amidst the test" in why(told, bus_map)


def test_a_test_that_runs_after_its_end_is_refused(session, bus_map):
    told = restated(session, lambda _, tick: tick == 600, state=3)
    assert "the status says that the test runs after it was complete" in why(told, bus_map)


def test_two_time_bases_are_a_second_sender(session, bus_map):
    second, extra = Encoder(), []
    for _ in range(128):  # far from the counters of the first
        second.status(0, 0, 0, 0.0, 77, 0)
    for frame in session:
        if frame.can_id == STATUS and frame.data[0] == 2:
            tick = (frame.time_ns - START) // TICK - 100
            late = frame.time_ns + 7 * TICK
            extra += second.status(BitState.RUNNING, 0, 1, (tick + 357) * 1e-3, 77, late)
    told = sorted([*session, *extra], key=lambda item: item.time_ns)
    assert "two time bases in turn" in why(told, bus_map)


def test_a_test_without_status_says_so(encoder, bus_map):
    recording = one(play(encoder, make_truth(300), status=False), bus_map)
    assert "no status frames: nothing says how the test ended" in recording.quality.notes


def test_a_test_without_its_last_word_says_so(session, bus_map):
    kept = [item for item in session if item.can_id != STATUS or item.data[0] == 2]
    recording = one(kept, bus_map)
    assert "the status frame that tells of the test's end is missing" in recording.quality.notes


def test_a_refused_request_is_told_beside_a_test(session, encoder, bus_map):
    later = session[-1].time_ns + TICK
    asked = [encoder.status(5, 3, 2, 0.0, 77, later + k * 20 * TICK)[0] for k in range(4)]
    found = recordings([*session, *asked], bus_map)
    assert [item.outcome.state for item in found] == [BitState.COMPLETE, BitState.REFUSED]
    assert found[1].test_id == 2
    assert found[1].samples is None


def test_counts_and_serial_survive_without_a_serial_on_the_bus(session, bus_map):
    messages = dict(bus_map.messages)
    status = messages["BitStatus"]
    roles = tuple(role for role in status.roles if role.name != "status.serial")
    messages["BitStatus"] = replace(status, roles=roles)
    recording = one(session, replace(bus_map, messages=messages))
    assert recording.serial is None
    assert recording.quality.refused == ()
