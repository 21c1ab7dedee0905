"""Ticks of a live bus whose counters do not tell them: placed some seconds at a time.

A stretch of frames is placed on ticks as that of a recording is. Between two stretches the ticks
begin anew.
"""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.episodes import Episode
from firmware_iface.alignment.frame_faults import drop_conflicts
from firmware_iface.alignment.grid import TickGrid, samples_of
from firmware_iface.alignment.ticks import place_frames
from firmware_iface.bus_map import BusMap
from firmware_iface.codec import channels_in, choose_channel, decode
from firmware_iface.live_decode import LiveTick
from firmware_iface.recording import BitOutcome, CommandMode, FloatArray, Samples
from firmware_iface.transport.frames import ColumnBuilder, Frame


class StretchTicks:
    """Puts frames together into ticks as `LiveTicks` of `firmware_iface.live_decode`, 30 s late.

    bus_map: mapping; any of which a recording can be diagnosed. mode: of the commands of the last
    stretch; lost: ticks without a spool position; breaks: times that the ticks began anew;
    conflicts: values that a second sender contradicted.
    """

    mode: CommandMode
    lost: int
    breaks: int
    conflicts: int

    def __init__(self, bus_map: BusMap) -> None:
        self._map = bus_map
        self._frames = ColumnBuilder()
        self._begin_ns: int | None = None
        self.mode = bus_map.fixed_mode or CommandMode.CURRENT
        self.lost = self.breaks = self.conflicts = 0

    def take(self, frame: Frame) -> list[LiveTick]:
        """Take a frame; returns the ticks of a stretch with the frame behind its end."""
        begin = frame.time_ns if self._begin_ns is None else self._begin_ns
        # 30 s: after each stretch the model settles for a second.
        over = frame.time_ns - begin >= 30_000_000_000 or len(self._frames) >= 500_000
        out = self.flush() if over else []
        if self._begin_ns is None:
            self._begin_ns = frame.time_ns
        self._frames.add_frame(frame)
        return out

    def flush(self) -> list[LiveTick]:
        """Return the ticks of the frames so far."""
        table, self._frames, self._begin_ns = self._frames.table(), ColumnBuilder(), None
        channel, ambiguous = choose_channel(self._map.channel, channels_in(table, self._map))
        if ambiguous or not len(table):
            return []
        bus_map = replace(self._map, channel=channel)
        decoded = decode(table, bus_map)
        axis = place_frames(decoded, bus_map.tick_ns)
        decoded, axis, conflicts = drop_conflicts(decoded, axis)
        if axis is None or not len(axis.tick):
            return []
        first, last = int(axis.tick.min()), int(axis.tick.max())
        whole = Episode(first, last - first + 1, None, None, BitOutcome())
        samples, _ = samples_of(TickGrid(whole, decoded, axis, bus_map, 0, len(table)))
        self.mode = samples.mode
        self.breaks += 1
        self.conflicts += sum(item.count for item in conflicts.values())
        self.lost += int(np.isnan(samples.spool).sum())
        columns = (samples.current, samples.spool, samples.pressure, samples.position)
        seen = np.where(samples.saturated, np.nan, np.stack(columns))
        rows = np.column_stack((_commands(samples), *seen))
        return [LiveTick(*row) for row in rows.tolist()]


def _commands(samples: Samples) -> FloatArray:
    """Commands at the ticks whose current they made; the current itself where there are none."""
    command, current = samples.command, samples.current
    if not np.isfinite(command).any():
        return current
    seen = np.concatenate(([np.nan], samples.position[:-1]))
    best, found = np.inf, command
    # Commands come at most 4 ticks before their samples (docs/how-to/bare-bus.md).
    for late in range(-1, 5):
        moved = np.full_like(command, np.nan)
        part = slice(max(late, 0), len(command) + min(late, 0))
        moved[part] = command[max(-late, 0) : len(command) - max(late, 0)]
        acts = moved - seen if samples.mode is CommandMode.POSITION else moved
        both = np.isfinite(acts) & np.isfinite(current)
        if both.sum() < 2:
            continue
        square = float(acts[both] @ acts[both])
        gain = float(acts[both] @ current[both]) / square if square > 0.0 else 0.0
        left = float(np.mean((current[both] - gain * acts[both]) ** 2))
        if left < best:
            best, found = left, moved
    return found
