"""Units with one effect or two, which a fast search over all effects misses in closed loop.

When the effects of a calibrated unit are taken to have changed since its calibration. Severities of
units whose data differ from their file by its tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest
from msgspec.structs import replace

from ehadiag import default_actuator
from ehadiag.assess.verdict import objections_to_estimate
from ehadiag.core.actuator import with_tolerance
from ehadiag.identify import nuisance_estimate
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.identification_session import identify
from ehadiag.identify.prior import JointPrior, UnitPrior, unit_prior
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.simulation import simulate
from ehadiag_tools.simulator.units import COARSE_STEP, random_unit, record
from firmware_iface.stored_test import resolve_test


def identified(test, truth, effects):
    stored, actuator = resolve_test(test), default_actuator()
    done = simulate(actuator, stored, Faults(*truth), effects, seed=3, step=1e-6)
    recording = done.recording("simulated")
    return identify([build_experiment(recording.samples, recording.environment, stored, actuator)])


def check(test, truth, effects, most=2e-3):
    found = identified(test, truth, effects)
    assert objections_to_estimate(found) == []
    for item, true in zip(found.estimates, truth, strict=True):
        assert abs(item.value - true) <= 4.0 * item.std + 1e-4
    np.testing.assert_allclose([item.value for item in found.estimates], truth, atol=most)
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
    """Without the time before the motion, when the noise moves the spool, it is an offset."""
    effects = Effects(load=-40.0, gain_change=-0.03, hysteresis=0.03, backlash=2e-6)
    found = check("closed", (0.2, 0.6, 0.7), effects, most=0.012)
    offset = -40.0 / default_actuator().jack.AJ
    assert found.nuisances["pressure_offset"].value == pytest.approx(offset, rel=0.05)


@pytest.mark.slow
def test_two_effects_of_a_healthy_unit_in_closed_loop():
    effects = Effects(null_bias=1e-4, gain_change=0.02)
    found = check("closed", (0.02, 0.0, 0.01), effects)
    assert found.nuisances["torque_motor_gain"].value == pytest.approx(0.02, rel=0.02)


@dataclass(frozen=True)
class Answer:
    excess: float
    explained: bool = False


CALIBRATED = UnitPrior(joint=JointPrior(("null_bias",), np.zeros(1), np.array([[1e-16]])))
"""A unit of which one effect is known well."""


@pytest.mark.parametrize(
    ("as_known", "loosened", "taken"),
    [
        (1.17, 1.14, 1.17),  # wear brings out what the unit's model leaves
        (1.9, 1.7, 1.9),  # the effects explain little of it
        (6.0, 1.1, 1.1),
    ],
)
def test_effects_are_loosened_only_where_that_explains_what_the_calibration_does_not(
    monkeypatch, as_known, loosened, taken
):
    def answer(_experiments, settings, _considered):
        return Answer(as_known if settings.joint is CALIBRATED.joint else loosened)

    monkeypatch.setattr(nuisance_estimate, "estimate_nuisances", answer)
    monkeypatch.setattr(nuisance_estimate, "considered_parameters", lambda *_: ())
    known = replace(CALIBRATED, aliases=(object(),))
    freeing = nuisance_estimate.NuisanceEstimator(known, effects=(), progress=lambda _share: None)
    found = freeing.estimated([], None)
    assert found.excess == taken


TRUTH = (0.51, 0.35, 0.14)


@lru_cache(maxsize=2)
def found(test):
    unit = random_unit(np.random.default_rng(7), data=True)
    recording = record(unit, resolve_test(test), Faults(*TRUTH), seed=7, step=COARSE_STEP)
    actuator = with_tolerance(default_actuator(), 0.05)
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test(test), actuator
    )
    return identify([experiment], prior=unit_prior(actuator))


@pytest.mark.slow
@pytest.mark.parametrize("test", ["open", "closed"])
def test_ten_data_five_percent_off_cost_little_and_are_in_the_interval(test):
    result = found(test)
    assert np.mean([abs(e.value - t) for e, t in zip(result.estimates, TRUTH, strict=True)]) < 1e-2
    for item, truth in zip(result.estimates, TRUTH, strict=True):
        assert abs(item.value - truth) < 3.0 * item.std
    # The first stage's flow gain passes for clogging, so the interval has its tolerance.
    assert result.named("Kintas").std > 0.01
    assert result.named("FSS").std < 0.02
    assert {"datum_KSF", "datum_GQ", "datum_MJ"} <= set(result.freed)
    assert "datum_GQF" not in result.freed
