"""Second stage with orifices and compressible oil: against the simulator and a library's solver."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from effect_cases import (
    CURRENT,
    MODELS,
    batch_of,
    residuals_of,
    rms,
    severities,
    simulated,
    unknowns_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ehadiag import default_actuator
from ehadiag.model.laws import jack_law
from ehadiag.model.plant import plant_constants
from ehadiag.model.second_stage import orifice_rate, orifice_step
from ehadiag_sim.conditions import Effects

BOTH = pytest.mark.parametrize("kind", list(MODELS))


def with_orifices(**stage):
    """The reference actuator with the other second stage."""
    actuator = default_actuator()
    stage = msgspec.structs.replace(actuator.second_stage, kind="orifice", **stage)
    return msgspec.structs.replace(actuator, second_stage=stage)


ORIFICE = with_orifices()


@pytest.mark.parametrize("x", [-3e-4, 2e-6, 1.5e-4])
def test_a_step_is_a_solvers(x):
    j = jack_law(plant_constants(ORIFICE))
    h, rise, load = 0.25e-3, 0.05, 150.0

    def rates(t, y):
        force = j.area * y[0] - j.viscosity * y[1] - load - j.friction
        return [orifice_rate(j, x + rise * t, y[0], y[1], j.oil), j.by_mass * force]

    start = [3e6, 0.02]
    fine = solve_ivp(rates, (0.0, h), start, rtol=1e-11, atol=1e-9).y[:, -1]
    path = (x, x + 0.5 * rise * h, x + rise * h)
    pressure, velocity, travel = orifice_step(j, h, load, j.oil, 1.0, *path, *start)
    assert pressure == pytest.approx(fine[0], abs=5.0)
    assert velocity == pytest.approx(fine[1], abs=1e-7)
    assert travel == pytest.approx(0.5 * h * (start[1] + velocity), rel=1e-2)


def test_near_null_the_pressure_gain_is_that_of_the_linear_stage():
    c = plant_constants(ORIFICE)
    j = jack_law(c)
    slopes = [
        orifice_rate(j, 1e-9, 0.0, 0.0, j.oil) / 1e-9,
        -orifice_rate(j, 0.0, 1.0, 0.0, j.oil) - j.oil * j.leak,
    ]
    assert slopes[0] / slopes[1] == pytest.approx(c.GP, rel=1e-3)


@BOTH
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.4), (0.8, 0.7, 0.9)])
def test_the_response_is_the_simulators(kind, faults):
    """The simulator's own step makes 0.2 LSB where friction stops and starts a worn jack."""
    measured = simulated(faults, actuator=ORIFICE)
    here = residuals_of(kind, severities(faults), batch_of(measured), ORIFICE)
    assert (rms(here) < [0.05, 0.3, 0.05]).all()
    assert np.quantile(np.abs(here[1]), 0.95) < 0.5


@BOTH
def test_sensors_and_loads_act_on_it_too(kind):
    measured = simulated(
        actuator=ORIFICE,
        effects=Effects(load=80.0, load_spring=2e4),
        filter_time=0.05e-3,
        early=0.08e-3,
    )
    values = {"filter_time": 0.05e-3, "sampling_lead": 0.08e-3, "load": 80.0, "load_spring": 2e4}
    here = residuals_of(kind, {**severities(), **values}, batch_of(measured), ORIFICE)
    assert (rms(here) < [0.1, 0.3, 0.05]).all()


@BOTH
def test_the_jack_meets_its_bounds(kind):
    """A jack that strikes its bound sends its pressure far up."""
    jack = msgspec.structs.replace(ORIFICE.jack, XJM=2e-3)
    actuator = msgspec.structs.replace(ORIFICE, jack=jack)
    measured = simulated(actuator=actuator)
    assert np.mean(np.abs(measured[2]) == 2e-3) > 0.1
    here = residuals_of(kind, severities(), batch_of(measured), actuator)
    assert (rms(here) < [0.05, 0.3, 0.05]).all()


@BOTH
def test_stiff_oil_rings_fast(kind):
    """Too fast for steps of all lanes: they go alone."""
    actuator = with_orifices(volume_of_one_chamber=1.6e-7)
    measured = simulated(actuator=actuator, current=CURRENT[500:800])
    here = residuals_of(kind, severities(), batch_of(measured, CURRENT[500:800]), actuator)
    assert (rms(here) < [0.05, 0.5, 0.05]).all()


@BOTH
def test_the_bulk_modulus_shows(kind):
    soft = simulated(actuator=with_orifices(beta=6e8))
    values = {**severities(), "bulk_modulus": 6.0 / 7.5 - 1.0}
    here = residuals_of(kind, values, batch_of(soft), ORIFICE)
    without = residuals_of(kind, severities(), batch_of(soft), ORIFICE)
    assert rms(here)[1] < 0.2
    assert rms(without)[1] > 2.0


VALUES = st.fixed_dictionaries(
    {
        "Kintas": st.floats(0.0, 1.0),
        "FSS": st.floats(0.0, 1.0),
        "FDJ": st.floats(0.0, 1.0),
        "bulk_modulus": st.floats(-0.7, 0.5),
        "filter_time": st.one_of(st.just(0.0), st.floats(1e-6, 2e-4)),
        "load": st.floats(-200.0, 200.0),
    }
)
SLOW_CURRENT = 3e-3 * np.sin(np.arange(300) * 0.045)


@settings(max_examples=30, deadline=None)
@given(values=VALUES)
def test_blocks_and_one_alone_agree(values):
    batch = batch_of(np.zeros((3, len(SLOW_CURRENT))), SLOW_CURRENT)
    one, other = (residuals_of(kind, values, batch, ORIFICE) for kind in MODELS)
    gaps = np.abs(one - other)
    assert np.quantile(gaps[1], 0.98) < 0.5
    assert gaps[2].max() < 0.5


@settings(max_examples=20, deadline=None)
@given(rows=st.lists(st.tuples(*[st.floats(0.0, 1.0)] * 3), min_size=2, max_size=20))
def test_no_lane_depends_on_its_neighbours(rows):
    batch = batch_of(np.zeros((3, len(SLOW_CURRENT))), SLOW_CURRENT)
    model = MODELS["block"](batch, unknowns_of(severities(), ORIFICE))
    together = model.residuals(np.array(rows))[0]
    alone = model.residuals(np.array(rows[-1:]))[0]
    np.testing.assert_array_equal(together[-1], alone[0])
