"""What no effect explains is refused soon; a load that was not estimated is recognised."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag.assess.acceptance import objections_to_estimate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.nuisance.estimate import estimate
from ehadiag.identify.nuisance.explained import (
    excess_of_signals,
    is_hopeless,
    is_of_the_pressure,
)
from ehadiag.identify.nuisance.prior import nuisances_of
from ehadiag.identify.nuisance.trial import would_explain
from ehadiag.identify.refine.first_part import CONSIDERED
from ehadiag.identify.session import identify
from ehadiag.model.parameters import FAULTS, OFFSETS, REGISTRY, parameter
from ehadiag_sim.faults.hardware import broken
from ehadiag_sim.plant.conditions import Effects, Faults
from ehadiag_sim.plant.simulator import simulate
from ehadiag_tools.accuracy.nuisances import UnitRun, perform_unit

MOST_RUNS = {"open": 1200, "closed": 2800}
"""Of the model, to refuse a recording: on short windows among them. In closed loop a search may end
beside the optimum, so that others are made which take their time."""


def experiment_of(recording, test):
    return build_experiment(
        recording.samples, recording.environment, resolve_test(test), default_actuator()
    )


def broken_experiment(kind, test, seed=4):
    rng, actuator = np.random.default_rng(seed), default_actuator()
    faults = Faults(0.15, 0.05, 0.1)
    return experiment_of(broken(kind, rng, actuator, resolve_test(test), faults, step=1e-6), test)


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
    free = (*FAULTS, *OFFSETS, *nuisances_of(REGISTRY))
    return estimate([experiment], free, considered=CONSIDERED, give_up=True, budget=300)


def test_a_load_that_was_not_estimated_is_recognised_and_nothing_else_is_taken_for_one() -> None:
    missing = with_all_effects(loaded(50.0))
    assert not missing.explained
    assert would_explain(parameter("load"), missing, seed=0)
    starved = with_all_effects(broken_experiment("starved", "open"))
    assert not would_explain(parameter("load"), starved, seed=0)


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


@pytest.mark.parametrize("case", [22, 25])
def test_a_search_that_went_astray_on_a_sound_unit_goes_on(case: int) -> None:
    """A third of the residuals are outliers after two starts; both were NOT TESTED once."""
    done = perform_unit(UnitRun("closed", case, seed=71, nuisances="auto"))
    assert not done["not_tested"]
    assert done["attempts"] > 2
    assert np.abs(np.subtract(done["value"], done["faults"])).max() < 0.002


def test_hopeless_is_much_on_many_ticks_or_very_much_on_few() -> None:
    noise = np.random.default_rng(1).standard_normal((2, 4000))
    assert not is_hopeless(noise, 2)
    slow = 20.0 * np.sin(np.arange(4000) / 200.0)
    waves = noise + np.array([[0.0], [1.0]]) * slow
    assert is_hopeless(waves, 1)
    assert is_of_the_pressure(waves)
    assert not is_of_the_pressure(waves[::-1])
    bursts = noise.copy()
    bursts[1, 1000:1300] += 400.0
    assert not is_hopeless(bursts, 1)
    assert is_hopeless(bursts, 2)
    assert not is_hopeless(bursts, 2, astray=True)  # of a search that went astray
    assert is_hopeless(bursts[::-1], 2, astray=True)  # a break-away shows in the pressure, too
    assert not is_hopeless(bursts[[1, 1]], 2, astray=True)
    bursts[1, 1000:2000] += 400.0
    assert not is_hopeless(bursts, 1, astray=True)
    assert is_hopeless(bursts, 2, astray=True)
    assert not is_hopeless(bursts[[1, 1]], 3, astray=True)
    assert is_hopeless(bursts[[1, 1]], 4, astray=True)
    assert not is_hopeless(waves, 1, astray=True)
    assert is_hopeless(waves, 2, astray=True)
    assert is_hopeless(waves[[1, 1]], 1, astray=True)
    spool, pressure = excess_of_signals(noise)
    assert spool == pytest.approx(1.0, abs=0.1)
    assert pressure == pytest.approx(1.0, abs=0.1)
    assert excess_of_signals(np.zeros((1, 5))) == [0.0]
