"""Constants at the oil and supply of the day."""

import itertools

import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Environment
from ehadiag.model.plant import plant_constants, relative_viscosity


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
