"""The simulated unit as two kernels on flat arrays: what runs where there is no Python.

The same integration, coefficients and control law as `ehadiag_sim.plant.simulator.Plant`, without
noise, strangers and damage.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import FunctionType
from typing import Any, Final, NamedTuple

import numba
import numpy as np

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel
from ehadiag.compile.rows import packer, unpacker
from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import SCALES
from ehadiag.core.conversion import actuator_channels
from ehadiag_sim.fcc.controller import PositionLaw, position_law
from ehadiag_sim.plant import coefficients as laws
from ehadiag_sim.plant.coefficients import Coefficients, Condition, UnitData, unit_data
from ehadiag_sim.plant.dynamics import DEFAULT_STEP
from ehadiag_sim.plant.kernels import P12, P12_SEEN, STATES, XJ, XS, XS_SEEN, advance
from ehadiag_sim.plant.torque_motor import play

__all__ = [
    "MEMORY",
    "MOST_PLAYS",
    "PLAN_SIZE",
    "Inputs",
    "Outputs",
    "Settings",
    "plant_plan",
    "start_plant",
    "tick_plant",
]

MOST_PLAYS: Final = 64


class Settings(NamedTuple):
    """What the unit is told at its start, beside its `Condition`.

    Attributes
    ----------
    hysteresis : float
        Width of the torque motor's loop over rated current, 0 … 1.
    plays : float
        Number of plays whose mean it is, 1 … MOST_PLAYS.
    null_bias : float
        A.
    offset_current : float
        Constant offsets of the converters, LSB.
    offset_spool : float
        See `offset_current`.
    offset_pressure : float
        See `offset_current`.
    offset_position : float
        See `offset_current`.
    gain_current : float
        Relative gain errors of the converters.
    gain_spool : float
        See `gain_current`.
    gain_pressure : float
        See `gain_current`.
    gain_position : float
        See `gain_current`.
    closed : float
        Not 0: commands are positions, m; 0: currents, A.
    """

    hysteresis: float
    plays: float
    null_bias: float
    offset_current: float
    offset_spool: float
    offset_pressure: float
    offset_position: float
    gain_current: float
    gain_spool: float
    gain_pressure: float
    gain_position: float
    closed: float


class Inputs(NamedTuple):
    """What the unit is given in each tick.

    Attributes
    ----------
    command : float
        A or m.
    """

    command: float


class Outputs(NamedTuple):
    """What the unit shows at the end of each tick: digitised, then as it is.

    Attributes
    ----------
    current : float
        A, as digitised.
    spool : float
        m, as digitised.
    pressure : float
        Pa, as digitised.
    position : float
        m, as digitised.
    true_current : float
        A.
    true_spool : float
        m.
    true_pressure : float
        Pa.
    true_position : float
        m.
    """

    current: float
    spool: float
    pressure: float
    position: float
    true_current: float
    true_spool: float
    true_pressure: float
    true_position: float


SETTINGS = len(Condition._fields)
INPUTS = SETTINGS + len(Settings._fields)
OUTPUTS = INPUTS + len(Inputs._fields)
VALUES: Final = OUTPUTS + len(Outputs._fields)
"""Of the values: `Condition`, `Settings`, `Inputs`, `Outputs`, one behind the other."""

COEFFICIENTS = 0
STATE = COEFFICIENTS + len(Coefficients._fields)
HELD = STATE + STATES
CONTROL = HELD + MOST_PLAYS
MEMORY: Final = CONTROL + 2
"""Numbers that the unit keeps: coefficients, state, plays, integral and error of the controller."""

PLAN_LAW = len(UnitData._fields)
PLAN_LSB = PLAN_LAW + len(PositionLaw._fields)
PLAN_HALF = PLAN_LSB + 4
PLAN_SIZE: Final = PLAN_HALF + 4
"""Of the plan: data, control law, steps of the converters, their codes of zero."""

_condition_of, _settings_of = unpacker(Condition), unpacker(Settings, SETTINGS)
_data_of, _law_of = unpacker(UnitData), unpacker(PositionLaw, PLAN_LAW)
_coefficients_of, _keep_coefficients = unpacker(Coefficients), packer(Coefficients)
_keep_outputs = packer(Outputs, OUTPUTS)
NUMBER = 8
RESOLUTION = (SCALES.current_step, SCALES.position_step)
"""Of commands on the bus, A and m."""


def _compiled(function: Callable[..., Any]) -> Any:
    return numba.njit(error_model="numpy")(function)


laws_viscosity = _compiled(laws.relative_viscosity)
_play, _position_law = _compiled(play), _compiled(position_law)


def _scaled_by_compiled_viscosity() -> Any:
    """`scaled` for kernels: what it calls must be compiled too."""
    scope = {**vars(laws), "relative_viscosity": laws_viscosity}
    function = FunctionType(laws.scaled.__code__, scope, "scaled")
    return _compiled(function)


_scaled = _scaled_by_compiled_viscosity()


def plant_plan(actuator: Actuator) -> list[float]:
    """What the kernels need of an actuator's data, PLAN_SIZE numbers."""
    law = actuator.controller
    gains = PositionLaw(law.IM, law.GAP, law.GAI, law.GAD, 1.0 / law.rate)
    channels = actuator_channels(actuator)
    steps = (*(item.lsb for item in channels), *(item.half for item in channels))
    return [float(value) for value in (*unit_data(actuator), *gains, *steps)]


