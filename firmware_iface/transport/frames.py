"""The types for frames: a single one, and many as columns that grow frame by frame."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from enum import IntEnum

import msgspec
import numpy as np
from numpy.typing import NDArray

from firmware_iface.recording import MAX_CAN_ID, MAX_STANDARD_CAN_ID, BoolArray, IntArray

MAX_PAYLOAD = 64
"""Bytes of the longest payload (CAN FD)."""
MAX_CHANNEL = 0xFFFF
"""Largest number of an adapter channel that is told apart."""


class Frame(msgspec.Struct, frozen=True):
    """One data or error frame."""

    time_ns: int
    """Host time stamp, ns since the epoch (or since the start of a log without a date)."""
    can_id: int
    """Identifier, 11 or 29 bits, without flag bits."""
    data: bytes
    """Payload, 0 to 64 bytes."""
    extended: bool = False
    """29-bit identifier."""
    fd: bool = False
    error: bool = False
    """Error frame; identifier and payload then carry no message."""
    remote: bool = False
    """Remote request; carries no payload."""
    sent: bool = False
    """Transmitted by this program (own echo), not received."""
    channel: int = 0
    """Adapter channel as loggers count them, from 1; 0 where the source has only one or does not
    say.
    """

    def __post_init__(self) -> None:
        limit = MAX_CAN_ID if self.extended else MAX_STANDARD_CAN_ID
        if not 0 <= self.can_id <= limit and not self.error:
            raise ValueError(f"identifier {self.can_id:#x} outside 0 … {limit:#x}")
        if len(self.data) > MAX_PAYLOAD:
            raise ValueError(f"payload of {len(self.data)} bytes, at most {MAX_PAYLOAD}")


class FrameTable(msgspec.Struct, frozen=True, eq=False):
    """Many frames as columns, in order of arrival; n rows."""

    time_ns: IntArray
    """int64, shape (n,)."""
    can_id: NDArray[np.uint32]
    """uint32, shape (n,)."""
    length: NDArray[np.uint8]
    """uint8, payload bytes, shape (n,)."""
    data: NDArray[np.uint8]
    """uint8, shape (n, width), zero beyond `length`; width 8, or 64 where a frame is longer."""
    extended: BoolArray
    """Bool, shape (n,)."""
    fd: BoolArray
    error: BoolArray
    remote: BoolArray
    sent: BoolArray
    channel: NDArray[np.uint16]
    """uint16, adapter channel of each frame, 0 where it is not said, shape (n,)."""

    def __len__(self) -> int:
        return len(self.time_ns)

    def rows(self, chosen: slice | BoolArray | IntArray) -> FrameTable:
        """Some of the rows; in the same order, or in that of the numbers given."""
        return FrameTable(**{name: getattr(self, name)[chosen] for name in self.__struct_fields__})

    @classmethod
    def from_frames(cls, frames: Iterable[Frame]) -> FrameTable:
        """Collect frames into columns."""
        columns = ColumnBuilder()
        for frame in frames:
            columns.add_frame(frame)
        return columns.table()


def concatenate(tables: Sequence[FrameTable]) -> FrameTable:
    """Join tables in the order given; payloads as wide as the widest."""
    if len(tables) == 1:
        return tables[0]
    width = max(table.data.shape[1] for table in tables)
    wide = []
    for table in tables:
        data = np.zeros((len(table), width), dtype=np.uint8)
        data[:, : table.data.shape[1]] = table.data
        wide.append(data)
    rest = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in FrameTable.__struct_fields__
        if name != "data"
    }
    return FrameTable(data=np.concatenate(wide), **rest)


class _Flag(IntEnum):
    """Bits of a frame's flags."""

    EXTENDED, FD, ERROR, REMOTE, SENT = 1, 2, 4, 8, 16


