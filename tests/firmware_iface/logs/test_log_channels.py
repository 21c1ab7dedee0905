"""Adapter channels of a recording: carried by every kind that has them, never mixed.

Of several tests in a log one is judged: what is passed over is always said.
"""

from __future__ import annotations

import pytest
from bus_synth import (
    COMMAND,
    START,
    STATUS,
    TELEMETRY,
    assert_truthful,
    make_truth,
    play,
    recordings,
)
from msgspec.structs import replace

from ehadiag import ConfigurationError, InputOutputError
from firmware_iface.bus_map import default_map
from firmware_iface.logs.reader import read_frames, read_recordings
from firmware_iface.logs.recorder import Recorder, StoredLog
from firmware_iface.recording import BitState
from firmware_iface.signals.recordings import choose_recording, describe_recording, read_recording
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import PythonCanTransport

WORN, HEALTHY = make_truth(300, 1), make_truth(300, 2)


def record(path, frames, **options):
    with Recorder(path, **options) as recorder:
        for frame in sorted(frames, key=lambda item: item.time_ns):
            recorder.write(frame)
    return path


@pytest.fixture
def both(encoder):
    """Two actuators on two channels at the same time."""
    first = [replace(item, channel=1) for item in play(encoder, WORN)]
    second = play(encoder, HEALTHY, start_ns=START + 50_000, serial=78)
    return first + [replace(item, channel=2) for item in second]


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".trc", ".mf4"])
@pytest.mark.filterwarnings("default")  # asammdf's own
def test_a_kind_of_log_carries_channels(tmp_path, suffix):
    if suffix == ".mf4":
        pytest.importorskip("asammdf", reason="MF4 needs the extra ehadiag[mf4]")
    frames = [Frame(START + k * 1_000_000, 0x123, bytes(8), channel=k % 3 + 1) for k in range(30)]
    table = read_frames(record(tmp_path / f"x{suffix}", frames))
    assert table.channel.tolist() == [frame.channel for frame in frames]


@pytest.mark.parametrize(
    ("said", "suffix", "read"), [(3, ".blf", 3), (None, ".blf", 1), (3, ".csv", 0)]
)
def test_a_recorder_writes_the_channel_that_the_mapping_names(tmp_path, said, suffix, read):
    path = record(tmp_path / f"x{suffix}", [Frame(START, 0x123, bytes(8))], channel=said)
    assert read_frames(path).channel.tolist() == [read]


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".trc"])
def test_two_channels_are_refused_until_one_is_chosen(tmp_path, both, suffix):
    path = record(tmp_path / f"both{suffix}", both)
    recording = read_recording(path)
    assert recording.samples is None
    assert "the adapter channels 1, 2: choose one by --log-channel" in recording.quality.refused[0]
    for channel, truth, serial in ((1, WORN, 77), (2, HEALTHY, 78)):
        recording = read_recording(path, replace(default_map(), channel=channel))
        assert_truthful(recording.samples, truth)
        assert (recording.serial, recording.channel) == (serial, channel)
        assert recording.quality.refused == ()
        assert recording.quality.foreign > 600


def test_one_after_the_other_is_refused_too(tmp_path, encoder):
    later = [replace(item, channel=2) for item in play(encoder, HEALTHY, start_ns=START + 10**10)]
    frames = [replace(item, channel=1) for item in play(encoder, WORN)] + later
    (recording,) = read_recordings(record(tmp_path / "x.blf", frames))
    assert "choose one by --log-channel" in recording.quality.refused[0]


def test_a_channel_without_the_actuator_is_refused(tmp_path, both):
    path = record(tmp_path / "both.blf", both)
    recording = read_recording(path, replace(default_map(), channel=5))
    assert recording.quality.refused == (
        "no frame of the actuator's on adapter channel 5, which was chosen; there are on 1, 2",
    )


def test_what_is_foreign_on_another_channel_does_no_harm(tmp_path, encoder):
    frames = [replace(item, channel=1) for item in play(encoder, WORN)]
    noise = [replace(item, data=bytes(8), channel=2) for item in frames]  # no valid check sum
    recording = read_recording(record(tmp_path / "x.blf", frames + noise))
    assert_truthful(recording.samples, WORN)
    assert recording.channel == 1
    assert recording.quality.total("crc_errors") == 0


def test_a_log_that_says_no_channel_fits_any(tmp_path, encoder):
    path = record(tmp_path / "x.csv", play(encoder, WORN))
    assert_truthful(read_recording(path, replace(default_map(), channel=4)).samples, WORN)


def test_replay_takes_one_channel(tmp_path, both):
    path = record(tmp_path / "both.blf", both)
    with pytest.raises(ConfigurationError, match="channels 1, 2: choose one by --log-channel"):
        StoredLog(path, None)
    with pytest.raises(InputOutputError, match="no frame on adapter channel 7, only on 1, 2"):
        StoredLog(path, 7)
    log = StoredLog(path, 2)
    tables = list(log)
    assert sum(map(len, tables)) == log.frames == len(both) // 2
    assert {number for table in tables for number in table.channel.tolist()} == {2}


def test_a_bus_opened_on_one_channel_names_none():
    name = "one-channel"
    with (
        PythonCanTransport(BusOptions("virtual", name), transmit=True) as ours,
        PythonCanTransport(BusOptions("virtual", name)) as theirs,
    ):
        ours.send(Frame(START, 0x123, b"1", channel=9))
        frame = theirs.receive(1.0)
    assert frame is not None
    assert frame.channel == 0


FIRST, SECOND = make_truth(300, 1), make_truth(400, 2)


@pytest.fixture
def first(encoder):
    return play(encoder, FIRST, idle_after=20)


def second(encoder, **options):
    return play(encoder, SECOND, start_ns=START + 10**9, idle_before=20, idle_after=20, **options)


def judged(frames, bus_map):
    found = choose_recording(recordings(frames, bus_map))
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
    assert (
        describe_recording(found, 1)
        == "test 1 (no. 1 of the recording, 0.300 s, serial 77): complete"
    )


def test_telemetry_alone_is_one_test_of_which_nothing_is_said(first, bus_map):
    found, _ = judged([item for item in first if item.can_id not in (STATUS, COMMAND)], bus_map)
    assert found.samples is not None
    assert any(item.can_id == TELEMETRY for item in first)
    assert "no status frames: nothing says how the test ended" in found.quality.notes
