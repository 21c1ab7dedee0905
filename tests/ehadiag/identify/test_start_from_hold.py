"""A closed-loop test that begins from a hold: friction keeps spool and pressure off their rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import ehadiag
from ehadiag.identify.experiment import build_experiment
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.simulation import Plant, SimulatedRun, bus_command, simulate
from firmware_iface.recording import CommandMode, Environment, Recording

CLOSED = next(test for test in ehadiag.bundled_tests().values() if test.closed_loop)
ENVIRONMENT = Environment(supply_pressure=20.7e6, return_pressure=0.7e6, oil_temperature=40.0)


def from_hold(seed: int, worn: Callable[[np.ndarray], None] = lambda _: None):
    """True severities, jack friction 0.75 and more, and the recording after a motion and a hold."""
    rng = np.random.default_rng(seed)
    faults = Faults(*rng.uniform(0.0, 0.6, 2), rng.uniform(0.75, 1.0))
    plant = Plant(ehadiag.default_actuator(), faults, Effects(), Sensors(), seed)
    size, ticks = rng.uniform(-5e-3, 5e-3), round(rng.uniform(500.0, 1500.0))
    for tick in range(ticks):
        plant.tick(size * np.sin(2.0 * np.pi * tick / 700.0), CommandMode.POSITION)
    for _ in range(1000):
        plant.tick(0.0, CommandMode.POSITION)
    command = bus_command(CLOSED, plant.scales)
    truth, codes = np.empty((4, CLOSED.ticks)), np.empty((4, CLOSED.ticks), dtype=np.int64)
    for tick, value in enumerate(command.tolist()):
        codes[:, tick] = plant.tick(value, CommandMode.POSITION)
        truth[:, tick] = plant.truth
    worn(codes)
    run = SimulatedRun(
        CLOSED, Effects(), command, *truth, codes, ENVIRONMENT, plant.scales.channels
    )
    return faults, run.recording(f"hold {seed}")


def severities_of(recording: Recording) -> list[float]:
    result = ehadiag.diagnose(recording)
    assert result.verdict is ehadiag.Verdict.FAULT, result.reasons
    return [item.value for item in result.severities.values()]


SEEDS = (2003, 2006, 2011)
"""Pressure of -1.7 and -0.25 MPa at the start; a spool that slips just then."""


@pytest.mark.parametrize("seed", SEEDS)
def test_it_is_diagnosed(seed: int) -> None:
    faults, recording = from_hold(seed)
    expected = (faults.Kintas, faults.FSS, faults.FDJ)
    np.testing.assert_allclose(severities_of(recording), expected, atol=0.005)


def frozen(codes: np.ndarray) -> None:
    codes[2] = codes[2, 0]


def frozen_half(codes: np.ndarray) -> None:
    codes[2, :2750] = codes[2, 0]


def shifted(codes: np.ndarray) -> None:
    codes[2, 1500:] += 40


@pytest.mark.parametrize(
    "worn",
    [frozen, *(pytest.param(item, marks=pytest.mark.slow) for item in (frozen_half, shifted))],
)
def test_a_pressure_sensor_that_lies_is_still_refused(worn: Callable[[np.ndarray], None]) -> None:
    result = ehadiag.diagnose(from_hold(SEEDS[0], worn)[1])
    assert result.verdict is ehadiag.Verdict.NOT_TESTED


def test_a_sensor_that_reads_beside_zero_is_no_hold() -> None:
    """A pressure 0.2 MPa off at rest is the sensor's, as the motion shows; so is 3 µm of spool."""
    done = simulate(
        ehadiag.default_actuator(),
        CLOSED,
        Faults(0.3, 0.3, 0.3),
        sensors=Sensors(offsets_lsb=(0.0, 12.0, 16.0, 0.0)),
        step=1e-6,
    )
    begun = build_experiment(done.samples, ENVIRONMENT, CLOSED, ehadiag.default_actuator())
    assert begun.origin == 0.0
    assert np.isfinite(begun.pressure).all()
