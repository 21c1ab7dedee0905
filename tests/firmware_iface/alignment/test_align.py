"""Alignment of damaged frame streams: nothing invented, everything counted."""

from __future__ import annotations

import numpy as np
import pytest
from bus_synth import (
    COMMAND,
    ENVIRONMENT,
    START,
    STATUS,
    TELEMETRY,
    TICK,
    assert_truthful,
    flip,
    make_truth,
    one,
    play,
    recordings,
    tick_of,
)
from msgspec.structs import replace

from ehadiag import CommandMode
from firmware_iface.recording import BitReason, BitState
from firmware_iface.transport.frames import Frame

TICKS = 900


@pytest.fixture(scope="module")
def truth():
    return make_truth(TICKS)


def present(samples):
    return np.flatnonzero(np.isfinite(samples.spool))


def counts(recording, name="ServoTelemetry"):
    return recording.quality.messages[name]


def test_clean_recording_is_complete_and_exact(frames, bus_map, truth):
    recording = one(frames, bus_map)
    assert_truthful(recording.samples, truth)
    assert len(present(recording.samples)) == TICKS
    assert np.isfinite(recording.samples.command).all()
    assert recording.samples.mode is CommandMode.CURRENT
    assert recording.samples.period_ns == TICK
    assert (recording.test_id, recording.serial) == (1, 77)
    assert recording.outcome.state is BitState.COMPLETE
    assert recording.environment.supply_pressure == pytest.approx(20.7e6)
    assert recording.environment.return_pressure == pytest.approx(0.7e6)
    assert recording.environment.oil_temperature == pytest.approx(40.0)
    assert counts(recording).received == counts(recording).accepted == TICKS
    for kind in ("lost", "repeated", "out_of_order", "crc_errors", "length_errors"):
        assert recording.quality.total(kind) == 0, kind
    assert recording.quality.notes == ()
    assert recording.samples.host_ns[7] == START + 7 * TICK + 530_000


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_loss_is_counted_and_left_out(frames, bus_map, truth, share, seed):
    rng = np.random.default_rng(seed)
    kept = [frame for frame in frames if rng.random() >= share]
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    for can_id, name in ((TELEMETRY, "ServoTelemetry"), (COMMAND, "ServoCommand")):
        arrived = sum(frame.can_id == can_id for frame in kept)
        assert counts(recording, name).accepted == arrived
        assert counts(recording, name).lost == TICKS - arrived
    ticks = sorted(tick_of(frame) for frame in kept if frame.can_id == TELEMETRY)
    assert present(recording.samples).tolist() == ticks


@pytest.mark.parametrize("gap", [1, 2, 127, 128, 129, 254, 255, 256, 257, 300, 511, 512, 513])
def test_gap_of_any_length_keeps_the_ticks(frames, bus_map, truth, gap):
    kept = [frame for frame in frames if not 200 <= tick_of(frame) < 200 + gap]
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).lost == gap
    assert np.isnan(recording.samples.spool[200 : 200 + gap]).all()
    assert np.isfinite(recording.samples.spool[[199, 200 + gap]]).all()


@pytest.mark.parametrize("head", [1, 37, 300])
def test_first_frames_lost(frames, bus_map, truth, head):
    kept = [frame for frame in frames if tick_of(frame) >= head]
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).lost == head
    assert np.isnan(recording.samples.spool[:head]).all()


@pytest.mark.parametrize("tail", [1, 37, 300])
def test_last_frames_lost_but_completion_seen(frames, bus_map, truth, tail):
    kept = [f for f in frames[:-1] if tick_of(f) < TICKS - tail] + frames[-1:]
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).lost == tail


def test_log_cut_in_the_middle_says_running(frames, bus_map, truth):
    kept = [frame for frame in frames if tick_of(frame) < 450]
    recording = one(kept, bus_map)
    assert recording.outcome.state is BitState.RUNNING
    assert recording.samples.ticks == 450
    np.testing.assert_allclose(recording.samples.spool, truth.channel(1)[:450], atol=1e-12)


