"""The objective: what counts, what does not, and that digits repeat."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_cases import own_experiment, own_samples, recorded

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Environment
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.search.objective import SEARCH_CAP, Objective
from ehadiag.identify.spans import ANCHOR_LSB, lay_out, unknowns_of
from ehadiag.model.parameters import FAULTS
from ehadiag.model.simd.model import SimdModel

share = st.floats(0.0, 1.0)
candidates = st.lists(st.tuples(share, share, share), min_size=1, max_size=9).map(np.array)


def objective_of(experiments, windows=None, **options):
    batch = lay_out(experiments, windows, **options)
    return Objective(SimdModel(batch, unknowns_of(experiments, FAULTS)))


@pytest.fixture(scope="module")
def objective():
    return objective_of([recorded("paper-closed-2.blf", "closed")])


@given(candidates)
@settings(max_examples=15)
def test_one_or_many_candidates_give_the_same_digits(objective, rows):
    together = objective(rows)
    alone = np.array([objective(row[None])[0] for row in rows])
    np.testing.assert_array_equal(together, alone)


@given(candidates)
@settings(max_examples=10)
def test_a_repeated_call_gives_the_same_digits(objective, rows):
    np.testing.assert_array_equal(objective(rows), objective(rows))


@given(candidates)
@settings(max_examples=10)
def test_cost_is_at_most_the_cap_of_each_sample(objective, rows):
    samples = np.count_nonzero(objective.model.batch.weight)
    cost = objective(rows)
    assert (cost >= 0.0).all()
    assert (cost <= SEARCH_CAP * samples).all()


def test_the_truth_costs_about_one_a_sample(objective):
    samples = np.count_nonzero(objective.model.batch.weight)
    cost = objective(
        np.array([[0.3, 0.6, 0.3], [0.35, 0.6, 0.3], [0.3, 0.7, 0.3], [0.3, 0.6, 0.4]])
    )
    assert cost[0] / samples == pytest.approx(1.0, abs=0.15)
    assert (cost[1:] > 2.0 * cost[0]).all()


def test_evaluations_are_counted(objective):
    before = objective.evaluations
    objective(np.full((7, 3), 0.5))
    objective(np.full((1, 3), 0.5))
    assert objective.evaluations == before + 8


def test_recordings_add_up():
    """Two recordings cost what they cost alone."""
    one, two = recorded("paper-open-2.blf", "open"), recorded("paper-closed-2.blf", "closed")
    x = np.array([[0.31, 0.59, 0.33], [0.9, 0.1, 0.5]])
    both = objective_of([one, two], anchor_lsb=ANCHOR_LSB)(x)
    apart = [objective_of([item], anchor_lsb=ANCHOR_LSB)(x) for item in (one, two)]
    np.testing.assert_allclose(both, apart[0] + apart[1], rtol=1e-12)


def test_missing_and_saturated_samples_cost_nothing():
    samples = own_samples((0.3, 0.3, 0.3))
    samples.spool[1000:] = np.nan
    samples.saturated[2, 1000:] = True
    samples.pressure[1000:] = 1e9
    test = resolve_test("open")
    broken = build_experiment(samples, Environment(), test, default_actuator())
    objective = objective_of([broken])
    assert np.count_nonzero(objective.model.batch.weight) == 2 * 1000
    assert objective(np.full((1, 3), 0.3))[0] < 2.0 * 2000


def test_windows_limit_what_counts():
    experiment = own_experiment((0.3, 0.3, 0.3))
    batch = lay_out([experiment], [((3.5, 4.5), (5.0, 5.5))], lead=0.1, channels=(False, True))
    assert np.count_nonzero(batch.weight[0]) == 0
    assert np.count_nonzero(batch.weight[1]) == 1500
    np.testing.assert_array_equal(np.diff(batch.start), [1100, 600])


def test_a_span_outside_the_recording_is_refused():
    with pytest.raises(ValueError, match="no span"):
        lay_out([own_experiment((0.3, 0.3, 0.3))], [((7.0, 8.0),)])
