"""Lays a test's frames out on its control ticks: channels, commands, frozen signals.

A live bus whose counters do not tell the ticks is placed some seconds at a time, each stretch of
frames as a recording is; between two stretches the ticks begin anew.
"""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.episodes import Episode
from firmware_iface.alignment.frame_faults import drop_conflicts
from firmware_iface.alignment.ticks import TickAxis, place_frames
from firmware_iface.bus_map import BusMap
from firmware_iface.codec import DecodedTable, channels_in, choose_channel, decode
from firmware_iface.live_decode import LiveTick
from firmware_iface.recording import (
    CHANNEL_NAMES,
    BitOutcome,
    BoolArray,
    CommandMode,
    FloatArray,
    IntArray,
    Samples,
)
from firmware_iface.transport.frames import ColumnBuilder, Frame


class RowBounds(msgspec.Struct, frozen=True, eq=False):
    """Finds the frames of a span of ticks without going through all of them."""

    axis: TickAxis
    """The control ticks of the recording."""
    highest: IntArray
    """Highest tick up to each axis frame; ascending."""
    lowest: IntArray
    """Lowest tick from each axis frame on; ascending."""

    @classmethod
    def of(cls, axis: TickAxis) -> RowBounds:
        """Bounds of an axis.

        axis: the control ticks of a recording. Returns where each tick's frames may stand.
        """
        lowest = np.minimum.accumulate(axis.tick[::-1])[::-1]
        return cls(axis, np.maximum.accumulate(axis.tick), lowest)

    def rows(self, episode: Episode, rows: int) -> tuple[int, int]:
        """Rows of the table that belong to a test: from neighbour to neighbour.

        They end with the word that the test has ended, if it has all its frames then: a live test
        is judged on that word, and its recording goes on for a while.

        episode: the test; rows: of the whole table. Returns the first row, and one past the last.
        """
        stop = episode.first + episode.ticks
        low = int(np.searchsorted(self.highest, episode.first))
        high = int(np.searchsorted(self.lowest, stop))
        tick = self.axis.tick[low:high]
        hits = np.flatnonzero((tick >= episode.first) & (tick < stop))
        if len(hits) == 0:
            return 0, rows
        first, last = low + int(hits[0]), low + int(hits[-1])
        begin = int(self.axis.row[first - 1]) + 1 if first > 0 else 0
        end = int(self.axis.row[last + 1]) if last + 1 < len(self.axis.row) else rows
        if episode.ended is not None:
            end = min(end, max(episode.ended, int(self.axis.row[last])) + 1)
        return begin, end


MIN_FROZEN_TICKS = 100


class TickGrid(msgspec.Struct, frozen=True, eq=False):
    """One test's tick grid, and the rows of the table that can hold its frames."""

    episode: Episode
    decoded: DecodedTable
    axis: TickAxis
    bus_map: BusMap
    begin: int
    """First row that can hold one of the test's."""
    end: int
    """One past the last."""

    def fill(self, role: str) -> GridColumn | None:
        """Put the values of a role on the grid; of two frames for one tick the first counts.

        role: as in a mapping. Returns None without a frame of the role's message.
        """
        item = self.decoded.messages.get(self.decoded.message_of.get(role, ""))
        tick = None if item is None else self.axis.ticks.get(item.message.name)
        if item is None or tick is None or len(tick) == 0:
            return None
        near = slice(*np.searchsorted(item.row, [self.begin, self.end]))
        at = tick[near] - self.episode.first
        value = item.values[role][near]
        usable = np.flatnonzero((at >= 0) & (at < self.episode.ticks) & np.isfinite(value))[::-1]
        at = at[usable]
        out = np.full(self.episode.ticks, np.nan)
        out[at] = value[usable]
        host = np.full(self.episode.ticks, -1, dtype=np.int64)
        host[at] = item.time_ns[near][usable]
        saturated = np.zeros(self.episode.ticks, dtype=np.bool_)
        if role in item.saturated:
            saturated[at] = item.saturated[role][near][usable]
        return GridColumn(out, saturated, host)


class GridColumn(msgspec.Struct, frozen=True, eq=False):
    """A role on the grid; NaN, False and -1 where no frame brought it."""

    value: FloatArray
    """Shape (ticks,)."""
    saturated: BoolArray
    """At the converter's end, shape (ticks,)."""
    host_ns: IntArray
    """Time stamps, shape (ticks,)."""


