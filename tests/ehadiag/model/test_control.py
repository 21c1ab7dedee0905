"""The control law, tick by tick, against formulas over the whole record."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ehadiag.core.actuator import default_actuator
from ehadiag.model.control import ControlLaw, ControlState, commanded_currents, control

TICK = 1e-3
GAP = default_actuator().controller.GAP
IM = default_actuator().controller.IM
errors = arrays(float, st.integers(1, 60), elements=st.floats(-5e-3, 5e-3))


def law(GAI=0.0, GAD=0.0):
    return ControlLaw(IM, GAP, GAI, GAD, TICK)


@given(errors)
def test_in_proportion_it_is_a_saturated_product(error):
    expected = np.clip(GAP * error, -IM, IM)
    np.testing.assert_array_equal(commanded_currents(law(), error), expected)


@given(errors, st.floats(0.0, 0.02))
def test_the_derivative_is_that_of_two_ticks(error, gain):
    slope = np.diff(error, prepend=error[0]) / TICK
    expected = np.clip(GAP * error + gain * slope, -IM, IM)
    found = commanded_currents(law(GAD=gain), error)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-16)


@given(arrays(float, 40, elements=st.floats(-1e-5, 1e-5)), st.floats(0.0, 50.0))
def test_the_integral_is_the_sum_while_nothing_saturates(error, gain):
    expected = GAP * error + gain * np.cumsum(error) * TICK
    found = commanded_currents(law(GAI=gain), error)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_the_integral_rests_while_it_would_push_further_into_saturation():
    gain = 5.0
    error = np.concatenate([np.full(2000, 5e-3), np.full(300, -1e-6)])
    found = commanded_currents(law(GAI=gain), error)
    assert found[1999] == IM
    # Wound up over 2 s at 5 mm, the integral alone would hold the current at its limit.
    assert gain * error[:2000].sum() * TICK > 2.0 * IM
    assert (np.abs(found[2000:]) < IM).all()


@given(errors, st.floats(0.0, 20.0), st.floats(0.0, 0.02))
def test_a_record_is_its_ticks(error, integral, slope):
    """What the monitor does tick by tick is what the identification does at once."""
    gains, state, out = law(integral, slope), ControlState(0.0, 0.0, 0.0), []
    for value in error.tolist():
        current, state = control(gains, ControlState(*state), value)
        out.append(current)
    np.testing.assert_array_equal(out, commanded_currents(gains, error))
