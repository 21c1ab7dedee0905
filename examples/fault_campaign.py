"""Thirty faults, put into a simulated unit while it runs: which verdict does each get?

The flight-control computer is the emulated one, in simulated time. The same changes work on a bus:
as a script of `ehadiag sim --script`, or line by line on the port of `ehadiag sim --control`.

python examples/fault_campaign.py [NUMBER ...]
"""

import sys

import ehadiag
from ehadiag_sim.control import Change, SimulatorControl
from ehadiag_sim.emulator import EmulatorTransport, emulated_computer

DURING = 2.0
"""Time of a change amid the test, s."""
CAMPAIGN = {
    "nothing": [],
    "filter clogs, 0.4": [Change(set={"Kintas": 0.4})],
    "filter clogs, 0.8": [Change(set={"Kintas": 0.8})],
    "spool sticks, 0.4": [Change(set={"FSS": 0.4})],
    "spool sticks, 0.8": [Change(set={"FSS": 0.8})],
    "jack rubs, 0.4": [Change(set={"FDJ": 0.4})],
    "jack rubs, 0.8": [Change(set={"FDJ": 0.8})],
    "all three, 0.3": [Change(set={"Kintas": 0.3, "FSS": 0.3, "FDJ": 0.3})],
    "spool sticks amid the test": [Change(set={"FSS": 0.8}, at_s=DURING)],
    "jack rubs more and more": [Change(set={"FDJ": 0.8}, at_s=DURING, ramp_s=3.0)],
    "null bias 0.1 mA": [Change(set={"null_bias_mA": 0.1})],
    "hysteresis 3 %": [Change(set={"hysteresis": 0.03})],
    "backlash 3 um": [Change(set={"backlash_um": 3.0})],
    "torque motor 5 % weak": [Change(set={"gain_change": -0.05})],
    "torque motor 40 % weak": [Change(set={"gain_change": -0.4})],
    "load 500 N": [Change(set={"load_N": 500.0})],
    "supply 18 MPa": [Change(set={"supply": 18.0})],
    "supply 12 MPa": [Change(set={"supply": 12.0})],
    "supply falls amid the test": [Change(set={"supply": 10.0}, at_s=DURING)],
    "oil 80 degC": [Change(set={"oil_temperature": 80.0})],
    "oil -40 degC": [Change(set={"oil_temperature": -40.0})],
    "oil probe reads 10 K too much": [Change(set={"temperature_error_K": 10.0})],
    "spool sensor off by 5 steps": [Change(set={"offsets": (0.0, 5.0, 0.0, 0.0)})],
    "pressure sensor 1 % steep": [Change(set={"sensor_gains": (0.0, 0.0, 0.01, 0.0)})],
    "noise of 5 steps": [Change(set={"noise": 5.0})],
    "2 % of frames lost": [Change(set={"frames_lost": 0.02})],
    "2 % of frames damaged": [Change(set={"frames_damaged": 0.02})],
    "2 % of frames doubled": [Change(set={"frames_doubled": 0.02})],
    "a second sender": [Change(set={"second_sender": 0.5})],
    "bus off for 0.5 s": [Change(set={"bus_off_s": 0.5}, at_s=DURING)],
}

numbers = [int(text) for text in sys.argv[1:]] or range(1, len(CAMPAIGN) + 1)
for number in numbers:
    name = list(CAMPAIGN)[number - 1]
    computer = emulated_computer(
        ehadiag.default_actuator(),
        ehadiag.bundled_tests().values(),
        control=SimulatorControl(CAMPAIGN[name]),
    )
    with EmulatorTransport(computer) as bus:
        result = ehadiag.run_test(bus, "open", transmit=True)
    reason = result.reasons[0] if result.reasons else ""
    print(f"{number:2} {name:30} {result.verdict:11} {reason}".rstrip())
