"""Builds recordings of tests from frames: samples at their ticks, losses as NaN and counted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.find_test import Sought, found_tests, rows_of_samples
from ehadiag.core.recording import (
    CommandMode,
    Environment,
    OnboardResult,
    Outcome,
    Quality,
    Recording,
    Samples,
)
from firmware_iface.alignment.counts import count_frames, within
from firmware_iface.alignment.episodes import Episode, find_episodes
from firmware_iface.alignment.policy import judge_frames
from firmware_iface.alignment.senders import (
    Conflicts,
    crowded,
    drop_conflicts,
    second_senders,
)
from firmware_iface.alignment.ticks import TickAxis, place
from firmware_iface.codec.channel import channels_in, choose_channel
from firmware_iface.codec.decode import DecodedTable, decode
from firmware_iface.codec.onboard import onboard_results
from firmware_iface.codec.status import read_status, resolve_turns
from firmware_iface.mapping.bus_map import BusMap
from firmware_iface.transport.frames import FrameTable

__all__ = ["assemble"]

STUCK_FRAMES = 20
LOOKED_BESIDE = 100
"""Ticks around a test, as the status tells it, in which its command is looked for."""
MARGIN = 1000
"""Rows around a test in which late frames of messages without a counter are looked for."""

CHANNEL_KEYS = ("current", "spool", "pressure", "position")
FROZEN_TICKS = 100
FROZEN_LIVELY = 0.2
"""Share of ticks, outside a frozen stretch, in which a live channel changes its code."""


def assemble(
    table: FrameTable,
    bus_map: BusMap,
    source: str,
    notes: tuple[str, ...] = (),
    *,
    channels: frozenset[int] | None = None,
    unsaid_is_test: bool = True,
    sought: Sought | None = None,
) -> tuple[Recording, ...]:
    """All tests in a frame table, at least one recording (without samples if none ran).

    Parameters
    ----------
    table : FrameTable
        Frames in order of arrival.
    bus_map : BusMap
        What they mean.
    source : str
        File or bus, for reports.
    notes : tuple[str, ...]
        Facts known before decoding.
    channels : frozenset[int] | None
        Adapter channels on which the actuator's frames came so far; None: in this table.
    unsaid_is_test : bool
        Take frames without command and status for one test.
    sought : Sought | None
        What to look for where the bus does not say when which test ran; None: nothing, all that
        is recorded is then one test.

    Returns
    -------
    tuple[Recording, ...]
        The tests in order of time; one recording without samples if there is none.
    """
    present = channels_in(table, bus_map) if channels is None else channels
    channel, ambiguous = choose_channel(bus_map.channel, present)
    if ambiguous:
        return (_undecoded(source, notes, ambiguous),)
    bus_map = replace(bus_map, channel=channel)
    decoded = decode(table, bus_map)
    axis = place(decoded, bus_map.tick_ns)
    decoded, axis, conflicts = drop_conflicts(decoded, axis)
    status = read_status(decoded, axis, bus_map)
    if axis is not None and (mended := resolve_turns(axis, status)) is not axis:
        axis, status = mended, read_status(decoded, mended, bus_map)
    notes += _protection_notes(bus_map)
    if axis is None:
        notes += ("no telemetry in the recording",)
    else:
        notes += axis.notes
    episodes = find_episodes(decoded, axis, status, bus_map, unsaid_is_test=unsaid_is_test)
    bounds = _Bounds.of(axis) if axis is not None else None
    looked_for = sought if axis is not None and not _says_when(decoded, axis, bus_map) else None
    margin = LOOKED_BESIDE if looked_for is not None else 0
    found: list[Recording] = []
    own = onboard_results(table, bus_map)
    for item, after in zip(episodes, (*episodes[1:], None), strict=True):
        one = _recording(
            item, decoded, conflicts, bounds, bus_map, source, notes, len(table), margin
        )
        if own:
            one = replace(one, onboard=_onboard_of(item, after, own, bounds, len(table)))
        found += [one] if looked_for is None else _looked_for(one, item, looked_for, margin)
    return tuple(found)


def _onboard_of(
    episode: Episode,
    after: Episode | None,
    found: list[tuple[int, OnboardResult]],
    bounds: _Bounds | None,
    rows: int,
) -> OnboardResult | None:
    """What the computer found between a test and the one after it, of that test."""
    if bounds is None or episode.ticks == 0:
        return None
    begin = bounds.rows(episode, rows)[1]
    end = rows if after is None or after.ticks == 0 else bounds.rows(after, rows)[0]
    between = (item for row, item in found if begin <= row < end)
    return next((item for item in between if item.is_of(episode.test_id)), None)


def _says_when(decoded: DecodedTable, axis: TickAxis, bus_map: BusMap) -> bool:
    """Whether commands carry the test's number, or counters tell to which tick a status belongs."""
    command = bus_map.find("command.test_id")
    if command is not None and len(decoded.messages[command[0].name].row):
        return True
    status = bus_map.find("status.test_id")
    return bool(axis.turn) and status is not None and len(decoded.messages[status[0].name].row) > 0


