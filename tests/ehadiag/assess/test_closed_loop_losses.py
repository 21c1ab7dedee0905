"""Jack positions that a closed loop lost, told by the response of spool and pressure.

Frames whose order is lost: what is refused, and what is told all the same. Delays between messages,
told by the response and put back.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from places import LOGS

from ehadiag import Diagnosis, Recording, Verdict, bundled_tests, default_actuator
from ehadiag.assess.acceptance import objection_to_frame_order
from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.lost_samples import (
    is_reconstructible,
    reconstruct_lost_samples,
)
from ehadiag.assess.response_checks import (
    Delay,
    any_significant_delay,
    delay_note,
    estimate_delays,
    shift_samples,
)
from ehadiag.core.criteria import LOSSES
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.identification_result import Identification
from ehadiag.identify.identification_session import identify
from firmware_iface.find_test import CandidateTests, extract_tests
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test

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
    assert is_reconstructible([bare], [before])
    answer = reconstruct_lost_samples([bare], [before], ACTUATOR, lambda _items: found)
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
        answer = reconstruct_lost_samples([bare], [before], ACTUATOR, lambda _items: found)
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
    answer = reconstruct_lost_samples([bare], [before], ACTUATOR, lambda _items: found)
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
    assert reconstruct_lost_samples([bare], [experiment(bare)], other, lambda _items: found) is None


def test_nothing_is_told_where_nothing_was_guessed(
    whole: tuple[Recording, Experiment, Identification],
) -> None:
    recording, item, _ = whole
    assert not is_reconstructible([recording], [item])
    assert not is_reconstructible([recording], [])


@pytest.mark.slow
def test_a_recording_with_a_twentieth_of_its_currents_lost_is_diagnosed() -> None:
    bare = without_pairs(read_recording(LOGS / "paper-closed-3.blf"), 20)
    came = diagnose([bare], ACTUATOR, bundled_tests().values())
    assert came.verdict is Verdict.DEGRADED
    assert came.identification is not None
    for item, value in zip(came.identification.estimates, (0.6, 0.6, 0.3), strict=True):
        assert item.interval95[0] < value < item.interval95[1] < item.interval95[0] + 0.006
    assert any("the response told" in note for note in came.notes)


TESTS = bundled_tests()
CHANNELS = ("current", "spool", "pressure", "position", "command")


def sorted_by_late_stamps(name: str) -> Recording:
    """Each tick's message is late by itself, by 1 ms half-normal; the log is sorted by stamps."""
    whole = read_recording(LOGS / name)
    samples = whole.samples
    assert samples is not None
    late = np.abs(np.random.default_rng(1).normal(0.0, 1.0, samples.ticks))
    order = np.argsort(np.arange(samples.ticks) + late)
    mixed = replace(samples, **{name: getattr(samples, name)[order] for name in CHANNELS})
    candidates = CandidateTests(tuple(TESTS.values()), default_actuator().controller)
    bare = replace(whole, samples=mixed, test_id=None, by_time=True)
    return extract_tests(bare, candidates)[0]


def diagnosed(recording: Recording) -> Diagnosis:
    return diagnose([recording], default_actuator(), TESTS.values())


@pytest.mark.slow
def test_in_open_loop_every_severity_is_left() -> None:
    mixed = sorted_by_late_stamps("paper-open-2.blf")
    assert mixed.out_of_order > LOSSES.max_wrong_share
    found = diagnosed(mixed)
    assert found.verdict is Verdict.NOT_TESTED
    (reason,) = found.reasons
    assert "of the commands are of other ticks (limit 1.5%)" in reason
    assert "lost their order, and no counter tells it: Kintas 0." in reason
    assert found.identification is not None
    truth = (0.3, 0.6, 0.3)
    for item, value in zip(found.identification.estimates, truth, strict=True):
        assert item.interval95[0] < value < item.interval95[1] < item.interval95[0] + 0.05


def test_order_counts_only_where_no_counter_tells_the_ticks() -> None:
    whole = read_recording(LOGS / "paper-open-2.blf")
    assert whole.out_of_order == 0.0
    for share, by_time, lost in ((0.2, True, True), (0.2, False, False), (0.01, True, False)):
        assert (
            bool(objection_to_frame_order(replace(whole, out_of_order=share, by_time=by_time)))
            is lost
        )


def later(values: np.ndarray, ticks: int) -> np.ndarray:
    return np.concatenate([values[:ticks], values[:-ticks]])


@pytest.fixture(scope="module")
def recording():
    """Pressure and position come by a message that is placed a tick late."""
    whole = replace(read_recording(LOGS / "paper-open-2.blf"), by_time=True)
    samples = whole.samples
    late = replace(
        samples, pressure=later(samples.pressure, 1), position=later(samples.position, 1)
    )
    return whole, replace(whole, samples=late)


@pytest.mark.slow
def test_a_tick_between_messages_is_put_back(recording):
    whole, late = recording
    true, found = (diagnose([item], default_actuator(), TESTS.values()) for item in (whole, late))
    assert found.verdict is true.verdict is Verdict.DEGRADED
    for one, other in zip(
        true.identification.estimates, found.identification.estimates, strict=True
    ):
        assert abs(one.value - other.value) < 1e-4
    (note,) = [item for item in found.notes if "put back" in item]
    assert "pressure +1.0" in note
    assert not any("put back" in item for item in true.notes)
    spool, pressure, _ = estimate_delays(true.experiments[0], true.identification)
    assert abs(spool.value) < 0.01
    assert abs(pressure.value) < 0.02
    half = replace(
        true.experiments[0],
        spool=0.5 * (true.experiments[0].spool + later(true.experiments[0].spool, 1)),
    )
    assert estimate_delays(half, true.identification)[0].value == pytest.approx(0.5, abs=0.03)


def test_only_large_and_sure_delays_count():
    assert not any_significant_delay([Delay("spool", 0.04, 0.001), Delay("pressure", 0.9, 0.3)])
    assert any_significant_delay([Delay("spool", 0.0, 0.001), Delay("pressure", -0.2, 0.01)])
    words = delay_note([Delay("spool", 1.0, 0.01)], 2e-3)
    assert "spool +2.000 ± 0.020 ms" in words


@pytest.mark.parametrize(("value", "expected"), [(1.05, 1.0), (-2.0, -2.0), (0.5, 0.5)])
def test_what_is_put_back(recording, value, expected):
    whole, _ = recording
    experiment = diagnose([whole], default_actuator(), TESTS.values()).experiments[0]
    ramp = np.arange(experiment.ticks, dtype=np.float64)
    item = replace(experiment, spool=ramp)
    nothing = Delay("", 0.0, 1.0)
    moved = shift_samples(item, (Delay("spool", value, 0.01), nothing, nothing)).spool
    known = np.isfinite(moved)
    assert np.allclose(moved[known] - ramp[known], expected)
    assert known.sum() >= experiment.ticks - 2
