"""What no effect explains is refused soon; a load that was not estimated is recognised."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag import default_actuator
from ehadiag.assess.verdict import objections_to_estimate
from ehadiag.identify.estimates import is_pressure_misfit, is_unexplainable, signal_excess_costs
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.identification_session import identify
from ehadiag.identify.nuisance_estimate import estimate_nuisances, would_effect_explain
from ehadiag.identify.nuisance_search import NuisanceSearchSettings
from ehadiag.identify.partial_refinement import CONSIDERED_PARAMETERS
from ehadiag.identify.prior import basic_nuisances_of
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS, parameter
from ehadiag_sim.broken_hardware import simulate_broken
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.simulation import simulate
from ehadiag_tools.accuracy.cases import UnitCase, perform_unit
from firmware_iface.stored_test import resolve_test

MOST_RUNS = {"open": 1200, "closed": 3300}
"""Of the model, to refuse a recording: on short windows among them. In closed loop a search may end
beside the optimum, so that others are made which take their time."""


def experiment_of(recording, test):
    return build_experiment(
        recording.samples, recording.environment, resolve_test(test), default_actuator()
    )


def broken_experiment(kind, test, seed=4):
    rng, actuator = np.random.default_rng(seed), default_actuator()
    faults = Faults(0.15, 0.05, 0.1)
    return experiment_of(
        simulate_broken(kind, rng, actuator, resolve_test(test), faults, step=1e-6), test
    )


def loaded(load, test="open"):
    done = simulate(
        default_actuator(),
        resolve_test(test),
        Faults(0.2, 0.1, 0.3),
        Effects(load=load),
        seed=3,
        step=1e-6,
    )
    return experiment_of(done.recording("simulated"), test)


def with_all_effects(experiment):
    free = (*FAULTS, *SENSOR_OFFSETS, *basic_nuisances_of(0.0))
    return estimate_nuisances(
        [experiment], NuisanceSearchSettings(free, give_up=True, budget=300), CONSIDERED_PARAMETERS
    )


def test_a_load_that_was_not_estimated_is_recognised_and_nothing_else_is_taken_for_one() -> None:
    missing = with_all_effects(loaded(50.0))
    assert not missing.explained
    assert would_effect_explain(parameter("load"), missing)
    starved = with_all_effects(broken_experiment("starved", "open"))
    assert not would_effect_explain(parameter("load"), starved)


@pytest.mark.parametrize(
    ("kind", "test"),
    [
        ("starved", "open"),
        ("loose-pressure", "open"),
        ("lost-surface", "closed"),
        ("starved", "closed"),
    ],
)
def test_what_no_effect_explains_is_refused_after_the_first_attempts(kind: str, test: str) -> None:
    found = identify([broken_experiment(kind, test)])
    assert objections_to_estimate(found)
    assert found.evaluations <= MOST_RUNS[test]


@pytest.mark.parametrize("case", [22, pytest.param(25, marks=pytest.mark.slow)])
def test_a_search_that_went_astray_on_a_sound_unit_goes_on(case: int) -> None:
    """A third of the residuals are outliers after a start; both were NOT TESTED once."""
    done = perform_unit(UnitCase("closed", case, seed=71))
    assert done["verdict"] == "answered"
    assert np.abs(np.subtract(done["value"], done["faults"])).max() < 0.002


def test_hopeless_is_much_on_many_ticks_or_very_much_on_few() -> None:
    noise = np.random.default_rng(1).standard_normal((2, 4000))
    assert not is_unexplainable(noise, 2)
    slow = 20.0 * np.sin(np.arange(4000) / 200.0)
    waves = noise + np.array([[0.0], [1.0]]) * slow
    assert is_unexplainable(waves, 1)
    assert is_pressure_misfit(waves)
    assert not is_pressure_misfit(waves[::-1])
    bursts = noise.copy()
    bursts[1, 1000:1300] += 400.0
    assert not is_unexplainable(bursts, 1)
    assert is_unexplainable(bursts, 2)
    assert not is_unexplainable(bursts, 2, astray=True)  # of a search that went astray
    assert is_unexplainable(bursts[::-1], 2, astray=True)  # a break-away shows in the pressure, too
    assert not is_unexplainable(bursts[[1, 1]], 2, astray=True)
    bursts[1, 1000:2000] += 400.0
    assert not is_unexplainable(bursts, 1, astray=True)
    assert is_unexplainable(bursts, 2, astray=True)
    assert not is_unexplainable(bursts[[1, 1]], 4, astray=True)  # the budget ends it
    assert not is_unexplainable(waves, 1, astray=True)
    assert is_unexplainable(waves, 1, astray=True, soon=True)  # the spool is explained
    assert is_unexplainable(waves, 2, astray=True)
    assert is_unexplainable(waves[[1, 1]], 1, astray=True)
    both = np.array([noise[0] + 3.0 * np.sin(np.arange(4000) / 200.0), waves[1]])
    assert not is_unexplainable(both, 1, astray=True, soon=True)
    assert is_unexplainable(both, 2, astray=True)
    spool, pressure = signal_excess_costs(noise)
    assert spool == pytest.approx(1.0, abs=0.1)
    assert pressure == pytest.approx(1.0, abs=0.1)
    assert signal_excess_costs(np.zeros((1, 5))) == [0.0]
