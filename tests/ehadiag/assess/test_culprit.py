"""What keeps the model from explaining a recording is named: signal, time, effect, next step."""

from __future__ import annotations

import json

import numpy as np
import pytest
from msgspec.structs import replace

from ehadiag import Verdict, bundled_tests, default_actuator
from ehadiag.assess.diagnosis import diagnose
from ehadiag.records import result_of
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.simulation import simulate
from firmware_iface.stored_test import resolve_test

pytestmark = pytest.mark.slow


def diagnosed(effects=None, sensors=None, change=None):
    done = simulate(
        default_actuator(),
        resolve_test("open"),
        Faults(0.1, 0.2, 0.1),
        effects or Effects(),
        sensors or Sensors(),
        seed=1,
        step=1e-6,
    )
    recording = done.recording("simulated")
    if change is not None:
        recording = replace(recording, samples=change(recording.samples))
    return diagnose([recording], default_actuator(), bundled_tests().values())


@pytest.mark.parametrize(
    ("effects", "sensors", "name", "advice"),
    [
        (Effects(load=1500.0), None, "load", "load looks +1.5e+03 N"),
        (
            Effects(oil_temperature=25.0),
            Sensors(temperature_error=15.0),
            "oil_viscosity",
            "oil temperature looks -15 K off",
        ),
        (
            None,
            Sensors(gains=(0.0, 0.0, -0.2, 0.0)),
            "pressure_gain",
            "the pressure sensor reads 20% too low",
        ),
    ],
)
def test_a_single_cause_is_named(effects, sensors, name, advice):
    found = diagnosed(effects, sensors)
    assert found.verdict is Verdict.NOT_TESTED
    assert found.culprit.signal == "pressure"
    assert found.culprit.suspects[0].name == name
    assert found.culprit.suspects[0].share > 0.6
    assert found.culprit.advice.startswith(advice)
    assert 0.0 <= found.culprit.start < found.culprit.end <= 5.5
    assert advice in str(result_of(found))
    told = json.loads(result_of(found).to_json())["culprit"]
    assert told["suspects"][0]["name"] == name
    assert told["advice"] == found.culprit.advice


def test_a_sensor_that_stands_still_is_named_with_its_time():
    def freeze(samples):
        spool = np.where(np.arange(samples.ticks) < 1500, samples.spool, samples.spool[1500])
        return replace(samples, spool=spool)

    found = diagnosed(change=freeze)
    assert "the spool sensor stands still from 1.5 s on" in found.culprit.advice


def test_a_reversed_sensor_is_named():
    found = diagnosed(change=lambda samples: replace(samples, spool=-samples.spool))
    assert "wrong sign" in found.culprit.advice


def test_an_explained_recording_has_none():
    assert diagnosed().culprit is None
