"""Builds recordings of tests from frames: samples at their ticks, losses as NaN and counted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

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
from firmware_iface.alignment.bounds import Bounds
from firmware_iface.alignment.counts import count_frames, within
from firmware_iface.alignment.episodes import Episode, find_episodes
from firmware_iface.alignment.grid import CHANNEL_KEYS, Grid, modes_told, samples_of
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
OWN_STEP_K = 0.1
"""Resolution in which the computer says the oil temperature in degC (`Environment` of the DBC)."""
SAME = 1e-6
"""Distance, in such steps, within which two scales are the same."""
SEVERAL = 2
LOOKED_BESIDE = 100
"""Ticks around a test, as the status tells it, in which its command is looked for."""
MARGIN = 1000
"""Rows around a test in which late frames of messages without a counter are looked for."""


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
    bounds = Bounds.of(axis) if axis is not None else None
    looked_for = sought if axis is not None and not _says_when(decoded, axis, bus_map) else None
    margin = LOOKED_BESIDE if looked_for is not None else 0
    found: list[Recording] = []
    own = onboard_results(table, bus_map)
    for item, after in zip(episodes, (*episodes[1:], None), strict=True):

        def told(mode: CommandMode | None, item: Episode = item) -> Recording:
            return _recording(
                item, decoded, conflicts, bounds, bus_map, source, notes, len(table), margin, mode
            )

        if looked_for is None or bounds is None:
            these = [told(None)]
        else:
            modes = modes_told(_grid(item, decoded, bounds, bus_map, len(table), margin))
            these = _in_each_mode(told, modes, item, looked_for, margin)
        if own:
            said = _onboard_of(item, after, own, bounds, len(table))
            these = [replace(one, onboard=said) for one in these]
        found += these
    return tuple(found)


def _onboard_of(
    episode: Episode,
    after: Episode | None,
    found: list[tuple[int, OnboardResult]],
    bounds: Bounds | None,
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
    told: Callable[[CommandMode | None], Recording],
    modes: tuple[CommandMode, ...],
    episode: Episode,
    sought: Sought,
    margin: int,
) -> list[Recording]:
    """The tests in a stretch, each among the commands of its own mode."""
    if len(modes) < SEVERAL:
        return list(_looked_for(told(None), episode, sought, margin))
    found: list[Recording] = []
    for mode in modes:
        own = (
            CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
            for test in sought.tests
        )
        tests = tuple(test for test, its in zip(sought.tests, own, strict=True) if its is mode)
        others = len(tests) < len(sought.tests)
        part = replace(sought, tests=tests)
        found += _looked_for(told(mode), episode, part, margin, others=others)
    named = [item for item in found if item.test_id is not None]
    named.sort(key=lambda item: item.start_ns or 0)
    return named or found[:1]


def _says_when(decoded: DecodedTable, axis: TickAxis, bus_map: BusMap) -> bool:
    """Whether commands carry the test's number, or counters tell to which tick a status belongs."""
    command = bus_map.find("command.test_id")
    if command is not None and len(decoded.messages[command[0].name].row):
        return True
    status = bus_map.find("status.test_id")
    return bool(axis.turn) and status is not None and len(decoded.messages[status[0].name].row) > 0


def _looked_for(
    one: Recording, episode: Episode, sought: Sought, margin: int, *, others: bool = False
) -> tuple[Recording, ...]:
    """The tests in a stretch of samples that is wider by a margin than what the status said."""
    if one.samples is None:
        return (one,)
    known = tuple(test for test in sought.tests if one.test_id in (None, test.id))
    found = found_tests(
        one,
        replace(sought, tests=known),
        within=one.test_id is not None,
        before=margin,
        others=others,
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
    bounds: Bounds | None,
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
        environment=replace(_environment(decoded, begin, end), temperature_std=_rounding(bus_map)),
        quality=quality,
        channel=bus_map.channel,
        start_ns=_start_ns(samples),
        by_time=axis is not None and not axis.turn,
    )


def _grid(
    episode: Episode,
    decoded: DecodedTable,
    bounds: Bounds,
    bus_map: BusMap,
    rows: int,
    beside: int,
) -> Grid:
    """Grid of a test, wider by some ticks on either side."""
    begin, end = bounds.rows(episode, rows)
    wide = replace(episode, first=episode.first - beside, ticks=episode.ticks + 2 * beside)
    return Grid(wide, decoded, bounds.axis, bus_map, max(begin - MARGIN, 0), end + MARGIN)


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


def _rounding(bus_map: BusMap) -> float:
    """What rounding the oil temperature to the bus's scale does, K; 0 of the computer's own."""
    found = bus_map.find("environment.oil_temperature")
    if found is None or found[1].signal.is_float:
        return 0.0
    role = found[1]
    step = abs(role.signal.scale * role.gain)
    zero = (role.gain * role.signal.offset + role.bias) / OWN_STEP_K
    own = abs(step / OWN_STEP_K - 1.0) < SAME and abs(zero - round(zero)) < SAME
    # A rig that holds 40 °C is off by the same half step, 0.05 K of 313.1 or 313.2 K, every day.
    return 0.0 if own else 0.5 * step
