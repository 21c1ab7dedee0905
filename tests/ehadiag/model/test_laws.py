"""The laws of the actuator, each for itself, against the specification's formulas."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.core.actuator import default_actuator
from ehadiag.model.laws import (
    excess,
    jack_law,
    pressure,
    resistance,
    spool_law,
    steady_rate,
)
from ehadiag.model.plant import plant_constants
from ehadiag_tools.damaged import damaged_unit

C = plant_constants(default_actuator())
AMOUNTS = st.floats(-1e-3, 1e-3)


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
    assert pressure(law, x, velocity) == pytest.approx(expected, rel=1e-9, abs=1e-3)


@given(st.floats(-8e-4, 8e-4), st.floats(-1e4, 1e4))
def test_excess_is_the_force_beyond_what_holds(x, hold):
    """Of a resting jack; times the resistance, which is positive."""
    law = jack_law(C._replace(FR=300.0))
    force = C.AJ * second_stage(C, x, 0.0) - 300.0 - hold
    weighed = force * resistance(law, x)
    assert resistance(law, x) > 0.0
    assert excess(law, x, hold) == pytest.approx(weighed, rel=1e-9, abs=1e-9 * resistance(law, x))


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
    v = steady_rate(law, xf, direction)
    flow_drag = constants.GPF / constants.GQF * constants.AS**2
    force = constants.AS * constants.GPF * xf - (flow_drag + constants.CS) * v
    assert force == pytest.approx(direction * law.dynamic, abs=1e-6)


def test_a_flapper_that_is_damped_too_much_does_not_ring():
    law = spool_law(C)
    own = math.sqrt(C.KF / C.JF)
    assert law.ring_rate**2 + law.ring_damping**2 == pytest.approx(own**2)
    assert spool_law(C._replace(CF=3.0 * own * C.JF)).ring_rate == 0.0
