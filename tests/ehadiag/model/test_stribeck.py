"""Friction that falls with the velocity: against the simulator, and one kernel against another."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from effect_cases import MODELS, batch_of, residuals_of, rms, severities, simulated, unknowns_of
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag.core.actuator import default_actuator
from ehadiag.model.laws import faded
from ehadiag_sim.plant.conditions import Effects

BOTH = pytest.mark.parametrize("kind", list(MODELS))
LINEAR = default_actuator()
ORIFICE = msgspec.structs.replace(
    LINEAR, second_stage=msgspec.structs.replace(LINEAR.second_stage, kind="orifice")
)
STAGES = pytest.mark.parametrize("actuator", [LINEAR, ORIFICE], ids=["linear", "orifice"])


@given(z=st.floats(0.0, 1e6))
def test_fading_is_exponential(z):
    assert faded(z) == pytest.approx(np.exp(-z), abs=1e-9)


@BOTH
@STAGES
@pytest.mark.parametrize("velocity", [1e-3, 5e-3, 50e-3])
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.7)])
def test_the_jacks_friction_is_the_simulators(kind, actuator, velocity, faults):
    measured = simulated(faults, Effects(jack_stribeck=velocity), actuator=actuator)
    values = {**severities(faults), "jack_stribeck": velocity}
    here = residuals_of(kind, values, batch_of(measured), actuator)
    without = residuals_of(kind, severities(faults), batch_of(measured), actuator)
    # Where full current turns, a jack that turns within the tick makes one sample wrong.
    assert (rms(np.clip(here, -3.0, 3.0)) < [0.05, 0.4, 0.05]).all()
    assert np.quantile(np.abs(here[1]), 0.9) < 0.5
    assert np.mean(np.abs(without[1])) > 4.0 * np.mean(np.abs(here[1]))


@BOTH
@pytest.mark.parametrize("backlash", [0.0, 3e-6])
@pytest.mark.parametrize("velocity", [5e-3, 20e-3, 50e-3])
@pytest.mark.parametrize("faults", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.7)])
def test_the_spools_friction_is_the_simulators(kind, velocity, faults, backlash):
    measured = simulated(faults, Effects(spool_stribeck=velocity, backlash=backlash))
    values = {**severities(faults), "spool_stribeck": velocity, "backlash": backlash}
    here = residuals_of(kind, values, batch_of(measured))
    without = residuals_of(kind, {**values, "spool_stribeck": 0.0}, batch_of(measured))
    # At 5 mm/s the velocity of a worn spool runs away: what a step does lasts.
    assert (rms(np.clip(here, -3.0, 3.0)) < [0.15, 0.3, 0.05]).all()
    assert rms(without)[0] > 1.0


VALUES = st.fixed_dictionaries(
    {
        "Kintas": st.floats(0.0, 1.0),
        "FSS": st.floats(0.0, 1.0),
        "FDJ": st.floats(0.0, 1.0),
        # Below, the velocity of a worn spool runs away, and which way it goes hangs on a micron.
        "spool_stribeck": st.one_of(st.just(0.0), st.floats(20e-3, 0.1)),
        "jack_stribeck": st.one_of(st.just(0.0), st.floats(1e-3, 0.1)),
        "filter_time": st.one_of(st.just(0.0), st.floats(1e-6, 2e-4)),
    }
)
SLOW_CURRENT = 3e-3 * np.sin(np.arange(300) * 0.045)


@STAGES
@settings(max_examples=25, deadline=None)
@given(values=VALUES, neighbour=VALUES)
def test_vector_and_scalar_kernels_agree(actuator, values, neighbour):
    batch = batch_of(np.zeros((3, len(SLOW_CURRENT))), SLOW_CURRENT)
    points = np.array([[one[name] for name in values] for one in (values, neighbour)])
    one, other = (
        model(batch, unknowns_of(values, actuator)).residuals(points)[0]
        for model in MODELS.values()
    )
    gaps = np.abs(one - other)
    assert np.quantile(gaps[:, 1], 0.97) < 0.5
    assert gaps[:, 2].max() < 1.0
