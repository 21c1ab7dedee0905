"""The monitor in a receive thread gets every tick, in order."""

import json
import subprocess

import numpy as np
import pytest
from places import ROOT

from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import CommandMode
from ehadiag.core.stored_test import resolve_test
from ehadiag.monitor import Monitor
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.simulator import Plant
from firmware_iface.alignment.live_ticks import LiveTicks
from firmware_iface.codec.encode import Encoder
from firmware_iface.transport.python_can import BusOptions, PythonCanTransport
from firmware_iface.transport.receiver import Receiver

FAULTS = (0.3, 0.3, 0.3)
TICKS = 1500


def test_residuals_on_a_virtual_bus_are_noise():
    """One tick is left out on the bus: the monitor is told, and goes on."""
    live = LiveTicks()
    monitor = Monitor(default_actuator(), FAULTS, mode=CommandMode.POSITION)
    residuals, alarms = [], 0

    def watch(frame):
        nonlocal alarms
        for tick in live.take(frame):
            reading = monitor.push(tick)
            residuals.append(reading.residual.copy())
            alarms += int(reading.alarmed.sum())

    plant, encoder = Plant(default_actuator(), Faults(*FAULTS), seed=3), Encoder()
    options = BusOptions("virtual", channel="monitor-live")
    with (
        PythonCanTransport(options) as bus,
        PythonCanTransport(options, transmit=True) as other,
        Receiver(bus, sink=watch) as source,
    ):
        for k, command in enumerate(resolve_test("closed").command()[:TICKS].tolist()):
            frames = encoder.command(CommandMode.POSITION, command, 0, 0)
            frames += encoder.telemetry(plant.tick(command, CommandMode.POSITION).tolist(), 0)
            for frame in frames if k != 700 else ():
                other.send(frame)
        received = 0
        while received < 2 * (TICKS - 1) and source.receive(5.0) is not None:
            received += 1
    assert (len(residuals), live.lost, live.breaks) == (TICKS, 1, 0)
    assert np.isnan(residuals[700]).all()
    assert alarms == 0
    np.testing.assert_allclose(np.sqrt(np.nanmean(np.square(residuals), axis=0)), 1.0, atol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("beside", ["thread", "process", "none"])
def test_the_soak_accounts_for_every_frame(beside):
    loopnet = str(ROOT / "tools" / "loopnet.sh")
    if subprocess.run([loopnet, "true"], capture_output=True, check=False).returncode == 125:
        pytest.skip("no network namespace can be made here")
    command = [loopnet, str(ROOT / "tools" / "soak"), "-i", "udp_multicast", "--json"]
    done = subprocess.run(
        [*command, "--monitor", beside, "--minutes", "0.05"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=ROOT,
    )
    told = json.loads(done.stdout)
    assert done.returncode == (1 if told["lost"] else 0)
    assert told["sent"] == told["received"] + told["lost"] > 2000
    assert told["pushes"] == told["received"] // 2 + told["ticks_lost"]
    assert told["alarms"] == 0
    assert (told["diagnoses"] == 0) == (beside == "none")
    assert all(0.0 < row[0] <= row[1] <= row[2] <= row[3] for row in (told["wall"], told["take"]))