def test_idle_frames_around_the_test_do_not_belong_to_it(encoder, bus_map, truth):
    frames = play(encoder, truth, idle_before=333, idle_after=412)
    recording = one(frames, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).received == counts(recording).accepted == TICKS
    assert recording.quality.total("lost") == 0


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_idle_frames_loss_and_no_status(encoder, bus_map, truth, seed):
    rng = np.random.default_rng(seed)
    frames = play(encoder, truth, idle_before=50, idle_after=60, status=False)
    edges = {50, 49, 50 + TICKS - 1, 50 + TICKS}
    kept = [
        frame
        for frame in frames
        if rng.random() >= 0.05 or (frame.can_id == COMMAND and tick_of(frame) in edges)
    ]
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    assert recording.outcome.state is None


def content(recording):
    samples = recording.samples
    arrays = [getattr(samples, name) for name in samples.__struct_fields__]
    rest = replace(recording, samples=None)
    return repr(rest), [np.asarray(item).tolist() for item in arrays]


@pytest.mark.parametrize("idle_after", [0, 3], ids=["silent", "idle"])
@pytest.mark.parametrize("end", [BitState.COMPLETE, BitState.ABORTED])
def test_what_comes_after_the_word_of_the_end_changes_nothing(encoder, bus_map, end, idle_after):
    """A live test is judged on that word; the file of it holds what came until it was closed."""
    truth = make_truth(300)
    frames = play(encoder, truth, end=end, idle_after=idle_after)
    word = max(i for i, f in enumerate(frames) if f.can_id == STATUS)
    assert frames[word].data[0] & 15 == end
    then = frames[word].time_ns
    hot = [
        frame
        for k in range(1, 6)
        for frame in encoder.environment(25e6, 1e6, 90.0, then + 10_000 * k)
    ]
    again = encoder.status(end, BitReason.NONE, 1, 0.3, 77, then + 80_000)
    foreign = Frame(then + 90_000, 0x321, bytes(8))
    late = [*frames[: word + 1], *hot, *again, foreign, *frames[word + 1 :]]
    live = one(frames[: word + 1], bus_map)
    assert live.outcome.state is end
    assert live.samples.ticks == 300
    assert content(one(late, bus_map)) == content(live)


def test_frames_that_come_after_the_word_of_the_end_belong_to_the_test(encoder, bus_map, truth):
    frames = play(encoder, truth)
    early = [*frames[:-41], frames[-1], *frames[-41:-1]]
    recording = one(early, bus_map)
    assert counts(recording).received == TICKS
    assert_truthful(recording.samples, truth)
    assert len(present(recording.samples)) == TICKS


def test_uncertain_start_is_noted(encoder, bus_map, truth):
    frames = play(encoder, truth, idle_before=50, status=False)
    kept = [frame for frame in frames if not 47 <= tick_of(frame) < 53]
    recording = one(kept, bus_map)
    assert any("start of the test uncertain" in note for note in recording.quality.notes)


def test_status_resolves_a_lost_start(encoder, bus_map, truth):
    frames = play(encoder, truth, idle_before=50)
    kept = [frame for frame in frames if not 47 <= tick_of(frame) < 53]
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).lost == 3


def test_without_status_and_idle_frames_the_ids_bound_the_test(encoder, bus_map, truth):
    recording = one(play(encoder, truth, status=False), bus_map)
    assert_truthful(recording.samples, truth)


def test_duplicates_are_counted_once_used(frames, bus_map, truth):
    doubled = []
    for frame in frames:
        doubled.append(frame)
        if frame.can_id == TELEMETRY and tick_of(frame) % 10 == 3:
            doubled.append(replace(frame, time_ns=frame.time_ns + 20_000))
    recording = one(doubled, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).repeated == TICKS // 10
    assert counts(recording).lost == 0
    assert counts(recording).received == TICKS + TICKS // 10


def test_duplicated_last_frame(frames, bus_map, truth):
    last = max(i for i, frame in enumerate(frames) if frame.can_id == TELEMETRY)
    again = [*frames[: last + 1], frames[last], *frames[last + 1 :]]
    recording = one(again, bus_map)
    assert_truthful(recording.samples, truth)
    assert (counts(recording).repeated, counts(recording).lost) == (1, 0)


