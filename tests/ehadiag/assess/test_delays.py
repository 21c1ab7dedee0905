"""Delays between messages, told by the response and put back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import LOGS

from ehadiag.assess.delays import Delay, delays_of, put_back, said, worth_it
from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from firmware_iface.logs.reader import read_recording

TESTS = bundled_tests()


def later(values: np.ndarray, ticks: int) -> np.ndarray:
    return np.concatenate([values[:ticks], values[:-ticks]])


@pytest.fixture(scope="module")
def recording():
    """Pressure and position come by a message that is placed a tick late."""
    whole = replace(read_recording(LOGS / "paper-open-2.blf"), by_time=True)
    samples = whole.samples
    late = replace(
        samples, pressure=later(samples.pressure, 1), position=later(samples.position, 1)
    )
    return whole, replace(whole, samples=late)


@pytest.mark.slow
def test_a_tick_between_messages_is_put_back(recording):
    whole, late = recording
    true, found = (diagnose([item], default_actuator(), TESTS.values()) for item in (whole, late))
    assert found.verdict is true.verdict is Verdict.DEGRADED
    for one, other in zip(
        true.identification.estimates, found.identification.estimates, strict=True
    ):
        assert abs(one.value - other.value) < 1e-4
    (note,) = [item for item in found.notes if "put back" in item]
    assert "pressure +1.0" in note
    assert not any("put back" in item for item in true.notes)
    spool, pressure, _ = delays_of(true.experiments[0], true.identification)
    assert abs(spool.value) < 0.01
    assert abs(pressure.value) < 0.02
    half = replace(
        true.experiments[0],
        spool=0.5 * (true.experiments[0].spool + later(true.experiments[0].spool, 1)),
    )
    assert delays_of(half, true.identification)[0].value == pytest.approx(0.5, abs=0.03)


def test_only_large_and_sure_delays_count():
    assert not worth_it([Delay("spool", 0.04, 0.001), Delay("pressure", 0.9, 0.3)])
    assert worth_it([Delay("spool", 0.0, 0.001), Delay("pressure", -0.2, 0.01)])
    words = said([Delay("spool", 1.0, 0.01)], 2e-3)
    assert "spool +2.000 ± 0.020 ms" in words


@pytest.mark.parametrize(("value", "expected"), [(1.05, 1.0), (-2.0, -2.0), (0.5, 0.5)])
def test_what_is_put_back(recording, value, expected):
    whole, _ = recording
    experiment = diagnose([whole], default_actuator(), TESTS.values()).experiments[0]
    ramp = np.arange(experiment.ticks, dtype=np.float64)
    item = replace(experiment, spool=ramp)
    nothing = Delay("", 0.0, 1.0)
    moved = put_back(item, (Delay("spool", value, 0.01), nothing, nothing)).spool
    known = np.isfinite(moved)
    assert np.allclose(moved[known] - ramp[known], expected)
    assert known.sum() >= experiment.ticks - 2
