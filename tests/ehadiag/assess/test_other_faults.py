"""Null bias, hysteresis, backlash and torque-motor gain as faults of their own."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.other_faults import (
    chance_beyond,
    degraded_by,
    notes_on_other_faults,
    other_faults,
)
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.actuator_file import actuator_toml
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag.core.toml_file import decode_toml
from ehadiag.identify.result import Nuisance
from ehadiag.report.asked import Asked
from ehadiag.report.json_line import json_line
from ehadiag.report.picture import diagnosis_figure
from ehadiag.report.spent import Spent
from ehadiag.report.table import text_of
from ehadiag_sim.plant.conditions import Effects, Faults
from ehadiag_sim.plant.simulator import simulate


def found(**values):
    nuisances = {name: Nuisance(*pair, at_bound=False) for name, pair in values.items()}
    return other_faults(SimpleNamespace(nuisances=nuisances), default_actuator())


@pytest.mark.parametrize(
    ("name", "value", "beyond"),
    [
        ("null_bias", 2.9e-4, False),
        ("null_bias", -3.1e-4, True),
        ("hysteresis", 0.059, False),
        ("hysteresis", 0.061, True),
        ("backlash", 7.9e-6, False),
        ("backlash", 8.1e-6, True),
        ("torque_motor_gain", -0.099, False),
        ("torque_motor_gain", -0.101, True),
    ],
)
def test_the_default_limits(name, value, beyond):
    (item,) = found(**{name: (value, 1e-9)})
    assert item.beyond is beyond
    verdict, reasons = degraded_by([item], Verdict.HEALTHY, ())
    assert verdict is (Verdict.DEGRADED if beyond else Verdict.HEALTHY)
    assert bool(reasons) is beyond


@pytest.mark.parametrize("verdict", [Verdict.DEGRADED, Verdict.FAULT, Verdict.NOT_TESTED])
def test_no_other_verdict_is_changed(verdict):
    others = found(null_bias=(4e-4, 1e-6))
    assert degraded_by(others, verdict, ("why",)) == (
        verdict,
        ("why", "null bias 0.4 mA beyond the limit 0.3 mA"),
    )


def test_what_may_be_beyond_is_a_note():
    others = found(backlash=(7e-6, 1e-6))
    assert degraded_by(others, Verdict.HEALTHY, ()) == (Verdict.HEALTHY, ())
    assert notes_on_other_faults(others) == (
        "feedback backlash 7 µm may be beyond the limit 8 µm: chance 16%",
    )
    assert notes_on_other_faults(found(backlash=(5e-6, 1e-6))) == ()


def test_the_chance_counts_both_signs():
    assert chance_beyond(0.0, 1.0, 1.0) == pytest.approx(0.3173, abs=1e-4)
    assert chance_beyond(-2.0, 0.0, 1.0) == 1.0
    assert chance_beyond(0.5, 0.0, 1.0) == 0.0


def test_the_actuator_file_may_set_the_limits():
    text = actuator_toml(default_actuator())
    changed = decode_toml(text + b"", Actuator, "file")
    assert changed.limits == default_actuator().limits
    wider = text.replace(b"null_bias = 0.03", b"null_bias = 0.05")
    assert decode_toml(wider, Actuator, "file").limits.null_bias == 0.05
    with pytest.raises(ConfigurationError, match="null_bias"):
        decode_toml(text.replace(b"null_bias = 0.03", b"null_bias = -1.0"), Actuator, "file")


@pytest.mark.slow
def test_a_large_null_bias_degrades_and_is_reported_everywhere():
    test = resolve_test("open")
    effects = Effects(null_bias=4e-4, hysteresis=0.02)
    done = simulate(default_actuator(), test, Faults(0.1, 0.1, 0.1), effects, seed=2, step=1e-6)
    recording = done.recording("simulated")
    diagnosis = diagnose([recording], default_actuator(), bundled_tests().values())
    assert diagnosis.verdict is Verdict.DEGRADED
    (reason,) = diagnosis.reasons
    assert reason.startswith("null bias 0.4 mA beyond the limit")
    told = json.loads(json_line(diagnosis, Spent(), Asked()))["other"]
    by_name = {item["name"]: item for item in told}
    assert by_name["null_bias"]["value"] == pytest.approx(4e-4, rel=0.01)
    assert by_name["null_bias"]["beyond"]
    assert by_name["null_bias"]["limit"] == pytest.approx(3e-4)
    assert not by_name["hysteresis"]["beyond"]
    assert by_name["hysteresis"]["unit"] == "1"
    assert "null bias" in text_of(diagnosis)
    assert "beyond its limit" in text_of(diagnosis)
    assert "null bias 0.4 mA beyond its limit" in diagnosis_figure(diagnosis).get_suptitle()