def test_two_payloads_with_one_counter_are_both_dropped(frames, bus_map, truth, encoder):
    place = next(i for i, f in enumerate(frames) if f.can_id == TELEMETRY and tick_of(f) == 100)
    (other,) = encoder.telemetry((1, 1, 1, 1), frames[place].time_ns + 1000, 13 + 100)
    recording = one([*frames[: place + 1], other, *frames[place + 1 :]], bus_map)
    assert_truthful(recording.samples, truth)
    assert np.isnan(recording.samples.spool[100])
    assert (counts(recording).conflicts, counts(recording).lost) == (1, 1)
    assert counts(recording).repeated == 0
    assert recording.quality.refused == ()


def test_swapped_frames_are_put_in_order(frames, bus_map, truth):
    swapped = list(frames)
    places = [i for i, frame in enumerate(frames) if frame.can_id == TELEMETRY][10::50]
    for place in places:
        after = next(i for i in range(place + 1, len(frames)) if frames[i].can_id == TELEMETRY)
        swapped[place], swapped[after] = swapped[after], swapped[place]
    recording = one(swapped, bus_map)
    assert_truthful(recording.samples, truth)
    assert len(present(recording.samples)) == TICKS
    assert counts(recording).out_of_order == len(places)
    assert counts(recording).lost == counts(recording).repeated == 0


def test_flipped_bits_are_rejected_not_lost(frames, bus_map, truth):
    rng = np.random.default_rng(5)
    hit = {i for i, f in enumerate(frames) if f.can_id == TELEMETRY and rng.random() < 0.02}
    damaged = [flip(f, int(rng.integers(64))) if i in hit else f for i, f in enumerate(frames)]
    recording = one(damaged, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).crc_errors == len(hit)
    assert counts(recording).received == TICKS
    assert counts(recording).accepted == TICKS - len(hit)
    assert counts(recording).lost == 0


def test_masquerade_is_rejected(frames, bus_map, truth):
    """A command's payload under the telemetry's identifier has a check sum that does not fit."""
    faked = [
        replace(frame, can_id=TELEMETRY)
        if frame.can_id == COMMAND and tick_of(frame) == 300
        else frame
        for frame in frames
    ]
    recording = one(faked, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).crc_errors == 1
    assert counts(recording, "ServoCommand").lost == 1


def test_extended_frame_with_the_same_number_is_foreign(frames, bus_map, truth):
    other = replace(frames[5], extended=True)
    recording = one([*frames[:5], other, *frames[5:]], bus_map)
    assert_truthful(recording.samples, truth)
    assert recording.quality.foreign == 1
    assert recording.quality.total("received") == len(frames)


@pytest.mark.parametrize("size", [0, 7, 12])
def test_wrong_length_is_rejected(frames, bus_map, truth, size):
    place = next(i for i, f in enumerate(frames) if f.can_id == TELEMETRY and tick_of(f) == 100)
    data = frames[place].data.ljust(size, b"\0")[:size]
    damaged = [*frames[:place], replace(frames[place], data=data), *frames[place + 1 :]]
    recording = one(damaged, bus_map)
    assert_truthful(recording.samples, truth)
    assert (counts(recording).length_errors, counts(recording).lost) == (1, 0)
    assert np.isnan(recording.samples.spool[100])


def test_error_and_remote_and_foreign_frames_are_counted_apart(frames, bus_map, truth):
    now = frames[100].time_ns
    extra = [
        Frame(now, 0, b"", error=True),
        Frame(now, TELEMETRY, b"", remote=True),
        Frame(now, 0x333, b"\1\2\3"),
        Frame(now, 0x334, b""),
    ]
    recording = one([*frames[:100], *extra, *frames[100:]], bus_map)
    assert_truthful(recording.samples, truth)
    assert (recording.quality.error_frames, recording.quality.foreign) == (1, 2)
    assert counts(recording).received == TICKS


@pytest.mark.parametrize("seconds", [-3.7, -0.2, 0.3, 4.1])
def test_clock_that_steps_does_not_move_samples(frames, bus_map, truth, seconds):
    step = round(seconds * 1e9)
    stepped = [
        replace(frame, time_ns=frame.time_ns + step) if tick_of(frame) >= 400 else frame
        for frame in frames
    ]
    recording = one(stepped, bus_map)
    assert_truthful(recording.samples, truth)
    assert recording.quality.total("lost") == 0
    assert any("host clock" in note for note in recording.quality.notes)


