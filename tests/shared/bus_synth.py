"""Synthetic tests on the default bus with known truth, and damage done to their frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from ehadiag import CommandMode
from firmware_iface.alignment.align import assemble
from firmware_iface.codec import Encoder
from firmware_iface.recording import CHANNELS, BitReason, BitState
from firmware_iface.transport.frames import Frame, FrameTable

TICK = 1_000_000
START = 1_700_000_000_000_000_000
TELEMETRY, COMMAND, ENVIRONMENT, REQUEST, STATUS = 0x110, 0x111, 0x120, 0x200, 0x201
KEYS = ("current", "spool", "pressure", "position")


@dataclass(frozen=True)
class Truth:
    codes: np.ndarray
    """Shape (ticks, 4)."""
    command: np.ndarray

    def channel(self, index: int) -> np.ndarray:
        return CHANNELS[index].decode(self.codes[:, index])


def make_truth(ticks: int, seed: int = 1) -> Truth:
    rng = np.random.default_rng(seed)
    walk = 2048 + np.cumsum(rng.integers(-3, 4, size=(ticks, 4)), axis=0)
    command = rng.integers(-20000, 20001, size=ticks) * 0.0005e-3
    return Truth(np.clip(walk, 1, 4094), command)


def play(
    encoder: Encoder,
    truth: Truth,
    *,
    start_ns: int = START,
    counter: int = 13,
    test_id: int = 1,
    idle_before: int = 0,
    idle_after: int = 0,
    status: bool = True,
    end: BitState = BitState.COMPLETE,
    serial: int = 77,
) -> list[Frame]:
    """Frames of idle ticks, a test, idle ticks, at the rates of BUS-4."""
    ticks = len(truth.codes)
    frames: list[Frame] = []
    for tick in range(-idle_before, ticks + idle_after):
        now = start_ns + (tick + idle_before) * TICK
        inside = 0 <= tick < ticks
        if status and tick == ticks:
            frames += encoder.status(end, BitReason.NONE, test_id, ticks * 1e-3, serial, now)
        elif status and tick % 20 == 0:
            state = BitState.RUNNING if inside else BitState.IDLE
            elapsed = tick * 1e-3 if inside else 0.0
            frames += encoder.status(state, 0, test_id if inside else 0, elapsed, serial, now)
        if tick % 100 == 0:
            frames += encoder.environment(20.7e6, 0.7e6, 40.0, now + 100_000)
        count = counter + tick + idle_before
        value = truth.command[tick] if inside else 0.0
        number = test_id if inside else 0
        frames += encoder.command(CommandMode.CURRENT, value, number, now + 400_000, count)
        codes = truth.codes[tick] if inside else (2048, 2048, 2048, 2048)
        frames += encoder.telemetry(codes, now + 530_000, count)
    if status and not idle_after:
        last = start_ns + (ticks + idle_before) * TICK
        frames += encoder.status(end, BitReason.NONE, test_id, ticks * 1e-3, serial, last)
    return frames


def recordings(frames, bus_map):
    return assemble(FrameTable.from_frames(frames), bus_map, "made up")


def one(frames, bus_map):
    (recording,) = recordings(frames, bus_map)
    return recording


def tick_of(frame: Frame, start_ns: int = START) -> int:
    return (frame.time_ns - start_ns) // TICK


def flip(frame: Frame, bit: int) -> Frame:
    data = bytearray(frame.data)
    data[bit // 8] ^= 1 << bit % 8
    return replace(frame, data=bytes(data))


def assert_truthful(samples, truth: Truth) -> None:
    """Every row that is there is the truth at its tick; nothing is invented."""
    assert samples.ticks == len(truth.codes)
    for index, key in enumerate(KEYS):
        got = getattr(samples, key)
        here = np.isfinite(got)
        close = 1e-6 * CHANNELS[index].lsb
        np.testing.assert_allclose(got[here], truth.channel(index)[here], rtol=0, atol=close)
    here = np.isfinite(samples.command)
    np.testing.assert_allclose(samples.command[here], truth.command[here], rtol=0, atol=1e-12)
