"""Wrong units and signs, found by what the channels have to do with each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import LOGS

from ehadiag.assess.wrong_units import implausible
from ehadiag.core.actuator import default_actuator
from firmware_iface.logs.reader import read_recording

NAMES = ("healthy-open.blf", "paper-open-4.blf", "healthy-closed.blf", "paper-closed-4.blf")


@pytest.fixture(scope="module", params=NAMES)
def samples(request):
    return read_recording(LOGS / request.param).samples


def test_right_units_are_not_complained_of(samples):
    assert implausible(samples, default_actuator()) == ()


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
def test_a_wrong_unit_or_sign_is_named(samples, channel, factor, words):
    wrong = replace(samples, **{channel: factor * getattr(samples, channel)})
    found = implausible(wrong, default_actuator())
    assert any(item.startswith(f"{channel}: ") and words in item for item in found) or (
        # The ends of the chain have one relation alone: either side of it explains it.
        len(found) == 1 and channel in ("command",)
    )


@pytest.mark.parametrize("factor", [1 / 14.5038, 100.0, 1e3])
def test_a_wrong_unit_of_pressure_is_found(samples, factor):
    wrong = replace(samples, pressure=factor * samples.pressure)
    (found,) = implausible(wrong, default_actuator())
    assert found.startswith("pressure: ")


def test_a_reversed_pressure_is_found(samples):
    (found,) = implausible(replace(samples, pressure=-samples.pressure), default_actuator())
    assert "sign is reversed" in found


def test_a_rest_says_nothing(samples):
    still = replace(
        samples,
        **{
            name: np.random.default_rng(seed).normal(0.0, 1e-6, samples.ticks)
            for seed, name in enumerate(("current", "spool", "pressure", "position", "command"))
        },
    )
    assert implausible(still, default_actuator()) == ()
