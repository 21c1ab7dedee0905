"""Sensors that show another motion than the others, refused before anything is identified.

Wrong units and signs, found by what the channels have to do with each other. Actuator files whose
values are each in range, and together of no actuator. The jack's position sensor against the motion
that the identified actuator must have made.
"""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from other_actuator import with_data
from places import LOGS

from ehadiag import Verdict, bundled_tests, default_actuator
from ehadiag.assess.acceptance import (
    objections_to_actuator,
    objections_to_travel,
    objections_to_units,
)
from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.response_checks import (
    PositionFit,
    fit_position,
    identified_response,
    max_position_gain_error,
    objections_to_position,
)
from ehadiag.identify.experiment import build_experiment, slow_ticks
from ehadiag.identify.identification_session import identify
from ehadiag_sim.broken_hardware import simulate_broken
from ehadiag_sim.conditions import Faults
from ehadiag_sim.simulation import simulate
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test

NAMES = ("healthy-open.blf", "paper-open-4.blf", "lossy-open.blf", "hot-worn-closed.asc")
ACTUATOR = default_actuator()
CLOSED = bundled_tests()["closed"]


@pytest.fixture(scope="module", params=NAMES)
def samples(request):
    return read_recording(LOGS / request.param).samples


def test_sound_sensors_are_not_complained_of(samples):
    assert objections_to_travel(samples, CLOSED, ACTUATOR) == []


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_lost_samples_are_no_reason(samples, share):
    rng = np.random.default_rng(1)
    lost = {
        name: np.where(rng.random(samples.ticks) < share, np.nan, getattr(samples, name))
        for name in ("spool", "position")
    }
    assert objections_to_travel(replace(samples, **lost), CLOSED, ACTUATOR) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": lambda item: -item.position}, "the position sensor reads with the wrong"),
        ({"spool": lambda item: -item.spool}, "the spool sensor reads with the wrong sign"),
        ({"position": lambda item: 0.0 * item.position}, "the position does not follow"),
        ({"spool": lambda item: 0.0 * item.spool}, "the spool follows neither"),
        (
            {"spool": lambda item: item.position / 100, "position": lambda item: item.spool * 100},
            "the spool follows neither",
        ),
    ],
)
def test_another_motion_is_named(samples, change, words):
    changed = replace(samples, **{name: make(samples) for name, make in change.items()})
    (reason,) = objections_to_travel(changed, CLOSED, ACTUATOR)
    assert reason.startswith(words)


def test_nothing_is_said_where_nothing_moves_or_is_known(samples):
    still = {name: 0.0 * getattr(samples, name) for name in ("spool", "position")}
    assert objections_to_travel(replace(samples, **still), CLOSED, ACTUATOR) == []
    unknown = replace(samples, position=np.full(samples.ticks, np.nan))
    assert objections_to_travel(unknown, CLOSED, ACTUATOR) == []


@pytest.mark.parametrize("kind", ["swapped-spool-position", "swapped-pressure-position"])
def test_swapped_wires_in_closed_loop_are_refused_without_a_search(kind):
    recording = simulate_broken(
        kind, np.random.default_rng(3), ACTUATOR, resolve_test("closed"), Faults(0.1, 0.1, 0.1)
    )
    found = diagnose([recording], ACTUATOR, bundled_tests().values())
    assert found.verdict is Verdict.NOT_TESTED
    assert found.identification is None


LOOPS = ("healthy-open.blf", "paper-open-4.blf", "healthy-closed.blf", "paper-closed-4.blf")


@pytest.fixture(scope="module", params=LOOPS)
def samples_of(request):
    return read_recording(LOGS / request.param).samples


def test_right_units_are_not_complained_of(samples_of):
    assert objections_to_units(samples_of, default_actuator()) == ()


@pytest.mark.parametrize("channel", ["current", "spool", "position", "command"])
@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (-1.0, "sign is reversed"),
        (1e3, "1000 times smaller"),
        (0.1, "ten times larger"),
        (25.4, "as inches"),
    ],
)
def test_a_wrong_unit_or_sign_is_named(samples_of, channel, factor, words):
    wrong = replace(samples_of, **{channel: factor * getattr(samples_of, channel)})
    found = objections_to_units(wrong, default_actuator())
    assert any(item.startswith(f"{channel}: ") and words in item for item in found) or (
        # The ends of the chain have one relation alone: either side of it explains it.
        len(found) == 1 and channel in ("command",)
    )


@pytest.mark.parametrize("factor", [1 / 14.5038, 100.0, 1e3])
def test_a_wrong_unit_of_pressure_is_found(samples_of, factor):
    wrong = replace(samples_of, pressure=factor * samples_of.pressure)
    (found,) = objections_to_units(wrong, default_actuator())
    assert found.startswith("pressure: ")


def test_a_reversed_pressure_is_found(samples_of):
    (found,) = objections_to_units(
        replace(samples_of, pressure=-samples_of.pressure), default_actuator()
    )
    assert "sign is reversed" in found


