"""Keywords of Robot Framework for built-in tests of a unit; see unit.robot."""

import ehadiag
from ehadiag_sim.emulator import EmulatorTransport, emulated_computer


class UnitLibrary:
    """Bus of an emulated computer; on a rig `can.Bus(interface="socketcan", channel="can0")`."""

    ROBOT_LIBRARY_SCOPE = "TEST"

    def run_built_in_test(self, name):
        """Run a stored test; its result."""
        tests = ehadiag.bundled_tests().values()
        with EmulatorTransport(emulated_computer(ehadiag.default_actuator(), tests)) as bus:
            return ehadiag.run_test(bus, name, transmit=True)

    def severity_should_be_below(self, result, name, limit):
        """Fail where the 95 % interval of a severity reaches the limit."""
        highest = result.severities[name].interval[1]
        if not highest < float(limit):
            raise AssertionError(f"{name} at most {highest:.3f}, limit {limit}")
