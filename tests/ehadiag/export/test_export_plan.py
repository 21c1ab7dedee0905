"""The plan of an exported library: tests, identity, what a calibration is not certain of."""

import msgspec
import numpy as np
import pytest
from exported import short_test

from ehadiag import ConfigurationError, default_actuator
from ehadiag.core.actuator import Calibration, CalibrationSource, FitQuality
from ehadiag.export.library import identity_of, library_plan, uncertain_constants, verdict_rules
from ehadiag.model.plant import PLANT_FIELDS
from ehadiag.model.registry import unit_constants
from ehadiag.monitor.plan import design_cusum
from ehadiag.onboard.onboard_memory import (
    ONBOARD_PLAN_SIZE,
    PLAN_DIRECTIONS,
    PLAN_TEST_SIZE,
    PLAN_TESTS,
)
from firmware_iface.stored_test import bundled_tests

DESIGN = design_cusum(100.0, 1e-3)
CALIBRATED = msgspec.structs.replace(
    default_actuator(),
    calibration=Calibration(
        date="2026-01-02T03:04:05Z", start="reference-31", serial=7,
        effects={"null_bias": 1.1e-4}, parameters=("null_bias", "datum_KF"),
        std=(2e-7, 0.01), root=((1.0,), (0.6, 0.8)),
        fit=FitQuality(excess=1.1, outliers=0.002, spool_rms=1.0, pressure_rms=1.02),
        recordings=(CalibrationSource(name="a.blf", test="open", sha256="00"),),
    ),
)  # fmt: skip


def test_a_plan_has_the_windows_of_its_tests():
    plan = library_plan(default_actuator(), DESIGN)
    assert len(plan) == ONBOARD_PLAN_SIZE
    for closed, name in enumerate(("open", "closed")):
        test, place = bundled_tests()[name], PLAN_TESTS + closed * PLAN_TEST_SIZE
        assert plan[place] == test.ticks
        first, end = test.windows.FDJ[0]
        assert plan[place + 1 : place + 3].tolist() == [1e3 * first, 1e3 * end]


def test_a_library_without_a_test_of_a_kind_identifies_none():
    plan = library_plan(default_actuator(), DESIGN, [short_test(400)])
    assert plan[PLAN_TESTS] == 400.0
    assert plan[PLAN_TESTS + PLAN_TEST_SIZE] == 0.0


def test_two_tests_of_a_kind_are_refused():
    with pytest.raises(ConfigurationError, match="one of each kind"):
        library_plan(default_actuator(), DESIGN, [short_test(400), short_test(500)])


def test_another_actuator_and_another_test_have_another_digest():
    plans = [
        library_plan(default_actuator(), DESIGN), library_plan(CALIBRATED, DESIGN),
        library_plan(default_actuator(), DESIGN, [short_test(400)]),
    ]  # fmt: skip
    digests = [plan[PLAN_TESTS - 3] for plan in plans]
    assert len(set(digests)) == len(digests)
    assert identity_of(CALIBRATED, 1.0).serial == 7.0
    assert identity_of(default_actuator(), 1.0).serial == 0.0


def test_what_a_calibration_is_not_certain_of_is_in_the_plan():
    """One direction for each column of the root."""
    rows, base = np.array(uncertain_constants(CALIBRATED)), np.array(unit_constants(CALIBRATED))
    assert len(rows) == 2
    fields = unit_constants(CALIBRATED)._fields
    bias, stiffness = fields.index("IB"), fields.index("KF")
    moved = rows - base
    assert moved[0, bias] == pytest.approx(2e-7, rel=1e-6)
    assert moved[0, stiffness] == pytest.approx(0.006 * base[stiffness], rel=1e-6)
    assert moved[1, bias] == pytest.approx(0.0, abs=1e-15)
    assert moved[1, stiffness] == pytest.approx(0.008 * base[stiffness], rel=1e-6)
    plan = library_plan(CALIBRATED, DESIGN)
    assert plan[PLAN_DIRECTIONS] == len(rows)
    assert plan[ONBOARD_PLAN_SIZE:].tolist() == rows.ravel().tolist()
    assert len(plan) == ONBOARD_PLAN_SIZE + len(rows) * PLANT_FIELDS


def test_a_calibration_has_a_discrepancy_of_each_severity():
    assert verdict_rules(default_actuator()).discrepancy_FDJ == 0.0
    rules = verdict_rules(CALIBRATED)
    assert min(rules.discrepancy_Kintas, rules.discrepancy_FSS, rules.discrepancy_FDJ) >= 1e-4
