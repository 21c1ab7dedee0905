"""The simulated unit as two kernels on flat arrays: what runs where there is no Python.

The same integration, coefficients and control law as `ehadiag_sim.simulation.Plant`, without
noise, unmodelled and damage.
"""

from __future__ import annotations

import math
from dataclasses import fields
from types import FunctionType
from typing import Any, Final, NamedTuple

import numpy as np

from ehadiag.compile.jit import bare_kernel
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at, packer, places, unpacker
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag_sim import plant_laws as laws
from ehadiag_sim.conditions import DataErrors, Effects, Faults, Sensors
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S, STATE, advance_plant
from ehadiag_sim.plant_laws import (
    PositionLaw,
    UnitCondition,
    UnitData,
    play_operator,
    position_law,
    unit_data,
)
from firmware_iface.recording import CHANNELS, DEFAULT_SCALES

MAX_FMU_PLAYS: Final = 64
"""Largest number of plays of the hysteresis, 1."""


class FmuSettings(NamedTuple):
    """Settings of the unit at its start, with its `UnitCondition`."""

    hysteresis: float
    """Width of the torque motor's loop over rated current, 0 … 1."""
    plays: float
    """Number of plays whose mean it is, 1 … MAX_FMU_PLAYS."""
    null_bias: float
    """A."""
    offset_current: float
    """Constant offsets of the converters, LSB."""
    offset_spool: float
    offset_pressure: float
    offset_position: float
    gain_current: float
    """Relative gain errors of the converters."""
    gain_spool: float
    gain_pressure: float
    gain_position: float
    closed: float
    """Not 0: commands are positions, m; 0: currents, A."""


class FmuInputs(NamedTuple):
    """What the unit is given in each tick."""

    command: float
    """A or m."""
    load_force: float
    """Force of another model on the jack, N, against positive positions as the constant load."""


class FmuOutputs(NamedTuple):
    """What the unit shows at the end of each tick: digitised, then as it is."""

    current: float
    """A, as digitised."""
    spool: float
    """m, as digitised."""
    pressure: float
    """Pa, as digitised."""
    position: float
    """m, as digitised."""
    true_current: float
    """A."""
    true_spool: float
    """m."""
    true_pressure: float
    """Pa."""
    true_position: float
    """m."""
    true_velocity: float
    """Of the jack, m/s."""


class FmuPlaces(NamedTuple):
    """Places of the values of a unit: condition, settings, inputs, outputs."""

    condition: int
    settings: int
    inputs: int
    outputs: int
    end: int


class PlantPlaces(NamedTuple):
    """Places of the memory of a unit."""

    state: int
    plays: int
    integral: int
    """Of the controller, m s."""
    error: int
    """Of the controller in the tick before, m."""
    end: int


class PlanPlaces(NamedTuple):
    """Places of a plan: data, control law, steps of the converters, their codes of zero."""

    data: int
    law: int
    lsb: int
    half: int
    end: int


FMU_VALUES = FmuPlaces(*places(UnitCondition, FmuSettings, FmuInputs, FmuOutputs))
PLANT_MEMORY = PlantPlaces(*places(STATE.end, MAX_FMU_PLAYS, 1, 1))
PLANT_PLAN = PlanPlaces(*places(UnitData, PositionLaw, len(CHANNELS), len(CHANNELS)))

_condition_of, _settings_of = unpacker(UnitCondition), unpacker(FmuSettings, FMU_VALUES.settings)
_data_of, _law_of = unpacker(UnitData), unpacker(PositionLaw, PLANT_PLAN.law)
_keep_outputs = packer(FmuOutputs, FMU_VALUES.outputs)
LOAD_PLACE = UnitCondition._fields.index("load")
FMU_COMMAND_RESOLUTION = (DEFAULT_SCALES.current_step, DEFAULT_SCALES.position_step)
"""Of commands on the bus, A and m."""


_compiled_viscosity = bare_kernel(laws.relative_viscosity)
_play, _position_law = bare_kernel(play_operator), bare_kernel(position_law)


def _scaled_by_compiled_viscosity() -> Any:
    """`scaled` for kernels: what it calls must be compiled too."""
    scope = {**vars(laws), "relative_viscosity": _compiled_viscosity}
    function = FunctionType(laws.scale_unit_data.__code__, scope, "scaled")
    return bare_kernel(function)


_scaled = _scaled_by_compiled_viscosity()


def plant_plan(actuator: Actuator) -> list[float]:
    """What the kernels need of an actuator's data, `PLANT_PLAN.end` numbers."""
    law = actuator.controller
    gains = PositionLaw(law.IM, law.GAP, law.GAI, law.GAD, 1.0 / law.rate)
    channels = actuator_channels(actuator)
    steps = (*(item.lsb for item in channels), *(item.half for item in channels))
    return [float(value) for value in (*unit_data(actuator), *gains, *steps)]


@bare_kernel
def _digitised(value: float, gain: float, offset: float, lsb: float, half: float) -> float:
    code = math.floor((value * (1.0 + gain) + offset * lsb) / lsb + 0.5) + half
    return float((min(max(code, 0.0), 2.0 * half - 1.0) - half) * lsb)


