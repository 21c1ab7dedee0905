"""Errors of the data, the oil and the supply act on the model as on the simulator."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Environment
from ehadiag.model.data_errors import DATA
from ehadiag.model.laws import jack_law, spool_law
from ehadiag.model.parameters import FAULTS, REGISTRY, Kind, Unknowns, parameter
from ehadiag.model.plant import plant_constants, relative_viscosity
from ehadiag_sim.plant.coefficients import coefficients
from ehadiag_sim.plant.conditions import DataErrors, Effects, Faults

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
    assert kinds == sorted(kinds, key=list(Kind).index)
    assert set(kinds) == set(Kind)


@settings(max_examples=50)
@given(errors=st.tuples(*[SHARE] * 9), faults=st.tuples(*[SEVERITY] * 3), gain=SHARE)
def test_data_errors_are_the_simulators(errors, faults, gain):
    values = {f"datum_{name}": value for name, value in zip(TEN, errors, strict=True)}
    severities = {item.name: value for item, value in zip(FAULTS, faults, strict=True)}
    # The torque motor's gain is a parameter of its own, not a datum.
    c = constants_with({**values, "torque_motor_gain": gain, **severities})
    data = DataErrors(GM=gain, **dict(zip(TEN, errors, strict=True)))
    p = coefficients(default_actuator(), Faults(*faults), Effects(data=data))
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
    p = coefficients(default_actuator(), Faults(), effects)
    np.testing.assert_allclose(
        [spool_law(c).damping, c.CJ, c.CLK, c.PSR], [p.DAMPING, p.CJ, p.CLK, p.PSR], rtol=1e-12
    )


@pytest.mark.parametrize("item", DATA, ids=lambda item: item.name)
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
