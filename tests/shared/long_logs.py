"""Writes recordings of many hours quickly, by repeating a stretch of a bus."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_iface.logs.blf import CONTAINER_HEADER, FILE_HEADER, OBJECT_HEADER
from firmware_iface.transport.frames import Frame

OBJECT = 48
STAMP = 24
"""Bytes of a classic frame's object, and where its time stamp lies."""
DATE = (2026, 1, 4, 1, 0, 0, 0, 0)
CAN_MESSAGE, CONTAINER, STORED, DEFLATED = 1, 10, 0, 2


def header() -> bytes:
    """File header of a BLF log."""
    return FILE_HEADER.pack(b"LOGG", FILE_HEADER.size, *(0,) * 8, 0, 0, 1, 0, *DATE, *DATE)


def objects(frames: Sequence[Frame], channel: int = 1) -> NDArray[np.uint8]:
    """Frames as objects of a BLF log, shape (n, 48), stamps in ns from the first frame's second."""
    begin = frames[0].time_ns
    out = bytearray()
    for frame in frames:
        out += OBJECT_HEADER.pack(b"LOBJ", 32, 1, OBJECT, CAN_MESSAGE)
        out += struct.pack("<LHHQ", 2, 0, 0, frame.time_ns - begin)
        out += struct.pack("<HBBL8s", channel, 0, len(frame.data), frame.can_id, frame.data)
    return np.frombuffer(bytes(out), dtype=np.uint8).reshape(-1, OBJECT)


def container(content: bytes, *, packed: bool = False) -> bytes:
    """One container around objects."""
    body = zlib.compress(content, 9) if packed else content
    size = OBJECT_HEADER.size + CONTAINER_HEADER.size + len(body)
    head = OBJECT_HEADER.pack(b"LOBJ", OBJECT_HEADER.size, 1, size, CONTAINER)
    return (
        head
        + CONTAINER_HEADER.pack(DEFLATED if packed else STORED, len(content))
        + body
        + bytes(size % 4)
    )


def write_repeated(path: Path, frames: Sequence[Frame], times: int, period_ns: int) -> int:
    """Write the frames so many times, each time `period_ns` later; return the number of frames."""
    rows = objects(frames).copy()
    stamps = rows[:, STAMP : STAMP + 8].copy().view("<u8").reshape(-1)
    with path.open("wb") as file:
        file.write(header())
        for turn in range(times):
            later = (stamps + np.uint64(turn * period_ns)).astype("<u8")
            rows[:, STAMP : STAMP + 8] = later.view(np.uint8).reshape(-1, 8)
            file.write(container(rows.tobytes()))
    return times * len(rows)


def write_bomb(path: Path, frames: int) -> None:
    """Write a small file that unpacks to so many frames, all the same."""
    one = objects([Frame(0, 0x321, bytes(8))])
    count = 1_000_000
    block = container(np.tile(one, (count, 1)).tobytes(), packed=True)
    with path.open("wb") as file:
        file.write(header())
        for _ in range(-(-frames // count)):
            file.write(block)
