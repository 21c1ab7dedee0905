"""The last part of a test, added to the optimum of the rest."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from identify_cases import own_experiment

from ehadiag.identify.refine.first_part import anchored, prefix_ticks, refine_prefix
from ehadiag.identify.refine.least_squares import refine
from ehadiag.identify.refine.update import add_last_part
from ehadiag.identify.search.stages import Memory
from ehadiag.identify.uncertainty import covariance, normal_matrix

FAULTS = (0.4, 0.5, 0.6)


def parts(experiments, faults=FAULTS):
    prefix = refine_prefix(experiments, np.clip(np.array(faults) + 1e-4, 0.0, 1.0), Memory())
    return prefix, prefix.judged(experiments)


def deviations(experiments):
    """Distance of the last step's optimum, and of the first part's, from that of one descent."""
    prefix, judged = parts(experiments)
    batch, noise = anchored(judged)
    whole = refine(batch, np.array(FAULTS), np.zeros(2), noise)
    std = np.sqrt(np.diag(covariance(whole)))
    found = add_last_part(judged, prefix)
    return (found.values - whole.values) / std, (prefix.refined.values - whole.values) / std


@pytest.mark.parametrize("seed", [4, 6])
def test_one_step_leads_where_a_descent_on_the_whole_test_leads(seed):
    step, without = deviations([own_experiment(FAULTS, seed=seed)])
    assert np.abs(without).max() > 0.4
    assert np.abs(step).max() < 0.2


def test_so_it_does_for_two_tests_together():
    step, without = deviations([own_experiment(FAULTS, seed=seed) for seed in (4, 6)])
    assert np.abs(without).max() > 0.4
    assert np.abs(step).max() < 0.2


def test_the_last_part_adds_its_information_and_its_gaps():
    (experiment,) = pair = [own_experiment(FAULTS)]
    prefix, judged = parts(pair)
    found = add_last_part(judged, prefix)
    assert found.gaps.shape == (2, experiment.ticks)
    assert np.all(np.diag(normal_matrix(found)) > np.diag(normal_matrix(prefix.refined)))
    assert found.used[:, prefix_ticks(experiment) :].mean() > 0.9
    assert not np.any(found.jacobian[:, ~found.used])


@pytest.mark.parametrize("bound", [0.0, 1.0])
def test_a_constant_at_its_bound_stays_where_the_first_part_pulls_it_out(bound):
    experiments = [own_experiment((0.5, bound, 0.5), seed=3)]
    prefix, judged = parts(experiments, (0.5, bound, 0.5))
    found = add_last_part(judged, prefix)
    outward = 1.0 if bound else -1.0
    first = prefix.refined
    # A hundred times what the last part can say.
    pulling = 100.0 * outward * first.jacobian[1] / np.abs(first.jacobian[1]).max()
    pulled = replace(first, values=np.array([0.5, bound, 0.5]), gaps=first.gaps - pulling)
    held = add_last_part(judged, replace(prefix, refined=pulled))
    assert held is not None
    assert held.values[1] == bound
    assert np.abs(found.values - (0.5, bound, 0.5)).max() < 1e-3


def test_a_first_part_that_is_off_is_not_mended_by_one_step():
    experiments = [own_experiment(FAULTS)]
    prefix, judged = parts(experiments)
    std = np.sqrt(np.diag(covariance(prefix.refined)))
    off = replace(prefix.refined, values=prefix.refined.values + 60.0 * std)
    assert add_last_part(judged, replace(prefix, refined=off)) is None


def test_the_first_part_holds_all_windows_in_whatever_order():
    experiment = own_experiment(FAULTS)
    windows = msgspec.structs.replace(
        experiment.test.windows, FSS=((4.2, 5.4),), refinement=((0.2, 1.2),)
    )
    test = msgspec.structs.replace(experiment.test, windows=windows)
    assert prefix_ticks(experiment) == 5000
    assert prefix_ticks(replace(experiment, test=test)) == 5400


def test_a_recording_that_ends_early_has_no_last_part():
    experiment = own_experiment(FAULTS)
    short = replace(
        experiment,
        trace=replace(experiment.trace, current=experiment.trace.current[:4900]),
        spool=experiment.spool[:4900],
        pressure=experiment.pressure[:4900],
    )
    prefix, judged = parts([short])
    found = add_last_part(judged, prefix)
    np.testing.assert_array_equal(found.values, prefix.refined.values)
    np.testing.assert_array_equal(found.gaps, prefix.refined.gaps)
