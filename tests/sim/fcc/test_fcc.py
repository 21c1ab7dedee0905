"""A simulated recording without a bus is what comes out of the emulated computer's frames."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag import CommandMode, bundled_tests, default_actuator
from ehadiag_sim.conditions import Effects, Sensors
from ehadiag_sim.emulator import FccCore
from ehadiag_sim.plant_laws import PositionController
from ehadiag_sim.simulation import simulate
from ehadiag_tools.rigs.rerecord import ForeignBus
from firmware_iface.codec import Encoder, decode
from firmware_iface.recording import BitState
from firmware_iface.tester import Assembler
from firmware_iface.transport.frames import FrameTable

LIMIT = default_actuator().controller.IM
metres = st.floats(-0.06, 0.06)


def law(**changes):
    return PositionController(msgspec.structs.replace(default_actuator().controller, **changes))


@given(st.lists(st.tuples(metres, metres), min_size=1, max_size=30))
def test_current_never_exceeds_the_rated_one(ticks):
    controller = law(GAI=30.0, GAD=0.05)
    for command, measured in ticks:
        assert abs(controller.current(command, CommandMode.POSITION, measured)) <= LIMIT


@given(metres, metres)
def test_default_is_proportional(command, measured):
    expected = max(-LIMIT, min(LIMIT, 1.7 * (command - measured)))
    assert law().current(command, CommandMode.POSITION, measured) == pytest.approx(expected)


@given(st.floats(-0.1, 0.1))
def test_current_mode_passes_the_command_saturated(command):
    current = law().current(command, CommandMode.CURRENT, 0.02)
    assert current == max(-LIMIT, min(LIMIT, command))


def test_integral_and_derivative_follow_their_definitions():
    controller = law(GAP=0.0, GAI=2.0, GAD=0.1)
    first = controller.current(1e-3, CommandMode.POSITION, 0.0)
    second = controller.current(1.01e-3, CommandMode.POSITION, 0.0)
    assert first == pytest.approx(2.0 * 1e-6)
    assert second == pytest.approx(2.0 * (1e-6 + 1.01e-6) + 0.1 * 0.01e-3 / 1e-3)


def test_integral_does_not_wind_up():
    winding = law(GAI=20.0)
    for _ in range(1000):
        assert winding.current(0.05, CommandMode.POSITION, 0.0) == LIMIT
    # One second at full error would hold 0.05 m s of it and keep the output at its end.
    assert winding.current(0.0, CommandMode.POSITION, 0.001) < 0.0


def test_current_mode_clears_the_memory():
    controller = law(GAI=20.0, GAD=0.01)
    for _ in range(10):
        controller.current(1e-3, CommandMode.POSITION, 0.0)
    controller.current(0.0, CommandMode.CURRENT, 0.0)
    fresh = law(GAI=20.0, GAD=0.01)
    assert controller.current(1e-3, CommandMode.POSITION, 0.0) == fresh.current(
        1e-3, CommandMode.POSITION, 0.0
    )


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


ALL_IN_ONE = ForeignBus(
    "one",
    """VERSION "1.0"
BU_: FCC RIG
BO_ 1040 All: 48 FCC
 SG_ command_position : 0|32@1- (1e-9,0) [0|0] "m" RIG
 SG_ command_mode : 32|8@1+ (1,0) [0|0] "" RIG
 SG_ status_state : 40|8@1+ (1,0) [0|0] "" RIG
 SG_ status_test_id : 48|8@1+ (1,0) [0|0] "" RIG
 SG_ channels_current : 64|32@1- (1e-6,0) [0|0] "mA" RIG
 SG_ channels_spool : 96|32@1- (1e-6,0) [0|0] "mm" RIG
 SG_ channels_pressure : 128|32@1- (1e-6,0) [0|0] "MPa" RIG
 SG_ channels_position : 160|32@1- (1e-6,0) [0|0] "mm" RIG
 SG_ environment_supply_pressure : 192|16@1+ (0.01,0) [0|0] "bar" RIG
 SG_ environment_return_pressure : 208|16@1+ (0.01,0) [0|0] "bar" RIG
 SG_ environment_oil_temperature : 224|16@1+ (0.1,0) [0|0] "K" RIG
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN_FD";
""",
)


def test_a_message_of_all_groups_is_sent_once_a_tick_with_all_of_them():
    bus_map = ALL_IN_ONE.bus_map()
    core = FccCore(default_actuator(), TESTS.values(), bus_map=bus_map, seed=3)
    core.start(TESTS["closed"].id)
    sent = [core.step() for _ in range(900)]
    assert {len(frames) for frames in sent} == {1}
    table = decode(FrameTable.from_frames(frame for (frame,) in sent), bus_map).messages["All"]
    assert set(table.values["environment.supply_pressure"].round(-3)) == {20.7e6}
    running = table.values["status.state"] == BitState.RUNNING
    assert not running[:100].any()
    assert running[100:].all()
    position, command = (table.values[f"{name}.position"] for name in ("channels", "command"))
    assert np.ptp(command[running]) > 1e-3
    np.testing.assert_allclose(position[running], command[running], atol=5e-3)
    assert np.ptp(position[running]) > 0.5 * np.ptp(command[running])
