"""Collects live frames and turns them into recordings, decoded as those of a log are."""

from __future__ import annotations

from collections.abc import Iterable

from ehadiag.core.recording import Recording
from firmware_iface.alignment.align import assemble
from firmware_iface.logs.reader import choose
from firmware_iface.mapping.bus_map import BusMap, default_map
from firmware_iface.transport.columns import ColumnBuilder
from firmware_iface.transport.frames import Frame, FrameTable, concatenate

__all__ = ["Assembler"]

MAX_FRAMES = 4_000_000
"""Half an hour of this bus, 120 MB."""


class Assembler:
    """Collects frames as they come; bounded memory, about 1 µs a frame.

    Of more than `max_frames` frames the oldest are forgotten, at least half of them kept.
    One thread adds; the recordings are read when it has stopped, or by the same thread.
    """

    def __init__(
        self, source: str, bus_map: BusMap | None = None, max_frames: int = MAX_FRAMES
    ) -> None:
        self._source = source
        self._map = bus_map or default_map()
        self._half = max(max_frames // 2, 1)
        self._old: FrameTable | None = None
        self._new = ColumnBuilder()
        self._forgotten = 0

    def __len__(self) -> int:
        return len(self._new) + (0 if self._old is None else len(self._old))

    def add(self, frame: Frame) -> None:
        """Take one frame."""
        if len(self._new) >= self._half:
            self._forgotten += 0 if self._old is None else len(self._old)
            self._old, self._new = self._new.table(), ColumnBuilder()
        self._new.add(
            frame.time_ns,
            frame.can_id & 0xFFFFFFFF,
            frame.data,
            extended=frame.extended,
            fd=frame.fd,
            error=frame.error,
            remote=frame.remote,
            sent=frame.sent,
            channel=frame.channel,
        )

    def extend(self, frames: Iterable[Frame]) -> None:
        """Take several frames, in order of arrival."""
        for frame in frames:
            self.add(frame)

    def table(self) -> FrameTable:
        """All frames kept, as columns."""
        new = self._new.table()
        return new if self._old is None else concatenate((self._old, new))

    def recordings(self) -> tuple[Recording, ...]:
        """All tests so far, at least one recording (see `align.assemble`)."""
        return self._recordings_of(self.table())

    def recording(self) -> Recording:
        """Last complete test so far; the last one begun if none was completed."""
        return self.recording_of(self.table())

    def recording_of(self, table: FrameTable) -> Recording:
        """As `recording`, of what `table` gave earlier; any thread may call this."""
        return choose(self._recordings_of(table))

    def _recordings_of(self, table: FrameTable) -> tuple[Recording, ...]:
        notes: tuple[str, ...] = ()
        if self._forgotten:
            notes = (f"the first {self._forgotten} frames were too old to keep",)
        return assemble(table, self._map, self._source, notes)
