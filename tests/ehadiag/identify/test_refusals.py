"""What no effect explains is refused soon; a load that was not estimated is recognised."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag import default_actuator
from ehadiag.assess.verdict import objections_to_estimate
from ehadiag.identify.estimates import (
    is_pressure_misfit,
    is_unexplainable,
    misses_only_pressure,
    signal_excess_costs,
)
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.identification_session import identify
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


LOADED = 0.2, 0.1, 0.3


def loaded(load, test="open"):
    done = simulate(
        default_actuator(),
        resolve_test(test),
        Faults(*LOADED),
        Effects(load=load),
        seed=3,
        step=1e-6,
    )
    return experiment_of(done.recording("simulated"), test)


def test_a_load_that_nobody_estimated_is_found() -> None:
    found = identify([loaded(50.0)])
    assert not objections_to_estimate(found)
    assert found.nuisances["load"].value == pytest.approx(50.0, abs=2.0)
    assert np.abs(np.subtract([item.value for item in found.estimates], LOADED)).max() < 0.002


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


def test_hopeless_is_much_on_many_ticks_or_the_pressure_alone() -> None:
    noise = np.random.default_rng(1).standard_normal((2, 4000))
    assert not is_unexplainable(noise)
    waves = noise + np.array([[0.0], [1.0]]) * 20.0 * np.sin(np.arange(4000) / 200.0)
    assert is_unexplainable(waves)
    assert is_pressure_misfit(waves)
    assert not is_unexplainable(waves[::-1]), "the spool may be explained elsewhere"
    assert not is_pressure_misfit(waves[::-1])
    assert is_unexplainable(waves[[1, 1]])
    bursts = noise.copy()
    bursts[1, 1000:1300] += 400.0
    assert misses_only_pressure(bursts)
    assert not is_unexplainable(bursts), "so few may be of a break-away"
    assert not is_unexplainable(bursts[[1, 1]])
    spool, pressure = signal_excess_costs(noise)
    assert spool == pytest.approx(1.0, abs=0.1)
    assert pressure == pytest.approx(1.0, abs=0.1)
    assert signal_excess_costs(np.zeros((1, 5))) == [0.0]
