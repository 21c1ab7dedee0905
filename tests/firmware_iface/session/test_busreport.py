"""The report of check-bus."""

from __future__ import annotations

from dataclasses import replace

import pytest
from bus_synth import COMMAND, START, TELEMETRY, TICK, flip, make_truth, play, tick_of

from ehadiag.assess import acceptance
from firmware_iface.logs.reader import read_frames
from firmware_iface.session.bus_report import LONGEST_GAP_S, render, report_bus
from firmware_iface.transport.frames import Frame, FrameTable


def by_name(report):
    return {item.name: item for item in report.messages}


def test_reference_recording(bus_map, logs):
    report = report_bus(read_frames(logs / "paper-open-1.blf"), bus_map)
    messages = by_name(report)
    assert report.frames == 11331
    assert report.duration == pytest.approx(5.4997, abs=1e-3)
    assert messages["ServoTelemetry"].rate == pytest.approx(1000.0, rel=1e-3)
    assert messages["Environment"].rate == pytest.approx(10.0, rel=1e-2)
    assert messages["ServoTelemetry"].lost == 0
    assert messages["ServoTelemetry"].longest_pause < 1.2e-3
    assert messages["ServoTelemetry"].roles == (
        "channels.current",
        "channels.spool",
        "channels.pressure",
        "channels.position",
    )
    assert messages["BitRequest"].received == 0
    assert report.delay == pytest.approx(0.13e-3, abs=2e-6)
    assert report.problems == ()
    assert [use.channel for use in report.ranges] == ["current", "spool", "pressure", "position"]
    current = report.ranges[0]
    assert current.codes == 4096
    assert 300 < current.lowest_code < 400
    assert current.highest == pytest.approx((current.highest_code - 2048) * 24e-3 / 4096)
    text = render(report)
    assert "everything that a diagnosis needs is there" in text
    assert "0.130 ms" in text
    assert max(map(len, text.splitlines())) <= 100


def test_lossy_recording(bus_map, logs):
    report = report_bus(read_frames(logs / "lossy-open.blf"), bus_map)
    messages = by_name(report)
    assert (messages["ServoTelemetry"].lost, messages["ServoTelemetry"].crc_errors) == (99, 20)
    assert "ServoTelemetry: 99 frames lost" in report.problems


def test_what_is_missing(encoder, bus_map):
    frames = [f for f in play(encoder, make_truth(200)) if f.can_id != COMMAND]
    frames += [Frame(START + 300 * TICK, 0x7F0, b"")] * 3
    frames += [Frame(START + 300 * TICK, 0x18FF0001, b"", extended=True)]
    frames += [Frame(START + 300 * TICK, 0, b"", error=True)]
    report = report_bus(FrameTable.from_frames(frames), bus_map)
    assert len(report.problems) == 1
    assert report.problems[0].startswith("ServoCommand (0x111) does not come: command.current")
    assert report.foreign == ((0x7F0, False, 3), (0x18FF0001, True, 1))
    assert report.errors == 1
    assert report.delay is None
    assert "not mapped: 0x7f0 (3)" in render(report)


def test_wrong_dbc_is_guessed(encoder, bus_map):
    frames = [flip(f, 3) if f.can_id == TELEMETRY else f for f in play(encoder, make_truth(200))]
    report = report_bus(FrameTable.from_frames(frames), bus_map)
    assert "ServoTelemetry: every frame has a wrong check sum" in report.problems[0]
    assert report.ranges == ()


def test_gap_and_saturation(encoder, bus_map):
    truth = make_truth(200)
    truth.codes[50:53, 3] = 4095
    frames = [f for f in play(encoder, truth) if not 100 <= tick_of(f) < 130]
    report = report_bus(FrameTable.from_frames(frames), bus_map)
    assert by_name(report)["ServoTelemetry"].longest_pause == pytest.approx(31e-3)
    assert by_name(report)["ServoTelemetry"].lost == 30
    assert report.ranges[3].saturated == 3
    assert report.ranges[3].highest_code == 4095


def test_a_pause_in_which_the_counter_turns_is_told(encoder, bus_map):
    """256 ticks: the counter goes on as if nothing were missing."""
    frames = play(encoder, make_truth(600))
    paused = [f for f in frames if not 200 <= tick_of(f) < 456]
    report = report_bus(FrameTable.from_frames(paused), bus_map)
    assert by_name(report)["ServoTelemetry"].lost == 0
    (remark,) = report.remarks
    assert remark == ("ServoTelemetry: nothing for 0.257 s; within a test a diagnosis bears 0.25 s")
    assert remark in render(report).splitlines()
    short = [f for f in frames if not 200 <= tick_of(f) < 449]
    assert report_bus(FrameTable.from_frames(short), bus_map).remarks == ()


def test_the_pause_that_is_borne_is_the_diagnosis_own():
    assert LONGEST_GAP_S == acceptance.LONGEST_GAP_S


def test_a_mapping_without_a_command_is_told(encoder, bus_map):
    messages = {k: v for k, v in bus_map.messages.items() if k != "ServoCommand"}
    table = FrameTable.from_frames(play(encoder, make_truth(200)))
    report = report_bus(table, replace(bus_map, messages=messages))
    assert report.problems == ()
    assert report.remarks == (
        "no command is mapped: the measured current has to bear out that of a stored test",
    )


def test_silent_bus(bus_map):
    report = report_bus(FrameTable.from_frames([]), bus_map)
    assert report.problems == ("the bus is silent",)
    assert "the bus is silent" in render(report)
