"""An identification that is fed while the test runs: the answer of the recording alone, sooner.

The optimum on the whole test, from that on its first part.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_cases import named, own_experiment, recorded
from msgspec.structs import replace

from ehadiag import Samples, default_actuator
from ehadiag.identify.estimates import estimate_covariance
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.identification_session import IdentificationSession, identify
from ehadiag.identify.least_squares import refine_severities
from ehadiag.identify.partial_refinement import (
    add_last_part,
    anchored_derivatives,
    first_part_ticks,
    refine_first_part,
)
from ehadiag.identify.staged_search import (
    STAGE_SHARES,
    first_approximation_ready_at,
    stage_ready_at,
)
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_sim.conditions import Faults
from ehadiag_sim.simulation import simulate
from firmware_iface.stored_test import resolve_test

FAULTS = (0.4, 0.5, 0.6)
STEPS = 1 + len(STAGE_SHARES) + 1
"""First approximation, stages of the search, refinement but its last step."""


@pytest.fixture(scope="module", params=["open", "closed"])
def recording(request):
    test = resolve_test(request.param)
    done = simulate(default_actuator(), test, Faults(*FAULTS), seed=3, step=1e-6)
    return test, done.recording("simulated")


def first_ticks_of(samples, ticks):
    """The samples as they were after so many ticks."""
    arrays = {
        name: getattr(samples, name)[..., :ticks]
        for name in Samples.__struct_fields__
        if isinstance(getattr(samples, name), np.ndarray)
    }
    return replace(samples, **arrays)


def experiment_after(recording, ticks=None):
    test, whole = recording
    samples = whole.samples if ticks is None else first_ticks_of(whole.samples, ticks)
    return build_experiment(samples, whole.environment, test, default_actuator())


def figures_of(result):
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
    return [getattr(item, name) for name in item.__struct_fields__]


@pytest.fixture(scope="module")
def alone(recording):
    return identify([experiment_after(recording)])


def test_fed_stage_by_stage_it_gives_the_digits_of_the_recording_alone(recording, alone):
    test, _ = recording
    session = IdentificationSession()
    ends = [
        first_approximation_ready_at(test),
        *(stage_ready_at(test, i) for i in range(len(STAGE_SHARES))),
    ]
    for end in ends:
        session.feed([experiment_after(recording, round(end * test.rate) + 7)])
    before = session.reused
    ahead = session.finish([experiment_after(recording)])
    assert session.reused - before >= STEPS
    assert figures_of(ahead) == figures_of(alone)


@settings(max_examples=6, deadline=None)
@given(cuts=st.lists(st.integers(0, 5500), max_size=5))
def test_fed_whenever_it_gives_the_digits_of_the_recording_alone(recording, alone, cuts):
    """At any instants, in any order, again and again: what is fed may change nothing."""
    session = IdentificationSession()
    for ticks in cuts:
        if ticks:
            session.feed([experiment_after(recording, ticks)])
    assert figures_of(session.finish([experiment_after(recording)])) == figures_of(alone)


def test_two_tests_are_fed_together():
    both = [recorded("paper-open-3.blf", "open"), recorded("paper-closed-3.blf", "closed")]
    session = IdentificationSession()
    session.feed(both)
    assert figures_of(session.finish(both)) == figures_of(identify(both))


def test_an_answer_is_given_again_without_work():
    experiment = own_experiment(FAULTS)
    session = IdentificationSession()
    first = session.finish([experiment])
    before = session.reused
    assert session.finish([experiment]) is first
    assert session.reused == before + 1


def test_stages_follow_the_second_part():
    test = resolve_test("open")
    assert first_approximation_ready_at(test) == pytest.approx(3.5)
    ends = [stage_ready_at(test, stage) for stage in range(len(STAGE_SHARES))]
    assert ends == pytest.approx([4.0, 4.5, 5.0])


def test_other_samples_are_not_answered_from_memory():
    experiment = own_experiment(FAULTS)
    session = IdentificationSession()
    session.feed([experiment])
    assert session.reused == 0
    experiment.spool[4200] += 1e-6  # after the first stage's window, in the others
    session.feed([experiment])
    assert session.reused == 2
    session.seed = 1
    session.feed([experiment])
    assert session.reused == 4, "another seed searches anew; first approximation and refinement not"


def test_another_actuators_data_are_not_answered_from_memory():
    """The same samples, but a jack of another mass: nothing that was found before holds."""
    experiment = own_experiment(FAULTS)
    heavier = experiment.constants._replace(MJ=1.1 * experiment.constants.MJ)
    other = replace(experiment, constants=heavier)
    session = IdentificationSession()
    session.feed([experiment])
    found = session.finish([other])
    assert session.reused == 0
    assert figures_of(found) == figures_of(identify([other]))


def test_too_little_is_left_alone():
    """Not even the first approximation has its windows: nothing is kept, and nothing fails."""
    short = own_experiment(FAULTS)
    session = IdentificationSession()
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


def parts(experiments, faults=FAULTS):
    until = [first_part_ticks(item) for item in experiments]
    start = named(np.clip(np.array(faults) + 1e-4, 0.0, 1.0))
    first = refine_first_part(experiments, until, start)
    return until, first, first.judged(experiments)


def severities(found):
    return np.array([found.values[name] for name in FAULT_NAMES])


def of_severities(found, values):
    names = [item.name for item in found.parameters]
    return np.array([values[names.index(name)] for name in FAULT_NAMES])


def deviations(experiments):
    """Distance of the optimum from the first part's, and of that, from that of one descent."""
    _, first, judged = parts(experiments)
    whole = refine_severities(anchored_derivatives(judged), named(FAULTS))
    std = of_severities(whole, np.sqrt(np.diag(estimate_covariance(whole))))
    found = add_last_part(judged, first)
    at = severities(whole)
    return (severities(found) - at) / std, (severities(first.refined) - at) / std


