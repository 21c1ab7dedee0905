"""A simulated recording without a bus is what comes out of the emulated computer's frames."""

import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import BitState
from ehadiag.core.stored_test import bundled_tests
from ehadiag_sim.fcc.computer import FccCore
from ehadiag_sim.plant.conditions import Effects, Sensors
from ehadiag_sim.plant.simulator import simulate
from firmware_iface.codec.encode import Encoder
from firmware_iface.session.assembler import Assembler

TESTS = bundled_tests()


@pytest.mark.parametrize("name", ["open", "closed"])
def test_recording_is_that_of_the_bus(name):
    actuator, test = default_actuator(), TESTS[name]
    effects = Effects(hysteresis=0.02, null_bias=0.1e-3, oil_temperature=47.77)
    sensors = Sensors(
        temperature_error=0.33,
        supply_error=0.0123e6,
        filter_time=1e-4,
        early=1e-4,
        gains=(0.0, 0.005, 0.0, -0.005),
        offsets_lsb=(1.0, -2.0, 3.0, 7.5),
    )
    core = FccCore(actuator, TESTS.values(), effects=effects, sensors=sensors, seed=3)
    core.take(Encoder().request("start", test.id)[0])
    assembler = Assembler("bus")
    for _ in range(test.ticks + 200):
        for frame in core.step():
            assembler.add(frame)
    there = assembler.recording()
    seed = int(np.random.SeedSequence((3, 1)).generate_state(1)[0])
    here = simulate(actuator, test, None, effects, sensors, seed=seed).recording("here")
    assert there.outcome.state is BitState.COMPLETE
    for channel in ("current", "spool", "pressure", "position", "command"):
        np.testing.assert_allclose(
            getattr(here.samples, channel), getattr(there.samples, channel), rtol=1e-9, atol=1e-15
        )
    for probe in ("oil_temperature", "supply_pressure", "return_pressure"):
        assert getattr(here.environment, probe) == pytest.approx(
            getattr(there.environment, probe), rel=1e-9
        )
