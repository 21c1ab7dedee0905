"""Logs of every format and defect: read as far as they go, or refused in one line."""

from __future__ import annotations

import contextlib
import csv
import gc
import gzip
import sys

import can
import numpy as np
import pytest
from bus_synth import START, assert_truthful, make_truth, play
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import LOGS

from ehadiag import CommandMode, ConfigurationError, EhadiagError, InputOutputError, bundled_tests
from firmware_iface.logs.reader import read_frames, read_recordings
from firmware_iface.recording import BitState
from firmware_iface.signals.recordings import read_recording
from firmware_iface.tester import Assembler
from firmware_iface.transport.frames import Frame, FrameTable

TRUTH = {row["file"]: row for row in csv.DictReader((LOGS / "truth.csv").read_text().splitlines())}


def to_message(frame: Frame) -> can.Message:
    return can.Message(
        timestamp=frame.time_ns * 1e-9,
        arbitration_id=frame.can_id,
        data=frame.data,
        is_extended_id=frame.extended,
        is_fd=frame.fd,
        is_error_frame=frame.error,
        is_remote_frame=frame.remote,
        is_rx=not frame.sent,
        check=True,
    )


def write(path, frames):
    with can.Logger(str(path)) as logger:
        for frame in frames:
            logger(to_message(frame))
    return path


def same_samples(a, b):
    for name in a.__struct_fields__:
        if name != "host_ns":
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("name", sorted(TRUTH))
def test_reference_recordings(name):
    recording = read_recording(LOGS / name)
    samples, row = recording.samples, TRUTH[name]
    test = bundled_tests()[row["test"]]
    assert recording.test_id == test.id
    assert recording.serial == 1
    assert recording.outcome.state is BitState.COMPLETE
    assert samples.ticks == test.ticks == 5500
    assert samples.mode is (CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT)
    here = np.isfinite(samples.command)
    step = 0.002e-3 if test.closed_loop else 0.0005e-3
    assert np.abs(samples.command - test.command())[here].max() <= 0.51 * step
    hot = name.startswith("hot")
    assert recording.environment.supply_pressure == pytest.approx(20.1e6 if hot else 20.7e6)
    assert recording.environment.oil_temperature == pytest.approx(85.0 if hot else 40.0)
    assert recording.quality.notes == ()
    if not name.startswith("lossy"):
        assert recording.quality.total("received") == 11331
        assert recording.quality.total("lost") == recording.quality.total("crc_errors") == 0
        assert np.isfinite(samples.spool).all()


def test_counts_of_the_lossy_recording():
    recording = read_recording(LOGS / "lossy-open.blf")
    counts = recording.quality.messages
    expected = {
        "ServoTelemetry": (5401, 5381, 99, 20),
        "ServoCommand": (5400, 5370, 100, 30),
        "Environment": (53, 53, 2, 0),
        "BitStatus": (271, 269, 5, 2),
        "BitRequest": (0, 0, 0, 0),
    }
    assert {
        name: (item.received, item.accepted, item.lost, item.crc_errors)
        for name, item in counts.items()
    } == expected
    assert np.isfinite(recording.samples.spool).sum() == 5381
    assert np.isfinite(recording.samples.command).sum() == 5370


@pytest.mark.filterwarnings("default")  # asammdf's own
@pytest.mark.parametrize("suffix", [".blf", ".asc", ".csv", ".trc", ".mf4", ".log"])
def test_one_recording_in_every_format(tmp_path, encoder, suffix):
    if suffix == ".mf4":
        pytest.importorskip("asammdf", reason="MF4 needs the extra ehadiag[mf4]")
    truth = make_truth(400)
    frames = play(encoder, truth)
    path = write(tmp_path / f"log{suffix}", frames)
    recording = read_recording(path)
    assert_truthful(recording.samples, truth)
    assert np.isfinite(recording.samples.spool).all()
    assembler = Assembler("live")
    assembler.extend(frames)
    live = assembler.recording()
    same_samples(live.samples, recording.samples)
    assert live.quality == recording.quality
    assert (live.test_id, live.serial, live.outcome, live.environment) == (
        recording.test_id,
        recording.serial,
        recording.outcome,
        recording.environment,
    )
    if suffix != ".trc":
        error = np.abs(recording.samples.host_ns - live.samples.host_ns).max()
        assert error < 1_000_000


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_blf_agrees_with_python_can(tmp_path, data):
    kinds = st.sampled_from(["data"] * 6 + ["extended", "remote", "error", "fd", "sent"])
    frames = []
    for index, kind in enumerate(data.draw(st.lists(kinds, min_size=1, max_size=80))):
        frame = Frame(START + index * 1_000_003, 0x123 + index, bytes(range(index % 9)))
        if kind == "extended":
            frame = replace(frame, extended=True, can_id=0x18FF0000 + index)
        elif kind == "remote":
            frame = replace(frame, remote=True, data=b"")
        elif kind == "error":
            frame = replace(frame, error=True, can_id=0, data=b"")
        elif kind == "fd":
            frame = replace(frame, fd=True, data=bytes(range(48)))
        elif kind == "sent":
            frame = replace(frame, sent=True)
        frames.append(frame)
    path = write(tmp_path / "any.blf", frames)
    table = read_frames(path)
    with can.BLFReader(str(path)) as reader:
        oracle = list(reader)
    assert len(table) == len(oracle) == len(frames)
    for row, (message, frame) in enumerate(zip(oracle, frames, strict=True)):
        assert table.error[row] == message.is_error_frame == frame.error
        assert abs(int(table.time_ns[row]) - round(message.timestamp * 1e9)) < 1000
        assert abs(int(table.time_ns[row]) - frame.time_ns) < 1000
        if message.is_error_frame:
            continue
        size = int(table.length[row])
        assert table.data[row, :size].tobytes() == bytes(message.data) == frame.data
        assert table.can_id[row] == message.arbitration_id
        assert table.extended[row] == message.is_extended_id
        assert table.remote[row] == message.is_remote_frame
        assert table.fd[row] == message.is_fd
        assert table.sent[row] == (not message.is_rx)
        assert not table.data[row, size:].any()


