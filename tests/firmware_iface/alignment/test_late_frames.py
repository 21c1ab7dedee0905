"""Frames without a counter, stamped late: jitter, drift, batches, bursts, losses.

Two tests of different modes in one log of a bus without test numbers: both are found. A second
sender under the telemetry's identifier: never a verdict, always its name.
"""

from __future__ import annotations

import numpy as np
import pytest
from bus_synth import COMMAND, ENVIRONMENT, TELEMETRY, TICK, assert_truthful, make_truth, one, play
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import LOGS

from ehadiag import CommandMode, bundled_tests, default_actuator
from ehadiag_tools.rigs.replay import as_sent
from ehadiag_tools.rigs.rerecord import BUSES, Disturbance, frames_on, played
from firmware_iface.alignment.align import windowed_recordings
from firmware_iface.alignment.ticks import place_late, settle_gaps, spacing_of
from firmware_iface.codec import Encoder
from firmware_iface.find_test import CandidateTests
from firmware_iface.live_decode import DOUBTFUL_TICKS, LiveDecoder, LiveTicks
from firmware_iface.protection import SenderWatch, conflicting
from firmware_iface.signals.recordings import read_recording
from firmware_iface.transport.frames import concatenate

COUNT = 4000


def stamps(
    tick: np.ndarray, seed: int, jitter: float = 0.0, drift_ppm: float = 0.0, batch: float = 0.0
) -> np.ndarray:
    """Ticks as an adapter stamps them: late by a half-normal delay, order kept, in batches."""
    rng = np.random.default_rng(seed)
    late = np.maximum.accumulate(tick + np.abs(rng.normal(0.0, jitter, len(tick))))
    if batch:
        late = np.ceil(late / batch) * batch
    late = late * (1.0 + 1e-6 * drift_ppm)
    return late - late[0]


