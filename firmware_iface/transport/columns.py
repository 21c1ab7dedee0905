"""Growing columns of frames, filled one frame or one block at a time."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from firmware_iface.transport.frames import MAX_PAYLOAD, FrameTable

__all__ = ["ColumnBuilder"]

Flags = NDArray[np.bool_]

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

    def extend(
        self,
        *,
        time_ns: NDArray[np.int64],
        can_id: NDArray[np.uint32],
        length: NDArray[np.uint8],
        data: NDArray[np.uint8],
        extended: Flags,
        remote: Flags,
        sent: Flags,
        channel: NDArray[np.uint16],
    ) -> None:
        """Append a block of classic data and remote frames; data of shape (n, 8)."""
        self._time.frombytes(np.ascontiguousarray(time_ns, dtype=np.int64).tobytes())
        self._id.frombytes(np.ascontiguousarray(can_id, dtype=np.uint32).tobytes())
        flags = extended * np.uint8(EXTENDED) | remote * np.uint8(REMOTE) | sent * np.uint8(SENT)
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
            extended=(flags & EXTENDED).astype(np.bool_),
            fd=(flags & FD).astype(np.bool_),
            error=(flags & ERROR).astype(np.bool_),
            remote=(flags & REMOTE).astype(np.bool_),
            sent=(flags & SENT).astype(np.bool_),
            channel=np.array(self._channel, dtype=np.uint16),
        )
