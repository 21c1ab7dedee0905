"""Drives the simulated plant with the currents of a recording.

Free-running loops with different noise part ways, so in closed loop the control law gets the
*recorded* (digitised) jack position. What was not recorded is told from the next current.
"""

from __future__ import annotations

import copy
import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CURRENT, POSITION
from ehadiag.core.recording import CommandMode, Samples
from ehadiag_sim.fcc.controller import PositionController
from ehadiag_sim.plant.conditions import Effects, Faults, Sensors
from ehadiag_sim.plant.converters import Converters
from ehadiag_sim.plant.dynamics import DEFAULT_STEP, Dynamics

__all__ = ["replay"]

NEIGHBOURS = 4
"""Codes on either side of the simulated position that a missing sample may have had."""


def replay(
    actuator: Actuator,
    samples: Samples,
    command: NDArray[np.float64],
    faults: Faults,
    effects: Effects,
    step: float = DEFAULT_STEP,
    sensors: Sensors | None = None,
) -> NDArray[np.float64]:
    """Current (A), spool (m), pressure (Pa), jack (m) as read without noise, shape (4, ticks).

    `command` of each tick in A or m, shape (ticks,), as the control computer had it. A missing
    jack sample (also the one before the test) is the code near the simulated position whose
    current is nearest to the recorded one; without that either, the code of the simulated
    position. `sensors` err as they say, but for noise.
    """
    sensors = sensors or Sensors()
    plant = Dynamics(
        actuator, faults, effects, step, filter_time=sensors.filter_time, early=sensors.early
    )
    electronics = Converters(actuator, sensors, effects.strangers, seed=0)
    law = PositionController(actuator.controller)
    truth = np.empty((4, samples.ticks))
    measured = math.nan
    # Readings at rest: of the current by its offset alone, of the jack before the test.
    zero, _, _, shown = electronics.read(plant.seen).tolist()
    for tick, wanted in enumerate(command.tolist()):
        if samples.mode is CommandMode.POSITION and math.isnan(measured):
            measured = _missing(law, wanted, float(samples.current[tick]) - zero, shown)
        plant.advance(law.current(wanted, samples.mode, measured))
        truth[:, tick] = electronics.read(plant.seen)
        shown = float(truth[3, tick])
        measured = float(samples.position[tick])
    return truth


def _missing(law: PositionController, command: float, current: float, simulated: float) -> float:
    """Jack position that the converter may have shown, m."""
    nearest = round(simulated / POSITION.lsb)
    if math.isnan(current):
        return nearest * POSITION.lsb

    def misfit(code: int) -> tuple[int, int]:
        trial = copy.copy(law).current(command, CommandMode.POSITION, code * POSITION.lsb)
        # In saturation many codes give one current: take the nearest position then.
        return round(abs(trial - current) / CURRENT.lsb), abs(code - nearest)

    codes = range(nearest - NEIGHBOURS, nearest + NEIGHBOURS + 1)
    return min(codes, key=misfit) * POSITION.lsb
