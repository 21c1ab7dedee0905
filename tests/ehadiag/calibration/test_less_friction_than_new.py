"""A unit whose friction as new is less than its data sheet's: no severity from 0 up explains it."""

from dataclasses import replace

import pytest

from ehadiag.calibration.unit import calibrate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from ehadiag.identify.nuisance.knowledge import severities_below
from ehadiag.model.parameters import FAULTS
from ehadiag_sim.plant.conditions import DataErrors, Effects
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, record

TESTS = bundled_tests()


def test_severities_reach_below_zero_by_what_the_data_may_be_off():
    actuator = default_actuator()
    clogging, spool, jack = severities_below(actuator, {"FSS0": 0.1, "FDJ0": 0.1})
    assert clogging == FAULTS[0]
    valve = actuator.servovalve
    assert valve.FSS0 + spool.lower * (valve.FSS1 - valve.FSS0) == pytest.approx(0.9 * valve.FSS0)
    assert actuator.jack.FDJ0 + jack.lower * (actuator.jack.FDJ1 - actuator.jack.FDJ0) == (
        pytest.approx(0.9 * actuator.jack.FDJ0)
    )
    assert [item.upper for item in (clogging, spool, jack)] == [1.0] * 3


@pytest.mark.slow
def test_such_a_unit_is_learned_by_its_data_alone():
    errors = DataErrors(FSS0=-0.04, FDJ0=-0.03, KSF=0.02)
    effects = Effects(hysteresis=0.02, backlash=1e-6, null_bias=5e-5, data=errors)
    unit = replace(Unit(effects=effects), serial=3)
    both = [record(unit, TESTS[name], seed=5, step=COARSE_STEP) for name in ("open", "closed")]
    found = calibrate(both, default_actuator(), TESTS.values())
    assert found.reasons == ()
    assert [item.words for item in found.tried] == ["linear second stage, one play"]
    assert found.actuator is not None
    spool, jack = found.actuator.servovalve.FSS0, found.actuator.jack.FDJ0
    assert spool == pytest.approx(0.96 * 2.0, rel=0.03)
    assert jack == pytest.approx(0.97 * 150.0, rel=0.01)
    assert {item.name: item.value for item in found.severities}["FSS"] <= 1e-3
