"""Watch an actuator tick by tick, as its bus shows it, and tell when it no longer is what it was.

The flight-control computer is the emulated one, in simulated time. On a rig take
`PythonCanTransport(BusOptions("socketcan", channel="can0"), transmit=False)` for the bus, leave
out the request, and let the loop end when you like.

python examples/monitor_stream.py
"""

import ehadiag
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface.codec import Encoder
from firmware_iface.live_decode import LiveTicks
from firmware_iface.transport.base import open_source
from firmware_iface.transport.frames import Frame

actuator = ehadiag.default_actuator()
tests = ehadiag.bundled_tests()

# What the actuator was like at its last test, ...
last = ehadiag.diagnose(ehadiag.simulate("closed", Kintas=0.3, FSS=0.3, FDJ=0.3))
monitor = ehadiag.Monitor(
    actuator,
    [fault.value for fault in last.faults.values()],
    mode=ehadiag.CommandMode.POSITION,
)
# ... and what has become of it: the spool sticks more.
computer = FccCore(actuator, tests.values(), faults=Faults(Kintas=0.3, FSS=0.4, FDJ=0.3))

live = LiveTicks()
alarms: list[int] = []
ticks = 0


def watch(frame: Frame) -> None:
    """Hand each tick that a frame completes to the monitor."""
    global ticks  # noqa: PLW0603 - a script
    for tick in live.take(frame):
        ticks += 1
        if monitor.push(tick).alarmed.any():
            alarms.append(ticks)


bus = EmulatorTransport(computer)
with bus, open_source(bus, sink=watch) as source:
    bus.send(Encoder().request("start", tests["closed"].id)[0])
    while bus.now_ns() < 2e9:
        source.receive(0.1)
print(f"{ticks} ticks, {live.lost} lost, first alarm after {alarms[0]} ms")
