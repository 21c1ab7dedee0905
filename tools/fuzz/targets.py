"""What is fuzzed: each target takes any bytes and must neither raise nor disagree with itself.

The errors that a user may see (`EhadiagError`) are answers, not findings. No target needs the
fuzzer: the tests play the kept inputs through these functions too.
"""

from __future__ import annotations

import contextlib
import functools
import struct
import tempfile
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path

from ehadiag.errors import EhadiagError
from ehadiag.tomlfile import decode_toml
from firmware_iface import busmap
from firmware_iface.align import assemble
from firmware_iface.blf import CONTAINER_HEADER, FILE_HEADER, OBJECT_HEADER
from firmware_iface.busmap import default_map
from firmware_iface.frames import MAX_PAYLOAD, Frame, FrameTable
from firmware_iface.livedecode import LiveDecoder
from firmware_iface.logs import read_recordings
from firmware_iface.mapping import MappingFile
from firmware_iface.protection import crc8
from firmware_iface.seriallink import LONGEST_CODED, Framer, packet_of

__all__ = ["TARGETS", "target"]

RECORD = struct.Struct("<BBhB8s")
"""One frame of the target `frames`: flags, choice of identifier, time step, length, payload."""
SEALED, EXTENDED, ERROR, REMOTE, SLOW = 1, 2, 4, 8, 16
IDENTIFIERS = (0x110, 0x111, 0x120, 0x200, 0x201, 0x110, 0x111, 0x7FF)
KINDS = (".blf", ".asc", ".csv", ".trc", "container")
"""Logs by the first byte of an input; `container` is the inside of a sound BLF file."""
MICROSECOND = 1000
MILLISECOND = 1_000_000


def target(name: str) -> Callable[[bytes], None]:
    """Return the function that takes one input."""
    make: Callable[[], Callable[[bytes], None]] = TARGETS[name]
    return make()


def _frames() -> Callable[[bytes], None]:
    bus = default_map()

    def check(data: bytes) -> None:
        frames = _frames_of(data)
        decoder = LiveDecoder(bus)
        for frame in frames:
            decoder.decode(frame)
        if frames:
            with contextlib.suppress(EhadiagError):
                assemble(FrameTable.from_frames(frames), bus, "fuzz")

    return check


def _frames_of(data: bytes) -> list[Frame]:
    """Frames of the default bus, damaged as the input has it."""
    frames = []
    now = 0
    for at in range(0, len(data) - RECORD.size + 1, RECORD.size):
        flags, choice, step, length, payload = RECORD.unpack_from(data, at)
        now += step * (MILLISECOND if flags & SLOW else MICROSECOND)
        can_id = IDENTIFIERS[choice % len(IDENTIFIERS)]
        if flags & SEALED:
            payload = payload[:7] + bytes((crc8(can_id.to_bytes(2, "little") + payload[:7]),))
        elif length != len(payload):
            payload = (payload * 8)[: length % (MAX_PAYLOAD + 1)]
        frames.append(
            Frame(
                now,
                can_id,
                payload,
                extended=bool(flags & EXTENDED),
                fd=len(payload) > 8,
                error=bool(flags & ERROR),
                remote=bool(flags & REMOTE),
            )
        )
    return frames


def _serial() -> Callable[[bytes], None]:
    def check(data: bytes) -> None:
        whole = Framer()
        frames = whole.feed(data)
        pieces = Framer()
        cut = 1 + (data[0] if data else 0) % 40
        found = []
        for at in range(0, len(data), cut):
            found += pieces.feed(data[at : at + cut])
            if len(pieces._partial) > LONGEST_CODED:
                raise AssertionError("the framer keeps more than a packet")
        if (found, pieces.bad, pieces.bytes_seen) != (frames, whole.bad, whole.bytes_seen):
            raise AssertionError("the framer depends on how the bytes come")
        for frame in frames:
            again = Framer().feed(packet_of(frame))
            if len(again) != 1 or (again[0].can_id, again[0].data) != (frame.can_id, frame.data):
                raise AssertionError("a frame does not survive its own packet")

    return check


def _logs() -> Callable[[bytes], None]:
    bus = default_map()
    # In memory where the system has such a folder: a file is written for every input.
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None

    def check(data: bytes) -> None:
        if not data:
            return
        kind, content = KINDS[data[0] % len(KINDS)], data[1:]
        if kind == "container":
            kind, content = ".blf", _blf_around(content)
        with (
            tempfile.TemporaryDirectory(dir=memory) as folder,
            contextlib.suppress(EhadiagError),
        ):
            path = Path(folder) / f"log{kind}"
            path.write_bytes(content)
            read_recordings(path, bus)

    return check


def _blf_around(content: bytes) -> bytes:
    """A BLF file with one container that is not compressed: a fuzzer does not get through zlib."""
    date = (2026, 1, 4, 1, 0, 0, 0, 0)
    header = FILE_HEADER.pack(
        b"LOGG", FILE_HEADER.size, *(0,) * 8, 0, len(content), 1, 0, *date, *date
    )
    size = OBJECT_HEADER.size + CONTAINER_HEADER.size + len(content)
    start = OBJECT_HEADER.pack(b"LOBJ", OBJECT_HEADER.size, 1, size, 10)
    return header + start + CONTAINER_HEADER.pack(0, len(content)) + content


def _mappings() -> Callable[[bytes], None]:
    """First byte even: a mapping against the default DBC; odd: a DBC for the default mapping."""
    data_files = resources.files("firmware_iface").joinpath("data")
    dbc = data_files.joinpath("eha_fcc.dbc").read_bytes()
    mapping = decode_toml(data_files.joinpath("eha_fcc.toml").read_bytes(), MappingFile, "default")
    parse = busmap._parse_dbc

    @functools.lru_cache(maxsize=1)
    def parsed_default() -> Mapping[str, object]:
        return parse(dbc, "default")

    def parse_once(text: bytes, name: str) -> object:
        return parsed_default() if text is dbc else parse(text, name)

    # Ten milliseconds for the same answer every time would be nearly all of the time.
    busmap._parse_dbc = parse_once  # type: ignore[assignment]

    def check(data: bytes) -> None:
        if not data:
            return
        with contextlib.suppress(EhadiagError):
            if data[0] % 2:
                busmap.resolve(mapping, data[1:], "fuzz", "fuzz")
            else:
                busmap.resolve(decode_toml(data[1:], MappingFile, "fuzz"), dbc, "fuzz", "fuzz")

    return check


TARGETS: Mapping[str, Callable[[], Callable[[bytes], None]]] = {
    "frames": _frames,
    "serial": _serial,
    "logs": _logs,
    "mappings": _mappings,
}
