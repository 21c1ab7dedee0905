"""Units with one effect or two, which a fast search over all effects misses in closed loop."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag.assess.acceptance import objections_to_estimate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.session import identify
from ehadiag_sim.plant.conditions import Effects, Faults
from ehadiag_sim.plant.simulator import simulate


def identified(test, truth, effects):
    stored, actuator = resolve_test(test), default_actuator()
    done = simulate(actuator, stored, Faults(*truth), effects, seed=3, step=1e-6)
    recording = done.recording("simulated")
    return identify([build_experiment(recording.samples, recording.environment, stored, actuator)])


def check(test, truth, effects):
    found = identified(test, truth, effects)
    assert objections_to_estimate(found) == []
    for item, true in zip(found.estimates, truth, strict=True):
        assert abs(item.value - true) <= 4.0 * item.std + 1e-4
    np.testing.assert_allclose([item.value for item in found.estimates], truth, atol=2e-3)
    return found


def test_a_little_gain_in_closed_loop():
    found = check("closed", (0.1, 0.1, 0.1), Effects(gain_change=1e-3))
    assert found.nuisances["torque_motor_gain"].value == pytest.approx(1e-3, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("test", "truth", "effects", "name", "value"),
    [
        ("closed", (0.0, 0.0, 0.0), Effects(null_bias=1e-4), "null_bias", 1e-4),
        ("closed", (0.0, 0.0, 0.0), Effects(hysteresis=2e-3), "hysteresis", 2e-3),
        ("open", (0.2, 0.1, 0.3), Effects(load=50.0), "load", 50.0),
    ],
)
def test_one_effect_alone(test, truth, effects, name, value):
    found = check(test, truth, effects)
    assert found.nuisances[name].value == pytest.approx(value, rel=0.1)


def test_a_load_beside_other_effects_in_closed_loop():
    effects = Effects(load=-40.0, gain_change=-0.03, hysteresis=0.03, backlash=2e-6)
    found = check("closed", (0.2, 0.6, 0.7), effects)
    assert found.nuisances["load"].value == pytest.approx(-40.0, rel=0.1)


@pytest.mark.slow
def test_two_effects_of_a_healthy_unit_in_closed_loop():
    effects = Effects(null_bias=1e-4, gain_change=0.02)
    found = check("closed", (0.02, 0.0, 0.01), effects)
    assert found.nuisances["torque_motor_gain"].value == pytest.approx(0.02, rel=0.02)
