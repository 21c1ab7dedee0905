"""Builds recordings of tests from frames: samples at their ticks, losses as NaN and counted.

A long stream is cut into windows that split no test, so that memory stays constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.episodes import Episode, find_episodes, read_status, resolve_turns
from firmware_iface.alignment.frame_faults import (
    Conflicts,
    count_frames,
    count_within,
    crowding_reason,
    drop_conflicts,
    judge_frames,
    second_sender_reasons,
    slow_values,
)
from firmware_iface.alignment.grid import (
    RowBounds,
    TickGrid,
    command_modes,
    samples_of,
)
from firmware_iface.alignment.ticks import TickAxis, place_frames
from firmware_iface.bus_map import BusMap
from firmware_iface.codec import DecodedTable, channels_in, choose_channel, decode
from firmware_iface.find_test import CandidateTests, extract_tests, rows_of_samples
from firmware_iface.live_decode import OnboardReader
from firmware_iface.protection import rows_of
from firmware_iface.recording import (
    ACTIVE_BIT_STATES,
    CHANNEL_NAMES,
    BitOutcome,
    CommandMode,
    Environment,
    IntArray,
    OnboardResult,
    Quality,
    Recording,
    Samples,
)
from firmware_iface.transport.frames import FrameTable, concatenate

MIN_STUCK_FRAMES = 20
LATE_FRAME_MARGIN_ROWS = 1000
"""Rows around a test in which late frames of messages without a counter are looked for."""


def assemble(
    table: FrameTable,
    bus_map: BusMap,
    source: str,
    notes: tuple[str, ...] = (),
    *,
    channels: frozenset[int] | None = None,
    no_status_is_test: bool = True,
    candidates: CandidateTests | None = None,
) -> tuple[Recording, ...]:
    """All tests in a frame table, at least one recording (without samples if none ran).

    table: frames in order of arrival; source: file or bus, for reports; notes: facts known before
    decoding; channels: adapter channels on which the actuator's frames came so far; None: in this
    table; no_status_is_test: take frames without command and status for one test; candidates: what
    to look for where the bus does not say when which test ran; None: all that is recorded is one
    test.
    """
    present = channels_in(table, bus_map) if channels is None else channels
    channel, ambiguous = choose_channel(bus_map.channel, present)
    if ambiguous:
        quality = Quality(notes=notes, refused=(ambiguous,))
        return (Recording(source, None, None, None, BitOutcome(), Environment(), quality),)
    bus_map = replace(bus_map, channel=channel)
    decoded = decode(table, bus_map)
    axis = place_frames(decoded, bus_map.tick_ns)
    decoded, axis, conflicts = drop_conflicts(decoded, axis)
    status = read_status(decoded, axis, bus_map)
    if axis is not None and (mended := resolve_turns(axis, status)) is not axis:
        axis, status = mended, read_status(decoded, mended, bus_map)
    notes += _protection_notes(bus_map)
    if axis is None:
        notes += ("no telemetry in the recording",)
    else:
        notes += axis.notes
    episodes = find_episodes(decoded, axis, status, no_status_is_test=no_status_is_test)
    bounds = RowBounds.of(axis) if axis is not None else None
    looked_for = candidates if axis is not None and not _has_test_timing(decoded, axis) else None
    # Ticks around a test, as the status has it, in which its command is looked for.
    margin = 100 if looked_for is not None else 0
    found: list[Recording] = []
    own = onboard_results(table, decoded.onboard, bus_map)
    for item, after in zip(episodes, (*episodes[1:], None), strict=True):

        def cut(mode: CommandMode | None, item: Episode = item) -> Recording:
            return _recording(
                item, decoded, conflicts, bounds, bus_map, source, notes, len(table), margin, mode
            )

        if looked_for is None or bounds is None:
            these = [cut(None)]
        else:
            modes = command_modes(_grid(item, decoded, bounds, bus_map, len(table), margin))
            these = _in_each_mode(cut, modes, item, looked_for, margin)
        if own:
            onboard = _onboard_of(item, after, own, bounds, len(table))
            these = [replace(one, onboard=onboard) for one in these]
        found += these
    return tuple(found)


def _onboard_of(
    episode: Episode,
    after: Episode | None,
    found: list[tuple[int, OnboardResult]],
    bounds: RowBounds | None,
    rows: int,
) -> OnboardResult | None:
    """What the computer found between a test and the one after it, of that test."""
    if bounds is None or episode.ticks == 0:
        return None
    begin = bounds.rows(episode, rows)[1]
    end = rows if after is None or after.ticks == 0 else bounds.rows(after, rows)[0]
    between = (item for row, item in found if begin <= row < end)
    return next((item for item in between if item.is_of(episode.test_id)), None)


def _in_each_mode(
    cut: Callable[[CommandMode | None], Recording],
    modes: tuple[CommandMode, ...],
    episode: Episode,
    candidates: CandidateTests,
    margin: int,
) -> list[Recording]:
    """The tests in a stretch, each among the commands of its own mode."""
    if len(modes) < 2:
        return list(_matched_in(cut(None), episode, candidates, margin))
    found: list[Recording] = []
    for mode in modes:
        tests = tuple(test for test in candidates.tests if test.command_mode is mode)
        others = len(tests) < len(candidates.tests)
        part = replace(candidates, tests=tests)
        found += _matched_in(cut(mode), episode, part, margin, others=others)
    named = [item for item in found if item.test_id is not None]
    named.sort(key=lambda item: item.start_ns or 0)
    return named or found[:1]


def _has_test_timing(decoded: DecodedTable, axis: TickAxis) -> bool:
    """Whether commands carry the test's number, or counters tell to which tick a status belongs."""
    command, status = (
        decoded.messages.get(decoded.message_of.get(role, ""))
        for role in ("command.test_id", "status.test_id")
    )
    if command is not None and len(command.row):
        return True
    return bool(axis.turn) and status is not None and len(status.row) > 0


