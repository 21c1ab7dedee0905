"""Reads the tests of a recording, be it frames or decoded signals, in one file or more.

Decoded signals are resampled to control ticks and matched with the stored tests.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.align import windowed_recordings
from firmware_iface.alignment.grid import live_ticks
from firmware_iface.bus_map import BusMap
from firmware_iface.errors import ConfigurationError
from firmware_iface.find_test import (
    CandidateTests,
    extract_tests,
    match_test,
    search_tests,
)
from firmware_iface.logs.log_files import Budget, holds_signals
from firmware_iface.logs.reader import iterate_recordings, read_frames, with_notes
from firmware_iface.recording import (
    CHANNELS,
    MAX_GRID_TICKS,
    Acquisition,
    BitOutcome,
    BitState,
    CommandMode,
    Environment,
    FloatArray,
    Quality,
    RecordedSignal,
    Recording,
    Samples,
    sampling_interval,
)
from firmware_iface.signals.clock import fit_clock
from firmware_iface.signals.columns import NEEDED_COLUMN_ROLES, ColumnMap
from firmware_iface.signals.held import bus_signals, held_by_test
from firmware_iface.signals.resample import (
    TickClock,
    held_on_ticks,
    is_held,
    on_ticks,
    usual_lead,
)
from firmware_iface.signals.tables import join_tables, read_signals
from firmware_iface.transport.frames import FrameTable, concatenate

MEASURED_ROLES = ("channels.spool", "channels.pressure", "channels.position")


def recordings_of_signals(
    paths: Sequence[Path | str], columns: ColumnMap, candidates: CandidateTests, budget: Budget
) -> tuple[Recording, ...]:
    """Read the tests in one recording of decoded signals.

    paths: its files: one, or several that follow or complete one another. Returns at least one;
    without a test number where no stored test was found. InputOutputError: a file cannot be read;
    ConfigurationError: a column is missing, or has a unit that is none of its quantity.
    """
    signals, start, readings = _read_signals(paths, columns, candidates, budget)
    source = ", ".join(str(path) for path in paths)
    found = [
        extract_tests(_on_ticks(signals, item, columns.tick_ns, start, source), candidates)
        for item in readings
    ]
    if len(found) == 1 or len(found[0]) != len(found[1]):
        return found[0]
    return tuple(replace(first, as_measured=other) for first, other in zip(*found, strict=True))


DecodedItem: TypeAlias = tuple[float, float, float, float, float] | Environment | CommandMode
"""A control tick, as `LiveTick`; or oil and supply, or what commands are, from the next one on."""


def decoded_items(
    path: Path | str, columns: ColumnMap, candidates: CandidateTests, budget: Budget
) -> tuple[Recording, Iterator[DecodedItem]]:
    """Read a whole recording of decoded signals, tests and the time between them, tick by tick.

    Arguments and errors: see `recordings_of_signals`. Returns all of it on ticks, and what comes
    one after another.
    """
    # What comes near a test in other motion would set a wrong clock.
    search = replace(candidates, tests=())
    signals, start, readings = _read_signals([path], columns, search, budget)
    clock = readings[0].clock
    whole = _on_ticks(signals, readings[0], columns.tick_ns, start, str(path))
    assert whole.samples is not None
    held_values = {
        key: item.value[np.maximum(np.searchsorted(item.time, clock.begin, side="right") - 1, 0)]
        for key in ("supply_pressure", "return_pressure", "oil_temperature")
        if (item := signals.get(f"environment.{key}")) is not None
    }
    samples = whole.samples

    def items() -> Iterator[DecodedItem]:
        last = Environment()
        yield samples.mode
        for tick, row in enumerate(live_ticks(samples)):
            now = Environment(**{key: float(value[tick]) for key, value in held_values.items()})
            if now != last:
                last = now
                yield now
            yield row

    return whole, items()


def _read_signals(
    paths: Sequence[Path | str], columns: ColumnMap, candidates: CandidateTests, budget: Budget
) -> tuple[dict[str, RecordedSignal], float, list[TickReading]]:
    """Signals by role, when the first begins, and the ways to put them on ticks."""
    alone = len(paths) == 1
    signals = join_tables(read_signals(path, columns, budget, complete=alone) for path in paths)
    source = ", ".join(str(path) for path in paths)
    lacking = [role for role in NEEDED_COLUMN_ROLES if role not in signals]
    if lacking:
        raise ConfigurationError(f"log {source}: no column for {', '.join(lacking)}")
    period = columns.tick_ns * 1e-9
    start = min(item.time[0] for item in signals.values())
    held = held_on_ticks(signals, period)
    if held is not None and any(role in held[1] for role in MEASURED_ROLES):
        clock, rows = held
        rate = float(np.mean(np.diff(clock.begin))) / period - 1.0
        note = f"ticks by the changes of held signals ({1e6 * rate:+.0f} ppm)"
        readings = [TickReading(clock, rows, None, note)]
    else:
        readings = _readings(signals, period, candidates, start)
    return signals, start, readings


class TickReading(msgspec.Struct, frozen=True):
    """One way to put signals on ticks."""

    clock: TickClock
    held: Mapping[str, FloatArray]
    """Values that a bus held, on them, by role."""
    acquired: Acquisition | None
    """How others were measured."""
    note: str
    """What showed the ticks."""


def _on_ticks(
    signals: Mapping[str, RecordedSignal],
    reading: TickReading,
    tick_ns: int,
    start: float,
    source: str,
) -> Recording:
    """All that was recorded, on ticks."""
    clock = reading.clock
    samples, rules = _samples(signals, reading.held, clock, tick_ns, start, reading.acquired)
    jitter = max(item.jitter for item in signals.values())
    even = (
        f"time stamps jitter by {1e3 * jitter:.2g} ms: the rows' own even clock takes their place"
    )
    evened = (even,) if jitter > 0.0 else ()
    cut = _cut_off(signals, clock)
    notes = ("decoded signals: no check sum, no counter", *evened, *cut, reading.note, *rules)
    return Recording(
        source=source,
        samples=samples,
        test_id=None,
        serial=None,
        outcome=BitOutcome(),
        environment=_environment(signals),
        quality=Quality(notes=notes),
        start_ns=round((clock.begin[0]) * 1e9),
        by_time=True,
    )


def _readings(
    signals: Mapping[str, RecordedSignal], period: float, candidates: CandidateTests, start: float
) -> list[TickReading]:
    """Ways to put signals on the ticks of a test, the likelier first."""
    first = max(signals[role].time[0] for role in NEEDED_COLUMN_ROLES)
    last = min(signals[role].time[-1] for role in NEEDED_COLUMN_ROLES)
    ticks = min(max(int((last - first) / period), 1), MAX_GRID_TICKS)
    even = TickClock.even(first, period, ticks)
    samples, _ = _samples(signals, {}, even, round(period * 1e9), first)
    found = match_test(samples, candidates.tests, candidates.controller)
    begin = None if found is None else first + found.first * period
    fitted = None
    if found is not None and begin is not None:
        fitted = fit_clock(signals, begin, period, found, candidates.controller)
    if fitted is None:
        unsure = "nothing shows where in a tick the signals were sampled: half a tick unsure"
        return [TickReading(even, {}, None, unsure)]
    length = period * (1.0 + fitted.rate)
    before = math.floor((fitted.begin - first) / length)
    begins = fitted.begin + length * (np.arange(ticks + 1) - before)
    clock = TickClock(begins[begins <= last + length])
    readings: list[TickReading] = []
    held = bus_signals(signals, period)
    # A late command misfits; it is judged again once it is placed.
    tests, _ = search_tests(samples, candidates, most=0.25)
    if held and tests:
        placed = held_by_test(held, clock, tests, candidates.controller)
        if placed is not None:
            late = placed.late * period * 1e3
            note = (
                f"values reach the logger late by {late:.1f} ms rms, some overtaken:"
                " the current against the test's command tells their ticks"
            )
            readings.append(TickReading(placed.clock, placed.rows, None, note))
            if any(is_held(item, period) for item in held.values()):
                return readings
    leader = signals["channels.spool"]
    acquired = Acquisition(
        1.0 / sampling_interval(leader),
        usual_lead(leader, clock, period),
        fitted.std,
        fitted.rate_std,
        tuple(
            replace(item, time=item.time - start)
            for item in (signals[f"channels.{channel.name}"] for channel in CHANNELS[1:])
        ),
    )
    note = (
        f"ticks by the {fitted.by}, of test {found.test.name!r}"
        f" ({1e6 * fitted.rate:+.0f} ppm; within {1e3 * fitted.std:.2g} ms)"
    ) if found else ""  # fmt: skip
    return [*readings, TickReading(clock, {}, acquired, note)]


def _cut_off(signals: Mapping[str, RecordedSignal], clock: TickClock) -> tuple[str, ...]:
    """Say where more was recorded than is looked at."""
    left = min(signals[role].time[-1] for role in NEEDED_COLUMN_ROLES) - float(clock.begin[-1])
    if clock.ticks < MAX_GRID_TICKS or left <= 0.0:
        return ()
    seen = float(clock.begin[-1] - clock.begin[0])
    return (f"the first {seen:.0f} s are looked at, the {left:.0f} s behind them are not",)


def _samples(
    signals: Mapping[str, RecordedSignal],
    held: Mapping[str, FloatArray],
    clock: TickClock,
    tick_ns: int,
    start: float,
    acquired: Acquisition | None = None,
) -> tuple[Samples, tuple[str, ...]]:
    """All signals on the ticks, and the rules by which they came there."""
    ticks, period = clock.ticks, tick_ns * 1e-9
    lead = 0.0 if acquired is None else acquired.lead
    empty = np.full(ticks, np.nan)
    filled: dict[str, FloatArray] = {}
    rules: dict[str, list[str]] = {}
    for channel in CHANNELS:
        key = channel.name
        signal = signals.get(f"channels.{key}")
        if signal is None:
            filled[key] = empty
            rules.setdefault("not recorded", []).append(key)
            continue
        if f"channels.{key}" in held:
            filled[key], rule = held[f"channels.{key}"], "values as held, by their changes"
        else:
            # The computer holds the current through a tick, whoever measures it.
            filled[key], rule = on_ticks(signal, clock, period, hold=key == "current", lead=lead)
        rules.setdefault(f"{1.0 / sampling_interval(signal):.0f} Hz, {rule}", []).append(key)
    mode, command = CommandMode.CURRENT, empty
    for mode_of, role in (
        (CommandMode.POSITION, "command.position"),
        (CommandMode.CURRENT, "command.current"),
    ):
        item = signals.get(role)
        if item is not None and np.ptp(item.value) > 0.0:
            mode = mode_of
            command = held[role] if role in held else on_ticks(item, clock, period, hold=True)[0]
            break
    samples = Samples(
        period_ns=tick_ns,
        mode=mode,
        current=filled["current"],
        spool=filled["spool"],
        pressure=filled["pressure"],
        position=filled["position"],
        command=command,
        saturated=np.zeros((len(CHANNELS), ticks), dtype=np.bool_),
        host_ns=np.rint((clock.begin[:-1] - start) * 1e9).astype(np.int64),
        acquired=acquired,
    )
    return samples, tuple(f"{', '.join(keys)}: {rule}" for rule, keys in rules.items())


def _environment(signals: Mapping[str, RecordedSignal]) -> Environment:
    def median(key: str) -> float | None:
        item = signals.get(f"environment.{key}")
        return float(np.median(item.value)) if item is not None and len(item.value) else None

    return Environment(
        supply_pressure=median("supply_pressure"),
        return_pressure=median("return_pressure"),
        oil_temperature=median("oil_temperature"),
    )


class Interpretation(msgspec.Struct, frozen=True):
    """What the content of recordings means."""

    bus_map: BusMap
    """Of frames."""
    columns: ColumnMap | None
    """Of decoded signals; None: none are mapped, and they go by their usual names."""
    candidates: CandidateTests
    """What to look for where nothing says which test ran when."""


def recorded_tests(
    paths: Sequence[Path | str], meaning: Interpretation, budget: Budget | None = None
) -> Iterator[Recording]:
    """Read the tests of one recording, in order of time.

    paths: its files: one; or several, split in time or one for each bus; meaning: mapping and
    tests; budget: what reading may cost; None: the default. Yields each test; where there is none,
    one recording with the reason. InputOutputError: a file cannot be read; ConfigurationError:
    unknown kind of log, unfit mapping, frames and signals in one recording.
    """
    idle, found = None, False
    for item in _stretches(paths, meaning, budget or Budget()):
        # What no stored test fits, and no status calls a test, is the time between tests.
        if item.test_id is None and item.outcome.state is None and not item.quality.refused:
            idle = item if idle is None or item.samples is not None else idle
        else:
            yield item
            found = True
    if not found and idle is not None:
        yield idle


def _stretches(
    paths: Sequence[Path | str], meaning: Interpretation, budget: Budget
) -> Iterator[Recording]:
    """What one recording holds, tests and the time between them."""
    mapped = meaning.columns is not None
    decoded = [holds_signals(path, mapped=mapped) for path in paths]
    if any(decoded):
        if not all(decoded):
            odd = paths[decoded.index(False)]
            raise ConfigurationError(f"log {odd}: holds frames, the others decoded signals")
        columns = meaning.columns or ColumnMap(tick_ns=meaning.bus_map.tick_ns)
        yield from recordings_of_signals(paths, columns, meaning.candidates, budget)
    elif len(paths) == 1:
        yield from iterate_recordings(paths[0], meaning.bus_map, budget, meaning.candidates)
    else:
        table = _merged_frames([read_frames(path, budget) for path in paths])
        source = ", ".join(str(path) for path in paths)
        yield from windowed_recordings(
            [table], meaning.bus_map, source, len(table) + 1, candidates=meaning.candidates
        )


def _merged_frames(tables: Sequence[FrameTable]) -> FrameTable:
    """Frames of several files in order of their stamps; each file keeps its own order at a tie.

    Loggers number the adapter channels of each file anew: the mapping's identifiers tell the
    messages apart.
    """
    whole = concatenate(tables)
    # A stamp that goes back within a file does not break the file's order.
    steady = np.concatenate([np.maximum.accumulate(table.time_ns) for table in tables])
    order = np.argsort(steady, kind="stable")
    channel = np.zeros(len(order), dtype=whole.channel.dtype)
    return replace(whole.rows(order), channel=channel)


MAX_LISTED_TESTS = 3
"""Tests passed over that are told one by one."""


def read_recording(
    path: Path | str,
    bus_map: BusMap | None = None,
    budget: Budget | None = None,
    candidates: CandidateTests | None = None,
) -> Recording:
    """Read the last complete test of a log; the last one begun if none was completed.

    Its notes say what was passed over. Where tests lie on several adapter channels and none was
    chosen, it is refused.
    """
    return choose_recording(iterate_recordings(path, bus_map, budget, candidates))


def choose_recording(recordings: Iterable[Recording]) -> Recording:
    """Return the last complete test, or the last with samples, or the last.

    Its notes name the other tests. Only the best so far is held.

    Parameters
    ----------
    recordings : Iterable[Recording]
        Tests of one log, in order of time.

    Returns
    -------
    Recording
        The chosen one, with notes on the others.

    Raises
    ------
    ValueError
        No recording at all.
    """
    best: Recording | None = None
    place = 0
    others: dict[int, str] = {}
    channels: set[int] = set()
    for number, item in enumerate(recordings, start=1):
        if item.samples is not None and item.channel:
            channels.add(item.channel)
        if best is not None and _completeness(item) < _completeness(best):
            others[number] = describe_recording(item, number)
            continue
        if best is not None:
            others[place] = describe_recording(best, place)
        best, place = item, number
    if best is None:
        raise ValueError("no recording to choose from")
    listed = sorted(others)[-MAX_LISTED_TESTS:]
    notes = tuple(f"passed over: {others[number]}" for number in listed)
    if len(others) > MAX_LISTED_TESTS:
        notes = (
            f"{len(others) - MAX_LISTED_TESTS} earlier tests of the recording passed over",
            *notes,
        )
    best = with_notes(best, notes)
    return _refused(best, sorted(channels)) if len(channels) > 1 else best


def _completeness(item: Recording) -> int:
    if item.samples is None:
        return 0
    return 2 if item.outcome.state is BitState.COMPLETE else 1


def _refused(item: Recording, channels: Sequence[int]) -> Recording:
    listed = ", ".join(map(str, channels))
    why = f"tests on the adapter channels {listed}: choose the actuator's by --log-channel"
    return replace(item, quality=replace(item.quality, refused=(*item.quality.refused, why)))


def describe_recording(item: Recording, number: int) -> str:
    """A test of a log in one clause: number, length, outcome, serial number, channel."""
    state = item.outcome.state
    how = "how it ended is not said" if state is None else state.name.lower().replace("_", " ")
    if state is BitState.RUNNING:
        how = "without the word of its end"
    test = "unnamed" if item.test_id is None else str(item.test_id)
    length = "" if item.samples is None else f", {item.duration:.3f} s"
    serial = "" if item.serial is None else f", serial {item.serial}"
    channel = f", channel {item.channel}" if item.channel else ""
    return f"test {test} (no. {number} of the recording{length}{serial}{channel}): {how}"
