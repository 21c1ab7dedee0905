"""The frames of one whole stored test, for transport tests to carry."""

from __future__ import annotations

import functools
import threading
import time

from ehadiag.assess.diagnosis import Diagnosis, diagnose
from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import bundled_tests
from ehadiag_sim.fcc.computer import FccCore
from ehadiag_sim.fcc.emulator import EmulatorTransport
from ehadiag_sim.plant.conditions import Faults
from firmware_iface.alignment.align import assemble
from firmware_iface.logs.replay import play
from firmware_iface.mapping.bus_map import default_map
from firmware_iface.session.tester import run_test
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.interface import Transport

START_NS = 1_700_000_000_000_000_000
IDLE_S = 3.0
"""Without a frame for so long the log has come to its end, or was lost."""


@functools.cache
def frames() -> tuple[Frame, ...]:
    """Frames of the stored test `open`, of an actuator with all three faults."""
    got: list[Frame] = []
    core = FccCore(
        default_actuator(),
        bundled_tests().values(),
        faults=Faults(0.2, 0.4, 0.3),
        serial=123,
        start_ns=START_NS,
    )
    with EmulatorTransport(core) as bus:
        outcome = run_test(bus, test_id=1, duration=5.5, transmit=True, on_frame=got.append)
    assert outcome.complete
    return tuple(got)


def recording(carried: tuple[Frame, ...] | list[Frame]) -> Recording:
    """Decode frames as they came."""
    return assemble(FrameTable.from_frames(carried), default_map(), "carried")[-1]


def diagnosis(carried: Recording) -> Diagnosis:
    """Diagnose a recording."""
    return diagnose([carried], default_actuator(), bundled_tests().values())


@functools.cache
def expected() -> Diagnosis:
    """Diagnosis of the frames that nothing carried."""
    return diagnosis(recording(frames()))


def figures(item: Diagnosis) -> list[object]:
    """All that a diagnosis says, to the last digit."""
    assert item.identification is not None
    estimates = [
        (e.name, e.first, e.search, e.value, e.std, e.interval95)
        for e in item.identification.estimates
    ]
    return [item.verdict, item.reasons, *estimates]


def received(transport: Transport) -> list[Frame]:
    """Read a transport until nothing more comes."""
    got: list[Frame] = []
    last = time.monotonic()
    while len(got) < len(frames()) and time.monotonic() - last < IDLE_S:
        item = transport.receive(0.1)
        if item is not None:
            got.append(item)
            last = time.monotonic()
    return got


def carry(sender: Transport, receiver: Transport, speed: float) -> list[Frame]:
    """Play the stored test from one end of a bus to the other."""
    table = FrameTable.from_frames(frames())
    playing = threading.Thread(target=play, args=(table, sender), kwargs={"speed": speed})
    playing.start()
    try:
        return received(receiver)
    finally:
        playing.join()
