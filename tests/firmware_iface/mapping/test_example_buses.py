"""The example mappings of the documentation, fed by cantools."""

from __future__ import annotations

import math

import cantools.database
import numpy as np
import pytest
from bus_synth import START, TICK, assert_truthful, flip, make_truth
from places import ROOT

from ehadiag import CommandMode
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import load_map
from firmware_iface.codec import Encoder
from firmware_iface.live_decode import LiveDecoder, Sample
from firmware_iface.recording import BitState
from firmware_iface.transport.frames import Frame, FrameTable

FOLDER = ROOT / "docs" / "examples" / "buses"
TICKS = 800


class Rig:
    """Encodes physical values by the DBC alone; knows nothing of the mapping."""

    def __init__(self, name):
        self.dbc = cantools.database.load_file(FOLDER / f"{name}.dbc")
        self.map = load_map(FOLDER / f"{name}.toml")

    def frame(self, name, time_ns, **signals):
        message = self.dbc.get_message_by_name(name)
        values = {item.name: 0 for item in message.signals} | signals
        if message.is_multiplexed():
            values = signals
        data = message.encode(values, strict=False)
        return Frame(time_ns, message.frame_id, data, extended=message.is_extended_frame)

    def one(self, frames):
        frames = sorted(frames, key=lambda frame: frame.time_ns)
        (recording,) = assemble(FrameTable.from_frames(frames), self.map, "example")
        return recording


def arinc825(rig, truth, jitter):
    current, spool, pressure, position = (truth.channel(i) for i in range(4))
    frames = [rig.frame("TestState", START - 5 * TICK, Phase=0)]
    for tick in range(TICKS):
        now = START + tick * TICK
        if tick % 50 == 0:
            frames.append(rig.frame("TestState", now, Phase=16, TestNumber=2, TestTime=tick * 1e-3))
            frames.append(rig.frame("Hydraulics", now, SystemPressure=207.0, OilTemp=313.15))
        frames.append(
            rig.frame(
                "ActuatorFast",
                now + 500_000 + jitter(),
                JackStroke=-position[tick] * 1e3,
                CoilCurrent=current[tick] * 1e3,
                CommandedStroke=-truth.command[tick] * 1e3,
            )
        )
        if tick % 2 == 0:
            frames.append(
                rig.frame(
                    "ActuatorSlow",
                    now + 700_000 + jitter(),
                    LoadPressure=pressure[tick] * 1e-5,
                    SpoolStroke=spool[tick] * 1e6,
                )
            )
    end = START + TICKS * TICK
    frames.append(rig.frame("TestState", end, Phase=32, TestNumber=2, TestTime=TICKS * 1e-3))
    return frames


def assert_near(samples, truth, slow, ticks):
    tolerance = {"current": 0.3e-6, "spool": 11e-9, "pressure": 501.0, "position": 1.1e-6}
    for index, key in enumerate(("current", "spool", "pressure", "position")):
        got = getattr(samples, key)
        here = np.isfinite(got)
        expected = ticks[ticks % 2 == 0] if key in slow else ticks
        assert np.flatnonzero(here).tolist() == expected.tolist(), key
        np.testing.assert_allclose(
            got[here], truth.channel(index)[here], rtol=0, atol=tolerance[key]
        )


