"""The last part of a test, added to the optimum of the rest."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from identify_cases import named, own_experiment

from ehadiag.identify.refine.first_part import anchored_derivatives, refine_first_part
from ehadiag.identify.refine.least_squares import refine
from ehadiag.identify.refine.update import add_last_part
from ehadiag.identify.textbook import first_ticks
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import FAULT_NAMES

FAULTS = (0.4, 0.5, 0.6)


def parts(experiments, faults=FAULTS):
    until = [first_ticks(item) for item in experiments]
    start = named(np.clip(np.array(faults) + 1e-4, 0.0, 1.0))
    first = refine_first_part(experiments, until, start)
    return until, first, first.judged(experiments)


def severities(found):
    return np.array([found.values[name] for name in FAULT_NAMES])


def of_severities(found, values):
    names = [item.name for item in found.parameters]
    return np.array([values[names.index(name)] for name in FAULT_NAMES])


def deviations(experiments):
    """Distance of the last step's optimum, and of the first part's, from that of one descent."""
    until, first, judged = parts(experiments)
    whole = refine(anchored_derivatives(judged), named(FAULTS))
    std = of_severities(whole, np.sqrt(np.diag(covariance(whole))))
    found = add_last_part(judged, until, first)
    at = severities(whole)
    return (severities(found) - at) / std, (severities(first.refined) - at) / std


@pytest.mark.parametrize("seed", [4, 6])
def test_one_step_leads_where_a_descent_on_the_whole_test_leads(seed):
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
    found = add_last_part(judged, until, first)
    assert found.residuals.shape == (2, experiment.ticks)
    # By a few break-aways more or less, which each round sees anew.
    gained = np.diag(found.normal) / np.diag(first.refined.normal)
    assert gained.min() > 0.9
    assert gained.mean() > 1.05
    assert found.used[:, until[0] :].mean() > 0.9
    assert not np.any(found.jacobian[:, ~found.used])


@pytest.mark.parametrize("bound", [0.0, 1.0])
def test_a_severity_at_its_bound_stays_where_the_first_part_pulls_it_out(bound):
    experiments = [own_experiment((0.5, bound, 0.5), seed=3)]
    until, first, judged = parts(experiments, (0.5, bound, 0.5))
    found = add_last_part(judged, until, first)
    outward = 1.0 if bound else -1.0
    refined = first.refined
    place = [item.name for item in refined.parameters].index("FSS")
    # A hundred times what the last part can say.
    rows = refined.jacobian[place]
    pulling = 100.0 * outward * rows / np.abs(rows).max()
    x = refined.x.copy()
    for k, item in enumerate(refined.parameters):
        x[k] = named((0.5, bound, 0.5)).get(item.name, x[k] * refined.scale[k]) / refined.scale[k]
    pulled = replace(refined, x=x, residuals=refined.residuals - pulling)
    held = add_last_part(judged, until, replace(first, refined=pulled))
    assert held is not None
    assert held.values["FSS"] == bound
    assert np.abs(severities(found) - (0.5, bound, 0.5)).max() < 1e-3


def test_a_first_part_that_is_off_is_not_mended_by_one_step():
    experiments = [own_experiment(FAULTS)]
    until, first, judged = parts(experiments)
    std = np.sqrt(np.diag(covariance(first.refined))) / first.refined.scale
    severity = [item.name in FAULT_NAMES for item in first.refined.parameters]
    off = replace(first.refined, x=first.refined.x + np.where(severity, 60.0 * std, 0.0))
    assert add_last_part(judged, until, replace(first, refined=off)) is None


def test_the_first_part_holds_all_windows_in_whatever_order():
    experiment = own_experiment(FAULTS)
    windows = msgspec.structs.replace(
        experiment.test.windows, FSS=((4.2, 5.4),), refinement=((0.2, 1.2),)
    )
    test = msgspec.structs.replace(experiment.test, windows=windows)
    assert first_ticks(experiment) == 5000
    assert first_ticks(replace(experiment, test=test)) == 5400


def test_a_recording_that_ends_early_has_no_last_part():
    experiment = own_experiment(FAULTS)
    short = replace(
        experiment,
        trace=replace(experiment.trace, current=experiment.trace.current[:4900]),
        spool=experiment.spool[:4900],
        pressure=experiment.pressure[:4900],
    )
    until, first, judged = parts([short])
    found = add_last_part(judged, until, first)
    std = of_severities(found, np.sqrt(np.diag(covariance(found))))
    assert np.all(np.abs(severities(found) - severities(first.refined)) < 0.5 * std)
    assert found.residuals.shape == first.refined.residuals.shape
