"""Any mix of harness faults: no sample is invented or moved, and the counts add up."""

from __future__ import annotations

import numpy as np
from bus_synth import (
    COMMAND,
    ENVIRONMENT,
    REQUEST,
    START,
    STATUS,
    TELEMETRY,
    TICK,
    Truth,
    assert_truthful,
    flip,
    make_truth,
    play,
    recordings,
    tick_of,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.protection import crc8
from firmware_iface.recording import BitState
from firmware_iface.transport.frames import Frame, FrameTable

TICKS = 700
MAP = default_map()
TRUTH = make_truth(TICKS, 9)
CLEAN = play(Encoder(MAP), TRUTH, idle_before=30, idle_after=30)
SETTINGS = settings(max_examples=60, suppress_health_check=list(HealthCheck))


PLANS = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**32),
        "loss": st.sampled_from([0.0, 0.01, 0.1, 0.2]),
        "repeat": st.sampled_from([0.0, 0.02]),
        "wrong": st.sampled_from([0.0, 0.005, 0.05]),
        "noise": st.sampled_from([0.0, 0.5]),
        "bursts": st.lists(st.tuples(st.integers(40, 600), st.integers(1, 400)), max_size=2),
        "swaps": st.integers(0, 5),
    }
)


def damage(plan):
    """The clean recording with faults done to it: loss, bursts, repeats, flips, noise, swaps."""
    rng = np.random.default_rng(plan["seed"])
    frames = []
    for frame in CLEAN:
        tick = tick_of(frame)
        in_burst = any(at <= tick < at + length for at, length in plan["bursts"])
        if in_burst or rng.random() < plan["loss"]:
            continue
        bad = rng.random() < plan["wrong"]
        frames.append(flip(frame, int(rng.integers(64))) if bad else frame)
        if rng.random() < plan["repeat"]:
            frames.append(frames[-1])
        if rng.random() < plan["noise"]:
            number = int(rng.integers(0x300, 0x7FF))
            frames.append(Frame(frame.time_ns, number, rng.bytes(int(rng.integers(9)))))
    for place in rng.integers(0, len(frames) - 3, plan["swaps"]).tolist():
        frames[place : place + 3] = frames[place : place + 3][::-1]
    return frames


@SETTINGS
@given(PLANS)
def test_what_is_there_is_true(plan):
    frames = damage(plan)
    found = recordings(frames, MAP)
    assert len(found) == 1
    (recording,) = found
    ticks = recording.samples.ticks
    if recording.outcome.state is BitState.COMPLETE:
        assert ticks == TICKS
    else:
        assert ticks <= TICKS  # the end was lost and nothing else tells it
    assert_truthful(recording.samples, Truth(TRUTH.codes[:ticks], TRUTH.command[:ticks]))
    counts = recording.quality.messages["ServoTelemetry"]
    assert counts.accepted == np.isfinite(recording.samples.spool).sum()
    assert counts.received >= counts.accepted + counts.crc_errors
    assert counts.accepted + counts.lost + counts.crc_errors >= ticks


def sealed(can_id, body):
    return body + bytes((crc8(bytes((can_id & 0xFF, can_id >> 8)) + body),))


MAPPED = st.sampled_from([TELEMETRY, COMMAND, ENVIRONMENT, REQUEST, STATUS])
TIMES = st.integers(-(2**40), 2**40).map(lambda t: START + t)


@st.composite
def strange_frames(draw):
    """Frames that pass every check and mean nothing together."""
    rows = draw(st.lists(st.tuples(MAPPED, st.binary(min_size=7, max_size=7)), max_size=60))
    anywhere = draw(st.booleans())
    frames = []
    for index, (can_id, body) in enumerate(rows):
        time = draw(TIMES) if anywhere else START + index * TICK // 2
        frames.append(Frame(time, can_id, sealed(can_id, body)))
    return frames


@settings(max_examples=300, suppress_health_check=list(HealthCheck))
@given(strange_frames())
def test_no_frames_crash_the_assembly(frames):
    for recording in recordings(frames, MAP):
        for item in recording.quality.messages.values():
            assert 0 <= item.accepted <= item.received
            assert item.lost >= 0
        if recording.samples is not None:
            assert recording.samples.ticks <= 1_000_000
            assert len(recording.samples.host_ns) == recording.samples.ticks


@settings(max_examples=100)
@given(
    st.lists(
        st.builds(
            Frame,
            st.integers(-(2**62), 2**62),
            st.integers(0, 0x7FF),
            st.binary(max_size=64),
            error=st.booleans(),
            remote=st.booleans(),
        ),
        max_size=30,
    )
)
def test_any_frames_at_any_time(frames):
    assert len(recordings(frames, MAP)) >= 1


def test_fault_free_harness_is_whole():
    (recording,) = recordings(CLEAN, MAP)
    assert_truthful(recording.samples, TRUTH)
    assert np.isfinite(recording.samples.spool).all()
    moved = [replace(frame, time_ns=frame.time_ns + 3) for frame in CLEAN]
    assert len(FrameTable.from_frames(moved)) == len(CLEAN)
