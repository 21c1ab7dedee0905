"""Of several tests in a log one is judged: what is passed over is always said."""

import pytest
from bus_synth import COMMAND, START, STATUS, TELEMETRY, make_truth, play, recordings

from ehadiag.core.recording import BitState
from firmware_iface.logs.reader import choose, describe

FIRST, SECOND = make_truth(300, 1), make_truth(400, 2)


@pytest.fixture
def first(encoder):
    return play(encoder, FIRST, idle_after=20)


def second(encoder, **options):
    return play(encoder, SECOND, start_ns=START + 10**9, idle_before=20, idle_after=20, **options)


def judged(frames, bus_map):
    found = choose(recordings(frames, bus_map))
    passed = [note for note in found.quality.notes if note.startswith("passed over: ")]
    return found, passed


def test_a_later_test_that_was_aborted(first, encoder, bus_map):
    found, passed = judged(first + second(encoder, end=BitState.ABORTED), bus_map)
    assert found.duration == pytest.approx(0.3)
    assert passed == ["passed over: test 1 (no. 2 of the recording, 0.400 s, serial 77): aborted"]


def test_a_later_test_without_its_last_word(first, encoder, bus_map):
    cut = [item for item in second(encoder) if item.can_id != STATUS or item.data[0] == 2]
    _, passed = judged(first + cut, bus_map)
    assert len(passed) == 1
    assert "0.400 s, serial 77): without the word of its end" in passed[0]


def test_a_later_test_that_is_cut(first, encoder, bus_map):
    later = second(encoder)
    found, passed = judged(first + later[: len(later) // 2], bus_map)
    assert found.duration == pytest.approx(0.3)
    assert "without the word of its end" in passed[0]


def test_a_later_test_without_any_status(first, encoder, bus_map):
    _, passed = judged(first + second(encoder, status=False), bus_map)
    assert len(passed) == 1


def test_an_earlier_complete_test(first, encoder, bus_map):
    found, passed = judged(first + second(encoder, serial=78), bus_map)
    assert found.serial == 78
    assert passed == ["passed over: test 1 (no. 1 of the recording, 0.300 s, serial 77): complete"]


def test_a_refused_request(first, encoder, bus_map):
    asked = [encoder.status(5, 3, 2, 0.0, 77, START + (500 + 20 * k) * 10**6)[0] for k in range(3)]
    _, passed = judged(first + asked, bus_map)
    assert passed == ["passed over: test 2 (no. 2 of the recording, serial 77): refused"]


def test_many_tests_are_told_in_short(encoder, bus_map):
    frames = []
    for number in range(8):
        frames += play(
            encoder, FIRST, start_ns=START + number * 10**9, idle_before=20, idle_after=20
        )
    found, passed = judged(frames, bus_map)
    assert len(passed) == 3
    assert "4 earlier tests of the recording passed over" in found.quality.notes


def test_one_test_alone_has_nothing_passed_over(first, bus_map):
    found, passed = judged(first, bus_map)
    assert passed == []
    assert found.quality.notes == ()
    assert describe(found, 1) == "test 1 (no. 1 of the recording, 0.300 s, serial 77): complete"


def test_telemetry_alone_is_one_test_of_which_nothing_is_said(first, bus_map):
    found, _ = judged([item for item in first if item.can_id not in (STATUS, COMMAND)], bus_map)
    assert found.samples is not None
    assert any(item.can_id == TELEMETRY for item in first)
    assert "no status frames: nothing says how the test ended" in found.quality.notes
