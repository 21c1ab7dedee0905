"""Recordings by an acquisition with converters and a clock of its own, truth known."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas
import pytest

from ehadiag import bundled_tests, default_actuator
from ehadiag.identify.experiment import build_experiment
from ehadiag_sim.plant_dynamics import PlantDynamics
from ehadiag_tools.rigs import replay
from ehadiag_tools.rigs.replay import SETTLING_S, DaqCase, perform_daq, recorded_columns
from ehadiag_tools.simulator.units import COARSE_STEP
from firmware_iface.bus_map import default_map
from firmware_iface.find_test import CandidateTests
from firmware_iface.signals.recordings import Interpretation, recorded_tests

SOUGHT = CandidateTests(tuple(bundled_tests().values()), default_actuator().controller)


@pytest.fixture(scope="module", autouse=True)
def coarse_plant():
    """As much as a cubic between two samples needs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "PLANT_RATE", 20_000.0)
        patch.setattr(replay, "PlantDynamics", partial(PlantDynamics, step=COARSE_STEP))
        yield


def case(test: str, rate: float, **changes: object) -> DaqCase:
    usual = {
        "test": test, "faults": (0.484, 0.841, 0.611), "rate": rate, "bits": 12,
        "with_command": False, "lead_in_s": 0.357, "phase": 0.3, "drift_ppm": 55.0, "seed": 11,
    }  # fmt: skip
    return DaqCase(**(usual | changes))


@cache
def read(this: DaqCase):
    with TemporaryDirectory() as folder:
        path = Path(folder, "daq.csv")
        pandas.DataFrame(recorded_columns(this)).to_csv(path, index=False, float_format="%.9g")
        (found,) = recorded_tests([path], Interpretation(default_map(), None, SOUGHT))
    return found


@pytest.mark.parametrize(
    ("test", "rate", "most_us"),
    [
        # By the control law: a line between two positions has less noise in its middle.
        ("closed", 1000.0, 40.0),
        ("closed", 5000.0, 15.0),
        pytest.param("closed", 10_000.0, 8.0, marks=pytest.mark.slow),
        # The current changes from tick to tick in the sines alone: half a sampling interval.
        pytest.param("open", 5000.0, 100.0, marks=pytest.mark.slow),
        ("open", 10_000.0, 50.0),
    ],
)
def test_the_ticks_are_found_between_samples(test, rate, most_us):
    this = case(test, rate)
    found = read(this)
    found = found.as_measured or found
    assert found.test_id == bundled_tests()[test].id
    at = found.samples.host_ns * 1e-9
    true = SETTLING_S + this.lead_in_s + np.arange(len(at)) * 1e-3
    true = (true - SETTLING_S - this.phase / rate) / (1.0 + this.drift_ppm * 1e-6)
    middle = len(at) // 2
    assert (at - true)[middle] * 1e6 == pytest.approx(0.0, abs=most_us)
    assert found.samples.acquired.rate == pytest.approx(rate)


def test_the_codes_of_a_closed_loop_follow_from_the_current():
    """The law on the acquisition's own positions would be 7 LSB off."""
    found = read(case("closed", 5000.0))
    test, actuator = bundled_tests()["closed"], default_actuator()
    trace = build_experiment(found.samples, found.environment, test, actuator).trace
    assert trace.residual_lsb < 1.0


def test_a_command_of_its_own_is_found_at_the_same_place():
    """The clock of the held command began with its first change, 0.2 s into the test."""
    this = case("open", 5000.0, with_command=True)
    found = read(this)
    assert np.isfinite(found.samples.spool[:200]).all()
    assert found.out_of_order == 0.0


def test_a_clock_that_gains_half_a_tick_is_told_from_one_that_loses_it():
    """Of two samples a tick both put each edge into the same intervals; one is a tick off then."""
    this = case(
        "open", 2000.0, faults=(0.827, 0.517, 0.605), lead_in_s=1.476, phase=0.12,
        drift_ppm=87.501, seed=421373300,
    )  # fmt: skip
    assert read(this).test_id == bundled_tests()["open"].id


STUCK = case(
    "closed", 5000.0, faults=(0.046, 0.047, 0.767), lead_in_s=0.687, phase=0.557,
    drift_ppm=-78.959, seed=2041007357,
)  # fmt: skip
"""Begins under pressure of 0.5 MPa, which the jack's friction holds."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "this",
    [
        case("open", 1000.0),
        case("open", 10_000.0, bits=16),
        case("closed", 1000.0),
        case("closed", 5000.0, bits=16),
        STUCK,
        case(  # at the edges half of the pressures are between samples too far apart
            "closed",
            2000.0,
            faults=(0.093, 0.555, 0.063),
            bits=16,
            lead_in_s=1.094,
            phase=0.628,
            drift_ppm=62.082,
            seed=294882555,
        ),
    ],
)
def test_a_verdict_that_holds_the_truth(this):
    found = perform_daq(this)
    assert found["verdict"] == ("FAULT" if max(this.faults) > 0.75 else "DEGRADED"), found
    ends = zip(found["value"], found["interval95"], this.faults, strict=True)
    for value, (low, high), truth in ends:
        std = (high - low) / 3.92
        assert abs(value - truth) < 3.5 * std
        assert std < 0.003


def test_a_refusal_names_a_rate_that_is_too_low():
    found = perform_daq(case("open", 500.0, bits=16))
    assert found["verdict"] == "NOT_TESTED"
    assert "took 500 samples a second, and the computer makes 1000 ticks" in " ".join(
        found["reasons"]
    )
