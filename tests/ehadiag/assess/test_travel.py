"""Sensors that show another motion than the others, refused before anything is identified."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import LOGS

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.travel import objections_to_travel
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag_sim.faults.hardware import broken
from ehadiag_sim.plant.conditions import Faults
from firmware_iface.logs.reader import read_recording

NAMES = ("healthy-open.blf", "paper-open-4.blf", "lossy-open.blf", "hot-worn-closed.asc")
ACTUATOR = default_actuator()


@pytest.fixture(scope="module", params=NAMES)
def samples(request):
    return read_recording(LOGS / request.param).samples


def test_sound_sensors_are_not_complained_of(samples):
    assert objections_to_travel(samples, ACTUATOR) == []


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_lost_samples_are_no_reason(samples, share):
    rng = np.random.default_rng(1)
    lost = {
        name: np.where(rng.random(samples.ticks) < share, np.nan, getattr(samples, name))
        for name in ("spool", "position")
    }
    assert objections_to_travel(replace(samples, **lost), ACTUATOR) == []


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
    (reason,) = objections_to_travel(changed, ACTUATOR)
    assert reason.startswith(words)


def test_nothing_is_said_where_nothing_moves_or_is_known(samples):
    still = {name: 0.0 * getattr(samples, name) for name in ("spool", "position")}
    assert objections_to_travel(replace(samples, **still), ACTUATOR) == []
    unknown = replace(samples, position=np.full(samples.ticks, np.nan))
    assert objections_to_travel(unknown, ACTUATOR) == []


@pytest.mark.parametrize("kind", ["swapped-spool-position", "swapped-pressure-position"])
def test_swapped_wires_in_closed_loop_are_refused_without_a_search(kind):
    recording = broken(
        kind, np.random.default_rng(3), ACTUATOR, resolve_test("closed"), Faults(0.1, 0.1, 0.1)
    )
    found = diagnose([recording], ACTUATOR, bundled_tests().values())
    assert found.verdict is Verdict.NOT_TESTED
    assert found.identification is None
