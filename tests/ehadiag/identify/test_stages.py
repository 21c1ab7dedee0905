"""Stages of the search, worked out ahead while a test runs."""

from dataclasses import fields, replace

import numpy as np
import pytest
from ehadiag.assess.online import OnlineIdentification
from ehadiag.identify.pipeline import identify, run_ahead
from identify_cases import own_experiment
from msgspec import structs

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Environment, Outcome, Quality, Recording, Samples
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.search.stages import STAGES, Memory, first_ends_at, stage_ends_at
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import simulate

FAULTS = (0.4, 0.5, 0.6)


@pytest.fixture(scope="module", params=["open", "closed"])
def recording(request):
    test = resolve_test(request.param)
    return simulate(default_actuator(), test, Faults(*FAULTS), seed=3).recording("simulated")


def cut(recording: Recording, ticks: int) -> Recording:
    """The recording as it was after so many ticks."""
    samples = recording.samples
    arrays = {
        field.name: getattr(samples, field.name)[..., :ticks]
        for field in fields(Samples)
        if isinstance(getattr(samples, field.name), np.ndarray)
    }
    return replace(recording, samples=replace(samples, **arrays))


def same(a, b):
    """Whether two identifications are the same to the last bit."""
    return (
        [(e.first, e.search, e.value, e.std) for e in a.estimates]
        == [(e.first, e.search, e.value, e.std) for e in b.estimates]
        and a.cost == b.cost
        and a.evaluations == b.evaluations
    )


def test_working_ahead_does_not_change_the_answer(recording):
    from ehadiag.identify.experiment import build_experiment

    test = resolve_test("open" if recording.test_id == 1 else "closed")
    online = OnlineIdentification(test, default_actuator())
    for due in online.due_s:
        online.take(cut(recording, round(due * test.rate) + 7))
    stages = len(online.memory)
    assert stages == 1 + len(STAGES) + 1, (
        "first approximation, search, refinement but its last step"
    )
    experiment = build_experiment(
        recording.samples, recording.environment, test, default_actuator()
    )
    alone = identify([experiment])
    ahead = identify([experiment], memory=online.memory)
    assert online.memory.reused >= stages
    assert same(alone, ahead)


def ends(test):
    return [stage_ends_at(test, stage) for stage in range(len(STAGES))]


def test_stages_follow_the_second_part():
    test = resolve_test("open")
    assert first_ends_at(test) == pytest.approx(3.5)
    assert ends(test) == pytest.approx([4.0, 4.5, 5.0])


def test_other_samples_are_not_answered_from_memory():
    experiment = own_experiment(FAULTS)
    memory = Memory()
    run_ahead(experiment, _solver(), 0, memory)
    assert memory.reused == 0
    experiment.spool[4200] += 1e-6  # after the first stage's window, in the others
    run_ahead(experiment, _solver(), 0, memory)
    assert memory.reused == 2
    run_ahead(experiment, _solver(), 1, memory)
    assert memory.reused == 3, "another seed searches anew; the first approximation needs none"


def _solver():
    from ehadiag.identify.search.solvers import CompactGa

    return CompactGa(budget=128)


def test_too_little_is_left_alone():
    online = OnlineIdentification(resolve_test("open"), default_actuator())
    empty = Recording("bus", None, 1, None, Outcome(), Environment(), Quality())
    online.take(empty)
    assert len(online.memory) == 0


def test_what_cannot_carry_a_verdict_is_left_alone(recording):
    """The model does not come back from a supply of nothing, or from frozen oil."""
    test = resolve_test("open" if recording.test_id == 1 else "closed")
    online = OnlineIdentification(test, default_actuator())
    samples = recording.samples
    everywhere = np.zeros_like(samples.saturated)
    everywhere[1] = True
    for unfit in (
        replace(recording, environment=Environment(0.0, 0.0, 40.0)),
        replace(recording, environment=Environment(21e6, 0.0, -100.0)),
        replace(recording, samples=replace(samples, saturated=everywhere)),
        replace(recording, test_id=99),
    ):
        online.take(unfit)
        assert len(online.memory) == 0
    online.take(recording)
    assert len(online.memory) > 0


def test_a_test_without_a_quiet_part_is_not_worked_ahead():
    test = resolve_test("open")
    windows = structs.replace(test.windows, refinement=((0.5, 5.5),))
    online = OnlineIdentification(structs.replace(test, windows=windows), default_actuator())
    assert online.due_s == ()
