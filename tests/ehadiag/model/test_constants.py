"""Constants at the oil and supply of the day.

Errors of the data, the oil and the supply act on the model as on the simulator. What acts on the
current: null bias and gain of the torque motor.
"""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag import default_actuator
from ehadiag.model.laws import jack_law, spool_law
from ehadiag.model.parameter import DATA_ERROR_PARAMETERS, ParameterKind
from ehadiag.model.plant import plant_constants, relative_viscosity
from ehadiag.model.registry import FAULTS, REGISTRY, Unknowns, parameter
from ehadiag.model.residual_models import model_response
from ehadiag_sim.conditions import DataErrors, Effects, Faults
from ehadiag_sim.plant_laws import plant_coefficients
from firmware_iface.recording import Environment
from firmware_iface.stored_test import resolve_test


def test_viscosity_goes_through_its_two_points():
    assert relative_viscosity(40.0) == pytest.approx(1.0, abs=1e-12)
    assert relative_viscosity(100.0) == pytest.approx(3.5 / 14.5, rel=1e-12)


def test_viscosity_falls_with_temperature():
    values = [relative_viscosity(t) for t in np.linspace(-54.0, 205.0, 50)]
    assert all(a > b > 0.0 for a, b in itertools.pairwise(values))


def test_viscosity_of_the_hot_recording():
    """85 degC, as the recording's truth table states it."""
    assert relative_viscosity(85.0) == pytest.approx(0.317, abs=5e-4)


def test_oil_and_supply_enter_where_the_contract_says():
    actuator = default_actuator()
    cold = plant_constants(actuator)
    hot = plant_constants(actuator, Environment(20.1e6, 0.7e6, 85.0))
    factor = relative_viscosity(85.0)
    scaled = {"CS": factor, "CJ": factor, "CLK": 1.0 / factor}
    for name, value in hot._asdict().items():
        expected = 19.4e6 if name == "PSR" else getattr(cold, name) * scaled.get(name, 1.0)
        assert value == pytest.approx(expected, rel=1e-12), name


def test_what_the_bus_does_not_say_keeps_the_actuators_data():
    actuator = default_actuator()
    assert plant_constants(actuator, Environment()) == plant_constants(actuator)
    assert plant_constants(actuator, Environment(supply_pressure=15e6)) == plant_constants(actuator)


TEN = ("KSF", "KF", "GP", "GQ", "CS", "CJ", "MJ", "FSS0", "FDJ0")
SHARE = st.floats(-0.3, 0.3)
SEVERITY = st.floats(0.0, 1.0)


def constants_with(values, environment=None):
    """Physical constants of the reference actuator with parameters at values, by name."""
    free = tuple(parameter(name) for name in values)
    unknowns = Unknowns(free, (plant_constants(default_actuator(), environment),), {})
    return unknowns.constants(np.array(list(values.values())))


def test_data_come_before_nuisances_and_these_before_faults():
    kinds = [item.kind for item in REGISTRY]
    assert kinds == sorted(kinds, key=list(ParameterKind).index)
    assert set(kinds) == set(ParameterKind)


@settings(max_examples=50)
@given(errors=st.tuples(*[SHARE] * 9), faults=st.tuples(*[SEVERITY] * 3), gain=SHARE)
def test_data_errors_are_the_simulators(errors, faults, gain):
    values = {f"datum_{name}": value for name, value in zip(TEN, errors, strict=True)}
    severities = {item.name: value for item, value in zip(FAULTS, faults, strict=True)}
    # The torque motor's gain is a parameter of its own, not a datum.
    c = constants_with({**values, "torque_motor_gain": gain, **severities})
    data = DataErrors(GM=gain, **dict(zip(TEN, errors, strict=True)))
    p = plant_coefficients(default_actuator(), Faults(*faults), Effects(data=data))
    spool, jack = spool_law(c), jack_law(c)
    here = [c.GM, c.KSF, c.KF, c.GP, c.GQ, spool.damping, c.CJ, c.MJ, c.FSS]
    there = [p.GM, p.KSF, p.KF, p.GP, p.GQ, p.DAMPING, p.CJ, p.MJ, p.FSS]
    np.testing.assert_allclose(here, there, rtol=1e-12)
    np.testing.assert_allclose(
        [spool.dynamic, jack.friction, jack.static], [p.FDS, p.FDJ, p.FSJ], rtol=1e-12
    )


def test_probes_that_err_are_put_right():
    """Oil and supply of the simulator, where the probes say 40 degC and 20 MPa."""
    c = constants_with(
        {
            "oil_viscosity": relative_viscosity(42.0) / relative_viscosity(40.0) - 1.0,
            "supply_pressure": -0.1e6,
        },
        Environment(20.7e6, 0.7e6, 40.0),
    )
    effects = Effects(oil_temperature=42.0, supply_pressure=20.6e6, return_pressure=0.7e6)
    p = plant_coefficients(default_actuator(), Faults(), effects)
    np.testing.assert_allclose(
        [spool_law(c).damping, c.CJ, c.CLK, c.PSR], [p.DAMPING, p.CJ, p.CLK, p.PSR], rtol=1e-12
    )


@pytest.mark.parametrize("item", DATA_ERROR_PARAMETERS, ids=lambda item: item.name)
def test_each_datum_changes_the_model(item):
    actuator = default_actuator()
    stage = msgspec.structs.replace(actuator.second_stage, kind="orifice")
    base = plant_constants(msgspec.structs.replace(actuator, second_stage=stage))
    unknowns = Unknowns((item,), (base,), {})
    assert unknowns.constants(np.zeros(1)) == base
    assert unknowns.constants(np.array([item.scale])) != base


def test_the_limit_of_damage_has_no_tolerance():
    values = {"datum_FSS0": 0.2, "datum_FDJ0": -0.1, "FSS": 1.0, "FDJ": 1.0}
    worn, base = constants_with(values), plant_constants(default_actuator())
    assert pytest.approx(base.FSS1) == worn.FSS
    assert pytest.approx(base.FDJ1) == worn.FDJ


CURRENT = resolve_test("open").command()[:3000]
TICK = 1e-3


def response_with(name, value, current=CURRENT, history=None):
    """Response of a worn actuator with one parameter at a value."""
    unknowns = Unknowns((*FAULTS, parameter(name)), (plant_constants(default_actuator()),), {})
    constants = unknowns.constants(np.array([0.3, 0.2, 0.4, value]))
    return model_response(constants, current, TICK, history=history)


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