def test_blf_over_many_containers(tmp_path):
    frames = [Frame(START + i * 500_000, i % 2048, i.to_bytes(4, "big")) for i in range(60_000)]
    table = read_frames(write(tmp_path / "long.blf", frames))
    assert len(table) == 60_000
    assert table.can_id.tolist() == [frame.can_id for frame in frames]
    assert table.data[:, :4].view(">u4").reshape(-1).tolist() == list(range(60_000))


@pytest.mark.parametrize("share", [0.999, 0.5, 0.3])
@pytest.mark.parametrize("name", ["paper-open-1.blf", "hot-worn-closed.asc"])
def test_log_cut_off_is_read_up_to_the_cut(tmp_path, name, share):
    whole = (LOGS / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(whole[: int(len(whole) * share)])
    recording, full = read_recording(path), read_recording(LOGS / name)
    assert 0.8 * share * 5500 < recording.samples.ticks <= 5500
    some = slice(0, recording.samples.ticks - 3)
    np.testing.assert_array_equal(recording.samples.spool[some], full.samples.spool[some])
    if name.endswith(".blf"):
        assert any("breaks off" in note for note in recording.quality.notes)
    if share < 0.99:
        assert recording.outcome.state is BitState.RUNNING


def test_damaged_container_keeps_what_is_before_it(tmp_path):
    whole = bytearray((LOGS / "paper-open-1.blf").read_bytes())
    whole[len(whole) // 2 : len(whole) // 2 + 50] = b"\xff" * 50
    path = tmp_path / "damaged.blf"
    path.write_bytes(bytes(whole))
    recording = read_recording(path)
    assert 500 < recording.samples.ticks <= 5500
    assert any("damaged" in note for note in recording.quality.notes)


ASC_RELATIVE = """date Sat Nov 21 01:48:15.189 2026
base hex  timestamps relative
internal events logged
Begin Triggerblock Tue Nov 14 22:13:20.0 2023
 0.000000 Start of measurement
 0.250000 1  110             Rx   d 2 01 02
 0.500000 // nothing of ours
 0.001000 1  111             Rx   d 1 FF
"""


def test_relative_asc_stamps_add_up(tmp_path):
    path = tmp_path / "relative.asc"
    path.write_text(ASC_RELATIVE)
    table = read_frames(path)
    assert np.diff(table.time_ns).tolist() == pytest.approx([501_000_000], abs=500)
    path.write_text(ASC_RELATIVE.replace("relative", "absolute"))
    assert np.diff(read_frames(path).time_ns).tolist() == pytest.approx([-249_000_000], abs=500)


def test_asc_with_a_date_of_another_language_starts_at_zero(tmp_path):
    path = tmp_path / "foreign.asc"
    path.write_text(ASC_RELATIVE.replace("Tue Nov 14", "mar sept 14"))
    assert read_frames(path).time_ns[0] == 250_000_000


def one_line(error: pytest.ExceptionInfo) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("name", ["none.blf", "none.asc", "none/deep.csv"])
def test_missing_file(tmp_path, name):
    with pytest.raises(InputOutputError, match="no such file") as error:
        read_recording(tmp_path / name)
    assert name in one_line(error)


@pytest.mark.parametrize("name", ["log.txt", "log", "log.txt.gz", "log.gz"])
def test_unknown_suffix(tmp_path, name):
    (tmp_path / name).write_text("x")
    with pytest.raises(ConfigurationError, match="unknown kind") as error:
        read_recording(tmp_path / name)
    assert ".blf" in one_line(error)


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".csv", ".trc", ".log", ".blf.gz", ".log.gz"])
@pytest.mark.parametrize("content", [b"", b"hello, world\n", b"\0" * 300, b"LOGG", b"\xff\xfe"])
def test_not_a_log(tmp_path, suffix, content):
    path = tmp_path / f"text{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputOutputError, match=f"text{suffix}") as error:
        read_recording(path)
    one_line(error)


