"""Serial number, test number, state and time base must be one through a test."""

from dataclasses import replace

import pytest
from bus_synth import START, STATUS, TICK, make_truth, one, play, recordings

from ehadiag.core.recording import BitState
from firmware_iface.codec.encode import Encoder

TICKS = 1000


@pytest.fixture
def frames(encoder):
    return play(encoder, make_truth(TICKS), idle_before=100, idle_after=100)


def restated(frames, chosen, **changes):
    """Status frames of the test, some of them told anew with other content."""
    encoder, out, number = Encoder(), [], 0
    for frame in frames:
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


def why(frames, bus_map):
    return "; ".join(one(frames, bus_map).quality.refused)


def test_a_sound_test_has_no_contradiction(frames, bus_map):
    assert why(restated(frames, lambda *_: False), bus_map) == ""


def test_a_serial_number_that_changes_is_refused(frames, bus_map):
    told = restated(frames, lambda _, tick: tick > 700, serial=78)
    assert "the serial number changes within the test: 77 and 78" in why(told, bus_map)


def test_a_serial_number_that_changes_with_the_last_word_is_refused(frames, bus_map):
    told = restated(frames, lambda _, tick: tick >= TICKS, serial=78)
    assert "the serial number changes within the test: 77 and 78" in why(told, bus_map)


def test_two_serial_numbers_in_turn_are_a_second_sender(frames, bus_map):
    told = restated(frames, lambda number, _: number % 2 == 1, serial=78)
    assert "in turn: a second sender of the status" in why(told, bus_map)


def test_one_odd_serial_number_is_a_note(frames, bus_map):
    (recording,) = recordings(restated(frames, lambda number, _: number == 9, serial=99), bus_map)
    assert recording.quality.refused == ()
    assert recording.serial == 77
    assert "one status frame says serial number 99, all others 77" in recording.quality.notes


def test_the_status_of_another_test_is_refused(frames, bus_map):
    told = restated(frames, lambda *_: True, test=2)
    assert "commands say test number 1, the status 2" in why(told, bus_map)


def test_idle_amidst_a_test_is_refused(frames, bus_map):
    told = restated(frames, lambda _, tick: 400 < tick < 480, state=0, elapsed=0.0, test=0)
    assert "the status says idle 3 times amidst the test" in why(told, bus_map)


def test_a_test_that_runs_after_its_end_is_refused(frames, bus_map):
    told = restated(frames, lambda _, tick: tick == 600, state=3)
    assert "the status says that the test runs after it was complete" in why(told, bus_map)


def test_two_time_bases_are_a_second_sender(frames, bus_map):
    second, extra = Encoder(), []
    for _ in range(128):  # far from the counters of the first
        second.status(0, 0, 0, 0.0, 77, 0)
    for frame in frames:
        if frame.can_id == STATUS and frame.data[0] == 2:
            tick = (frame.time_ns - START) // TICK - 100
            late = frame.time_ns + 7 * TICK
            extra += second.status(BitState.RUNNING, 0, 1, (tick + 357) * 1e-3, 77, late)
    told = sorted([*frames, *extra], key=lambda item: item.time_ns)
    assert "two time bases in turn" in why(told, bus_map)


def test_a_test_without_status_says_so(encoder, bus_map):
    recording = one(play(encoder, make_truth(300), status=False), bus_map)
    assert "no status frames: nothing says how the test ended" in recording.quality.notes


def test_a_test_without_its_last_word_says_so(frames, bus_map):
    kept = [item for item in frames if item.can_id != STATUS or item.data[0] == 2]
    recording = one(kept, bus_map)
    assert "the status frame that tells of the test's end is missing" in recording.quality.notes


def test_a_refused_request_is_told_beside_a_test(frames, encoder, bus_map):
    later = frames[-1].time_ns + TICK
    asked = [encoder.status(5, 3, 2, 0.0, 77, later + k * 20 * TICK)[0] for k in range(4)]
    found = recordings([*frames, *asked], bus_map)
    assert [item.outcome.state for item in found] == [BitState.COMPLETE, BitState.REFUSED]
    assert found[1].test_id == 2
    assert found[1].samples is None


def test_counts_and_serial_survive_without_a_serial_on_the_bus(frames, bus_map):
    messages = dict(bus_map.messages)
    status = messages["BitStatus"]
    roles = tuple(role for role in status.roles if role.name != "status.serial")
    messages["BitStatus"] = replace(status, roles=roles)
    recording = one(frames, replace(bus_map, messages=messages))
    assert recording.serial is None
    assert recording.quality.refused == ()
