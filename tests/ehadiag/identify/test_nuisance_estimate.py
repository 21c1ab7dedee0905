"""Severities of actuators with effects that their data do not tell."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from identify_cases import recorded

from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.session import Nuisances, identify
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.simulator.units import random_unit, record

FAULTS = (0.52, 0.6, 0.47)
FREED = ("null_bias", "torque_motor_gain", "hysteresis", "backlash")


@lru_cache(maxsize=4)
def stranger(test, seed=1):
    """Recording of a unit with offsets, gain, null bias, hysteresis and backlash, and the unit."""
    unit = random_unit(np.random.default_rng(seed))
    recording = record(unit, resolve_test(test), Faults(*FAULTS), seed=seed)
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test(test), default_actuator()
    )
    return experiment, unit


def errors(result):
    """Of the severities, in percent of damage."""
    values = np.array([item.value for item in result.estimates])
    return 100.0 * np.abs(values - FAULTS)


@pytest.fixture(scope="module", params=["open", "closed"])
def found(request):
    return request.param, identify([stranger(request.param)[0]])


def test_severities_are_exact_with_all_effects_unknown(found):
    test, result = found
    assert errors(result).mean() < {"open": 0.05, "closed": 0.5}[test]
    for item, truth in zip(result.estimates, FAULTS, strict=True):
        assert abs(item.value - truth) < 4.0 * item.std
        assert item.shown


def test_it_says_what_was_freed_and_what_it_found(found):
    test, result = found
    effects = stranger(test)[1].effects
    assert set(result.freed) == set(FREED)
    truth = (effects.null_bias, effects.gain_change, effects.hysteresis, effects.backlash)
    for name, value in zip(FREED, truth, strict=True):
        nuisance = result.nuisances[name]
        assert abs(nuisance.value - value) < 5.0 * nuisance.std + 1e-9
        assert nuisance.std > 0.0


def test_it_is_explained_and_quick(found):
    _, result = found
    assert result.fit.outliers < 0.01
    assert result.evaluations < 4000


def test_severities_alone_do_not_explain_it():
    result = identify([stranger("open")[0]], nuisances=Nuisances.NONE)
    assert result.freed == ()
    assert result.fit.outliers > 0.015


def test_both_tests_together_are_better_than_closed_loop_alone(found):
    test, alone = found
    if test == "open":
        pytest.skip("against closed loop")
    both = identify([stranger("open")[0], stranger("closed")[0]])
    assert errors(both).mean() < 0.05
    for one, joint in zip(alone.estimates, both.estimates, strict=True):
        assert joint.std < one.std


@pytest.mark.parametrize("test", ["open", "closed"])
def test_a_textbook_actuator_is_identified_as_without_nuisances(test):
    item = recorded(f"paper-{test}-2.blf", test)
    auto, none = (identify([item], nuisances=mode) for mode in (Nuisances.AUTO, Nuisances.NONE))
    assert auto.freed == ()
    assert [e.value for e in auto.estimates] == [e.value for e in none.estimates]
    assert [e.std for e in auto.estimates] == [e.std for e in none.estimates]


@pytest.mark.parametrize("test", ["open", "closed"])
def test_a_textbook_actuator_with_everything_free(test):
    result = identify([recorded(f"paper-{test}-2.blf", test)], nuisances=Nuisances.ALL)
    truth = np.array([0.3, 0.6, 0.3])
    values = np.array([item.value for item in result.estimates])
    assert set(result.freed) == set(FREED)
    assert 100.0 * np.abs(values - truth).mean() < {"open": 0.05, "closed": 0.5}[test]


def test_a_reversed_sensor_is_explained_by_nothing():
    experiment, _ = stranger("open")
    result = identify([replace(experiment, spool=-experiment.spool)])
    assert result.fit.outliers > 0.015
    assert result.evaluations < 4000
