"""A supply lower than its probe says, seen where the measured pressure is cut off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import LOGS

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.modelled import response_of
from ehadiag.assess.supply import objections_to_supply
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag_sim.faults.hardware import broken
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import simulate
from firmware_iface.logs.reader import read_recording

ACTUATOR = default_actuator()
TESTS = tuple(bundled_tests().values())


@pytest.fixture(scope="module", params=["healthy-closed.blf", "paper-open-4.blf"])
def sound(request):
    """Experiment, response and remaining offset of a sound recording."""
    found = diagnose([read_recording(LOGS / request.param)], ACTUATOR, TESTS)
    (experiment,) = found.experiments
    response = response_of(experiment, found.identification)
    return (
        experiment,
        response,
        found.identification.fit.pressure_offset - experiment.pressure_offset,
    )


def cut(experiment, share):
    top = share * np.nanmax(np.abs(experiment.pressure))
    return replace(experiment, pressure=np.clip(experiment.pressure, -top, top))


def test_a_sound_recording_is_believed(sound):
    assert objections_to_supply(*sound) == []


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_pressure_that_stops_is_named(sound, share):
    experiment, *rest = sound
    (reason,) = objections_to_supply(cut(experiment, share), *rest)
    assert "supply lower than its probe says" in reason


def test_an_offset_and_lost_peaks_are_none_of_it(sound):
    experiment, response, offset = sound
    moved = replace(experiment, pressure=experiment.pressure + 0.25e6)
    assert objections_to_supply(moved, response, offset + 0.25e6) == []
    high = np.abs(experiment.pressure) > 0.5 * np.nanmax(np.abs(experiment.pressure))
    lost = replace(experiment, pressure=np.where(high, np.nan, experiment.pressure))
    lost_model = replace(response, pressure=np.where(high, 9e9, response.pressure))
    assert objections_to_supply(lost, lost_model, offset) == []


def test_nothing_is_said_without_samples(sound):
    experiment, *rest = sound
    assert objections_to_supply(cut(experiment, np.nan), *rest) == []


def test_a_starved_unit_in_closed_loop_is_not_healthy():
    rng = np.random.default_rng(4)
    recording = broken("starved", rng, ACTUATOR, resolve_test("closed"), Faults(0.14, 0.0, 0.12))
    assert diagnose([recording], ACTUATOR, TESTS).verdict is Verdict.NOT_TESTED


@pytest.fixture(scope="module")
def offset_recordings():
    """Both tests of a clogged valve; the sensor reads a sixth of what its pressure reaches more."""
    out = {}
    for name in ("open", "closed"):
        faults = Faults(0.98, 0.45, 0.02)
        done = simulate(ACTUATOR, resolve_test(name), faults, seed=3, step=1e-6)
        recording = done.recording("simulated", 1)
        samples = replace(recording.samples, pressure=recording.samples.pressure + 0.25e6)
        out[name] = replace(recording, samples=samples)
    return out


@pytest.mark.parametrize("names", [("open",), ("open", "closed"), ("closed", "open")])
def test_the_offset_at_rest_is_taken_off_once(offset_recordings, names):
    """In closed loop the actuator does not rest, so that nothing was taken off."""
    found = diagnose([offset_recordings[name] for name in names], ACTUATOR, TESTS)
    assert not any("supply" in reason for reason in found.reasons)
    assert found.verdict is Verdict.FAULT
