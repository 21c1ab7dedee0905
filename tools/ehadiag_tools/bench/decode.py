"""Reading and bulk decoding of long recordings."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ehadiag.core.recording import Recording
from ehadiag_tools.bench.figures import Figure, Sizes
from ehadiag_tools.bench.problem import LOG
from firmware_iface.alignment.align import assemble
from firmware_iface.codec.decode import decode
from firmware_iface.logs.reader import read_frames
from firmware_iface.mapping.bus_map import default_map
from firmware_iface.transport.frames import FrameTable

__all__ = ["measure", "tiled"]

SECTION = "decode"
WRITTEN = 60_000
"""Frames in the log that is read."""


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    short = read_frames(sizes.logs / LOG)
    table, bus_map = tiled(short, sizes.frames), default_map()
    repeats = max(1, sizes.repeats // 5)
    decoding = _cpu(lambda: decode(table, bus_map), repeats)
    kept: list[tuple[Recording, ...]] = []
    assembling = _cpu(lambda: kept.append(assemble(table, bus_map, "tiled", ())), 1)
    out = [
        Figure(
            SECTION, "decode in bulk", len(table) / decoding / 1e6, "million frames/s", _of(table)
        ),
        Figure(
            SECTION,
            "decode, find tests and align",
            len(table) / assembling / 1e6,
            "million frames/s",
            f"{len(kept[0])} recordings in it",
        ),
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.blf"
        _write(tiled(short, min(WRITTEN, sizes.frames)), path)
        own = _cpu(lambda: read_frames(path), repeats)
        theirs = _cpu(lambda: _read_with_python_can(path), repeats)
        count = len(read_frames(path))
    return [
        *out,
        Figure(SECTION, "read BLF into columns", count / own / 1e6, "million frames/s"),
        Figure(SECTION, "python-can reads the same", count / theirs / 1e6, "million frames/s"),
        Figure(SECTION, "faster than python-can's reader", theirs / own, "times"),
    ]


def _of(table: FrameTable) -> str:
    return f"{len(table)} frames: {LOG}, over and over"


def _cpu(work: Callable[[], object], repeats: int) -> float:
    spent = []
    for _ in range(repeats):
        begin = time.thread_time()
        work()
        spent.append(time.thread_time() - begin)
    return statistics.median(spent)


def tiled(table: FrameTable, frames: int) -> FrameTable:
    """Repeat a table up to so many frames, each copy a second after the one before."""
    row = np.arange(frames) % len(table)
    copy = np.arange(frames) // len(table)
    span = int(table.time_ns[-1] - table.time_ns[0]) + 1_000_000_000
    return FrameTable(
        time_ns=table.time_ns[row] + copy * span,
        can_id=table.can_id[row],
        length=table.length[row],
        data=table.data[row],
        extended=table.extended[row],
        fd=table.fd[row],
        error=table.error[row],
        remote=table.remote[row],
        sent=table.sent[row],
        channel=table.channel[row],
    )


def _write(table: FrameTable, path: Path) -> None:
    import can  # noqa: PLC0415 - half a second

    with can.BLFWriter(path) as writer:
        for k in range(len(table)):
            writer.on_message_received(
                can.Message(
                    timestamp=float(table.time_ns[k]) * 1e-9,
                    arbitration_id=int(table.can_id[k]),
                    data=table.data[k, : table.length[k]].tobytes(),
                    is_extended_id=bool(table.extended[k]),
                )
            )


def _read_with_python_can(path: Path) -> int:
    import can  # noqa: PLC0415 - half a second

    with can.BLFReader(path) as reader:
        return sum(1 for _ in reader)
