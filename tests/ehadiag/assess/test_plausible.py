"""Actuator files whose values are each in range, and together of no actuator."""

import pytest
from other_actuator import with_data

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.plausible import objections_to_actuator
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag_sim.plant.simulator import simulate


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
