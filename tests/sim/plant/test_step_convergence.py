"""The plant's kernels against an independent stiff solver with event location."""

import numpy as np
import pytest
from other_actuator import with_data

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import POSITION, PRESSURE, SPOOL
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.dynamics import DEFAULT_STEP, respond
from ehadiag_tools.simulator.stiff_reference import StiffReference

LSB = np.array([[SPOOL.lsb], [PRESSURE.lsb], [POSITION.lsb]])
STEPS = np.array([8e-6, 4e-6, 2e-6, 1e-6, 0.5e-6])
TIME = np.arange(200) * 1e-3


def errors(actuator, currents, fault, steps):
    reference = StiffReference(actuator, fault.Kintas, fault.FSS, fault.FDJ)
    truth = reference.respond(currents)
    gaps = [(respond(actuator, currents, fault, step=step) - truth) / LSB for step in steps]
    return np.array([np.sqrt((gap**2).mean(axis=1)) for gap in gaps]), truth, reference


def order(rms):
    """Slope of error over step in doubly logarithmic scale, per channel."""
    return np.polyfit(np.log(STEPS), np.log(rms), 1)[0]


def test_smooth_history_converges_with_order_one():
    """No friction, no stop: 25 Hz across both corners of the pressure saturation."""
    actuator = with_data(servovalve={"FSS0": 0.0}, jack={"FDJ0": 0.0})
    drive = 3e-3 * np.sin(2 * np.pi * 25 * TIME)
    rms, truth, _ = errors(actuator, drive, Faults(Kintas=0.3), STEPS)
    assert np.abs(truth[0]).max() > actuator.servovalve.PSR / actuator.servovalve.GP
    np.testing.assert_allclose(order(rms), 1.0, atol=0.03)


def test_stick_slip_history_converges_with_order_one():
    """Two tones: spool and jack stick and break away again and again."""
    drive = 1.5e-3 * (np.sin(2 * np.pi * 7 * TIME) + np.sin(2 * np.pi * 43 * TIME))
    rms, _, reference = errors(default_actuator(), drive, Faults(0.3, 0.6, 0.6), STEPS)
    assert reference.slides[1] >= 15
    assert reference.slides[2] >= 6
    np.testing.assert_allclose(order(rms), 1.0, atol=0.2)


def test_stops_of_flapper_and_spool_converge_with_order_one():
    """Twenty per cent more torque than as new drives the spool into its stops."""
    actuator = with_data(servovalve={"GM": 1.2 * 2.82})
    drive = 10e-3 * np.sign(np.sin(2 * np.pi * 20 * TIME + 0.1))
    rms, truth, reference = errors(actuator, drive, Faults(0.2, 0.2, 0.3), STEPS)
    assert np.abs(truth[0]).max() == pytest.approx(actuator.servovalve.XSM)
    assert reference.slides[0] >= 5
    np.testing.assert_allclose(order(rms), 1.0, atol=0.2)


def test_default_step_is_converged():
    """Of the noise floor of 0.58 LSB the integration takes less than a tenth anywhere."""
    rng = np.random.default_rng(7)
    drive = np.interp(TIME, TIME[::10], rng.uniform(-10e-3, 10e-3, 20))
    rms, _, reference = errors(default_actuator(), drive, Faults(0.5, 0.5, 0.5), [DEFAULT_STEP])
    assert reference.slides[1] >= 5
    assert rms.max() < 0.05