class ColumnBuilder:
    """Collects frames into columns; no object per frame is kept.

    Payloads take 8 bytes a frame until the first longer one comes, 64 from then on.
    """

    def __init__(self) -> None:
        self._time = array("q")
        self._id = array("I")
        self._flags = bytearray()
        self._length = bytearray()
        self._channel = array("H")
        self._data = bytearray()
        self._width = 8

    def __len__(self) -> int:
        return len(self._time)

    def add(
        self,
        time_ns: int,
        can_id: int,
        data: bytes,
        *,
        extended: bool = False,
        fd: bool = False,
        error: bool = False,
        remote: bool = False,
        sent: bool = False,
        channel: int = 0,
    ) -> None:
        """Append one frame."""
        size = len(data)
        if size > self._width:
            self._widen()
        self._time.append(time_ns)
        self._id.append(can_id)
        self._length.append(size)
        self._channel.append(channel)
        self._flags.append(extended | fd << 1 | error << 2 | remote << 3 | sent << 4)
        self._data += data
        if size < self._width:
            self._data += bytes(self._width - size)

    def add_frame(self, frame: Frame, channel: int | None = None) -> None:
        """Append one frame; `channel` takes the place of its own."""
        self.add(
            frame.time_ns,
            frame.can_id & 0xFFFFFFFF,
            frame.data,
            extended=frame.extended,
            fd=frame.fd,
            error=frame.error,
            remote=frame.remote,
            sent=frame.sent,
            channel=frame.channel if channel is None else channel,
        )

    def extend(
        self,
        *,
        time_ns: IntArray,
        can_id: NDArray[np.uint32],
        length: NDArray[np.uint8],
        data: NDArray[np.uint8],
        extended: BoolArray,
        remote: BoolArray,
        sent: BoolArray,
        channel: NDArray[np.uint16],
    ) -> None:
        """Append a block of classic data and remote frames; data of shape (n, 8)."""
        self._time.frombytes(np.ascontiguousarray(time_ns, dtype=np.int64).tobytes())
        self._id.frombytes(np.ascontiguousarray(can_id, dtype=np.uint32).tobytes())
        flags = (
            extended * np.uint8(_Flag.EXTENDED)
            | remote * np.uint8(_Flag.REMOTE)
            | sent * np.uint8(_Flag.SENT)
        )
        self._flags += flags.astype(np.uint8).tobytes()
        self._length += length.astype(np.uint8).tobytes()
        self._channel.frombytes(np.ascontiguousarray(channel, dtype=np.uint16).tobytes())
        if self._width > 8:
            wide = np.zeros((len(data), self._width), dtype=np.uint8)
            wide[:, :8] = data
            data = wide
        self._data += np.ascontiguousarray(data).tobytes()

    def _widen(self) -> None:
        old = np.frombuffer(bytes(self._data), dtype=np.uint8).reshape(-1, self._width)
        wide = np.zeros((len(old), MAX_PAYLOAD), dtype=np.uint8)
        wide[:, : self._width] = old
        self._data = bytearray(wide.tobytes())
        self._width = MAX_PAYLOAD

    def table(self) -> FrameTable:
        """Copy of the columns so far."""
        flags = np.frombuffer(bytes(self._flags), dtype=np.uint8)
        payload = np.frombuffer(bytes(self._data), dtype=np.uint8)
        return FrameTable(
            time_ns=np.array(self._time, dtype=np.int64),
            can_id=np.array(self._id, dtype=np.uint32),
            length=np.frombuffer(bytes(self._length), dtype=np.uint8),
            data=payload.reshape(-1, self._width),
            extended=(flags & np.uint8(_Flag.EXTENDED)).astype(np.bool_),
            fd=(flags & np.uint8(_Flag.FD)).astype(np.bool_),
            error=(flags & np.uint8(_Flag.ERROR)).astype(np.bool_),
            remote=(flags & np.uint8(_Flag.REMOTE)).astype(np.bool_),
            sent=(flags & np.uint8(_Flag.SENT)).astype(np.bool_),
            channel=np.array(self._channel, dtype=np.uint16),
        )