@pytest.mark.parametrize("stall", [20, 100, 130, 250, 256, 260, 500])
def test_stalled_receiver_that_hands_over_late(frames, bus_map, truth, stall):
    release = START + (200 + stall) * TICK
    late = [
        replace(f, time_ns=max(f.time_ns, release + 1000 * i)) if tick_of(f) >= 200 else f
        for i, f in enumerate(frames)
    ]
    recording = one(late, bus_map)
    assert_truthful(recording.samples, truth)
    assert recording.quality.total("lost") == 0


def test_stalled_receiver_that_also_lost_frames(frames, bus_map, truth):
    kept = []
    for frame in frames:
        tick = tick_of(frame)
        if 350 <= tick < 650:
            continue
        kept.append(replace(frame, time_ns=START + 700 * TICK) if 150 <= tick < 700 else frame)
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).lost == 300


def test_jitter_of_tens_of_milliseconds(frames, bus_map, truth):
    rng = np.random.default_rng(7)
    delay = np.where(rng.random(len(frames)) < 0.02, rng.integers(0, 60_000_000, len(frames)), 0)
    at = np.maximum.accumulate([f.time_ns + int(d) for f, d in zip(frames, delay, strict=True)])
    late = [replace(frame, time_ns=int(time)) for frame, time in zip(frames, at, strict=True)]
    recording = one(late, bus_map)
    assert_truthful(recording.samples, truth)
    assert recording.quality.total("lost") == 0


def test_time_that_stands_still(frames, bus_map, truth):
    frozen = [replace(frame, time_ns=START) for frame in frames]
    assert_truthful(one(frozen, bus_map).samples, truth)


def test_pause_of_five_seconds_of_the_bus(encoder, bus_map):
    truth = make_truth(7000)
    frames = play(encoder, truth)
    kept = [frame for frame in frames if not 1000 <= tick_of(frame) < 6000]
    recording = one(kept, bus_map)
    assert_truthful(recording.samples, truth)
    assert counts(recording).lost == 5000


def test_stuck_counter_yields_few_samples_and_says_so(encoder, bus_map, truth):
    frames = play(encoder, truth)
    stuck = []
    for frame in frames:
        if frame.can_id == TELEMETRY and tick_of(frame) >= 100:
            (frozen,) = encoder.telemetry(truth.codes[tick_of(frame)], frame.time_ns, 13 + 100)
            stuck.append(frozen)
        else:
            stuck.append(frame)
    recording = one(stuck, bus_map)
    assert len(present(recording.samples)) < 110
    assert counts(recording).repeated + counts(recording).lost > 700
    assert any("counter stands still" in note for note in recording.quality.notes)


def test_two_tests_in_one_log(encoder, bus_map):
    first, second = make_truth(600, 1), make_truth(700, 2)
    frames = play(encoder, first, idle_after=100)
    later = START + 2000 * TICK
    frames += play(encoder, second, start_ns=later, counter=90, test_id=2, idle_before=40)
    one_, two = recordings(frames, bus_map)
    assert_truthful(one_.samples, first)
    assert_truthful(two.samples, second)
    assert (one_.test_id, two.test_id) == (1, 2)
    assert counts(one_).received == 600
    assert counts(two).received == 700


def test_the_same_test_twice_without_idle_frames_between(encoder, bus_map):
    first, second = make_truth(600, 1), make_truth(600, 2)
    frames = play(encoder, first) + play(encoder, second, start_ns=START + 900 * TICK, counter=200)
    one_, two = recordings(frames, bus_map)
    assert_truthful(one_.samples, first)
    assert_truthful(two.samples, second)


def test_two_tests_back_to_back_with_counters_that_start_again(encoder, bus_map):
    first, second = make_truth(600, 1), make_truth(600, 2)
    frames = play(encoder, first) + play(encoder, second, start_ns=START + 600 * TICK)
    one_, two = recordings(frames, bus_map)
    assert_truthful(one_.samples, first)
    assert_truthful(two.samples, second)
    for recording in (one_, two):
        assert recording.outcome.state is BitState.COMPLETE
        assert recording.quality.total("lost") == recording.quality.total("repeated") == 0