@pytest.mark.parametrize("every", [1, 2, 20])
@pytest.mark.parametrize("drift", [-100.0, 0.0, 100.0])
@pytest.mark.parametrize("jitter", [0.0, 0.2, 0.5, 1.0])
def test_all_frames_keep_their_ticks_whatever_jitter_and_drift(
    jitter: float, drift: float, every: int
) -> None:
    tick = every * np.arange(COUNT)
    since = stamps(tick, 3, jitter, drift)
    assert spacing_of(since) == every
    found = place_late(since, every).tick
    wrong = found - found[COUNT // 2] != tick - tick[COUNT // 2]
    assert wrong.sum() == 0


@pytest.mark.parametrize("batch", [1.0, 2.5, 4.0, 16.0])
def test_batches_stamped_together_are_taken_apart(batch: float) -> None:
    tick = np.arange(COUNT)
    since = stamps(tick + 0.37, 1, 0.1, 80.0, batch)
    assert spacing_of(since) == 1
    found = place_late(since, 1).tick
    inner = slice(50, -50)
    assert np.unique(found[inner] - tick[inner]).size == 1


@pytest.mark.parametrize("seed", range(4))
def test_lost_frames_among_late_ones_shift_only_their_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tick = np.flatnonzero(rng.random(COUNT) > 0.02)
    placed = place_late(stamps(tick, seed, 1.0, 100.0), 1)
    away = placed.tick - tick
    away = away - int(np.median(away))
    assert np.abs(away).max() <= 2
    assert np.mean(away != 0) < 0.08


def test_signals_that_move_tell_where_the_gap_is() -> None:
    rng = np.random.default_rng(5)
    tick = np.flatnonzero(rng.random(COUNT) > 0.02)
    placed = place_late(stamps(tick, 5, 1.0), 1)
    signal = 300.0 * np.sin(2 * np.pi * 0.013 * tick) + rng.normal(0.0, 0.5, len(tick))
    settled = settle_gaps(placed.tick, placed.late, 1, [signal])

    def wrong(found: np.ndarray) -> int:
        away = found - tick
        return int(np.sum(away != int(np.median(away))))

    assert wrong(settled) < 0.35 * wrong(placed.tick)


def test_a_burst_of_late_frames_goes_back() -> None:
    since = np.arange(COUNT, dtype=float)
    since[1000:1200] = 1200.0
    placed = place_late(since, 1)
    assert (placed.tick == np.arange(COUNT)).all()
    assert placed.late.max() == pytest.approx(200.0, abs=0.5)


def test_the_usual_lateness_is_that_of_the_stamps() -> None:
    since = stamps(np.arange(COUNT), 2, 0.2)
    assert place_late(since, 1).usual == pytest.approx(0.4, abs=0.05)


def test_the_dbc_decides_between_spacings_that_losses_blur() -> None:
    rng = np.random.default_rng(0)
    tick = 20 * np.flatnonzero(rng.random(400) > 0.1)
    assert spacing_of(stamps(tick, 0), stated=20.0) == 20


TESTS = bundled_tests()
LATER_NS = 7_000_000_000


@pytest.fixture(scope="module")
def log():
    """An open and a closed loop test, one after the other, frames late by 0.5 ms."""
    tables = []
    for index, (name, test) in enumerate((("paper-open-2", "open"), ("paper-closed-3", "closed"))):
        recording = read_recording(LOGS / f"{name}.blf")
        this = played(recording.samples, as_sent(TESTS[test]), 0.5)
        table, bus_map = frames_on(
            BUSES["command"], recording, this, Disturbance(0.5, drift_ppm=100.0), 1
        )
        tables.append(replace(table, time_ns=table.time_ns + index * LATER_NS))
    return concatenate(tables), bus_map


def found(log, *tests: str, **where: float):
    table, bus_map = log
    candidates = CandidateTests(
        tuple(TESTS[name] for name in tests), default_actuator().controller, **where
    )
    return list(windowed_recordings([table], bus_map, "log", len(table) + 1, candidates=candidates))


def test_both_are_found_in_order_of_time(log):
    both = found(log, "open", "closed")
    assert [item.test_id for item in both] == [1, 2]
    notes = [" ".join(item.quality.notes) for item in both]
    assert "test 'open' found by its command at 0.500 s" in notes[0]
    assert "test 'closed' found by its command at 7.499 s" in notes[1]


@pytest.mark.parametrize("name", ["open", "closed"])
def test_one_is_chosen_by_its_name(log, name):
    (only,) = found(log, name)
    assert only.test_id == TESTS[name].id


def test_one_is_chosen_by_its_time(log):
    (first,) = found(log, "open", "closed", end_s=6.8)
    (second,) = found(log, "open", "closed", start_s=6.5)
    assert (first.test_id, second.test_id) == (1, 2)


TICKS = 600
OTHER = make_truth(TICKS, 9)


def sent_beside(frames, late_ns, shift=0, every=1, rng=None):
    """Another test's telemetry beside that of the frames, its counters shifted or by chance."""
    encoder, extra, tick = Encoder(), [], 0
    for frame in frames:
        if frame.can_id != TELEMETRY:
            continue
        if tick % every == 0:
            count = frame.data[6] + shift if rng is None else int(rng.integers(256))
            codes = OTHER.codes[tick % TICKS]
            extra += encoder.telemetry(codes, frame.time_ns + late_ns, count)
        tick += 1
    return sorted([*frames, *extra], key=lambda item: item.time_ns)


@pytest.fixture
def truth():
    return make_truth(TICKS)


@pytest.fixture
def frames(encoder, truth):
    return play(encoder, truth, idle_before=150, idle_after=150)


@pytest.mark.parametrize("late_ns", [-50_000, 50_000, 450_000, 600_000, 950_000, 3_000_000])
def test_the_same_counters_are_refused_whoever_comes_first(frames, bus_map, late_ns):
    recording = one(sent_beside(frames, late_ns), bus_map)
    assert any(
        "a second sender of ServoTelemetry (0x110)" in why for why in recording.quality.refused
    )
    assert recording.quality.messages["ServoTelemetry"].conflicts > 0.9 * TICKS


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(shift=st.integers(1, 255), late=st.integers(-999_999, 999_999))
def test_shifted_counters_are_refused(frames, bus_map, shift, late):
    recording = one(sent_beside(frames, late, shift), bus_map)
    assert any("a second sender of ServoTelemetry" in why for why in recording.quality.refused)


@pytest.mark.parametrize("shift", [40, 100, 128, 200])
def test_counters_far_apart_are_named_as_interleaved(frames, bus_map, shift):
    recording = one(sent_beside(frames, 300_000, shift), bus_map)
    assert any("two interleaved counters" in why for why in recording.quality.refused)


@pytest.mark.parametrize("every", [1, 3, 10, 20])
def test_random_counters_are_refused(frames, bus_map, every):
    rng = np.random.default_rng(5)
    recording = one(sent_beside(frames, 200_000, every=every, rng=rng), bus_map)
    assert any("a second sender of ServoTelemetry" in why for why in recording.quality.refused)


def test_what_is_below_the_limit_is_dropped_and_nothing_else(frames, bus_map, truth):
    recording = one(sent_beside(frames, 200_000, every=100), bus_map)
    assert recording.quality.refused == ()
    counts = recording.quality.messages["ServoTelemetry"]
    assert 5 <= counts.conflicts == counts.lost <= 7
    assert_truthful(recording.samples, truth)
    assert np.isnan(recording.samples.spool).sum() == counts.conflicts


def test_repeats_are_harmless(frames, bus_map, truth):
    twice = [
        item for frame in frames for item in (frame, replace(frame, time_ns=frame.time_ns + 9))
    ]
    recording = one(twice, bus_map)
    assert recording.quality.refused == ()
    assert recording.quality.total("conflicts") == 0
    assert recording.quality.messages["ServoTelemetry"].repeated == TICKS
    assert_truthful(recording.samples, truth)


def test_a_standing_counter_is_one_conflict(frames, bus_map):
    encoder, changed, tick = Encoder(), [], 0
    for frame in frames:
        tick += frame.can_id == TELEMETRY
        if frame.can_id == TELEMETRY and 300 <= tick < 400:
            changed += encoder.telemetry([1000 + tick] * 4, frame.time_ns, 7)
        else:
            changed.append(frame)
    recording = one(changed, bus_map)
    assert recording.quality.refused == ()
    assert recording.quality.messages["ServoTelemetry"].conflicts <= 1


@pytest.mark.parametrize("number", [COMMAND, ENVIRONMENT])
def test_other_messages_are_watched_too(encoder, bus_map, number):
    frames = play(encoder, make_truth(2500))
    second, extra = Encoder(), []
    for frame in frames:
        if frame.can_id != number:
            continue
        count, late = frame.data[6], frame.time_ns + 100_000
        if number == COMMAND:
            extra += second.command(CommandMode.CURRENT, 5e-3, 1, late, count)
        else:
            extra += second.environment(10e6, 0.5e6, 80.0, late)
    recording = one(sorted([*frames, *extra], key=lambda item: item.time_ns), bus_map)
    name = "ServoCommand" if number == COMMAND else "Environment"
    assert any(f"a second sender of {name}" in why for why in recording.quality.refused)


def test_without_counters_there_are_more_frames_than_ticks(frames, bus_map):
    messages = {
        name: replace(item, counter=None, counts_ticks=False)
        for name, item in bus_map.messages.items()
    }
    bare = replace(bus_map, messages=messages)
    assert not any("second sender" in why for why in one(frames, bare).quality.refused)
    recording = one(sent_beside(frames, 300_000), bare)
    assert any("no counter to tell them apart" in why for why in recording.quality.refused)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2)), max_size=30))
