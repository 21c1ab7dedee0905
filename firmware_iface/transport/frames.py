"""The types for frames: a single one, and many as columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_CHANNEL", "MAX_PAYLOAD", "Frame", "FrameTable", "concatenate"]

MAX_PAYLOAD = 64
"""Bytes of the longest payload (CAN FD)."""
MAX_CHANNEL = 0xFFFF
"""Largest number of an adapter channel that is told apart."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One data or error frame.

    Attributes
    ----------
    time_ns : int
        Host time stamp, ns since the epoch (or since the start of a log without a date).
    can_id : int
        Identifier, 11 or 29 bits, without flag bits.
    data : bytes
        Payload, 0 to 64 bytes.
    extended : bool
        29-bit identifier.
    fd : bool
        CAN FD frame.
    error : bool
        Error frame; identifier and payload then carry no message.
    remote : bool
        Remote request; carries no payload.
    sent : bool
        Transmitted by this program (own echo), not received.
    channel : int
        Adapter channel as loggers count them, from 1; 0 where the source has only one or does
        not say.
    """

    time_ns: int
    can_id: int
    data: bytes
    extended: bool = False
    fd: bool = False
    error: bool = False
    remote: bool = False
    sent: bool = False
    channel: int = 0

    def __post_init__(self) -> None:
        limit = 0x1FFFFFFF if self.extended else 0x7FF
        if not 0 <= self.can_id <= limit and not self.error:
            raise ValueError(f"identifier {self.can_id:#x} outside 0 … {limit:#x}")
        if len(self.data) > MAX_PAYLOAD:
            raise ValueError(f"payload of {len(self.data)} bytes, at most {MAX_PAYLOAD}")


@dataclass(frozen=True, slots=True, eq=False)
class FrameTable:
    """Many frames as columns, in order of arrival; n rows.

    Attributes
    ----------
    time_ns : NDArray[np.int64]
        int64, shape (n,).
    can_id : NDArray[np.uint32]
        uint32, shape (n,).
    length : NDArray[np.uint8]
        uint8, payload bytes, shape (n,).
    data : NDArray[np.uint8]
        uint8, shape (n, width), zero beyond `length`; width 8, or 64 where a frame is longer.
    extended : NDArray[np.bool_]
        Bool, shape (n,).
    fd : NDArray[np.bool_]
        See `extended`.
    error : NDArray[np.bool_]
        See `extended`.
    remote : NDArray[np.bool_]
        See `extended`.
    sent : NDArray[np.bool_]
        See `extended`.
    channel : NDArray[np.uint16]
        uint16, adapter channel of each frame, 0 where it is not said, shape (n,).
    """

    time_ns: NDArray[np.int64]
    can_id: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]
    extended: NDArray[np.bool_]
    fd: NDArray[np.bool_]
    error: NDArray[np.bool_]
    remote: NDArray[np.bool_]
    sent: NDArray[np.bool_]
    channel: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.time_ns)

    def rows(self, chosen: slice | NDArray[np.bool_] | NDArray[np.int64]) -> FrameTable:
        """Some of the rows; in the same order, or in that of the numbers given."""
        return FrameTable(**{item.name: getattr(self, item.name)[chosen] for item in fields(self)})

    @classmethod
    def from_frames(cls, frames: Iterable[Frame]) -> FrameTable:
        """Collect frames into columns."""
        rows = list(frames)
        width = 8 if all(len(row.data) <= 8 for row in rows) else MAX_PAYLOAD
        packed = b"".join(row.data.ljust(width, b"\0") for row in rows)
        return cls(
            time_ns=np.array([row.time_ns for row in rows], dtype=np.int64),
            can_id=np.array([row.can_id for row in rows], dtype=np.uint32),
            length=np.array([len(row.data) for row in rows], dtype=np.uint8),
            data=np.frombuffer(packed, dtype=np.uint8).reshape(len(rows), width),
            extended=np.array([row.extended for row in rows], dtype=np.bool_),
            fd=np.array([row.fd for row in rows], dtype=np.bool_),
            error=np.array([row.error for row in rows], dtype=np.bool_),
            remote=np.array([row.remote for row in rows], dtype=np.bool_),
            sent=np.array([row.sent for row in rows], dtype=np.bool_),
            channel=np.array([row.channel for row in rows], dtype=np.uint16),
        )


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
    return FrameTable(
        time_ns=np.concatenate([table.time_ns for table in tables]),
        can_id=np.concatenate([table.can_id for table in tables]),
        length=np.concatenate([table.length for table in tables]),
        data=np.concatenate(wide),
        extended=np.concatenate([table.extended for table in tables]),
        fd=np.concatenate([table.fd for table in tables]),
        error=np.concatenate([table.error for table in tables]),
        remote=np.concatenate([table.remote for table in tables]),
        sent=np.concatenate([table.sent for table in tables]),
        channel=np.concatenate([table.channel for table in tables]),
    )
