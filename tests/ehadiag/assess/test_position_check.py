"""The jack's position sensor against the motion that the identified actuator must have made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.modelled import response_of
from ehadiag.assess.position import (
    PositionFit,
    most_gain_error,
    objections_to_position,
    position_fit,
)
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.session import identify
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import simulate


@pytest.fixture(scope="module", params=["open", "closed"])
def sound(request):
    """A recording, what was identified from it, and its experiment."""
    test, actuator = resolve_test(request.param), default_actuator()
    done = simulate(actuator, test, Faults(0.1, 0.05, 0.2), seed=4, step=1e-6)
    recording = done.recording("simulated")
    experiment = build_experiment(recording.samples, recording.environment, test, actuator)
    return recording, identify([experiment]), experiment


def fit(sound, position):
    """Fit with another position than was measured; the current is that of the whole sensor."""
    return position_fit(replace(sound[2], position=position), response_of(sound[2], sound[1]))


def test_a_sound_sensor_is_believed(sound):
    found = fit(sound, sound[2].position)
    assert found.gain == pytest.approx(1.0, abs=0.005)
    assert abs(found.drift) < 1e-4
    assert found.rms < 1.0
    assert found.outliers == 0.0
    assert objections_to_position(found) == []


@pytest.mark.parametrize("gain", [0.8, 1.2])
def test_a_wrong_gain_is_named(sound, gain):
    found = fit(sound, gain * sound[2].position)
    assert found.gain == pytest.approx(gain, abs=0.005)
    (reason,) = objections_to_position(found)
    assert f"20% too {'high' if gain > 1.0 else 'low'}" in reason


def broken_position(kind, position):
    ticks = np.arange(len(position))
    return {
        "wrong sign": lambda: -position,
        "dead": lambda: np.zeros_like(position),
        "frozen": lambda: np.where(ticks < 1000, position, position[1000]),
        "runs away": lambda: position + 2e-6 * ticks,
        "travel": lambda: np.concatenate([np.zeros(10), position[:-10]]),
        "0.1 s": lambda: np.where(ticks % 200 < 10, 0.0, position),
    }[kind]()


@pytest.mark.parametrize("kind", ["wrong sign", "dead", "frozen", "runs away", "travel", "0.1 s"])
def test_a_broken_sensor_is_named(sound, kind):
    (reason,) = objections_to_position(fit(sound, broken_position(kind, sound[2].position)))
    assert kind in reason
    assert "position sensor" in reason


def test_single_spikes_and_lost_samples_are_none_of_it(sound):
    position = sound[2].position.copy()
    position[::80] += 5e-3
    position[1000:1400] = np.nan
    position[5::7] = np.nan
    assert objections_to_position(fit(sound, position)) == []


def test_without_samples_the_sensor_is_not_judged(sound):
    assert fit(sound, np.full_like(sound[2].position, np.nan)) is None


def test_a_jack_that_rests_has_no_gain(sound):
    _, identification, experiment = sound
    rest = replace(experiment.trace, current=np.zeros_like(experiment.trace.current))
    still = replace(experiment, trace=rest, position=np.zeros_like(experiment.position))
    found = position_fit(still, response_of(still, identification))
    assert np.isnan(found.gain)
    assert objections_to_position(found) == []


@pytest.mark.parametrize(
    ("found", "objects"),
    [
        (PositionFit(1.0, 0.0, 1.0, 0.0), False),
        (PositionFit(1.09, 0.0, 1.0, 0.0), False),
        (PositionFit(1.0, 0.0, 5.0, 0.0), True),
        (PositionFit(1.0, 0.0, 1.0, 0.02), True),
        (PositionFit(1.0, -1e-3, 1.0, 0.0), True),
        (PositionFit(0.1, 0.0, 1.0, 0.0), True),
    ],
)
def test_limits(found, objects):
    assert bool(objections_to_position(found)) is objects


@pytest.mark.parametrize("sound", ["open"], indirect=True)
def test_the_verdict_is_not_tested_and_says_so(sound):
    recording = sound[0]
    tests = bundled_tests().values()
    whole = diagnose([recording], default_actuator(), tests)
    assert whole.verdict is Verdict.HEALTHY
    assert objections_to_position(whole.positions[0]) == []
    samples = replace(recording.samples, position=-recording.samples.position)
    wrong = diagnose([replace(recording, samples=samples)], default_actuator(), tests)
    assert wrong.verdict is Verdict.NOT_TESTED
    assert wrong.reasons == ("the position sensor reads with the wrong sign",)
    nothing = np.full_like(samples.position, np.nan)
    absent = replace(recording, samples=replace(samples, position=nothing))
    silent = diagnose([absent], default_actuator(), tests)
    assert silent.verdict is Verdict.HEALTHY
    assert silent.positions == (None,)
    assert any("jack position" in note for note in silent.notes)


def test_a_unit_with_effects_of_its_own_may_have_another_gain(sound):
    found = fit(sound, 0.82 * sound[2].position)
    assert objections_to_position(found)
    assert objections_to_position(found, 0.25) == []
    assert most_gain_error(default_actuator()) < 0.2