def test_conflicting_is_what_its_words_say(pairs):
    position = np.array([p for p, _ in pairs], dtype=np.int64)
    data = np.array([[d] for _, d in pairs], dtype=np.uint8).reshape(len(pairs), 1)
    slow = [any(p == q and d != e for q, e in pairs) for p, d in pairs]
    assert conflicting(position, data).tolist() == slow


def watch(pairs, period_ns=TICK):
    found = SenderWatch(256, period_ns)
    dropped = [found.take((count,), data, time_ns) for count, data, time_ns in pairs]
    return found, dropped


def test_the_live_watch_sees_pairs_and_not_a_standing_counter():
    pairs = [(k, bytes((k, who)), k * TICK) for k in range(50) for who in (1, 2)]
    found, dropped = watch(pairs)
    assert (found.conflicts, sum(dropped), found.second_sender) == (50, 50, True)
    found, _ = watch([(5, bytes((k,)), k * TICK) for k in range(100)])
    assert (found.conflicts, found.second_sender) == (0, False)
    found, _ = watch([(k % 256, k.to_bytes(2, "big"), k * TICK) for k in range(2000)])
    assert found.conflicts == 0


def test_the_live_watch_keeps_little():
    found, _ = watch([(k % (1 << 20), b"x", k) for k in range(5000)])
    assert len(found._seen) <= 128


def test_the_live_decoder_names_the_second_sender(frames):
    decoder = LiveDecoder()
    for frame in frames:
        decoder.decode(frame)
    assert (decoder.second_sender, decoder.conflicts) == ("", 0)
    decoder = LiveDecoder()
    for frame in sent_beside(frames, 200_000):
        decoder.decode(frame)
    assert decoder.second_sender.startswith("a second sender of ServoTelemetry (0x110)")


def test_live_ticks_give_nothing_out_beside_a_second_sender(frames):
    live = LiveTicks(mode=CommandMode.CURRENT)
    ticks = [tick for frame in sent_beside(frames, 200_000) for tick in live.take(frame)]
    assert live.conflicts > 0.9 * TICKS
    assert np.isnan([tick.spool for tick in ticks[5:]]).all()
    live = LiveTicks(mode=CommandMode.CURRENT)
    ticks = [tick for frame in sent_beside(frames, 200_000, every=450) for tick in live.take(frame)]
    lost = int(np.isnan([tick.spool for tick in ticks]).sum())
    assert lost == live.lost == live.conflicts * DOUBTFUL_TICKS


def test_frames_of_a_second_channel_are_no_samples_of_the_first(frames):
    decoder = LiveDecoder()
    first = [replace(frame, channel=1) for frame in frames[:50]]
    assert any(decoder.decode(frame) is not None for frame in first)
    assert [decoder.decode(replace(frame, channel=2)) for frame in frames[50:90]] == [None] * 40
    assert "on the channels 1 and 2" in decoder.second_sender
