"""Jack positions that a closed loop lost, told by the response of spool and pressure."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from places import LOGS

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.lost_ticks import can_be_told, told_by_response
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.result import Identification
from ehadiag.identify.session import identify
from firmware_iface.logs.reader import read_recording

ACTUATOR, TEST = default_actuator(), resolve_test("closed")
ROW = ("current", "spool", "pressure", "position")


def experiment(recording: Recording) -> Experiment:
    assert recording.samples is not None
    return build_experiment(recording.samples, recording.environment, TEST, ACTUATOR)


def without_pairs(recording: Recording, every: int) -> Recording:
    """Two ticks in a row lost: neither position nor current tells what the control law did."""
    samples = recording.samples
    assert samples is not None
    gone = np.isin(np.arange(samples.ticks) % every, (7, 8))
    lost = {name: np.where(gone, np.nan, getattr(samples, name)) for name in ROW}
    return replace(recording, samples=replace(samples, **lost))


@pytest.fixture(scope="module")
def whole() -> tuple[Recording, Experiment, Identification]:
    recording = read_recording(LOGS / "paper-closed-1.blf")
    item = experiment(recording)
    return recording, item, identify([item])


def test_what_the_response_tells_is_what_the_computer_saw(
    whole: tuple[Recording, Experiment, Identification],
) -> None:
    recording, true, found = whole
    bare = without_pairs(recording, 60)
    before = experiment(bare)
    assert can_be_told([bare], [before])
    answer = told_by_response([bare], [before], ACTUATOR, lambda _items: found)
    assert answer is not None
    (after,), _, note = answer
    told = np.isfinite(after.position) & np.isnan(before.position)
    right = np.abs(after.position - true.position)[told] < 0.3 * true.channels.position.lsb
    assert told.sum() > 25
    assert right.mean() > 0.9
    assert after.trace.guessed < 0.7 * before.trace.guessed
    assert "lost jack positions" in note
    assert "rows of samples" not in note


def test_rows_that_stand_a_tick_beside_their_own_are_moved_back_where_no_counter_placed_them(
    whole: tuple[Recording, Experiment, Identification],
) -> None:
    recording, true, found = whole
    samples = recording.samples
    assert samples is not None
    rows = {name: getattr(samples, name).copy() for name in ROW}
    for tick in range(1500, 5000, 100):
        # Two ticks are lost, and the two after them stand one too early.
        for values in rows.values():
            values[tick + 1 : tick + 3] = values[tick + 2 : tick + 4]
            values[[tick - 1, tick, tick + 3]] = np.nan
    mixed = replace(recording, samples=replace(samples, **rows))
    before = experiment(mixed)

    def misplaced(item: Experiment) -> int:
        seen = np.isfinite(item.spool)
        return int(np.sum(np.abs(item.spool - true.spool)[seen] > 1e-9))

    left = {}
    for by_time in (True, False):
        bare = replace(mixed, by_time=by_time)
        answer = told_by_response([bare], [before], ACTUATOR, lambda _items: found)
        left[by_time] = misplaced(answer[0][0] if answer else before)
    assert left[False] == misplaced(before)
    assert left[True] < 0.5 * misplaced(before)


def test_samples_are_not_moved_away_from_ticks_of_which_other_signals_came(
    whole: tuple[Recording, Experiment, Identification],
) -> None:
    recording, true, found = whole
    samples = recording.samples
    assert samples is not None
    odd = np.arange(samples.ticks) % 2 == 1
    spikes = np.random.default_rng(2).random(samples.ticks) < 0.03
    bare = replace(
        recording,
        by_time=True,
        samples=replace(
            samples,
            position=np.where(odd, np.nan, samples.position),
            spool=samples.spool + 8.0 * true.channels.spool.lsb * spikes,
        ),
    )
    before = experiment(bare)
    answer = told_by_response([bare], [before], ACTUATOR, lambda _items: found)
    after = answer[0][0] if answer else before
    np.testing.assert_array_equal(np.isfinite(after.spool), np.isfinite(before.spool))
    assert answer is None or "rows of samples" not in answer[2]


def test_a_controller_with_memory_tells_nothing(
    whole: tuple[Recording, Experiment, Identification],
) -> None:
    recording, _, found = whole
    bare = without_pairs(recording, 60)
    law = msgspec.structs.replace(ACTUATOR.controller, GAI=1.0)
    other = msgspec.structs.replace(ACTUATOR, controller=law)
    assert told_by_response([bare], [experiment(bare)], other, lambda _items: found) is None


def test_nothing_is_told_where_nothing_was_guessed(
    whole: tuple[Recording, Experiment, Identification],
) -> None:
    recording, item, _ = whole
    assert not can_be_told([recording], [item])
    assert not can_be_told([recording], [])


@pytest.mark.slow
def test_a_recording_with_a_twentieth_of_its_currents_lost_is_diagnosed() -> None:
    bare = without_pairs(read_recording(LOGS / "paper-closed-3.blf"), 20)
    came = diagnose([bare], ACTUATOR, bundled_tests().values())
    assert came.verdict is Verdict.DEGRADED
    assert came.identification is not None
    for item, value in zip(came.identification.estimates, (0.6, 0.6, 0.3), strict=True):
        assert item.interval95[0] < value < item.interval95[1] < item.interval95[0] + 0.006
    assert any("the response told" in note for note in came.notes)
