"""Severities of units whose data differ from their file by its tolerance."""

from functools import lru_cache

import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator, with_tolerance
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.nuisance.knowledge import knowledge_of
from ehadiag.identify.session import identify
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.simulator.units import COARSE_STEP, random_unit, record

TRUTH = (0.51, 0.35, 0.14)


@lru_cache(maxsize=2)
def found(test):
    unit = random_unit(np.random.default_rng(7), data=True)
    recording = record(unit, resolve_test(test), Faults(*TRUTH), seed=7, step=COARSE_STEP)
    actuator = with_tolerance(default_actuator(), 0.05)
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test(test), actuator
    )
    return identify([experiment], knowledge=knowledge_of(actuator))


@pytest.mark.slow
@pytest.mark.parametrize("test", ["open", "closed"])
def test_ten_data_five_percent_off_cost_little_and_are_in_the_interval(test):
    result = found(test)
    assert np.mean([abs(e.value - t) for e, t in zip(result.estimates, TRUTH, strict=True)]) < 5e-3
    for item, truth in zip(result.estimates, TRUTH, strict=True):
        assert abs(item.value - truth) < 3.0 * item.std
    # The first stage's flow gain passes for clogging, so the interval has its tolerance.
    assert result.named("Kintas").std > 0.01
    assert result.named("FSS").std < 0.02
    assert {"datum_KSF", "datum_GQ", "datum_MJ"} <= set(result.freed)
    assert "datum_GQF" not in result.freed