def _looked_for(
    one: Recording, episode: Episode, sought: Sought, margin: int
) -> tuple[Recording, ...]:
    """The tests in a stretch of samples that is wider by a margin than what the status said."""
    if one.samples is None:
        return (one,)
    known = tuple(test for test in sought.tests if one.test_id in (None, test.id))
    found = found_tests(
        one, replace(sought, tests=known), within=one.test_id is not None, before=margin
    )
    if found[0].samples is one.samples:
        cut = rows_of_samples(one.samples, margin, margin, episode.ticks)
        return tuple(replace(item, samples=cut, start_ns=_start_ns(cut)) for item in found)
    return found


def _undecoded(source: str, notes: tuple[str, ...], why: str) -> Recording:
    quality = Quality(notes=notes, refused=(why,))
    return Recording(source, None, None, None, Outcome(), Environment(), quality)


def _protection_notes(bus_map: BusMap) -> tuple[str, ...]:
    notes = []
    for message in bus_map.messages.values():
        if message.crc is None and any(r.name.startswith("channels.") for r in message.roles):
            notes.append(f"{message.name}: no check sum; a corrupt frame cannot be told")
    return tuple(notes)


def _recording(
    episode: Episode,
    decoded: DecodedTable,
    conflicts: Mapping[str, Conflicts],
    bounds: _Bounds | None,
    bus_map: BusMap,
    source: str,
    notes: tuple[str, ...],
    rows: int,
    beside: int = 0,
) -> Recording:
    begin, end = bounds.rows(episode, rows) if bounds is not None else (0, rows)
    axis = bounds.axis if bounds is not None else None
    extra: list[str] = []
    samples = None
    if axis is not None and episode.ticks > 0:
        wide = replace(episode, first=episode.first - beside, ticks=episode.ticks + 2 * beside)
        grid = _Grid(wide, decoded, axis, bus_map, max(begin - MARGIN, 0), end + MARGIN)
        samples, extra = _samples(grid)
    elif axis is not None:
        extra = ["no test in the recording"]
    extra += _stuck_counters(decoded, bus_map, begin, end)
    counts = {
        name: count_frames(
            item,
            axis,
            episode,
            begin,
            end,
            conflicts[name].within(begin, end) if name in conflicts else 0,
        )
        for name, item in decoded.messages.items()
    }
    refused, used = judge_frames(bus_map.policy, counts)
    crowds = (crowded(item, bus_map.tick_ns, begin, end) for item in decoded.messages.values())
    refused = (
        *second_senders(counts, conflicts, bus_map, begin, end),
        *filter(None, crowds),
        *episode.refused,
        *refused,
    )
    quality = Quality(
        messages=counts,
        saturated=_saturated(samples),
        foreign=within(decoded.foreign, begin, end),
        error_frames=within(decoded.errors, begin, end),
        notes=(*notes, *episode.notes, *extra, *used),
        refused=refused,
    )
    return Recording(
        source=source,
        samples=samples,
        test_id=episode.test_id,
        serial=episode.serial,
        outcome=episode.outcome,
        environment=_environment(decoded, begin, end),
        quality=quality,
        channel=bus_map.channel,
        start_ns=_start_ns(samples),
    )


def _start_ns(samples: Samples | None) -> int | None:
    """Host time of row 0, told by the first row that came."""
    if samples is None:
        return None
    came = np.flatnonzero(samples.host_ns >= 0)
    return int(samples.host_ns[came[0]] - came[0] * samples.period_ns) if len(came) else None


