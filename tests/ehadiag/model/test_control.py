"""The control law, tick by tick, against formulas over the whole record.

How many threads one diagnosis uses. The own exponential function against arithmetic of eighty
digits. The laws of the actuator, each for itself, against the specification's formulas.
"""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ehadiag import default_actuator
from ehadiag.compile.elementary import exponential, exponential_less_one
from ehadiag.model.laws import (
    ControlLaw,
    ControlState,
    control_current,
    control_currents,
    excess_force,
    jack_law,
    spool_law,
    stage_pressure,
    stage_resistance,
    steady_spool_velocity,
)
from ehadiag.model.plant import plant_constants
from ehadiag.model.residual_models import processor_count
from ehadiag_tools.simulator.units import damaged_unit

TICK = 1e-3
GAP = default_actuator().controller.GAP
IM = default_actuator().controller.IM
errors = arrays(float, st.integers(1, 60), elements=st.floats(-5e-3, 5e-3))


def law(GAI=0.0, GAD=0.0):
    return ControlLaw(IM, GAP, GAI, GAD, TICK)


@given(errors)
def test_in_proportion_it_is_a_saturated_product(error):
    expected = np.clip(GAP * error, -IM, IM)
    np.testing.assert_array_equal(control_currents(law(), error), expected)


@given(errors, st.floats(0.0, 0.02))
def test_the_derivative_is_that_of_two_ticks(error, gain):
    slope = np.diff(error, prepend=error[0]) / TICK
    expected = np.clip(GAP * error + gain * slope, -IM, IM)
    found = control_currents(law(GAD=gain), error)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-16)


@given(arrays(float, 40, elements=st.floats(-1e-5, 1e-5)), st.floats(0.0, 50.0))
def test_the_integral_is_the_sum_while_nothing_saturates(error, gain):
    expected = GAP * error + gain * np.cumsum(error) * TICK
    found = control_currents(law(GAI=gain), error)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_the_integral_rests_while_it_would_push_further_into_saturation():
    gain = 5.0
    error = np.concatenate([np.full(2000, 5e-3), np.full(300, -1e-6)])
    found = control_currents(law(GAI=gain), error)
    assert found[1999] == IM
    # Wound up over 2 s at 5 mm, the integral alone would hold the current at its limit.
    assert gain * error[:2000].sum() * TICK > 2.0 * IM
    assert (np.abs(found[2000:]) < IM).all()


@given(errors, st.floats(0.0, 20.0), st.floats(0.0, 0.02))
def test_a_record_is_its_ticks(error, integral, slope):
    """What the monitor does tick by tick is what the identification does at once."""
    gains, state, out = law(integral, slope), ControlState(0.0, 0.0, 0.0), []
    for value in error.tolist():
        current, state = control_current(gains, ControlState(*state), value)
        out.append(current)
    np.testing.assert_array_equal(out, control_currents(gains, error))


def test_a_variable_bounds_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EHADIAG_THREADS", raising=False)
    there = processor_count()
    assert there >= 1
    for told, expected in (("1", 1), ("999999", there), ("0", there), ("two", there), ("", there)):
        monkeypatch.setenv("EHADIAG_THREADS", told)
        assert processor_count() == expected


def off(value, x, less):
    """Error in units in the last place."""
    with localcontext() as context:
        context.prec = 80
        exact = Decimal(x).exp() - less
        return float(abs(Decimal(value) - exact) / Decimal(math.ulp(float(exact))))


@given(st.floats(-700.0, 700.0))
def test_power_is_within_its_bound(x):
    assert off(exponential(x), x, 0) <= 0.85


@given(st.floats(-1.0, 1.0))
def test_power_of_a_small_number_is_within_its_bound(x):
    assert off(exponential(x), x, 0) <= 0.85


@given(st.floats(-40.0, 40.0).filter(lambda x: abs(x) > 1e-20))
def test_power_less_one_is_within_its_bound(x):
    assert off(exponential_less_one(x), x, 1) <= 3.0


@pytest.mark.parametrize(
    ("x", "power"), [(-1e9, 0.0), (-math.inf, 0.0), (1e9, math.inf), (math.inf, math.inf), (0, 1)]
)
def test_beyond_its_range(x, power):
    assert exponential(float(x)) == power


def test_nothing_of_nothing():
    assert math.isnan(exponential(math.nan))
    assert math.isnan(exponential_less_one(math.nan))


C = plant_constants(default_actuator())


def second_stage(c, x, velocity):
    """PHY-6 as it stands: pressure gain that saturates, flow gain, leakage."""
    saturated = abs(c.GP * x) > c.PSR
    source = min(max(c.GP * x, -c.PSR), c.PSR)
    drop = c.PSR / (c.GQ * abs(x)) if saturated else c.GP / c.GQ
    return (source - drop * c.AJ * velocity) / (1.0 + drop * c.CLK)


@given(st.floats(-8e-4, 8e-4), st.floats(-0.2, 0.2))
def test_pressure_is_that_of_the_second_stage(x, velocity):
    law = jack_law(C)
    expected = second_stage(C, x, velocity)
    assert stage_pressure(law, x, velocity) == pytest.approx(expected, rel=1e-9, abs=1e-3)


@given(st.floats(-8e-4, 8e-4), st.floats(-1e4, 1e4))
def test_excess_is_the_force_beyond_what_holds(x, hold):
    """Of a resting jack; times the resistance, which is positive."""
    law = jack_law(C._replace(FR=300.0))
    force = C.AJ * second_stage(C, x, 0.0) - 300.0 - hold
    weighed = force * stage_resistance(law, x)
    assert stage_resistance(law, x) > 0.0
    assert excess_force(law, x, hold) == pytest.approx(
        weighed, rel=1e-9, abs=1e-9 * stage_resistance(law, x)
    )


def test_friction_is_that_of_the_specification():
    """PHY-14: half of the spool's static friction slides; PHY-15: twice the jack's holds."""
    constants = damaged_unit((0.3, 0.6, 0.4))
    spool, jack = spool_law(constants), jack_law(constants)
    assert spool.dynamic == pytest.approx(0.5 * constants.FSS)
    assert spool.breakaway * spool.force == pytest.approx(constants.FSS)
    assert spool.dry * spool.force == pytest.approx(spool.dynamic)
    assert (jack.friction, jack.static) == (constants.FDJ, 2.0 * constants.FDJ)


@given(st.floats(0.0, 1.0), st.floats(-5e-4, 5e-4), st.sampled_from([-1.0, 1.0]))
def test_a_steady_spool_has_its_forces_in_balance(kintas, xf, direction):
    constants = damaged_unit((kintas, 0.2, 0.0))
    law = spool_law(constants)
    v = steady_spool_velocity(law, xf, direction)
    flow_drag = constants.GPF / constants.GQF * constants.AS**2
    force = constants.AS * constants.GPF * xf - (flow_drag + constants.CS) * v
    assert force == pytest.approx(direction * law.dynamic, abs=1e-6)


def test_a_flapper_that_is_damped_too_much_does_not_ring():
    law = spool_law(C)
    own = math.sqrt(C.KF / C.JF)
    assert law.ring_rate**2 + law.ring_damping**2 == pytest.approx(own**2)
    assert spool_law(C._replace(CF=3.0 * own * C.JF)).ring_rate == 0.0