def test_aborted_test(encoder, bus_map, truth):
    frames = play(encoder, truth, end=BitState.ABORTED, idle_after=50)
    recording = one(frames, bus_map)
    assert recording.outcome.state is BitState.ABORTED
    assert_truthful(recording.samples, truth)


def test_refusal_has_a_reason_and_no_samples(encoder, bus_map, truth):
    idle = play(encoder, make_truth(1), status=False, idle_before=200)[:-2]
    refusal = encoder.status(
        BitState.REFUSED, BitReason.OIL_TOO_COLD, 1, 0.0, 77, idle[-1].time_ns + 1000
    )
    recording = one([*idle, *refusal], bus_map)
    assert recording.samples is None
    assert recording.outcome.state is BitState.REFUSED
    assert recording.outcome.reason is BitReason.OIL_TOO_COLD
    assert (recording.test_id, recording.serial) == (1, 77)


def test_second_tester_refused_does_not_spoil_the_running_test(encoder, bus_map, truth):
    frames = play(encoder, truth)
    place = next(i for i, f in enumerate(frames) if tick_of(f) == 300)
    now = frames[place].time_ns
    refusal = encoder.status(BitState.REFUSED, BitReason.ALREADY_RUNNING, 2, 0.3, 77, now)
    recording = one([*frames[:place], *refusal, *frames[place:]], bus_map)
    assert_truthful(recording.samples, truth)
    assert recording.outcome.state is BitState.COMPLETE
    assert recording.test_id == 1


def test_idle_bus_has_no_test(encoder, bus_map):
    idle = play(encoder, make_truth(1), idle_before=300)[:-4]
    recording = one([f for f in idle if tick_of(f) < 290], bus_map)
    assert recording.samples is None
    assert "no test in the recording" in recording.quality.notes


def test_no_telemetry(frames, bus_map):
    recording = one([f for f in frames if f.can_id != TELEMETRY], bus_map)
    assert recording.samples is None
    assert "no telemetry in the recording" in recording.quality.notes


def test_no_commands(frames, bus_map, truth):
    recording = one([f for f in frames if f.can_id != COMMAND], bus_map)
    assert np.isnan(recording.samples.command).all()
    assert_truthful(recording.samples, truth)
    assert counts(recording, "ServoCommand").lost == TICKS
    assert any("no command" in note for note in recording.quality.notes)


def test_telemetry_alone_is_taken_as_one_test(frames, bus_map, truth):
    recording = one([f for f in frames if f.can_id == TELEMETRY], bus_map)
    assert_truthful(recording.samples, truth)
    assert recording.outcome.state is None


def test_no_environment(frames, bus_map):
    recording = one([f for f in frames if f.can_id != ENVIRONMENT], bus_map)
    assert recording.environment.oil_temperature is None


def test_saturated_codes_are_marked(encoder, bus_map):
    truth = make_truth(300)
    truth.codes[40, 0], truth.codes[41, 1], truth.codes[42:45, 2] = 0, 4095, 4095
    recording = one(play(encoder, truth), bus_map)
    assert recording.quality.saturated == {"current": 1, "spool": 1, "pressure": 3, "position": 0}
    assert np.argwhere(recording.samples.saturated).tolist() == [
        [0, 40],
        [1, 41],
        [2, 42],
        [2, 43],
        [2, 44],
    ]


def test_frozen_channel_is_noted(encoder, bus_map):
    truth = make_truth(900)
    truth.codes[400:501, 2] = truth.codes[400, 2]
    assert any("pressure stood" in n for n in one(play(encoder, truth), bus_map).quality.notes)
    truth = make_truth(900)
    truth.codes[400:480, 2] = truth.codes[400, 2]
    assert not any("stood" in n for n in one(play(encoder, truth), bus_map).quality.notes)


def test_lost_status_and_environment_frames_are_counted(frames, bus_map):
    where = [i for i, frame in enumerate(frames) if frame.can_id == STATUS]
    kept = [frame for i, frame in enumerate(frames) if i not in (where[3], where[7], where[8])]
    assert counts(one(kept, bus_map), "BitStatus").lost == 3


def test_no_frames_at_all(bus_map):
    recording = one([], bus_map)
    assert recording.samples is None
    assert recording.outcome.state is None
