"""A unit with effects beyond the basic ones: what is learned of it, and that it is no sensor's."""

from __future__ import annotations

import pytest

from ehadiag.calibration.unit import calibrate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from ehadiag.identify.experiment import build_experiment
from ehadiag.model.nuisances import NUISANCES
from ehadiag.model.unit import unit_constants
from ehadiag_sim.plant.conditions import Effects, Faults, Strangers
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, record

TESTS = bundled_tests()
SHIFT = 1.8e-6


def recorded(effects, name="open", faults=None):
    return record(Unit(effects=effects), TESTS[name], faults, seed=5, step=COARSE_STEP)


@pytest.mark.slow
def test_displaced_lands_and_a_bent_torque_are_told_from_all_else():
    effects = Effects(
        null_bias=4e-5,
        hysteresis=0.02,
        strangers=Strangers(land_shift=SHIFT, torque_cubic=0.03),
    )
    both = [recorded(effects, name) for name in ("open", "closed")]
    found = calibrate(both, default_actuator(), TESTS.values())
    assert found.reasons == ()
    assert found.actuator is not None
    assert found.actuator.calibration is not None
    learned = found.actuator.calibration.effects
    assert learned["land_shift"] == pytest.approx(SHIFT, rel=0.03)
    assert learned["torque_odd"] == pytest.approx(0.03, rel=0.05)
    basic = {"null_bias", "torque_motor_gain", "hysteresis", "backlash"}
    assert len(set(learned) - basic) <= 3


@pytest.fixture(scope="module")
def stuck():
    """With so much jack friction that the jack stands still beside the pressure of its lands."""
    return recorded(Effects(strangers=Strangers(land_shift=SHIFT)), faults=Faults(0.0, 0.0, 0.9))


@pytest.fixture
def built_with(stuck, monkeypatch):
    def build(name=None, value=0.0):
        def known(actuator, environment):
            constants = unit_constants(actuator, environment)
            return constants._replace(**effect.changes(constants, value)) if effect else constants

        effect = next((item for item in NUISANCES if item.name == name), None)
        monkeypatch.setattr("ehadiag.identify.experiment.unit_constants", known)
        return build_experiment(stuck.samples, stuck.environment, TESTS["open"], default_actuator())

    return build


def test_pressure_at_rest_of_displaced_lands_is_no_offset(built_with):
    assert built_with().origin == pytest.approx(-SHIFT, rel=0.05)
    known = built_with("land_shift", SHIFT)
    assert known.origin == 0.0
    assert known.pressure_offset == pytest.approx(0.0, abs=2e4)


@pytest.mark.parametrize(("name", "value"), [("land_shift", 2e-9), ("load", 3.0)])
def test_pressure_at_rest_beyond_what_is_asked_for_is_of_a_spool_beside_the_middle(
    built_with, name, value
):
    plain, known = built_with(), built_with(name, value)
    assert known.origin == pytest.approx(plain.origin, rel=0.01)
    assert known.pressure_offset == 0.0
    assert known.spool_offset == pytest.approx(plain.spool_offset, abs=1e-8)