def test_text_named_blf_says_so(tmp_path):
    path = tmp_path / "text.blf"
    path.write_text("time,value\n" * 100)
    with pytest.raises(InputOutputError, match="not a BLF file"):
        read_recording(path)


def test_folder_is_not_a_log(tmp_path):
    (tmp_path / "folder.blf").mkdir()
    with pytest.raises(InputOutputError, match="not a file"):
        read_recording(tmp_path / "folder.blf")


def test_log_without_telemetry(tmp_path):
    path = write(tmp_path / "other.blf", [Frame(START + i, 0x333, b"abc") for i in range(50)])
    recording = read_recording(path)
    assert recording.samples is None
    assert recording.quality.foreign == 50
    assert recording.source == str(path)
    assert "no telemetry in the recording" in recording.quality.notes


def test_last_complete_test_is_the_default(tmp_path, encoder):
    first, second = make_truth(300, 1), make_truth(300, 2)
    frames = play(encoder, first, idle_after=20)
    frames += play(encoder, second, start_ns=START + 10**9, idle_before=20, end=BitState.ABORTED)
    path = write(tmp_path / "two.blf", frames)
    one, two = read_recordings(path)
    assert (one.outcome.state, two.outcome.state) == (BitState.COMPLETE, BitState.ABORTED)
    assert_truthful(read_recording(path).samples, first)


def test_assembler_forgets_the_oldest(encoder):
    frames = play(encoder, make_truth(400))
    assembler = Assembler("live", max_frames=500)
    assembler.extend(frames)
    assert 250 <= len(assembler) <= 500
    kept = assembler.table()
    tail = FrameTable.from_frames(frames[-len(kept) :])
    np.testing.assert_array_equal(kept.data, tail.data)
    np.testing.assert_array_equal(kept.time_ns, tail.time_ns)
    assert any("too old to keep" in note for note in assembler.recording().quality.notes)


BLF_SEED = (LOGS / "paper-open-1.blf").read_bytes()[:6000]
ASC_SEED = (LOGS / "hot-worn-closed.asc").read_bytes()[:1500]
CANDUMP_SEED = b"(1700000000.000001) can0 110#0102030405060708\n(1.5) can0 00000111##1FF R\n" * 9
PACKED_SEED = gzip.compress(CANDUMP_SEED)


@settings(max_examples=150, suppress_health_check=list(HealthCheck))
@given(st.data(), st.sampled_from([".blf", ".asc", ".csv", ".trc", ".log", ".log.gz"]))
def test_no_bytes_crash_the_reader(tmp_path, data, suffix):
    seed = {".blf": BLF_SEED, ".log": CANDUMP_SEED, ".log.gz": PACKED_SEED}.get(suffix, ASC_SEED)
    content = bytearray(data.draw(st.sampled_from([b"", seed])))
    for _ in range(data.draw(st.integers(0, 6))):
        at = data.draw(st.integers(0, len(content)))
        content[at : at + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    path = tmp_path / f"fuzz{suffix}"
    path.write_bytes(bytes(content))
    with contextlib.suppress(EhadiagError):
        recording = read_recording(path)
        assert recording.quality.total("accepted") <= recording.quality.total("received")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_cut_mf4_file_is_told_in_one_line(share, tmp_path, monkeypatch):
    """Its library's destructor fails after its constructor; nobody is to hear of that."""
    pytest.importorskip("asammdf", reason="MF4 needs the extra ehadiag[mf4]")
    path = write(
        tmp_path / "cut.mf4", [Frame(START + k * 1_000_000, k, bytes(8)) for k in range(50)]
    )
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    heard = []
    monkeypatch.setattr(sys, "unraisablehook", heard.append)
    with pytest.raises(InputOutputError, match=r"cut\.mf4: not a readable MF4 log") as error:
        read_frames(path)
    assert one_line(error)
    gc.collect()
    # That the library leaves its file to the collector is a warning of development only.
    assert [item for item in heard if item.exc_type is not ResourceWarning] == []