@pytest.mark.parametrize("seed", [4, 6])
def test_two_rounds_lead_where_a_descent_on_the_whole_test_leads(seed):
    step, without = deviations([own_experiment(FAULTS, seed=seed)])
    assert np.abs(without).max() > 0.4
    assert np.abs(step).max() < 0.2


def test_so_it_does_for_two_tests_together():
    step, without = deviations([own_experiment(FAULTS, seed=seed) for seed in (4, 6)])
    assert np.abs(without).max() > 0.4
    assert np.abs(step).max() < 0.2


def test_the_last_part_adds_its_information_and_its_residuals():
    (experiment,) = pair = [own_experiment(FAULTS)]
    until, first, judged = parts(pair)
    found = add_last_part(judged, first)
    assert found.residuals.shape == (2, experiment.ticks)
    # Without rows that jump, in the first part, too; each round sees break-aways anew.
    sure = np.where(found.used[:, : until[0]], first.refined.jacobian, 0.0).reshape(
        len(found.x), -1
    )
    gained = np.diag(found.normal) / np.diag(sure @ sure.T)
    assert gained.min() > 0.9
    assert gained.mean() > 1.05
    assert found.used[:, until[0] :].mean() > 0.9
    assert not np.any(found.jacobian[:, ~found.used])


@pytest.mark.parametrize("bound", [0.0, 1.0])
def test_a_severity_at_its_bound_is_found_there(bound):
    experiments = [own_experiment((0.5, bound, 0.5), seed=3)]
    _, first, judged = parts(experiments, (0.5, bound, 0.5))
    found = add_last_part(judged, first)
    assert np.abs(severities(found) - (0.5, bound, 0.5)).max() < 1e-3


def test_from_a_first_part_that_is_off_all_is_refined():
    experiments = [own_experiment(FAULTS)]
    _, first, judged = parts(experiments)
    std = np.sqrt(np.diag(estimate_covariance(first.refined))) / first.refined.scale
    severity = [item.name in FAULT_NAMES for item in first.refined.parameters]
    off = replace(first.refined, x=first.refined.x + np.where(severity, 20.0 * std, 0.0))
    found = add_last_part(judged, replace(first, refined=off))
    near = add_last_part(judged, first)
    assert found.evaluations > 2 * near.evaluations
    assert found.converged
    distance = (severities(found) - severities(near)) / of_severities(
        near, np.sqrt(np.diag(estimate_covariance(near)))
    )
    assert np.abs(distance).max() < 0.3


def test_the_first_part_holds_all_windows_in_whatever_order():
    experiment = own_experiment(FAULTS)
    windows = msgspec.structs.replace(
        experiment.test.windows, FSS=((4.2, 5.4),), refinement=((0.2, 1.2),)
    )
    test = msgspec.structs.replace(experiment.test, windows=windows)
    assert first_part_ticks(experiment) == 5000
    assert first_part_ticks(replace(experiment, test=test)) == 5400


def test_a_recording_that_ends_early_has_no_last_part():
    experiment = own_experiment(FAULTS)
    short = replace(
        experiment,
        trace=replace(experiment.trace, current=experiment.trace.current[:4900]),
        spool=experiment.spool[:4900],
        pressure=experiment.pressure[:4900],
    )
    _, first, judged = parts([short])
    found = add_last_part(judged, first)
    std = of_severities(found, np.sqrt(np.diag(estimate_covariance(found))))
    assert np.all(np.abs(severities(found) - severities(first.refined)) < 0.5 * std)
    assert found.residuals.shape == first.refined.residuals.shape
