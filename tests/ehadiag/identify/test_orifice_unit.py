"""Units whose second stage has orifices and compressible oil: what is left over, severities."""

from functools import lru_cache

import numpy as np
import pytest

from ehadiag.core.channels import CHANNELS, POSITION, PRESSURE, SPOOL
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.session import identify
from ehadiag.identify.spans import lay_out
from ehadiag.model.parameters import FAULTS, Unknowns, parameter
from ehadiag.model.simd.model import SimdModel
from ehadiag_sim.plant import conditions
from ehadiag_tools.simulator.units import random_unit, record

SEVERITIES = (0.52, 0.34, 0.47)
NOISE_LSB = np.sqrt(0.5**2 + 1.0 / 12.0)
"""Of the electronics and of rounding (PHY-22)."""
LSB = np.array([SPOOL.lsb, PRESSURE.lsb, POSITION.lsb])


@lru_cache(maxsize=4)
def recorded_unit(test, seed):
    """Recording of a unit with orifices, offsets, gain, null bias, hysteresis and backlash."""
    unit = random_unit(np.random.default_rng(seed), orifice=True)
    recording = record(unit, resolve_test(test), conditions.Faults(*SEVERITIES), seed=seed)
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test(test), unit.actuator
    )
    return experiment, unit


def truth(experiment, unit):
    """Values of the model's parameters by name."""
    effects, offsets = unit.effects, unit.sensors.offsets_lsb
    return {
        "null_bias": effects.null_bias,
        "hysteresis": effects.hysteresis,
        "torque_motor_gain": effects.gain_change,
        "backlash": effects.backlash,
        "spool_offset": offsets[1] * CHANNELS[1].lsb - experiment.spool_offset,
        "pressure_offset": offsets[2] * CHANNELS[2].lsb - experiment.pressure_offset,
        "position_offset": offsets[3] * CHANNELS[3].lsb - experiment.position_offset,
        **{item.name: value for item, value in zip(FAULTS, SEVERITIES, strict=True)},
    }


@pytest.mark.parametrize("test", ["open", "closed"])
def test_with_all_known_nothing_but_noise_is_left(test):
    experiment, unit = recorded_unit(test, 0)
    values = truth(experiment, unit)
    unknowns = Unknowns(tuple(parameter(name) for name in values), (experiment.constants,), {})
    model = SimdModel(lay_out([experiment], channels=(True, True, True)), unknowns)
    residuals = model.residuals(np.array([list(values.values())]))[0][0]
    level = np.sqrt(np.mean(residuals**2, axis=1)) * np.array(experiment.noise) / LSB
    assert level == pytest.approx([NOISE_LSB] * 3, rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 6])
def test_severities_are_found_with_the_effects_unknown_in_closed_loop(seed):
    experiment, _ = recorded_unit("closed", seed)
    found = identify([experiment])
    errors = [abs(item.value - to) for item, to in zip(found.estimates, SEVERITIES, strict=True)]
    assert np.mean(errors) < 0.5e-2


@pytest.mark.slow
def test_severities_are_found_with_the_effects_unknown_in_open_loop():
    experiment, _ = recorded_unit("open", 0)
    found = identify([experiment])
    errors = [abs(item.value - to) for item, to in zip(found.estimates, SEVERITIES, strict=True)]
    assert np.mean(errors) < 0.05e-2
