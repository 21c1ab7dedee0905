"""The frames of one whole stored test, for transport tests to carry."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence

from ehadiag import Diagnosis, Recording, bundled_tests, default_actuator
from ehadiag.assess.diagnosis import diagnose
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.tester import run_test
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame, FrameTable

START_NS = 1_700_000_000_000_000_000
IDLE_S = 20.0
"""s without a frame after which one is taken for lost."""
BLOCK = 50
"""Frames on their way at once; a pseudo-terminal has room for more than a hundred."""


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


def received(transport: Transport, count: int) -> list[Frame]:
    """Read so many frames; fewer only where none comes for `IDLE_S`."""
    got: list[Frame] = []
    last = time.monotonic()
    while len(got) < count and time.monotonic() - last < IDLE_S:
        item = transport.receive(0.1)
        if item is not None:
            got.append(item)
            last = time.monotonic()
    return got


def carry(sent: Sequence[Frame], sender: Transport, receiver: Transport) -> list[Frame]:
    """Send frames from one end of a bus to the other, at the pace of the reader.

    No frame is lost for want of room, and no stall is longer than the counters can tell, whatever
    else the machine does.
    """
    got: list[Frame] = []
    for start in range(0, len(sent), BLOCK):
        block = sent[start : start + BLOCK]
        for frame in block:
            sender.send(frame)
        got += received(receiver, len(block))
    return got
