"""Run a built-in test on a bus from Python, with what happens as it happens, and diagnose it.

The flight-control computer is the emulated one, in simulated time. On a rig take an open bus of
python-can, such as `can.Bus(interface="socketcan", channel="can0")`: the surface moves.

python examples/test_on_bus.py
"""

import ehadiag
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import EmulatorTransport, emulated_computer
from firmware_iface.handshake import ChannelLimits

computer = emulated_computer(
    ehadiag.default_actuator(),
    ehadiag.bundled_tests().values(),
    faults=Faults(Kintas=0.2, FSS=0.4, FDJ=0.1),
    serial=12,
)
stages: list[str] = []


def progress(stage: str, _share: float) -> None:
    """Note each stage once; a page or a log would show its share too."""
    if stage not in stages:
        stages.append(stage)


with EmulatorTransport(computer) as bus:
    # Listens only, and sends nothing: is everything there that a diagnosis needs?
    print(ehadiag.check_bus(bus, duration_s=0.5).report.problems or "no problem")
    # Sends only because of transmit=True; beyond 45 mm it requests the abort.
    result = ehadiag.run_test(
        bus,
        "open",
        transmit=True,
        record="bus.blf",
        limits=ChannelLimits(position=0.045),
        progress=progress,
    )
print(f"{stages[0]}, then the identification: {stages[-1]}")
print(f"serial {result.recordings[0].serial}: {result.verdict}, {'; '.join(result.reasons)}")
for name, fault in result.faults.items():
    print(f"  {name} {fault.value:.3f}")