def samples_of(grid: TickGrid, mode: CommandMode | None = None) -> tuple[Samples, list[str]]:
    """Put the channels and the commands of one test on its ticks.

    mode: of the commands to take; None: that of most of them.
    """
    ticks, period = grid.episode.ticks, grid.bus_map.tick_ns
    empty = GridColumn(
        np.full(ticks, np.nan), np.zeros(ticks, dtype=np.bool_), np.full(ticks, -1, dtype=np.int64)
    )
    notes: list[str] = []
    filled: dict[str, GridColumn] = {}
    for key in CHANNEL_NAMES:
        found = grid.fill(f"channels.{key}")
        filled[key] = found or empty
        if found is None:
            notes.append(f"no frame brings the {key}")
            continue
        frozen = _frozen(found.value, found.saturated)
        if frozen:
            seconds = frozen * period * 1e-9
            notes.append(f"{key} stood at one code for {seconds:.3g} s though it moves elsewhere")
    mode, command, command_notes = _command(grid, mode)
    samples = Samples(
        period_ns=period,
        mode=mode,
        current=filled["current"].value,
        spool=filled["spool"].value,
        pressure=filled["pressure"].value,
        position=filled["position"].value,
        command=command,
        saturated=np.stack([filled[key].saturated for key in CHANNEL_NAMES]),
        host_ns=filled["spool"].host_ns,
        stated=grid.bus_map.stated,
    )
    return samples, notes + command_notes


def _frozen(value: FloatArray, saturated: BoolArray) -> int:
    """Length of a frozen stretch in ticks, 0 if the channel never stood still suspiciously."""
    known = np.flatnonzero(np.isfinite(value) & ~saturated)
    if len(known) == 0:
        return 0
    edges = np.flatnonzero(np.diff(value[known]) != 0.0)
    bounds = np.concatenate(([-1], edges, [len(known) - 1]))
    lengths = np.diff(bounds)
    longest = int(lengths.argmax())
    run = int(lengths[longest])
    others = len(known) - run
    span = int(known[bounds[longest + 1]] - known[bounds[longest] + 1]) + 1
    # Share of ticks in which a live channel changes its code.
    lively = others > MIN_FROZEN_TICKS and len(edges) >= 0.2 * others
    return span if run >= MIN_FROZEN_TICKS and lively else 0


def command_modes(grid: TickGrid) -> tuple[CommandMode, ...]:
    """Find the modes of a stretch's commands, each of at least a few dozens of them.

    grid: the stretch and its frames. Returns empty where no frame says a mode.
    """
    modes = grid.fill("command.mode")
    if modes is None:
        return ()
    values, count = np.unique(modes.value[np.isfinite(modes.value)], return_counts=True)
    found = {
        grid.bus_map.modes[int(value)]
        for value, times in zip(values, count, strict=True)
        # So many commands of a mode: a test may have been played in it.
        if times >= 50 and int(value) in grid.bus_map.modes
    }
    return tuple(sorted(found))


def _command(grid: TickGrid, mode: CommandMode | None) -> tuple[CommandMode, FloatArray, list[str]]:
    """Mode and command of a test; NaN where no frame said, or where it said another mode."""
    notes: list[str] = []
    bus_map = grid.bus_map
    mode = mode or bus_map.fixed_mode
    modes = grid.fill("command.mode")
    if modes is not None and mode is None:
        known = modes.value[np.isin(modes.value, list(bus_map.modes))]
        if len(known):
            values, count = np.unique(known, return_counts=True)
            mode = bus_map.modes[int(values[np.argmax(count)])]
    if mode is None:
        mode = CommandMode.CURRENT
        notes.append("no command says its mode; taken as a current")
    command = grid.fill(f"command.{mode.name.lower()}")
    if command is None:
        return mode, np.full(grid.episode.ticks, np.nan), [*notes, "no command frames"]
    value = command.value
    if modes is not None:
        wanted = [number for number, meaning in bus_map.modes.items() if meaning is mode]
        other = np.isfinite(modes.value) & ~np.isin(modes.value, wanted)
        if other.any():
            notes.append(f"{int(other.sum())} commands of another mode left out")
            value[other] = np.nan
    return mode, value, notes


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
        return live_ticks(samples)


def live_ticks(samples: Samples) -> list[LiveTick]:
    """Ticks as `firmware_iface.live_decode.LiveTicks` gives them, of samples on the tick grid."""
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
