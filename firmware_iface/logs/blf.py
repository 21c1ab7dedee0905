"""Reads BLF recordings in blocks, without a Python object for each frame.

python-can's reader is the oracle in the tests; it makes a message of every frame, which takes
about fifty times as long. Layouts after its source and Vector's published headers.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from enum import IntEnum
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputOutputError, reason_of
from firmware_iface.logs.log_files import DamagedLogError, Spending
from firmware_iface.recording import MAX_CAN_ID, IntArray
from firmware_iface.transport.frames import ColumnBuilder, FrameTable

Bytes = NDArray[np.uint8]

FILE_HEADER = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
OBJECT_HEADER = struct.Struct("<4sHHLL")
CONTAINER_HEADER = struct.Struct("<H6xL4x")
FD_MESSAGE = struct.Struct("<HBBLLBBB5x")
FD_MESSAGE_64 = struct.Struct("<BBBBLLLLLLLHBBL")
OBJECT_SIGNATURE = int.from_bytes(b"LOBJ", "little")
START_TIME_FIELD = 14
"""Where the start time begins among the fields of the file header."""


class _Kind(IntEnum):
    """Kinds of objects."""

    CLASSIC, CLASSIC_2, CONTAINER = 1, 86, 10
    ERROR_EXT, FD, FD_64 = 73, 100, 101


class _Packing(IntEnum):
    """How a container is packed."""

    STORED, DEFLATED = 0, 2


CONTAINER_PIECE_BYTES = 256 << 10
"""Bytes that are read from a container and handed to the unpacker at once."""
PARSE_BATCH_BYTES = 2 << 20
"""Unpacked bytes that are parsed at once: whatever a container unpacks to, no more is held."""
MAX_STAMP_NS = 1 << 62
"""Nanoseconds from 1970 to the start, at most, and from there to a frame: 146 years."""
MIN_RUN_OBJECTS = 16
"""Objects of one size in a row from which on they are found in one step."""


class BlfReader:
    """Vector's binary log, see `LogReader`."""

    signature = b"LOGG"

    def frames(self, path: Path, spending: Spending) -> Iterator[FrameTable]:
        """Read a file.

        path: the file; spending: what reading may still cost. Yields frames in order of arrival.
        DamagedLogError: it breaks off or is damaged; InputOutputError: not a BLF file, it cannot be
        read, or it costs more than its budget.
        """
        content = _BlfContent(spending)
        try:
            with path.open("rb") as file:
                parser = _BlfParser(_file_header(file, path))
                for block in content.batches(file):
                    table = parser.feed(block)
                    if len(table):
                        yield table
                    if parser.trouble:
                        break
        except OSError as error:
            raise InputOutputError(f"log {path}: {reason_of(error)}") from None
        if trouble := content.trouble or parser.trouble:
            raise DamagedLogError(trouble)


class _BlfContent:
    """Unpacks the containers of a file; `trouble` says what ended that early."""

    def __init__(self, spending: Spending) -> None:
        self._spending = spending
        self.trouble = ""

    def batches(self, file: BinaryIO) -> Iterator[bytes]:
        """Unpacked content in pieces of about `PARSE_BATCH_BYTES`."""
        pending: list[bytes] = []
        held = 0
        for piece in self._unpacked(file):
            self._spending.add_bytes(len(piece))
            pending.append(piece)
            held += len(piece)
            if held >= PARSE_BATCH_BYTES:
                yield b"".join(pending)
                pending, held = [], 0
        yield b"".join(pending)

    def _unpacked(self, file: BinaryIO) -> Iterator[bytes]:
        while header := file.read(OBJECT_HEADER.size):
            if len(header) < OBJECT_HEADER.size:
                self.trouble = "the log breaks off"
                return
            signature, _, _, size, kind = OBJECT_HEADER.unpack(header)
            # As packed: loggers write 128 KiB.
            if signature != b"LOBJ" or not OBJECT_HEADER.size <= size <= 1 << 30:
                self.trouble = "the log is damaged"
                return
            self._spending.look_at_clock()
            self._spending.report_progress(file.tell())
            if kind == _Kind.CONTAINER:
                yield from self._container(file, size - OBJECT_HEADER.size)
            else:
                file.seek(size - OBJECT_HEADER.size, os.SEEK_CUR)
            if self.trouble:
                return
            file.seek(size % 4, os.SEEK_CUR)

    def _container(self, file: BinaryIO, size: int) -> Iterator[bytes]:
        header = file.read(min(CONTAINER_HEADER.size, size))
        if len(header) < CONTAINER_HEADER.size:
            self.trouble = "the log breaks off"
            return
        method, _ = CONTAINER_HEADER.unpack(header)
        if method not in (_Packing.STORED, _Packing.DEFLATED):
            self.trouble = f"the log is packed in an unknown way ({method})"
            return
        unpacker = zlib.decompressobj() if method == _Packing.DEFLATED else None
        left = size - len(header)
        while left > 0:
            packed = file.read(min(left, CONTAINER_PIECE_BYTES))
            if not packed:
                self.trouble = "the log breaks off"
                return
            left -= len(packed)
            yield from (packed,) if unpacker is None else self._inflated(unpacker, packed)
            if self.trouble:
                return
        if unpacker is not None and not unpacker.eof:
            self.trouble = "the log breaks off"

    def _inflated(self, unpacker: zlib._Decompress, packed: bytes) -> Iterator[bytes]:
        """What a piece unpacks to, never more than `CONTAINER_PIECE_BYTES` at a time: it may be a
        thousandfold."""
        while packed and not unpacker.eof:
            try:
                data = unpacker.decompress(packed, CONTAINER_PIECE_BYTES)
            except zlib.error:
                self.trouble = "the log is damaged"
                return
            yield data
            packed = unpacker.unconsumed_tail


