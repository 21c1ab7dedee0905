"""The C side of the bus, called through ctypes."""

from __future__ import annotations

import ctypes
from ctypes import Structure, c_bool, c_int16, c_size_t, c_uint8, c_uint16, c_uint32
from pathlib import Path
from typing import Any

from places import ROOT

from firmware_iface.transport.frames import Frame

SOURCES = ROOT / "firmware_iface" / "c"
FRAMES_PER_TICK = 5
UDS_FRAMES_PER_TICK = 13
NODE_WORDS = 512
"""Room for `struct fcc_node` in words of 8 bytes, several times its size."""


class CFrame(Structure):
    _fields_ = (("id", c_uint16), ("data", c_uint8 * 8))

    @property
    def content(self) -> tuple[int, bytes]:
        return self.id, bytes(self.data)


class CLink(Structure):
    _fields_ = (("coded", c_uint8 * 17), ("size", c_size_t), ("dropped", c_uint32))


class CRig(Structure):
    _fields_ = (
        ("supply", c_uint16),
        ("ret", c_uint16),
        ("oil", c_uint16),
        ("interlock_open", c_bool),
    )


class CCommand(Structure):
    _fields_ = (("mode", c_uint8), ("value", c_int16), ("test_id", c_uint8))


class Telemetry(Structure):
    _fields_ = (
        *((name, c_uint16) for name in ("current", "spool", "pressure", "position")),
        ("counter", c_uint8),
        ("crc8", c_uint8),
    )


class Command(Structure):
    _fields_ = (
        ("position", c_int16),
        ("current", c_int16),
        *((name, c_uint8) for name in ("mode", "test_id", "counter", "crc8")),
    )


class Environment(Structure):
    _fields_ = (
        *((name, c_uint16) for name in ("supply", "ret", "oil")),
        ("counter", c_uint8),
        ("crc8", c_uint8),
    )


class Request(Structure):
    _fields_ = tuple((name, c_uint8) for name in ("code", "test_id", "counter", "crc8"))


class Status(Structure):
    _fields_ = (
        *((name, c_uint8) for name in ("state", "reason", "test_id")),
        *((name, c_uint16) for name in ("elapsed", "serial")),
        *((name, c_uint8) for name in ("counter", "crc8")),
    )


MESSAGES: dict[str, type[Structure]] = {
    "telemetry": Telemetry,
    "command": Command,
    "environment": Environment,
    "request": Request,
    "status": Status,
}


def load(path: Path) -> Any:
    """Load the shared library; functions that return no int, or take doubles, are declared."""
    library = ctypes.CDLL(str(path))
    library.fcc_crc8.restype = c_uint8
    library.fcc_crc16.restype = c_uint16
    library.fcc_link_feed.restype = c_bool
    library.fcc_node_begin.restype = CCommand
    library.fcc_node_end.restype = c_size_t
    library.fcc_uds_tick.restype = c_size_t
    library.fcc_test_find.restype = ctypes.c_void_p
    library.fcc_test_ticks.argtypes = [ctypes.c_void_p]
    library.fcc_test_ticks.restype = c_uint16
    library.fcc_test_command.argtypes = [ctypes.c_void_p, c_uint16]
    library.fcc_test_command.restype = c_int16
    for name in MESSAGES:
        getattr(library, f"fcc_unpack_{name}").restype = c_bool
    return library


def pack(library: Any, message: str, *values: Any, counter: int = 0) -> tuple[CFrame, int]:
    """Pack one frame; returns it and the counter that comes next."""
    frame, count = CFrame(), c_uint8(counter)
    getattr(library, f"fcc_pack_{message}")(ctypes.byref(frame), *values, ctypes.byref(count))
    return frame, count.value


def unpack(library: Any, message: str, frame: Frame) -> Any:
    """Structure of raw numbers, None if the C side takes the frame for damaged or foreign."""
    out = MESSAGES[message]()
    raw = c_frame(frame)
    ours = getattr(library, f"fcc_unpack_{message}")(ctypes.byref(raw), ctypes.byref(out))
    return out if ours else None


def c_frame(frame: Frame) -> CFrame:
    return CFrame(frame.can_id, (c_uint8 * 8)(*frame.data))


class Node:
    """`struct fcc_node`, opaque."""

    def __init__(self, library: Any, serial: int, rig: CRig) -> None:
        self._library = library
        self._state = (ctypes.c_uint64 * NODE_WORDS)()
        library.fcc_node_init(self._state, c_uint16(serial), ctypes.byref(rig))

    def take(self, frame: Frame) -> None:
        self._library.fcc_node_take(self._state, ctypes.byref(c_frame(frame)))

    def begin(self) -> CCommand:
        command: CCommand = self._library.fcc_node_begin(self._state)
        return command

    def end(self, codes: tuple[int, ...]) -> list[tuple[int, bytes]]:
        frames = (CFrame * FRAMES_PER_TICK)()
        count = self._library.fcc_node_end(self._state, (c_uint16 * 4)(*codes), frames)
        return [frames[i].content for i in range(count)]


class CFound(Structure):
    _fields_ = (
        ("state", c_uint8),
        ("verdict", c_uint8),
        ("runs", c_uint16),
        ("severity", c_uint32 * 3),
        ("deviation", c_uint32 * 3),
    )


class CUds(Structure):
    """The part of `struct fcc_uds` that the caller keeps up to date."""

    _fields_ = (
        ("found", CFound),
        ("offsets", c_int16 * 4),
        ("software", ctypes.c_char * 16),
        ("rest", c_uint8 * 1024),
    )


class UdsNode(Node):
    """A node whose requests and status go by UDS."""

    def __init__(self, library: Any, serial: int, rig: CRig) -> None:
        super().__init__(library, serial, rig)
        self.uds = CUds()
        library.fcc_uds_init(ctypes.byref(self.uds))

    def take(self, frame: Frame) -> None:
        self._library.fcc_uds_take(ctypes.byref(self.uds), ctypes.byref(c_frame(frame)))

    def answers(self) -> list[tuple[int, bytes]]:
        frames = (CFrame * UDS_FRAMES_PER_TICK)()
        count = self._library.fcc_uds_tick(ctypes.byref(self.uds), self._state, frames)
        assert count <= UDS_FRAMES_PER_TICK
        return [frames[i].content for i in range(count)]


class Link:
    """`struct fcc_link`: bytes in, frames with their times in µs out."""

    def __init__(self, library: Any) -> None:
        self._library = library
        self._link = CLink()

    @property
    def dropped(self) -> int:
        count: int = self._link.dropped
        return count

    def feed(self, chunk: bytes) -> list[tuple[int, bytes, int]]:
        found = []
        frame, time_us = CFrame(), c_uint32()
        for byte in chunk:
            if self._library.fcc_link_feed(
                ctypes.byref(self._link),
                c_uint8(byte),
                ctypes.byref(frame),
                ctypes.byref(time_us),
            ):
                found.append((*frame.content, time_us.value))
        return found


def link_packet(library: Any, frame: Frame, time_us: int) -> bytes:
    packet = (c_uint8 * 18)()
    library.fcc_link_encode(packet, ctypes.byref(c_frame(frame)), c_uint32(time_us))
    return bytes(packet)


__all__ = [
    "SOURCES",
    "CRig",
    "Link",
    "Node",
    "UdsNode",
    "c_frame",
    "link_packet",
    "load",
    "pack",
    "unpack",
]
