"""Both ends of a line for live tests: a pair of pseudo-terminals, and the computer on a bus."""

from __future__ import annotations

import contextlib
import os
import select
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from ehadiag_sim.emulator import FccCore, run_emulator
from firmware_iface.handshake import TimeLimits
from firmware_iface.transport.base import Transport

LOADED_MACHINE = TimeLimits(
    wait=100.0, status=100.0, arming=100.0, telemetry=100.0, finish=100.0, abort=100.0
)
"""Time limits where the computer is a thread or process of a machine that other work shares."""


@contextmanager
def cable() -> Iterator[tuple[str, str]]:
    """Join two pty pairs in the middle; gives the names of the two ends."""
    if not hasattr(os, "openpty"):
        pytest.skip("no pseudo-terminals on this system")
    import tty

    (a, a_end), (b, b_end) = os.openpty(), os.openpty()
    for item in (a, b, a_end, b_end):
        tty.setraw(item)
    for item in (a, b):
        os.set_blocking(item, False)
    stop = threading.Event()

    def forward(target: int, data: bytes) -> None:
        # An end that nobody reads fills up: its writer must not hang for ever.
        while data and not stop.is_set():
            if select.select([], [target], [], 0.02)[1]:
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(target, data) :]

    def join() -> None:
        while not stop.is_set():
            for source in select.select([a, b], [], [], 0.02)[0]:
                forward(b if source == a else a, os.read(source, 4096))

    thread = threading.Thread(target=join)
    thread.start()
    try:
        yield os.ttyname(a_end), os.ttyname(b_end)
    finally:
        stop.set()
        thread.join()
        for item in (a, b, a_end, b_end):
            os.close(item)


@contextmanager
def computer_on(bus: Transport, core: FccCore) -> Iterator[None]:
    """Run the emulated computer in a thread while the block runs."""
    stop = threading.Event()
    core.step()  # compiles
    node = threading.Thread(target=run_emulator, args=(core, bus, stop))
    node.start()
    try:
        yield
    finally:
        stop.set()
        node.join()
