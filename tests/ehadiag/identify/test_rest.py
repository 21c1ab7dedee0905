"""Offsets of the sensors are taken from the rest before a test, if there was one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag_sim.plant.conditions import Effects, Faults
from ehadiag_sim.plant.simulator import simulate

OPEN = resolve_test("open")
FAULTS = (0.78, 0.02, 0.98)


@pytest.fixture(scope="module")
def pushed():
    """Recording of a unit whose null bias moves the spool from the first tick on."""
    effects = Effects(null_bias=9.2e-5, hysteresis=0.007, gain_change=0.01)
    done = simulate(default_actuator(), OPEN, Faults(*FAULTS), effects, seed=1, step=1e-6)
    return done.recording("simulated", 1)


def experiment_of(recording):
    return build_experiment(recording.samples, recording.environment, OPEN, default_actuator())


def test_a_spool_that_moves_from_the_first_tick_on_shows_no_offset(pushed):
    experiment = experiment_of(pushed)
    assert not experiment.rested
    assert experiment.origin == experiment.pressure_offset == 0.0


def test_nor_does_it_start_displaced(pushed):
    found = diagnose([pushed], default_actuator(), bundled_tests().values())
    assert found.verdict is Verdict.FAULT
    values = [item.value for item in found.identification.estimates]
    np.testing.assert_allclose(values, FAULTS, atol=0.002)


def test_a_spool_that_friction_holds_beside_the_middle_starts_there(pushed):
    pressure = np.where(np.arange(OPEN.ticks) < 100, 1.8e6, pushed.samples.pressure)
    held = replace(pushed, samples=replace(pushed.samples, pressure=pressure))
    experiment = experiment_of(held)
    assert experiment.rested
    assert experiment.origin > 0.0


def test_a_spoilt_sample_does_not_undo_a_rest(pushed):
    pressure = np.where(np.arange(OPEN.ticks) < 100, 1.8e6, pushed.samples.pressure)
    pressure[1] += 0.2e6
    spoilt = replace(pushed, samples=replace(pushed.samples, pressure=pressure))
    assert experiment_of(spoilt).rested
