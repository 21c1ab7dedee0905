"""A simulated unit in the place of the rig's bus, which --ehadiag-interface names otherwise."""

import pytest

import ehadiag
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import EmulatorTransport, emulated_computer


@pytest.fixture
def ehadiag_bus():
    """Bus of an emulated computer in simulated time."""
    tests = ehadiag.bundled_tests().values()
    worn = Faults(Kintas=0.1, FSS=0.4, FDJ=0.1)
    with EmulatorTransport(
        emulated_computer(ehadiag.default_actuator(), tests, faults=worn)
    ) as bus:
        yield bus
