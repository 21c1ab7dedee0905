"""A station of OpenHTF: severities as measurements with limits, recording and page attached.

python examples/frameworks/openhtf_station.py
"""

from pathlib import Path

import openhtf as htf
from openhtf.plugs import BasePlug

import ehadiag
from ehadiag_sim.emulator import EmulatorTransport, emulated_computer


class UnitPlug(BasePlug):
    """Bus of the unit; on a rig `can.Bus(interface="socketcan", channel="can0")`."""

    def __init__(self):
        tests = ehadiag.bundled_tests().values()
        self.bus = EmulatorTransport(emulated_computer(ehadiag.default_actuator(), tests))

    def tearDown(self):
        """Close the bus."""
        self.bus.close()


@htf.measures(*(htf.Measurement(name).in_range(0.0, 0.25) for name in ("Kintas", "FSS", "FDJ")))
@htf.plug(unit=UnitPlug)
def built_in_test(test, unit):
    """Run test 'open' and measure the severities, 1."""
    result = ehadiag.run_test(unit.bus, "open", transmit=True, record="openhtf.blf")
    for name, severity in result.severities.items():
        test.measurements[name] = severity.value
    test.attach_from_file("openhtf.blf")
    test.attach("result.json", result.to_json().encode())


if __name__ == "__main__":
    station = htf.Test(built_in_test, test_name="actuator")
    station.add_output_callbacks(lambda record: Path("openhtf.txt").write_text(record.outcome.name))
    raise SystemExit(not station.execute(test_start=lambda: "unit 12"))
