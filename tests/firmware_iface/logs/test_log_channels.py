"""Adapter channels of a recording: carried by every kind that has them, never mixed."""

from dataclasses import replace

import pytest
from bus_synth import START, assert_truthful, make_truth, play

from ehadiag.core.errors import ConfigurationError, InputOutputError
from firmware_iface.logs.reader import read_frames, read_recording, read_recordings
from firmware_iface.logs.recorder import Recorder
from firmware_iface.logs.replay import StoredLog
from firmware_iface.mapping.bus_map import default_map
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import BusOptions, PythonCanTransport

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