@_compiled
def _digitised(value: float, gain: float, offset: float, lsb: float, half: float) -> float:
    code = math.floor((value * (1.0 + gain) + offset * lsb) / lsb + 0.5) + half
    return float((min(max(code, 0.0), 2.0 * half - 1.0) - half) * lsb)


@_compiled
def _show(values: Any, current: float, state: Any, plan: Any) -> None:
    s = _settings_of(values)
    lsb, half = plan[PLAN_LSB:PLAN_HALF], plan[PLAN_HALF:PLAN_SIZE]
    _keep_outputs(
        values,
        Outputs(
            _digitised(current, s.gain_current, s.offset_current, lsb[0], half[0]),
            _digitised(state[XS_SEEN], s.gain_spool, s.offset_spool, lsb[1], half[1]),
            _digitised(state[P12_SEEN], s.gain_pressure, s.offset_pressure, lsb[2], half[2]),
            _digitised(state[XJ], s.gain_position, s.offset_position, lsb[3], half[3]),
            current,
            state[XS],
            state[P12],
            state[XJ],
        ),
    )


@brief_kernel
def start_plant(address: int, plan_address: int, values_address: int) -> int:
    """Put the unit at rest in the middle, with coefficients of its values.

    Parameters
    ----------
    address : int
        Of MEMORY numbers.
    plan_address : int
        Of the PLAN_SIZE numbers of `plant_plan`.
    values_address : int
        Of the VALUES numbers.

    Returns
    -------
    int
        0; 1: a value is out of its range.
    """
    memory, values = array_at(address, (MEMORY,)), array_at(values_address, (VALUES,))
    c, s = _condition_of(values), _settings_of(values)
    for i in range(INPUTS):
        if not math.isfinite(values[i]):
            return 1
    for severity in (c.Kintas, c.FSS, c.FDJ, s.hysteresis):
        if not 0.0 <= severity <= 1.0:
            return 1
    if (
        not 1.0 <= s.plays <= MOST_PLAYS
        or c.supply_pressure <= c.return_pressure
        or not -54.0 <= c.oil_temperature <= 205.0
        or c.backlash < 0.0
        or c.spool_stribeck < 0.0
        or c.jack_stribeck < 0.0
        or c.filter_time < 0.0
    ):
        return 1
    for i in range(MEMORY):
        memory[i] = 0.0
    plan = array_at(plan_address, (PLAN_SIZE,))
    data = _data_of(plan)
    _keep_coefficients(memory, _scaled(data, c))
    memory[CONTROL + 1] = math.nan
    _show(values, 0.0, array_at(address + NUMBER * STATE, (STATES,)), plan)
    return 0


@brief_kernel
def tick_plant(address: int, plan_address: int, values_address: int) -> int:
    """Advance the unit by one control tick under the command among its values.

    Parameters
    ----------
    address : int
        See `start_plant`.
    plan_address : int
        See `start_plant`.
    values_address : int
        See `start_plant`; the outputs are written.

    Returns
    -------
    int
        0; 1: the command is no number.
    """
    memory, values = array_at(address, (MEMORY,)), array_at(values_address, (VALUES,))
    plan = array_at(plan_address, (PLAN_SIZE,))
    law = _law_of(plan)
    state = array_at(address + NUMBER * STATE, (STATES,))
    s, p = _settings_of(values), _coefficients_of(memory)
    command = values[INPUTS]
    if not math.isfinite(command):
        return 1
    resolution = RESOLUTION[0] if s.closed == 0.0 else RESOLUTION[1]
    command = np.rint(command / resolution) * resolution
    if s.closed == 0.0:
        current = max(-law.IM, min(law.IM, command))
        memory[CONTROL], memory[CONTROL + 1] = 0.0, math.nan
    else:
        error = command - values[OUTPUTS + 3]
        current, memory[CONTROL] = _position_law(law, memory[CONTROL], memory[CONTROL + 1], error)
        memory[CONTROL + 1] = error
    count = int(s.plays)
    total = 0.0
    for i in range(count):
        width = s.hysteresis * law.IM * (i + 0.5) / count
        memory[HELD + i] = _play(memory[HELD + i], current + s.null_bias, width)
        total += memory[HELD + i]
    substeps = math.ceil(law.tick / DEFAULT_STEP - 1e-6)
    advance(state, p, p.GM * total / count, law.tick / substeps, substeps)
    _show(values, current, state, plan)
    return 0