def _matched_in(
    one: Recording,
    episode: Episode,
    candidates: CandidateTests,
    margin: int,
    *,
    others: bool = False,
) -> tuple[Recording, ...]:
    """The tests in a stretch of samples that is wider by a margin than what the status said."""
    if one.samples is None:
        return (one,)
    known = tuple(test for test in candidates.tests if one.test_id in (None, test.id))
    found = extract_tests(
        one,
        replace(candidates, tests=known),
        within=one.test_id is not None,
        before=margin,
        others=others,
    )
    if found[0].samples is one.samples:
        cut = rows_of_samples(one.samples, margin, margin, episode.ticks)
        return tuple(replace(item, samples=cut, start_ns=_start_ns(cut)) for item in found)
    return found


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
    bounds: RowBounds | None,
    bus_map: BusMap,
    source: str,
    notes: tuple[str, ...],
    rows: int,
    beside: int = 0,
    mode: CommandMode | None = None,
) -> Recording:
    begin, end = bounds.rows(episode, rows) if bounds is not None else (0, rows)
    axis = bounds.axis if bounds is not None else None
    extra: list[str] = []
    samples = None
    if bounds is not None and episode.ticks > 0:
        grid = _grid(episode, decoded, bounds, bus_map, rows, beside)
        samples, extra = samples_of(grid, mode)
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
    crowds = (
        crowding_reason(item, bus_map.tick_ns, begin, end) for item in decoded.messages.values()
    )
    environment, mixed = _environment(decoded, begin, end, episode.ticks * bus_map.tick_ns)
    refused = (
        *second_sender_reasons(counts, conflicts, bus_map, begin, end),
        *mixed,
        *filter(None, crowds),
        *episode.refused,
        *refused,
    )
    quality = Quality(
        messages=counts,
        saturated=_saturated(samples),
        foreign=count_within(decoded.foreign, begin, end),
        error_frames=count_within(decoded.errors, begin, end),
        notes=(*notes, *episode.notes, *extra, *used),
        refused=refused,
    )
    return Recording(
        source=source,
        samples=samples,
        test_id=episode.test_id,
        serial=episode.serial,
        outcome=episode.outcome,
        environment=replace(
            environment,
            temperature_std=_rounding_std(decoded, "oil_temperature"),
            supply_std=_rounding_std(decoded, "supply_pressure", "return_pressure"),
        ),
        quality=quality,
        channel=bus_map.channel,
        start_ns=_start_ns(samples),
        by_time=axis is not None and not axis.turn,
    )


