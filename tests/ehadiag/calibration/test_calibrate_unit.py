"""What recordings of a unit as new teach about it, and when they are refused."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.calibration.unit import calibrate, update
from ehadiag.core.actuator import default_actuator, load_actuator
from ehadiag.core.actuator_file import actuator_toml
from ehadiag.core.stored_test import bundled_tests
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.simulator.units import COARSE_STEP, random_unit, record

TESTS = bundled_tests()
UNIT = random_unit(np.random.default_rng([1, 3]), data=True, serial=41)


@lru_cache(maxsize=8)
def recording(test, faults=(0.0, 0.0, 0.0), seed=1):
    return record(UNIT, TESTS[test], Faults(*faults), seed=seed, step=COARSE_STEP)


@lru_cache(maxsize=1)
def learned():
    both = [recording("open"), recording("closed", seed=2)]
    return calibrate(both, default_actuator(), TESTS.values())


def refusal(recordings, start=None):
    return calibrate(recordings, start or default_actuator(), TESTS.values()).reasons


def test_one_recording_is_not_enough():
    assert "not enough" in refusal([recording("open")])[0]


def test_recordings_of_two_units_are_refused_by_their_numbers():
    other = replace(recording("closed", seed=2), serial=42)
    assert "41, 42" in refusal([recording("open"), other])[0]


def test_what_cannot_be_diagnosed_cannot_be_learned_from():
    bad = replace(recording("closed", seed=2), samples=None)
    assert "no telemetry" in refusal([recording("open"), bad])[0]


def test_a_recording_counts_once():
    both = [recording("open"), recording("open")]
    assert "name each test once" in refusal(both)[0]


def test_only_a_calibrated_unit_can_be_updated():
    found = update([recording("open")], default_actuator(), TESTS.values())
    assert "not calibrated" in found.reasons[0]


@pytest.mark.slow
def test_it_learns_the_unit_and_keeps_it_in_a_file(tmp_path):
    found = learned()
    assert found.reasons == ()
    unit = found.actuator
    assert unit.calibration.serial == 41
    assert unit.calibration.effects["hysteresis"] == pytest.approx(
        UNIT.effects.hysteresis, abs=2e-4
    )
    assert all(item.value < 0.005 for item in found.severities)
    file = tmp_path / "unit.toml"
    file.write_bytes(actuator_toml(unit))
    assert load_actuator(file) == unit


@pytest.mark.slow
@pytest.mark.parametrize("test", ["open", "closed"])
def test_a_worn_unit_is_then_diagnosed_to_hundredths_of_a_percent(test):
    truth = (0.3, 0.45, 0.2)
    worn = recording(test, truth, seed=3)
    found = diagnose([worn], learned().actuator, TESTS.values())
    assert found.verdict is Verdict.DEGRADED
    for item, value in zip(found.identification.estimates, truth, strict=True):
        assert abs(item.value - value) < min(4.0 * item.std, 2e-3)


@pytest.mark.slow
def test_another_units_recording_is_refused_with_a_calibrated_file():
    other = replace(recording("open"), serial=42)
    found = diagnose([other], learned().actuator, TESTS.values())
    assert found.verdict is Verdict.NOT_TESTED
    assert "calibrated for serial 41" in found.reasons[0]


@pytest.mark.slow
def test_a_worn_unit_is_not_as_new():
    faults = (0.05, 0.4, 0.1)
    found = refusal([recording("open", faults, 4), recording("closed", faults, 5)])
    assert "not as new: FSS 0.4" in found[0]


@pytest.mark.slow
def test_a_later_recording_refines_it():
    before = learned().actuator
    found = update([recording("open", (0.05, 0.1, 0.02), 6)], before, TESTS.values())
    assert found.reasons == ()
    after = found.actuator.calibration
    assert len(after.recordings) == 3
    sharper = [b <= a * 1.05 for a, b in zip(before.calibration.std, after.std, strict=True)]
    assert np.mean(sharper) > 0.7