def test_a_rest_says_nothing(samples_of):
    still = replace(
        samples_of,
        **{
            name: np.random.default_rng(seed).normal(0.0, 1e-6, samples_of.ticks)
            for seed, name in enumerate(("current", "spool", "pressure", "position", "command"))
        },
    )
    assert objections_to_units(still, default_actuator()) == ()


def test_the_reference_actuator_is_one():
    assert objections_to_actuator(default_actuator()) == []


@pytest.mark.parametrize("factor", [0.3, 3.0])
@pytest.mark.parametrize("key", ["GM", "KSF", "KF", "XFM", "GQF", "GPF", "AS", "MS", "GP", "GQ"])
def test_another_size_of_valve_is_one_too(key, factor):
    value = getattr(default_actuator().servovalve, key)
    assert objections_to_actuator(with_data({key: factor * value})) == []


@pytest.mark.parametrize(
    ("key", "value"), [("KSF", 1e7), ("KF", 1e7), ("GQF", 1e-6), ("MS", 1e-6), ("GPF", 1e16)]
)
def test_an_absurd_value_is_named(key, value):
    objections = objections_to_actuator(with_data({key: value}))
    assert objections
    assert all(key in text.split("check")[1] for text in objections)


def test_an_absurd_jack_is_named():
    (objection,) = objections_to_actuator(with_data(jack={"MJ": 1e-3}))
    assert "MJ" in objection


def test_it_is_refused_before_any_search():
    recording = simulate(default_actuator(), resolve_test("open"), step=1e-6).recording("simulated")
    found = diagnose([recording], with_data({"KSF": 1e7}), bundled_tests().values())
    assert found.verdict is Verdict.NOT_TESTED
    assert found.identification is None
    assert "KSF" in found.reasons[0]


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
    return fit_position(
        replace(sound[2], position=position), identified_response(sound[2], sound[1])
    )


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


def test_travel_of_a_jack_that_slips_is_none_of_it(sound):
    """A jack that slips in steps travels otherwise; one that is fast, or a dead sensor, tells."""
    model = identified_response(sound[2], sound[1])
    slow = slow_ticks(model.position, sound[2].channels.position, 0.02 * sound[2].tick)
    assert 0.05 < slow.mean() < 0.95
    steps = sound[2].position + np.where(slow, 5e-4 * np.sign(np.sin(np.arange(len(slow)))), 0.0)
    experiment = replace(sound[2], position=steps)
    assert objections_to_position(fit_position(experiment, model))
    assert objections_to_position(fit_position(experiment, model, slip_speed=0.02)) == []
    dead = replace(sound[2], position=np.zeros_like(steps))
    assert objections_to_position(fit_position(dead, model, slip_speed=0.02))
    assert fit_position(dead, model, slip_speed=1.0) is None


def test_single_spikes_and_lost_samples_are_none_of_it(sound):
    position = sound[2].position.copy()
    position[::80] += 5e-3
    position[1000:1400] = np.nan
    position[5::7] = np.nan
    assert objections_to_position(fit(sound, position)) == []


def test_without_samples_the_sensor_is_not_judged(sound):
    assert fit(sound, np.full_like(sound[2].position, np.nan)) is None


def test_travel_after_a_guessed_current_is_none_of_it(sound):
    """The model's spool is elsewhere for a while: its current is another, or was guessed."""
    _, identification, experiment = sound
    current = experiment.trace.current.copy()
    current[2800:2950] += 0.5e-3
    counted, guessed = (
        objections_to_position(fit_position(other, identified_response(other, identification)))
        for other in (
            replace(experiment, trace=replace(experiment.trace, current=current, guessed=share))
            for share in (0.0, 2e-3)
        )
    )
    assert guessed == []
    assert counted


def test_a_jack_that_rests_has_no_gain(sound):
    _, identification, experiment = sound
    rest = replace(experiment.trace, current=np.zeros_like(experiment.trace.current))
    still = replace(experiment, trace=rest, position=np.zeros_like(experiment.position))
    found = fit_position(still, identified_response(still, identification))
    assert np.isnan(found.gain)
    assert objections_to_position(found) == []


@pytest.mark.parametrize(
    ("found", "objects"),
    [
        (PositionFit(1.0, 0.0, 1.0, 0.0, most_drift=8e-4), False),
        (PositionFit(1.09, 0.0, 1.0, 0.0, most_drift=8e-4), False),
        (PositionFit(1.0, 0.0, 5.0, 0.0, most_drift=8e-4), True),
        (PositionFit(1.0, 0.0, 1.0, 0.02, most_drift=8e-4), True),
        (PositionFit(1.0, -1e-3, 1.0, 0.0, most_drift=8e-4), True),
        (PositionFit(0.1, 0.0, 1.0, 0.0, most_drift=8e-4), True),
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
    assert max_position_gain_error(default_actuator()) < 0.2
