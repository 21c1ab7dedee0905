"""The simulated unit in place of the rig's bus, which --ehadiag-interface names otherwise."""

import pytest

import ehadiag
from ehadiag.setup import resolve_bus_map
from ehadiag_sim.conditions import DataErrors, Effects, Faults
from ehadiag_sim.emulator import EmulatorTransport, emulated_computer

WORN = Faults(Kintas=0.1, FSS=0.4, FDJ=0.2)
EFFECTS = Effects(null_bias=5e-5, hysteresis=0.01, data=DataErrors(GM=0.02, GP=-0.03, CJ=0.1))


@pytest.fixture
def ehadiag_bus():
    """Bus of an emulated computer in simulated time, with the rig's messages."""
    computer = emulated_computer(
        ehadiag.default_actuator(),
        ehadiag.bundled_tests().values(),
        resolve_bus_map("rig.toml", None),
        faults=WORN,
        effects=EFFECTS,
        serial=7,
    )
    with EmulatorTransport(computer) as bus:
        yield bus