def _file_header(file: BinaryIO, path: Path) -> int:
    text = file.read(FILE_HEADER.size)
    if len(text) < FILE_HEADER.size or not text.startswith(b"LOGG"):
        raise InputOutputError(f"log {path}: not a BLF file (no LOGG header); is the suffix right?")
    fields = FILE_HEADER.unpack(text)
    file.seek(max(fields[1], FILE_HEADER.size))
    year, month, _, day, hour, minute, second, milli = fields[
        START_TIME_FIELD : START_TIME_FIELD + 8
    ]
    try:
        start = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return 0
    start_ns = int(start.timestamp()) * 1_000_000_000 + milli * 1_000_000
    return start_ns if 0 <= start_ns < MAX_STAMP_NS else 0


class _BlfParser:
    """Objects of the joined containers into columns; an object may span two of them."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._columns = ColumnBuilder()
        self._tail = b""
        self.trouble = ""

    def feed(self, block: bytes) -> FrameTable:
        """Parse a further block; keeps the last, incomplete object."""
        self._columns = ColumnBuilder()
        text = self._tail + block
        data = np.frombuffer(text, dtype=np.uint8)
        places, kinds, consumed = self._walk(text, data)
        self._tail = text[consumed:]
        if len(places):
            self._append(data, places, kinds)
        return self._columns.table()

    def _walk(self, text: bytes, data: Bytes) -> tuple[IntArray, IntArray, int]:
        """Positions and kinds of all whole objects, and the bytes used."""
        places: list[IntArray] = []
        at, end = 0, len(text)
        unpack = OBJECT_HEADER.unpack_from
        single: list[int] = []
        while at + OBJECT_HEADER.size <= end:
            signature, _, _, size, _ = unpack(text, at)
            if signature != b"LOBJ":
                found = text.find(b"LOBJ", at, at + 8)
                if found < 0:
                    self.trouble = "the log is damaged"
                    break
                at = found
                continue
            # An embedded text or picture, never a frame.
            if size < OBJECT_HEADER.size or size > 16 << 20:
                self.trouble = "the log is damaged"
                break
            if at + size > end:
                break
            count = _run(data, at, size) if size % 4 == 0 else 1
            if count >= MIN_RUN_OBJECTS:
                places.extend((np.array(single, dtype=np.int64), at + size * np.arange(count)))
                single = []
            else:
                single.extend(range(at, at + count * size, size))
            at += count * size
        places.append(np.array(single, dtype=np.int64))
        where = np.concatenate(places)
        return where, _u32(data, where + 12), at

    def _append(self, data: Bytes, places: IntArray, kinds: IntArray) -> None:
        classic = (kinds == _Kind.CLASSIC) | (kinds == _Kind.CLASSIC_2)
        special = np.flatnonzero(np.isin(kinds, (_Kind.ERROR_EXT, _Kind.FD, _Kind.FD_64)))
        start = 0
        for index in special:
            self._classic(data, places[start:index][classic[start:index]])
            self._special(data, int(places[index]), int(kinds[index]))
            start = int(index) + 1
        self._classic(data, places[start:][classic[start:]])

    def _classic(self, data: Bytes, places: IntArray) -> None:
        """CAN_MESSAGE and CAN_MESSAGE2: the first 16 bytes of their body are the same."""
        version = _u16(data, places + 6)
        body = places + np.where(version == 2, 40, 32)
        sound = ((version == 1) | (version == 2)) & (body + 16 <= places + _u32(data, places + 8))
        places, body = places[sound], body[sound]
        if len(places) == 0:
            return
        flags = data[body + 2]
        can_id = _u32(data, body + 4)
        length = np.minimum(data[body + 3], 8)
        payload = _rows(data, body + 8, 8)
        remote = (flags & 0x80).astype(np.bool_)
        length[remote] = 0
        payload[np.arange(8) >= length[:, None]] = 0
        self._columns.extend(
            time_ns=self._times(data, places),
            can_id=(can_id & MAX_CAN_ID).astype(np.uint32),
            length=length,
            data=payload,
            extended=can_id >> 31 == 1,
            remote=remote,
            sent=(flags & 1).astype(np.bool_),
            channel=_u16(data, body).astype(np.uint16),
        )

    def _special(self, data: Bytes, place: int, kind: int) -> None:
        """Error frames and CAN FD, one at a time: rare on this bus."""
        version = int(data[place + 6])
        size = int(_u32(data, np.array([place + 8]))[0])
        body = place + (40 if version == 2 else 32)
        if body > place + size:
            self.trouble = "the log is damaged"
            return
        whole = data[body : place + size].tobytes()
        time_ns = int(self._times(data, np.array([place]))[0])
        if kind == _Kind.ERROR_EXT:
            channel = int.from_bytes(whole[:2], "little")
            self._columns.add(time_ns, 0, b"", error=True, channel=channel)
            return
        try:
            if kind == _Kind.FD:
                channel, flags, _, can_id, _, _, fd_flags, valid = FD_MESSAGE.unpack_from(whole)
                payload = whole[FD_MESSAGE.size :][: min(valid, 64)]
                remote, sent, fd = bool(flags & 0x80), bool(flags & 1), bool(fd_flags & 1)
            else:
                fields = FD_MESSAGE_64.unpack_from(whole)
                channel, valid, can_id, fd_flags = fields[0], fields[2], fields[4], fields[6]
                direction = fields[12]
                stop = fields[13] - (body - place) if fields[13] else len(whole)
                payload = whole[FD_MESSAGE_64.size : max(stop, 0)][: min(valid, 64)]
                payload = payload.ljust(min(valid, 64), b"\0")
                remote, sent, fd = bool(fd_flags & 0x10), bool(direction), bool(fd_flags & 0x1000)
        except struct.error:
            self.trouble = "the log is damaged"
            return
        self._columns.add(
            time_ns,
            can_id & MAX_CAN_ID,
            b"" if remote else payload,
            extended=bool(can_id >> 31),
            fd=fd,
            remote=remote,
            sent=sent,
            channel=channel,
        )

    def _times(self, data: Bytes, places: IntArray) -> IntArray:
        """Stamps in ns: object flag 1 counts 10 µs, all others ns."""
        ten_micros = _u32(data, places + 16) == 1
        stamp = _rows(data, places + 24, 8).view("<i8").reshape(-1).astype(np.int64)
        limit = MAX_STAMP_NS // 10_000
        stamp = np.clip(stamp, 0, np.where(ten_micros, limit, limit * 10_000))
        return self._start_ns + np.where(ten_micros, stamp * 10_000, stamp)


def _run(data: Bytes, at: int, size: int) -> int:
    """Objects of that size that follow one another from `at` on, at least 1."""
    most = (len(data) - at) // size
    if most < MIN_RUN_OBJECTS or size > 256:
        return 1
    found, probe = 0, MIN_RUN_OBJECTS
    # In growing steps: objects of changing size must not cost a look at all that follow.
    while found < most:
        count = min(probe, most - found)
        begin = at + found * size
        rows = data[begin : begin + count * size].reshape(count, size)
        same = rows[:, :4].copy().view("<u4").reshape(-1) == OBJECT_SIGNATURE
        same &= rows[:, 8:12].copy().view("<u4").reshape(-1) == size
        if not same.all():
            return max(found + int(np.argmin(same)), 1)
        found, probe = found + count, 4 * probe
    return found


def _rows(data: Bytes, places: IntArray, width: int) -> Bytes:
    out: Bytes = data[places[:, None] + np.arange(width)]
    return out


def _u32(data: Bytes, places: IntArray) -> IntArray:
    return _rows(data, places, 4).view("<u4").reshape(-1).astype(np.int64)


def _u16(data: Bytes, places: IntArray) -> IntArray:
    return _rows(data, places, 2).view("<u2").reshape(-1).astype(np.int64)
