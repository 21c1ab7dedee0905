"""The simulated unit on flat arrays against the simulator itself."""

import math

import numpy as np
import pytest

from ehadiag import CommandMode, default_actuator
from ehadiag_sim.conditions import DataErrors, Effects, Faults, Sensors
from ehadiag_sim.fmu_plant import (
    FMU_VALUES,
    PLANT_MEMORY,
    FmuSettings,
    plant_plan,
    start_plant,
    tick_plant,
)
from ehadiag_sim.plant_laws import unit_condition
from ehadiag_sim.simulation import Plant
from firmware_iface.recording import CHANNELS

PLAN = np.array(plant_plan(default_actuator()))
FAULTS = Faults(0.3, 0.2, 0.1)
EFFECTS = Effects(
    hysteresis=0.02, plays=4, null_bias=1e-4, gain_change=0.03, backlash=1e-6,
    oil_temperature=20.0, supply_pressure=19e6, return_pressure=0.5e6, spool_stribeck=0.01,
    jack_stribeck=0.02, load=500.0, load_spring=1e4,
    data=DataErrors(GM=0.01, KSF=0.02, KF=-0.02, GP=0.05, GQ=-0.03, CS=0.1, CJ=0.2, MJ=0.1,
                    FSS0=0.05, FDJ0=-0.05),
)  # fmt: skip
SENSORS = Sensors(
    noise_lsb=0.0, filter_time=2e-4, offsets_lsb=(1.0, -2.0, 3.0, -4.0), gains=(0, 0.01, 0, -0.01)
)


def values_of(faults, effects, sensors, closed):
    values = np.zeros(FMU_VALUES.end)
    first = unit_condition(faults, effects, sensors.filter_time, effects.oil_temperature)
    rest = FmuSettings(
        effects.hysteresis,
        effects.plays,
        effects.null_bias,
        *sensors.offsets_lsb,
        *sensors.gains,
        closed,
    )
    values[: FMU_VALUES.inputs] = [*first, *rest]
    return values


@pytest.mark.parametrize("mode", list(CommandMode))
def test_the_same_as_the_simulator(mode):
    plant = Plant(default_actuator(), FAULTS, EFFECTS, SENSORS)
    memory = np.zeros(PLANT_MEMORY.end)
    values = values_of(FAULTS, EFFECTS, SENSORS, mode is CommandMode.POSITION)
    addresses = memory.ctypes.data, PLAN.ctypes.data, values.ctypes.data
    assert start_plant(*addresses) == 0
    for k in range(150):
        values[FMU_VALUES.inputs] = 0.005 * math.sin(0.05 * k)
        assert tick_plant(*addresses) == 0
        codes = plant.tick(values[FMU_VALUES.inputs], mode)
        shown = [float(c.decode(codes[i : i + 1])[0]) for i, c in enumerate(CHANNELS)]
        np.testing.assert_allclose(
            values[FMU_VALUES.outputs : FMU_VALUES.outputs + 4], shown, rtol=1e-12
        )
        np.testing.assert_allclose(
            values[FMU_VALUES.outputs + 4 : -1], plant.truth, rtol=1e-9, atol=1e-15
        )
    # The velocity is that at the end of the tick.
    before = plant.truth[3]
    plant.tick(values[FMU_VALUES.inputs], mode)
    assert values[-1] == pytest.approx((plant.truth[3] - before) / 1e-3, rel=0.1)


@pytest.mark.parametrize(
    ("index", "wrong"),
    [(0, 1.5), (1, -0.1), (5, 300.0), (6, 0.0), (0, math.nan), (FMU_VALUES.inputs - 11, 0)],
)
def test_a_value_out_of_its_range_is_refused(index, wrong):
    values = values_of(Faults(), Effects(), Sensors(), False)
    values[index] = wrong
    assert (
        start_plant(np.zeros(PLANT_MEMORY.end).ctypes.data, PLAN.ctypes.data, values.ctypes.data)
        == 1
    )


def test_a_command_that_is_no_number_is_refused():
    memory, values = np.zeros(PLANT_MEMORY.end), values_of(Faults(), Effects(), Sensors(), False)
    addresses = memory.ctypes.data, PLAN.ctypes.data, values.ctypes.data
    assert start_plant(*addresses) == 0
    values[FMU_VALUES.inputs] = math.nan
    assert tick_plant(*addresses) == 1
