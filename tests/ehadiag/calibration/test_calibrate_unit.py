"""What recordings of a unit as new teach about it, and when they are refused.

Which effects of a unit its recordings ask for. A unit with effects beyond the basic ones: what is
learned of it, and that it is no sensor's. A unit whose friction as new is less than its data
sheet's: no severity from 0 up explains it.
"""

from __future__ import annotations

import numpy as np
import pytest
from calibrated_unit import TESTS, UNIT, learned, of_calibrated_unit, recording
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace

from ehadiag import Verdict, default_actuator, load_actuator
from ehadiag.assess.diagnosis import diagnose
from ehadiag.calibration.calibrate_unit import calibrate, update_calibration
from ehadiag.calibration.model_choice import select_significant
from ehadiag.core.actuator import actuator_toml
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.prior import faults_below_zero
from ehadiag.model.registry import FAULTS, NUISANCE_PARAMETERS, unit_constants
from ehadiag_sim.conditions import DataErrors, Effects, Faults, UnmodelledEffects
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, record


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
    found = update_calibration([recording("open")], default_actuator(), TESTS.values())
    assert "not calibrated" in found.reasons[0]


@pytest.mark.slow
def test_what_no_model_explains_is_named_by_its_block():
    waved = []
    for test in ("open", "closed"):
        given = recording(test)
        wave = 3e-6 * np.sin(np.arange(len(given.samples.spool)) / 40.0)
        waved.append(
            replace(given, samples=replace(given.samples, spool=given.samples.spool + wave))
        )
    reasons = refusal(waved)
    assert "no model explains" in reasons[0]
    assert reasons[1] == "not explained: the spool"


@pytest.mark.slow
@of_calibrated_unit
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
@of_calibrated_unit
@pytest.mark.parametrize("test", ["open", "closed"])
def test_a_worn_unit_is_then_diagnosed_to_hundredths_of_a_percent(test):
    truth = (0.3, 0.45, 0.2)
    worn = recording(test, truth, seed=3)
    found = diagnose([worn], learned().actuator, TESTS.values())
    assert found.verdict is Verdict.DEGRADED
    for item, value in zip(found.identification.estimates, truth, strict=True):
        assert abs(item.value - value) < min(4.0 * item.std, 2e-3)


@pytest.mark.slow
@of_calibrated_unit
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
@of_calibrated_unit
def test_a_later_recording_refines_it():
    before = learned().actuator
    found = update_calibration([recording("open", (0.05, 0.1, 0.02), 6)], before, TESTS.values())
    assert found.reasons == ()
    after = found.actuator.calibration
    assert len(after.recordings) == 3
    sharper = [b <= a * 1.05 for a, b in zip(before.calibration.std, after.std, strict=True)]
    assert np.mean(sharper) > 0.7


NAMES = ("KSF", "load", "torque_odd", "spool_bow")
BESIDE = NAMES[1:]


def test_what_is_clear_stays_and_what_is_not_goes():
    values, std = np.array([0.02, 1.0, -0.05, 0.001]), np.array([0.01, 30.0, 0.001, 0.001])
    assert select_significant(BESIDE, NAMES, values, np.diag(std**2), 10.0) == ("torque_odd",)


def test_of_two_that_do_the_same_one_stays():
    # Either alone is in doubt since the other may stand for it, both are not.
    values = np.array([0.0, 0.0, 1.0, 1.0])
    spread = np.diag([1.0, 1.0, 1.0, 1.0]) * 0.26
    spread[2, 3] = spread[3, 2] = -0.25
    spread[0, 0] = spread[1, 1] = 1.0
    kept = select_significant(BESIDE, NAMES, values, spread, 10.0)
    assert len(kept) == 1
    assert kept[0] in ("torque_odd", "spool_bow")


@given(
    values=st.lists(st.floats(-10.0, 10.0), min_size=4, max_size=4),
    std=st.lists(st.floats(0.1, 10.0), min_size=4, max_size=4),
)
def test_of_what_is_independent_each_is_judged_alone(values, std):
    assume(all(abs(abs(v / s) - 2.0) > 1e-6 for v, s in zip(values, std, strict=True)))
    kept = select_significant(BESIDE, NAMES, np.array(values), np.diag(np.square(std)), 4.0)
    alone = tuple(n for n, v, s in zip(NAMES, values, std, strict=True) if abs(v / s) >= 2.0)
    assert kept == tuple(name for name in alone if name in BESIDE)


@pytest.mark.parametrize("worth", [0.0, 1e9])
def test_the_price_of_an_unknown_decides(worth):
    kept = select_significant(BESIDE, NAMES, np.ones(4), np.eye(4), worth)
    assert kept == (() if worth else BESIDE)