@bare_kernel
def _show(values: Any, current: float, state: Any, plan: Any) -> None:
    s = _settings_of(values)
    lsb, half = (plan[PLANT_PLAN.lsb : PLANT_PLAN.half], plan[PLANT_PLAN.half : PLANT_PLAN.end])
    _keep_outputs(
        values,
        FmuOutputs(
            _digitised(current, s.gain_current, s.offset_current, lsb[0], half[0]),
            _digitised(state[STATE.spool_filtered], s.gain_spool, s.offset_spool, lsb[1], half[1]),
            _digitised(
                state[STATE.pressure_filtered], s.gain_pressure, s.offset_pressure, lsb[2], half[2]
            ),
            _digitised(state[STATE.jack], s.gain_position, s.offset_position, lsb[3], half[3]),
            current,
            state[STATE.spool],
            state[STATE.pressure],
            state[STATE.jack],
            state[STATE.jack_velocity],
        ),
    )


_RANGES = {
    **{f"E_{item.name}": item.metadata["range"] for item in fields(DataErrors)},
    **{
        item.name: item.metadata["range"]
        for kind in (Sensors, Effects, Faults)
        for item in fields(kind)
        if "range" in item.metadata
    },
}
_RANGED = (*UnitCondition._fields, "hysteresis", "plays", "null_bias")
FIXED_VALUES: Final = frozenset(
    {*(f"E_{item.name}" for item in fields(DataErrors)), "plays", "filter_time"}
)
"""Parameters that cannot be set in a run: errors of the data, sizes of the memory."""
RANGED_VALUES: Final = len(_RANGED)
"""Number of values, the first ones, that have the range of a condition of the simulator, 1."""
LOWEST_VALUES, HIGHEST_VALUES = zip(*(map(float, _RANGES[key]) for key in _RANGED), strict=True)


@bare_kernel
def _are_sound(values: Any) -> bool:
    """Whether condition, settings and inputs are finite and in their ranges."""
    for i in range(FMU_VALUES.outputs):
        if not math.isfinite(values[i]):
            return False
    for i in range(RANGED_VALUES):
        if not LOWEST_VALUES[i] <= values[i] <= HIGHEST_VALUES[i]:
            return False
    c = _condition_of(values)
    if c.supply_pressure <= c.return_pressure:
        return False
    return bool(_settings_of(values).plays <= MAX_FMU_PLAYS)


@bare_kernel
def start_plant(address: int, plan_address: int, values_address: int) -> int:
    """Put the unit at rest in the middle, with coefficients of its values; 1: a value is out of
    range.
    """
    memory, values = (
        array_at(address, (PLANT_MEMORY.end,)),
        array_at(values_address, (FMU_VALUES.end,)),
    )
    if not _are_sound(values):
        return 1
    for i in range(PLANT_MEMORY.end):
        memory[i] = 0.0
    plan = array_at(plan_address, (PLANT_PLAN.end,))
    memory[PLANT_MEMORY.error] = math.nan
    _show(
        values, 0.0, array_at(address + BYTES_PER_NUMBER * PLANT_MEMORY.state, (STATE.end,)), plan
    )
    return 0


@bare_kernel
def tick_plant(address: int, plan_address: int, values_address: int) -> int:
    """Advance the unit by one control tick under its values, and write the outputs.

    Returns 0, or 1 where a value is no number or out of range.
    """
    memory, values = (
        array_at(address, (PLANT_MEMORY.end,)),
        array_at(values_address, (FMU_VALUES.end,)),
    )
    plan = array_at(plan_address, (PLANT_PLAN.end,))
    law = _law_of(plan)
    state = array_at(address + BYTES_PER_NUMBER * PLANT_MEMORY.state, (STATE.end,))
    if not _are_sound(values):
        return 1
    s, command = _settings_of(values), values[FMU_VALUES.inputs]
    constant_load = values[LOAD_PLACE]
    values[LOAD_PLACE] = constant_load + values[FMU_VALUES.inputs + 1]
    p = _scaled(_data_of(plan), _condition_of(values))
    values[LOAD_PLACE] = constant_load
    resolution = FMU_COMMAND_RESOLUTION[0] if s.closed == 0.0 else FMU_COMMAND_RESOLUTION[1]
    command = np.rint(command / resolution) * resolution
    if s.closed == 0.0:
        current = max(-law.IM, min(law.IM, command))
        memory[PLANT_MEMORY.integral], memory[PLANT_MEMORY.error] = 0.0, math.nan
    else:
        error = command - values[FMU_VALUES.outputs + 3]
        current, memory[PLANT_MEMORY.integral] = _position_law(
            law, memory[PLANT_MEMORY.integral], memory[PLANT_MEMORY.error], error
        )
        memory[PLANT_MEMORY.error] = error
    count = int(s.plays)
    total = 0.0
    for i in range(count):
        width = s.hysteresis * law.IM * (i + 0.5) / count
        memory[PLANT_MEMORY.plays + i] = _play(
            memory[PLANT_MEMORY.plays + i], current + s.null_bias, width
        )
        total += memory[PLANT_MEMORY.plays + i]
    substeps = math.ceil(law.tick / DEFAULT_STEP_S - 1e-6)
    advance_plant(state, p, p.GM * total / count, law.tick / substeps, substeps)
    _show(values, current, state, plan)
    return 0
