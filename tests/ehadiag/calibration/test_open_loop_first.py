"""Open loop leads a search with both loops, and what it must not be trusted with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from ehadiag.calibration.unit import calibrate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from ehadiag.identify.nuisance.staged import carried_over
from ehadiag.identify.refine.linearisation import Belief
from ehadiag.model.parameters import parameter
from ehadiag_sim.plant.conditions import DataErrors, Effects
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, record

TESTS = bundled_tests()


@dataclass
class Part:
    """Of a model of recordings what a belief is carried over by."""

    names: tuple[str, ...]
    scale: np.ndarray

    @property
    def estimated(self):
        return tuple(parameter(name) for name in self.names)

    @property
    def curved(self):
        return np.array([k for k, item in enumerate(self.estimated) if item.adds_to is None])

    @property
    def lower(self):
        return np.array([item.lower for item in self.estimated]) / self.scale

    @property
    def upper(self):
        return np.array([item.upper for item in self.estimated]) / self.scale


def test_a_belief_keeps_its_values_and_correlations_in_other_units():
    part = Part(("FSS", "spool_offset", "backlash"), np.array([1.0, 1e-7, 1e-6]))
    whole = Part(
        ("FSS", "spool_offset", "backlash", "spool_offset"), np.array([2.0, 1e-6, 1e-5, 1e-6])
    )
    root = np.array([[0.1, 0.0], [0.3, 0.2]])
    there = carried_over(part, Belief(np.array([0.4, 20.0, 3.0]), root), whole)
    assert there.x * whole.scale == pytest.approx([0.4, 2e-6, 3e-6, 2e-6])
    units = np.diag([1.0, 1e-6]), np.diag([2.0, 1e-5])
    before, after = units[0] @ root, units[1] @ there.root
    assert after @ after.T == pytest.approx(before @ before.T, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hysteresis", "backlash", "bias"), [(0.0074, 4.2e-6, -7e-5), (0.003, 2.1e-6, 1e-4)]
)
def test_a_unit_with_little_hysteresis_is_calibrated_as_what_it_is(hysteresis, backlash, bias):
    errors = DataErrors(GM=-0.024, KSF=-0.023, KF=-0.047, GP=-0.016, FSS0=-0.015, FDJ0=-0.038)
    effects = Effects(hysteresis=hysteresis, backlash=backlash, null_bias=bias, data=errors)
    new = [
        record(Unit(effects=effects), TESTS[name], seed=k, step=COARSE_STEP)
        for k, name in enumerate(("open", "closed"))
    ]
    found = calibrate(new, default_actuator(), TESTS.values())
    assert found.reasons == ()
    assert found.actuator is not None
    assert found.actuator.calibration is not None
    assert found.actuator.calibration.plays == 1
    assert found.actuator.calibration.fit.excess < 1.5
    learned = found.actuator.calibration.effects
    assert learned["hysteresis"] == pytest.approx(hysteresis, abs=2e-4)
    assert learned["backlash"] == pytest.approx(backlash, abs=1e-7)
