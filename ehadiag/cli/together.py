"""Listens for the tests of several actuators on one bus at once, and records the bus once."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import bus_options

if TYPE_CHECKING:
    from ehadiag.cli.acquire import Heard
    from firmware_iface.transport.interface import Transport

__all__ = ["Listener", "listen_together"]

Listener = Callable[["Transport", Path], "Heard"]


def listen_together(
    arguments: argparse.Namespace,
    path: Path,
    channel: int | None,
    listeners: Sequence[Listener],
    stop: threading.Event,
) -> list[Heard]:
    """Open the bus, and let each listen in a thread of its own until all have heard their test.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line: which bus.
    path : Path
        Recording.
    channel : int | None
        Adapter channel that is written into it.
    listeners : Sequence[Listener]
        Called with the bus and the recording's path.
    stop : threading.Event
        Set where a thread fails: the others end too.

    Returns
    -------
    list[Heard]
        In their order.

    Raises
    ------
    EhadiagError
        The bus cannot be opened, or a listener failed.
    """
    from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can
    from firmware_iface.transport.shared import SharedBus  # noqa: PLC0415

    with (
        bus_options.open_transport(arguments, transmit=False) as bus,
        SharedBus(bus, len(listeners), Recorder(path, channel=channel)) as shared,
        ThreadPoolExecutor(len(listeners), thread_name_prefix="ehadiag-listen") as pool,
    ):
        pairs = zip(listeners, shared.branches, strict=True)
        futures = [pool.submit(listen, branch, path) for listen, branch in pairs]
        try:
            return [future.result() for future in futures]
        except BaseException:
            stop.set()
            raise