def test_arinc825_two_rates_no_counter():
    rig, truth = Rig("arinc825"), make_truth(TICKS)
    recording = rig.one(arinc825(rig, truth, lambda: 0))
    samples = recording.samples
    assert samples.ticks == TICKS
    assert samples.mode is CommandMode.POSITION
    assert_near(samples, truth, ("spool", "pressure"), np.arange(TICKS))
    np.testing.assert_allclose(samples.command, truth.command, rtol=0, atol=1.1e-6)
    assert recording.outcome.state is BitState.COMPLETE
    assert recording.test_id == 2
    assert recording.serial is None
    assert recording.environment.supply_pressure == pytest.approx(20.7e6)
    assert recording.environment.return_pressure is None
    assert recording.environment.oil_temperature == pytest.approx(40.0, abs=0.06)
    notes = " ".join(recording.quality.notes)
    assert "ActuatorFast: no counter" in notes
    assert "ActuatorSlow: no counter" in notes
    assert "ActuatorFast: no check sum" in notes
    assert recording.quality.total("lost") == 0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_arinc825_jitter_and_loss_leave_holes_not_shifts(seed):
    rig, truth = Rig("arinc825"), make_truth(TICKS)
    rng = np.random.default_rng(seed)
    frames = arinc825(rig, truth, lambda: int(rng.normal(0, 40_000)))
    lost = set(rng.choice(np.arange(10, TICKS - 10), 40, replace=False).tolist())
    kept = [
        frame
        for frame in frames
        if not (frame.can_id & 0xFF < 0x20 and (frame.time_ns - START) // TICK in lost)
    ]
    recording = rig.one(kept)
    ticks = np.array([tick for tick in range(TICKS) if tick not in lost])
    assert_near(recording.samples, truth, ("spool", "pressure"), ticks)
    assert recording.quality.messages["ActuatorFast"].lost == 40


def test_arinc825_late_burst_goes_back_to_its_ticks():
    rig, truth = Rig("arinc825"), make_truth(TICKS)
    frames = arinc825(rig, truth, lambda: 0)
    release = START + 312 * TICK + 100_000
    late = [
        Frame(
            release + i if START + 300 * TICK < f.time_ns < release else f.time_ns,
            f.can_id,
            f.data,
            f.extended,
        )
        for i, f in enumerate(sorted(frames, key=lambda f: f.time_ns))
    ]
    assert_near(rig.one(late).samples, truth, ("spool", "pressure"), np.arange(TICKS))


def canaerospace(rig, truth, start_code=250):
    values = [truth.channel(i) for i in range(4)]
    frames = []
    for tick in range(TICKS):
        now, code = START + tick * TICK, (start_code + tick) % 256
        if tick % 50 == 0:
            frames.append(
                rig.frame(
                    "TestState",
                    now,
                    StateCode=tick // 50,
                    StateNumber=2,
                    StateTest=1,
                    StateElapsed=tick,
                )
            )
        frames += [
            rig.frame("CurrentCommand", now + 300_000, CommandCode=code,
                      CommandValue=truth.command[tick]),
            rig.frame("ServoCurrent", now + 500_000, CurrentCode=code,
                      CurrentValue=values[0][tick]),
            rig.frame("SpoolPosition", now + 600_000, SpoolCode=(code + 7) % 256,
                      SpoolValue=values[1][tick]),
            rig.frame("LoadPressure", now + 700_000, PressureCode=code,
                      PressureValue=values[2][tick] * 1e-2),
            rig.frame("JackPosition", now + 800_000, JackCode=(code + 99) % 256,
                      JackValue=values[3][tick]),
        ]  # fmt: skip
    end = START + TICKS * TICK
    frames.append(
        rig.frame("TestState", end, StateCode=TICKS // 50, StateNumber=3, StateTest=1,
                  StateElapsed=TICKS)
    )  # fmt: skip
    return frames


def assert_single_precision(samples, truth):
    for index, key in enumerate(("current", "spool", "pressure", "position")):
        got = getattr(samples, key)
        here = np.isfinite(got)
        np.testing.assert_allclose(got[here], truth.channel(index)[here], rtol=1e-6, atol=1e-9)
    here = np.isfinite(samples.command)
    np.testing.assert_allclose(samples.command[here], truth.command[here], rtol=1e-6)


def test_canaerospace_counters_of_their_own():
    rig, truth = Rig("canaerospace"), make_truth(TICKS)
    recording = rig.one(canaerospace(rig, truth))
    assert recording.samples.ticks == TICKS
    assert_single_precision(recording.samples, truth)
    assert np.isfinite(recording.samples.pressure).all()
    assert recording.quality.total("lost") == 0
    assert (recording.outcome.state, recording.test_id) == (BitState.COMPLETE, 1)
    assert recording.samples.mode is CommandMode.CURRENT


@pytest.mark.parametrize("seed", [1, 2])
def test_canaerospace_loss_and_heavy_jitter(seed):
    rig, truth = Rig("canaerospace"), make_truth(TICKS)
    rng = np.random.default_rng(seed)
    kept = [f for f in canaerospace(rig, truth) if rng.random() > 0.05]
    late = np.maximum.accumulate([f.time_ns + int(rng.exponential(300_000)) for f in kept])
    moved = [Frame(int(t), f.can_id, f.data) for t, f in zip(late, kept, strict=True)]
    recording = rig.one(moved)
    assert recording.samples.ticks == TICKS
    assert_single_precision(recording.samples, truth)
    for key, can_id in (("current", 1500), ("spool", 1501), ("pressure", 1502), ("position", 1503)):
        arrived = sum(f.can_id == can_id for f in kept)
        assert np.isfinite(getattr(recording.samples, key)).sum() == arrived


@pytest.mark.parametrize("bits", [0x7FC00000, 0x7F800000, 0xFF800000, 0x7FA00000, 0x3F800000])
def test_float_that_is_no_number_or_out_of_range_is_left_out(bits):
    rig, truth = Rig("canaerospace"), make_truth(TICKS)
    frames = canaerospace(rig, truth)
    place = [i for i, f in enumerate(frames) if f.can_id == 1501][100]
    data = frames[place].data[:4] + bits.to_bytes(4, "big")
    frames[place] = Frame(frames[place].time_ns, 1501, data)
    recording = rig.one(frames)
    assert np.flatnonzero(np.isnan(recording.samples.spool)).tolist() == [100]
    assert recording.quality.messages["SpoolPosition"].range_errors == 1


def test_a_live_message_tells_which_channels_it_brings():
    rig, truth = Rig("canaerospace"), make_truth(TICKS)
    decoder = LiveDecoder(rig.map)
    brought = {1500: "current", 1501: "spool", 1502: "pressure", 1503: "position"}
    samples = [(f.can_id, decoder.decode(f)) for f in canaerospace(rig, truth)[:100]]
    heard = [(i, item) for i, item in samples if isinstance(item, Sample)]
    assert {i for i, _ in heard} == set(brought)
    assert all(item.brought == {brought[i]} for i, item in heard)
    assert math.isnan(heard[0][1].position)  # not yet known, and not brought
    assert math.isfinite(heard[-1][1].position)


def multiplexed(rig, truth, start_counter=200):
    encoder = Encoder(rig.map)
    frames = []
    for tick in range(TICKS):
        now, count = START + tick * TICK, start_counter + tick
        frames += encoder.command(CommandMode.CURRENT, truth.command[tick], 3, now, count)
        first, second = encoder.telemetry(truth.codes[tick], now + 400_000, count)
        frames += [first, Frame(now + 500_000, second.can_id, second.data)]
    return frames


def test_multiplexed_pages_share_a_tick():
    rig, truth = Rig("multiplexed"), make_truth(TICKS)
    frames = multiplexed(rig, truth)
    recording = rig.one(frames)
    assert_truthful(recording.samples, truth)
    assert np.isfinite(recording.samples.pressure).all()
    counts = recording.quality.messages["Servo"]
    assert (counts.accepted, counts.lost, counts.repeated) == (2 * TICKS, 0, 0)
    assert recording.test_id == 3
    page = rig.dbc.decode_message(frames[2].can_id, frames[2].data)
    assert page["Page"] == 1
    assert page["Jack"] == pytest.approx(truth.channel(3)[0] * 1e3)


def test_multiplexed_one_page_lost():
    rig, truth = Rig("multiplexed"), make_truth(TICKS)
    frames = multiplexed(rig, truth)
    assert frames[3 * 100 + 2].data[0] & 15 == 1
    frames[3 * 120 + 1] = flip(frames[3 * 120 + 1], 3)
    del frames[3 * 100 + 2]
    recording = rig.one(frames)
    assert_truthful(recording.samples, truth)
    assert np.flatnonzero(np.isnan(recording.samples.position)).tolist() == [100]
    assert np.flatnonzero(np.isnan(recording.samples.spool)).tolist() == [120]
    counts = recording.quality.messages["Servo"]
    assert (counts.lost, counts.crc_errors) == (1, 1)
