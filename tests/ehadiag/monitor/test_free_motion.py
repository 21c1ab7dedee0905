"""The monitor between tests: silent where nothing can be told, and not elsewhere."""

import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import SPOOL
from ehadiag.core.recording import CommandMode
from ehadiag.monitor import FreeMotionMonitor, Monitor, undecided_spool
from ehadiag.monitor.free_motion import SETTLING
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import Plant
from ehadiag_tools.free_motion.motion import free_motion

ACTUATOR = default_actuator()
WORN = (0.3, 0.3, 0.3)


def monitor_of(faults, mode, hours=0.5):
    inner = Monitor(ACTUATOR, faults, mode=mode, hours=hours)
    return FreeMotionMonitor(inner, undecided_spool(ACTUATOR, faults[2]))


def alarms_of(monitor, rows):
    found = []
    for tick, row in enumerate(rows.tolist()):
        reading = monitor.push(tuple(row))
        if monitor.settled and reading.alarmed.any():
            found.append(tick)
    return found


@pytest.mark.parametrize("mode", list(CommandMode))
def test_free_motion_of_a_known_unit_gives_no_alarm_and_that_of_a_changed_one_does(mode):
    """Four seconds: an alarm in half an hour is not to be met with."""
    same = free_motion(ACTUATOR, Faults(*WORN), mode, 4.0, seed=3)
    assert alarms_of(monitor_of(WORN, mode), same) == []
    assert alarms_of(monitor_of((0.3, 0.3, 0.6), mode), same)


def held(seconds, seed=0):
    """A worn unit that is held in the middle, where the jack sticks and slides by turns."""
    plant = Plant(ACTUATOR, Faults(*WORN), seed=seed)
    lsb = np.array([12e-3, 0.5e-3, 25e6, 60e-3]) / 2048
    rows = []
    for tick in range(round(seconds * 1000)):
        command = 2e-3 if tick < 300 else 0.0
        codes = plant.tick(command, CommandMode.POSITION)
        rows.append([command, *((codes - 2048) * lsb)])
    return np.array(rows)


def test_the_pressure_says_nothing_while_the_surface_is_held():
    monitor = monitor_of(WORN, CommandMode.POSITION)
    rests = [np.isnan(monitor.push(tuple(row)).residual[1]) for row in held(2.0).tolist()]
    assert np.mean(rests[1500:]) > 0.25
    assert np.mean(rests[20:250]) < 0.1


def test_what_friction_hides_grows_with_it_and_is_never_less_than_some_steps():
    sizes = [undecided_spool(ACTUATOR, severity) for severity in (0.0, 0.5, 1.0)]
    assert sizes == sorted(sizes)
    assert sizes[0] > 3.0 * SPOOL.lsb
    assert sizes[-1] < 0.01 * ACTUATOR.servovalve.XSM


def test_a_spool_that_rests_beside_the_middle_is_found_while_the_monitor_settles():
    """It is half a step beside the noisy sample that the monitor began with."""
    rng = np.random.default_rng(1)
    place, lsb = 0.5 * SPOOL.lsb, SPOOL.lsb
    monitor = monitor_of((0.0, 0.9, 0.0), CommandMode.CURRENT)
    monitor.reset(-lsb)
    residuals = []
    for _ in range(2 * SETTLING):
        spool = np.rint((place + 0.5 * lsb * rng.standard_normal()) / lsb) * lsb
        reading = monitor.push((0.0, 0.0, spool, 0.0, 0.0))
        residuals.append(float(reading.residual[0]))
        assert not (monitor.settled and reading.alarmed.any())
    assert abs(np.mean(residuals[SETTLING:])) < 0.3


def test_settling_counts_only_ticks_with_a_sample():
    monitor = monitor_of((0.0, 0.0, 0.0), CommandMode.CURRENT)
    nan = float("nan")
    for _ in range(2 * SETTLING):
        monitor.push((0.0, nan, nan, nan, nan))
    assert not monitor.settled
    for _ in range(SETTLING):
        monitor.push((0.0, 0.0, 0.0, 0.0, 0.0))
    assert monitor.settled
    monitor.settle()
    assert not monitor.settled
