"""What acts on the current: null bias and gain of the torque motor."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import resolve_test
from ehadiag.model.parameters import FAULTS, Unknowns, parameter
from ehadiag.model.plant import plant_constants
from ehadiag.model.scalar.response import respond

CURRENT = resolve_test("open").command()[:3000]
TICK = 1e-3


def response_with(name, value, current=CURRENT, history=None):
    """Response of a worn actuator with one parameter at a value."""
    unknowns = Unknowns((*FAULTS, parameter(name)), (plant_constants(default_actuator()),), {})
    constants = unknowns.constants(np.array([0.3, 0.2, 0.4, value]))
    return respond(constants, current, TICK, history=history)


@pytest.mark.parametrize("value", [-0.05, 0.02])
def test_a_gain_of_the_torque_motor_acts_like_as_much_more_current(value):
    found = response_with("torque_motor_gain", value)
    expected = response_with("torque_motor_gain", 0.0, CURRENT * (1.0 + value))
    np.testing.assert_allclose(found.spool, expected.spool, atol=1e-12)
    np.testing.assert_allclose(found.pressure, expected.pressure, atol=1e-2)


@pytest.mark.parametrize("value", [-2e-4, 5e-5])
def test_a_null_bias_acts_like_as_much_current(value):
    found = response_with("null_bias", value, history=np.zeros(1))
    expected = response_with("null_bias", 0.0, CURRENT + value, np.array([value]))
    np.testing.assert_allclose(found.spool, expected.spool, atol=1e-12)
    np.testing.assert_allclose(found.pressure, expected.pressure, atol=1e-2)