def _stuck_counters(decoded: DecodedTable, bus_map: BusMap, begin: int, end: int) -> list[str]:
    """Notes on counters that often stay while time goes on: repeats of a frame take no time."""
    notes = []
    for name, item in decoded.messages.items():
        inside = slice(*np.searchsorted(item.row, [begin, end]))
        if item.counter is None:
            continue
        still = np.diff(item.counter[inside]) == 0
        still &= np.diff(item.time_ns[inside]) > bus_map.tick_ns // 2
        if still.sum() >= STUCK_FRAMES:
            notes.append(f"{name}: the counter stands still in {int(still.sum())} frames")
    return notes


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    """Finds the frames of a span of ticks without going through all of them.

    Attributes
    ----------
    axis : TickAxis
        The control ticks of the recording.
    highest : NDArray[np.int64]
        Highest tick up to each axis frame; ascending.
    lowest : NDArray[np.int64]
        Lowest tick from each axis frame on; ascending.
    """

    axis: TickAxis
    highest: NDArray[np.int64]
    lowest: NDArray[np.int64]

    @classmethod
    def of(cls, axis: TickAxis) -> _Bounds:
        """Bounds of an axis."""
        lowest = np.minimum.accumulate(axis.tick[::-1])[::-1]
        return cls(axis, np.maximum.accumulate(axis.tick), lowest)

    def rows(self, episode: Episode, rows: int) -> tuple[int, int]:
        """Rows of the table that belong to a test: from neighbour to neighbour.

        They end with the word that the test has ended, if it has all its frames then: a live test
        is judged on that word, and its recording goes on for a while.
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


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """One test's tick grid, and the rows of the table that can hold its frames."""

    episode: Episode
    decoded: DecodedTable
    axis: TickAxis
    bus_map: BusMap
    begin: int
    end: int

    def fill(self, role: str) -> _Filled | None:
        """Put the values of a role on the grid; of two frames for one tick the first counts.

        None without a frame of the role's message.
        """
        found = self.bus_map.find(role)
        tick = self.axis.ticks.get(found[0].name) if found is not None else None
        if found is None or tick is None or len(tick) == 0:
            return None
        item = self.decoded.messages[found[0].name]
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
        return _Filled(out, saturated, host)


@dataclass(frozen=True, slots=True, eq=False)
class _Filled:
    """A role on the grid; NaN, False and -1 where no frame brought it."""

    value: NDArray[np.float64]
    saturated: NDArray[np.bool_]
    host_ns: NDArray[np.int64]


def _samples(grid: _Grid) -> tuple[Samples, list[str]]:
    ticks, period = grid.episode.ticks, grid.bus_map.tick_ns
    nothing = _Filled(
        np.full(ticks, np.nan), np.zeros(ticks, dtype=np.bool_), np.full(ticks, -1, dtype=np.int64)
    )
    notes: list[str] = []
    filled: dict[str, _Filled] = {}
    for key in CHANNEL_KEYS:
        found = grid.fill(f"channels.{key}")
        filled[key] = found or nothing
        if found is None:
            notes.append(f"no frame brings the {key}")
            continue
        frozen = _frozen(found.value, found.saturated)
        if frozen:
            seconds = frozen * period * 1e-9
            notes.append(f"{key} stood at one code for {seconds:.3g} s though it moves elsewhere")
    mode, command, said = _command(grid)
    samples = Samples(
        period_ns=period,
        mode=mode,
        current=filled["current"].value,
        spool=filled["spool"].value,
        pressure=filled["pressure"].value,
        position=filled["position"].value,
        command=command,
        saturated=np.stack([filled[key].saturated for key in CHANNEL_KEYS]),
        host_ns=filled["spool"].host_ns,
        stated=grid.bus_map.stated,
    )
    return samples, notes + said


def _frozen(value: NDArray[np.float64], saturated: NDArray[np.bool_]) -> int:
    """Length of a frozen stretch in ticks, 0 if the channel never stood still suspiciously."""
    known = np.flatnonzero(np.isfinite(value) & ~saturated)
    if len(known) == 0:
        return 0
    edges = np.flatnonzero(np.diff(value[known]) != 0.0)
    bounds = np.concatenate(([-1], edges, [len(known) - 1]))
    lengths = np.diff(bounds)
    longest = int(lengths.argmax())
    run = int(lengths[longest])
    elsewhere = len(known) - run
    span = int(known[bounds[longest + 1]] - known[bounds[longest] + 1]) + 1
    lively = elsewhere > FROZEN_TICKS and len(edges) >= FROZEN_LIVELY * elsewhere
    return span if run >= FROZEN_TICKS and lively else 0


def _command(grid: _Grid) -> tuple[CommandMode, NDArray[np.float64], list[str]]:
    """Mode and command of a test; NaN where no frame said, or where it said another mode."""
    notes: list[str] = []
    bus_map = grid.bus_map
    mode = bus_map.fixed_mode
    modes = grid.fill("command.mode")
    if modes is not None:
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


def _saturated(samples: Samples | None) -> dict[str, int]:
    if samples is None:
        return {}
    return {key: int(samples.saturated[index].sum()) for index, key in enumerate(CHANNEL_KEYS)}


def _environment(decoded: DecodedTable, begin: int, end: int) -> Environment:
    def median(key: str) -> float | None:
        role = f"environment.{key}"
        for item in decoded.messages.values():
            if role in item.values:
                value = item.values[role][slice(*np.searchsorted(item.row, [begin, end]))]
                value = value[np.isfinite(value)]
                return float(np.median(value)) if len(value) else None
        return None

    return Environment(
        supply_pressure=median("supply_pressure"),
        return_pressure=median("return_pressure"),
        oil_temperature=median("oil_temperature"),
    )