def _grid(
    episode: Episode,
    decoded: DecodedTable,
    bounds: RowBounds,
    bus_map: BusMap,
    rows: int,
    beside: int,
) -> TickGrid:
    """Grid of a test, wider by some ticks on either side."""
    begin, end = bounds.rows(episode, rows)
    wide = replace(episode, first=episode.first - beside, ticks=episode.ticks + 2 * beside)
    return TickGrid(
        wide,
        decoded,
        bounds.axis,
        bus_map,
        max(begin - LATE_FRAME_MARGIN_ROWS, 0),
        end + LATE_FRAME_MARGIN_ROWS,
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
        if still.sum() >= MIN_STUCK_FRAMES:
            notes.append(f"{name}: the counter stands still in {int(still.sum())} frames")
    return notes


def _saturated(samples: Samples | None) -> dict[str, int]:
    if samples is None:
        return {}
    return {key: int(samples.saturated[index].sum()) for index, key in enumerate(CHANNEL_NAMES)}


def _environment(
    decoded: DecodedTable, begin: int, end: int, span_ns: int
) -> tuple[Environment, tuple[str, ...]]:
    """Oil and supply of a test, and why they are not of one sender."""
    medians: dict[str, float] = {}
    reasons: list[str] = []
    for item in decoded.messages.values():
        values, mixed = slow_values(item, begin, end, span_ns)
        reasons += mixed
        for role, value in values.items():
            sound = value[np.isfinite(value)]
            if len(sound):
                medians[role.removeprefix("environment.")] = float(np.median(sound))
    return Environment(**medians), tuple(reasons)


def _rounding_std(decoded: DecodedTable, *quantities: str) -> float:
    """Standard deviation of the sum of quantities of the environment by their steps on the bus.

    SI, or K; each is off evenly by half a step at most.
    """
    wanted = {f"environment.{name}" for name in quantities}
    roles = (role for item in decoded.messages.values() for role in item.message.roles)
    steps = (
        role.signal.scale * role.gain
        for role in roles
        if role.name in wanted and not role.signal.is_float
    )
    return math.hypot(*steps) / math.sqrt(12.0)


MIN_WINDOW_FRAMES = 200_000
"""Frames from which on a window is closed where no test runs: two minutes of the default bus."""


def windowed_recordings(
    tables: Iterable[FrameTable],
    bus_map: BusMap,
    source: str,
    held: int,
    least: int = MIN_WINDOW_FRAMES,
    candidates: CandidateTests | None = None,
) -> Iterator[Recording]:
    """Tests of a stream of frames in order of time; one recording without samples if there is none.

    tables: blocks of frames in order of arrival; bus_map: what they mean; source: file or bus, for
    reports; held: frames that a window may have at most; a test beyond that is cut, and said to be;
    least: frames from which on a window is closed where no test runs; candidates: what to look for
    where the bus does not say when which test ran. Yields each test as soon as it is complete.
    """
    reading = _WindowReader(bus_map, source, candidates)
    empty: Recording | None = None
    found = False
    for window, cut in _windows(tables, reading, held, least):
        for recording in reading.recordings(window, cut):
            if recording.samples is not None or recording.test_id is not None:
                found = True
                yield recording
            elif (
                empty is None or empty.outcome.state is None or recording.outcome.state is not None
            ):
                empty = recording
    if not found and empty is not None:
        yield empty


def _windows(
    tables: Iterable[FrameTable], reading: _WindowReader, held: int, least: int
) -> Iterator[tuple[FrameTable, bool]]:
    """Windows, and whether one was cut for its length."""
    pending: list[FrameTable] = []
    size, look_at = 0, least
    for table in tables:
        pending.append(table)
        size += len(table)
        if size < look_at:
            continue
        window = concatenate(pending)
        end = reading.quiet_row(window)
        if end:
            yield window.rows(slice(0, end)), False
            pending, size, look_at = [window.rows(slice(end, None))], size - end, least
        elif size >= held:
            yield window, True
            pending, size, look_at = [], 0, least
        else:
            pending, look_at = [window], min(2 * size, held)
    if size:
        yield concatenate(pending), False


class _WindowReader:
    """What is known of a recording from the windows read so far."""

    def __init__(
        self, bus_map: BusMap, source: str, candidates: CandidateTests | None = None
    ) -> None:
        self._map = bus_map
        self._candidates = candidates
        self._source = source
        self._has_timing = False
        self._channels: frozenset[int] = frozenset()
        telling = ("command.test_id", "status.state")
        messages = {
            name: replace(item, roles=tuple(role for role in item.roles if role.name in telling))
            for name, item in bus_map.messages.items()
        }
        self._telling = replace(
            bus_map, messages={name: item for name, item in messages.items() if item.roles}
        )

    def recordings(self, window: FrameTable, cut: bool) -> tuple[Recording, ...]:
        """Tests of a window."""
        self._channels |= channels_in(window, self._map)
        notes = (f"cut off at {len(window)} frames, the most that are held at once",) if cut else ()
        return assemble(
            window,
            self._map,
            self._source,
            notes,
            channels=self._channels,
            no_status_is_test=not self._has_timing,
            candidates=self._candidates,
        )

    def quiet_row(self, window: FrameTable) -> int:
        """Row at which a window may end: amidst the longest stretch of its second half without a
        test, or where only foreign frames came; 0 if there is none."""
        test_rows = self._rows_of_a_test(window)
        half = len(window) // 2
        test_rows = test_rows[test_rows >= half]
        edges = np.concatenate(([half], test_rows, [len(window)]))
        quiet = np.diff(edges)
        longest = int(quiet.argmax())
        # Half a second or less.
        if quiet[longest] < 1000:
            return 0
        return int(edges[longest] + quiet[longest] // 2)

    def _rows_of_a_test(self, window: FrameTable) -> IntArray:
        decoded = decode(window, self._telling)
        rows: list[IntArray] = []
        for item in decoded.messages.values():
            self._has_timing |= len(item.row) > 0
            for role, value in item.values.items():
                if role == "command.test_id":
                    rows.append(item.row[value > 0])
                else:
                    active = [
                        key for key, state in self._map.states.items() if state in ACTIVE_BIT_STATES
                    ]
                    rows.append(item.row[np.isin(value, active)])
        if not self._has_timing:
            # Without commands and status all that is recorded is one test.
            measured = (item for item in self._map.messages.values() if item.measures)
            rows += [rows_of(window, item) for item in measured]
        return np.sort(np.concatenate(rows)) if rows else np.empty(0, dtype=np.int64)


def onboard_results(
    table: FrameTable, rows: IntArray, bus_map: BusMap
) -> list[tuple[int, OnboardResult]]:
    """Find all results of the computer in a frame table.

    table: frames in order of arrival; rows: of those that it may consist of; bus_map: what they
    mean. Returns the row at which each was whole, ascending, and the result.
    """
    if not len(rows):
        return []
    reader, found = OnboardReader(bus_map), []
    before = None
    for row in rows.tolist():
        payload = table.data[row, : table.length[row]].tobytes()
        reader.take_payload(int(table.can_id[row]), bool(table.extended[row]), payload)
        if reader.result is not before:
            before = reader.result
            if before is not None:
                found.append((row, before))
    return found
