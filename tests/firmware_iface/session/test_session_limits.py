"""Watched limits: when a value or a silence ends a test, and the wording.

The report of check-bus.
"""

from __future__ import annotations

import math

import pytest
from bus_synth import COMMAND, START, TELEMETRY, TICK, flip, make_truth, play, tick_of
from msgspec.structs import replace

from ehadiag.core.criteria import RECORDING
from firmware_iface.bus_report import render_bus_report, report_bus
from firmware_iface.handshake import ChannelLimits, ChannelWatch
from firmware_iface.live_decode import Sample
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import MAX_SAMPLE_GAP_S
from firmware_iface.transport.frames import Frame, FrameTable

MS = 1_000_000
BEGIN = 1_700_000_000_000_000_000
ALL = ChannelLimits(position=0.025, pressure=20e6, current=10e-3)
SILENCE = 0.25
LOST = "telemetry lost: no {} for 0.25 s, and its limit is watched"


def sample(*brought, current=0.0, spool=0.0, pressure=0.0, position=0.0):
    """Everything is brought unless told."""
    values = (current, spool, pressure, position)
    return Sample(*values, frozenset(brought)) if brought else Sample(*values)


@pytest.fixture
def watching():
    def make(limits=ALL):
        watch = ChannelWatch(limits, SILENCE)
        watch.begin(BEGIN)
        return watch

    return make


def answers(watch, *samples, now=BEGIN):
    return [watch.on_sample(now, item) for item in samples]


def test_only_channels_with_a_limit_are_watched():
    assert list(ChannelLimits().watched()) == []
    assert dict(ALL.watched()) == {"position": 0.025, "pressure": 20e6, "current": 10e-3}
    assert list(ChannelLimits(pressure=1.0).watched()) == [("pressure", 1.0)]


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"position": -0.02534}, "position -25.34 mm beyond its limit ±25 mm"),
        ({"pressure": 20.5e6}, "pressure 20.5 MPa beyond its limit ±20 MPa"),
        ({"current": 12.3456e-3}, "current 12.35 mA beyond its limit ±10 mA"),
    ],
)
def test_the_third_sample_in_a_row_ends_the_test(watching, values, why):
    beyond = sample(**values)
    assert answers(watching(), beyond, beyond, beyond, beyond) == ["", "", why, why]
    assert answers(watching(), beyond, beyond, sample(), beyond, beyond, beyond)[-2:] == ["", why]


def test_digits_of_a_limit_are_said_as_far_as_they_count(watching):
    watch = watching(ChannelLimits(position=0.0123456, samples=1))
    (why,) = answers(watch, sample(position=0.1))
    assert why == "position 100 mm beyond its limit ±12.35 mm"


def test_how_many_samples_may_be_told(watching):
    beyond = sample(current=-0.011)
    assert answers(watching(ChannelLimits(current=0.01, samples=1)), beyond) != [""]
    five = ChannelLimits(current=0.01, samples=5)
    assert [bool(why) for why in answers(watching(five), *[beyond] * 6)] == [False] * 4 + [True] * 2


def test_the_limit_itself_is_not_beyond(watching):
    edge = sample(position=0.025, pressure=-20e6, current=10e-3)
    assert answers(watching(), *[edge] * 5) == [""] * 5


def test_each_channel_has_its_own_count(watching):
    mixed = [sample(position=1.0), sample(position=1.0), sample(pressure=1e9), sample(current=1.0)]
    assert answers(watching(), *mixed) == [""] * 4
    both = sample(pressure=1e9, current=1.0)
    assert answers(watching(), both, both, both)[-1].startswith("pressure ")


@pytest.mark.parametrize("other", [sample("spool", position=1.0), sample(position=math.nan)])
def test_what_brings_no_value_neither_counts_nor_ends_the_count(watching, other):
    beyond = sample("position", position=1.0)
    got = answers(watching(), beyond, other, other, other, beyond, other, beyond)
    assert [bool(why) for why in got] == [False] * 6 + [True]


def test_a_channel_after_one_that_brings_nothing_is_watched_too(watching):
    """The first of the watched channels is missing, the last is beyond."""
    beyond = sample("current", current=1.0)
    assert answers(watching(), beyond, beyond, beyond)[-1].startswith("current ")


def test_spool_has_no_limit(watching):
    assert answers(watching(), *[sample(spool=1.0)] * 5) == [""] * 5


def test_silence_counts_from_the_begin_of_the_test(watching):
    watch = watching()
    assert watch.on_time(BEGIN + 250 * MS - 1) == ""
    assert watch.on_time(BEGIN + 250 * MS) == LOST.format("position")


def test_each_channel_must_keep_coming(watching):
    watch = watching()
    answers(watch, sample(), now=BEGIN + 100 * MS)
    answers(watch, sample("position", "current"), now=BEGIN + 300 * MS)
    assert watch.on_time(BEGIN + 350 * MS - 1) == ""
    assert watch.on_time(BEGIN + 350 * MS) == LOST.format("pressure")
    answers(watch, sample("pressure", pressure=math.nan), now=BEGIN + 340 * MS)
    assert watch.on_time(BEGIN + 350 * MS) == LOST.format("pressure")
    answers(watch, sample("pressure"), now=BEGIN + 340 * MS)
    assert watch.on_time(BEGIN + 549 * MS) == ""
    assert watch.on_time(BEGIN + 550 * MS) == LOST.format("position")


def test_a_sample_beyond_its_limit_is_heard_as_well(watching):
    watch = watching()
    answers(watch, sample(position=1.0), now=BEGIN + 200 * MS)
    assert watch.on_time(BEGIN + 449 * MS) == ""


def test_a_time_in_which_nobody_listened_is_no_silence(watching):
    watch = watching()
    answers(watch, sample("position"), now=BEGIN + 100 * MS)
    watch.excuse(1000 * MS)
    assert watch.on_time(BEGIN + 1249 * MS) == ""
    assert watch.on_time(BEGIN + 1250 * MS) == LOST.format("pressure")
    answers(watch, sample("pressure", "current"), now=BEGIN + 1240 * MS)
    assert watch.on_time(BEGIN + 1349 * MS) == ""
    assert watch.on_time(BEGIN + 1350 * MS) == LOST.format("position")


def test_what_nobody_watches_may_be_silent(watching):
    assert watching(ChannelLimits()).on_time(BEGIN + 10**12) == ""


def test_the_next_test_begins_anew(watching):
    watch = watching()
    beyond = sample(position=1.0)
    answers(watch, beyond, beyond)
    watch.begin(BEGIN + 1000 * MS)
    assert watch.on_time(BEGIN + 1249 * MS) == ""
    assert answers(watch, beyond, beyond, now=BEGIN + 1240 * MS) == ["", ""]


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
    text = render_bus_report(report)
    assert "everything that a diagnosis needs is there" in text
    assert "0.130 ms" in text
    assert max(map(len, text.splitlines())) <= 80


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
    assert "not mapped: 0x7f0 (3)" in render_bus_report(report)


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
    assert remark in render_bus_report(report).splitlines()
    short = [f for f in frames if not 200 <= tick_of(f) < 449]
    assert report_bus(FrameTable.from_frames(short), bus_map).remarks == ()


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
    assert "the bus is silent" in render_bus_report(report)


def test_the_longest_gap_of_samples_is_that_of_the_diagnosis():
    assert RECORDING.max_sample_gap_s == MAX_SAMPLE_GAP_S