SHIFT = 1.8e-6


def recorded(effects, name="open", faults=None):
    return record(Unit(effects=effects), TESTS[name], faults, seed=5, step=COARSE_STEP)


@pytest.mark.slow
def test_displaced_lands_and_a_bent_torque_are_told_from_all_else():
    effects = Effects(
        null_bias=4e-5,
        hysteresis=0.02,
        unmodelled=UnmodelledEffects(land_shift=SHIFT, torque_cubic=0.03),
    )
    both = [recorded(effects, name) for name in ("open", "closed")]
    found = calibrate(both, default_actuator(), TESTS.values())
    assert found.reasons == ()
    assert found.actuator is not None
    assert found.actuator.calibration is not None
    assert found.actuator.calibration.plays == 1
    learned = found.actuator.calibration.effects
    assert learned["hysteresis"] == pytest.approx(effects.hysteresis, rel=0.02)
    assert learned["land_shift"] == pytest.approx(SHIFT, rel=0.03)
    assert learned["torque_odd"] == pytest.approx(0.03, rel=0.05)
    basic = {"null_bias", "torque_motor_gain", "hysteresis", "backlash"}
    assert len(set(learned) - basic) <= 3


@pytest.fixture(scope="module")
def stuck():
    """With so much jack friction that the jack stands still beside the pressure of its lands."""
    return recorded(
        Effects(unmodelled=UnmodelledEffects(land_shift=SHIFT)), faults=Faults(0.0, 0.0, 0.9)
    )


@pytest.fixture
def built_with(stuck, monkeypatch):
    def build(name=None, value=0.0):
        def known(actuator, environment):
            constants = unit_constants(actuator, environment)
            return constants._replace(**effect.changes(constants, value)) if effect else constants

        effect = next((item for item in NUISANCE_PARAMETERS if item.name == name), None)
        monkeypatch.setattr("ehadiag.identify.experiment.unit_constants", known)
        return build_experiment(stuck.samples, stuck.environment, TESTS["open"], default_actuator())

    return build


def test_pressure_at_rest_of_displaced_lands_is_no_offset(built_with):
    assert built_with().origin == pytest.approx(-SHIFT, rel=0.05)
    known = built_with("land_shift", SHIFT)
    assert known.origin == 0.0
    assert known.pressure_offset == pytest.approx(0.0, abs=2e4)


@pytest.mark.parametrize(("name", "value"), [("land_shift", 2e-9), ("load", 3.0)])
def test_pressure_at_rest_beyond_what_is_asked_for_is_of_a_spool_beside_the_middle(
    built_with, name, value
):
    plain, known = built_with(), built_with(name, value)
    assert known.origin == pytest.approx(plain.origin, rel=0.01)
    assert known.pressure_offset == 0.0
    assert known.spool_offset == pytest.approx(plain.spool_offset, abs=1e-8)


def test_severities_reach_below_zero_by_what_the_data_may_be_off():
    actuator = default_actuator()
    clogging, spool, jack = faults_below_zero(actuator, {"FSS0": 0.1, "FDJ0": 0.1})
    assert clogging == FAULTS[0]
    valve = actuator.servovalve
    assert valve.FSS0 + spool.lower * (valve.FSS1 - valve.FSS0) == pytest.approx(0.9 * valve.FSS0)
    assert actuator.jack.FDJ0 + jack.lower * (actuator.jack.FDJ1 - actuator.jack.FDJ0) == (
        pytest.approx(0.9 * actuator.jack.FDJ0)
    )
    assert [item.upper for item in (clogging, spool, jack)] == [1.0] * 3


@pytest.mark.slow
def test_such_a_unit_is_learned_by_its_data_alone():
    errors = DataErrors(FSS0=-0.04, FDJ0=-0.03, KSF=0.02)
    effects = Effects(hysteresis=0.02, backlash=1e-6, null_bias=5e-5, data=errors)
    unit = Unit(effects=effects, serial=3)
    both = [record(unit, TESTS[name], seed=5, step=COARSE_STEP) for name in ("open", "closed")]
    found = calibrate(both, default_actuator(), TESTS.values())
    assert found.reasons == ()
    assert [item.words for item in found.tried] == ["linear second stage, one play"]
    assert found.actuator is not None
    spool, jack = found.actuator.servovalve.FSS0, found.actuator.jack.FDJ0
    assert spool == pytest.approx(0.96 * 2.0, rel=0.03)
    assert jack == pytest.approx(0.97 * 150.0, rel=0.01)
    assert {item.name: item.value for item in found.severities}["FSS"] <= 1e-3
