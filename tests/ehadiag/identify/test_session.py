"""An identification that is fed while the test runs: the answer of the recording alone, sooner."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_cases import own_experiment, recorded

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Samples
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.search.stages import STAGES, first_ends_at, stage_ends_at
from ehadiag.identify.session import Session, identify
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import simulate

FAULTS = (0.4, 0.5, 0.6)
STEPS = 1 + len(STAGES) + 1
"""First approximation, stages of the search, refinement but its last step."""


@pytest.fixture(scope="module", params=["open", "closed"])
def recording(request):
    test = resolve_test(request.param)
    return test, simulate(default_actuator(), test, Faults(*FAULTS), seed=3).recording("simulated")


def first_ticks_of(samples, ticks):
    """The samples as they were after so many ticks."""
    arrays = {
        field.name: getattr(samples, field.name)[..., :ticks]
        for field in fields(Samples)
        if isinstance(getattr(samples, field.name), np.ndarray)
    }
    return replace(samples, **arrays)


def experiment_after(recording, ticks=None):
    test, whole = recording
    samples = whole.samples if ticks is None else first_ticks_of(whole.samples, ticks)
    return build_experiment(samples, whole.environment, test, default_actuator())


def said(result):
    """All numbers of an identification but the time it took."""
    return (
        [structs_of(item) for item in result.estimates],
        dict(result.nuisances),
        result.covariance.tolist(),
        structs_of(result.fit),
        result.cost,
        result.evaluations,
        result.generations,
        result.attempts,
    )


def structs_of(item):
    return [getattr(item, field.name) for field in fields(item)]


@pytest.fixture(scope="module")
def alone(recording):
    return identify([experiment_after(recording)])


def test_fed_stage_by_stage_it_gives_the_digits_of_the_recording_alone(recording, alone):
    test, _ = recording
    session = Session()
    ends = [first_ends_at(test), *(stage_ends_at(test, i) for i in range(len(STAGES)))]
    for end in ends:
        session.feed([experiment_after(recording, round(end * test.rate) + 7)])
    before = session.reused
    ahead = session.finish([experiment_after(recording)])
    assert session.reused - before >= STEPS
    assert said(ahead) == said(alone)


@settings(max_examples=6, deadline=None)
@given(cuts=st.lists(st.integers(0, 5500), max_size=5))
def test_fed_whenever_it_gives_the_digits_of_the_recording_alone(recording, alone, cuts):
    """At any instants, in any order, again and again: what is fed may change nothing."""
    session = Session()
    for ticks in cuts:
        if ticks:
            session.feed([experiment_after(recording, ticks)])
    assert said(session.finish([experiment_after(recording)])) == said(alone)


def test_two_tests_are_fed_together():
    both = [recorded("paper-open-3.blf", "open"), recorded("paper-closed-3.blf", "closed")]
    session = Session()
    session.feed(both)
    assert said(session.finish(both)) == said(identify(both))


def test_an_answer_is_given_again_without_work():
    experiment = own_experiment(FAULTS)
    session = Session()
    first = session.finish([experiment])
    before = session.reused
    assert session.finish([experiment]) is first
    assert session.reused == before + 1


def test_stages_follow_the_second_part():
    test = resolve_test("open")
    assert first_ends_at(test) == pytest.approx(3.5)
    ends = [stage_ends_at(test, stage) for stage in range(len(STAGES))]
    assert ends == pytest.approx([4.0, 4.5, 5.0])


def test_other_samples_are_not_answered_from_memory():
    experiment = own_experiment(FAULTS)
    session = Session()
    session.feed([experiment])
    assert session.reused == 0
    experiment.spool[4200] += 1e-6  # after the first stage's window, in the others
    session.feed([experiment])
    assert session.reused == 2
    session.seed = 1
    session.feed([experiment])
    assert session.reused == 3, "another seed searches anew; the first approximation needs none"


def test_another_actuators_data_are_not_answered_from_memory():
    """The same samples, but a jack of another mass: nothing that was found before holds."""
    experiment = own_experiment(FAULTS)
    heavier = experiment.constants._replace(MJ=1.1 * experiment.constants.MJ)
    other = replace(experiment, constants=heavier)
    session = Session()
    session.feed([experiment])
    found = session.finish([other])
    assert session.reused == 0
    assert said(found) == said(identify([other]))


def test_too_little_is_left_alone():
    """Not even the first approximation has its windows: nothing is kept, and nothing fails."""
    short = own_experiment(FAULTS)
    session = Session()
    for ticks in (1, 300, 3400):
        session.feed([cut(short, ticks)])
    session.finish([short])
    assert session.reused == 0


def cut(experiment, ticks):
    return replace(
        experiment,
        trace=replace(experiment.trace, current=experiment.trace.current[:ticks]),
        spool=experiment.spool[:ticks],
        pressure=experiment.pressure[:ticks],
    )


def test_a_search_that_ends_beside_the_optimum_it_began_at_is_begun_there():
    """Its optimum leaves 18 % of the residuals unexplained, what it began from hardly any."""
    test, actuator = resolve_test("closed"), default_actuator()
    truth = (0.20149922, 0.66335092, 0.05055473)
    done = simulate(actuator, test, Faults(*truth), seed=37, step=1e-6)
    recording = done.recording("simulated")
    experiment = build_experiment(recording.samples, recording.environment, test, actuator)
    found = identify([experiment])
    assert not found.freed
    np.testing.assert_allclose([item.value for item in found.estimates], truth, atol=2e-3)
