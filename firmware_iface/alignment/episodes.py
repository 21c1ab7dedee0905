"""Finds the tests in a recording by commands and status: where each begins, and how it ended."""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import replace

from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.bus_map import BusMap
from firmware_iface.codec import Decoded, DecodedTable
from firmware_iface.protection import NO_POSITION
from firmware_iface.recording import (
    MAX_GRID_TICKS,
    BitOutcome,
    BitReason,
    BitState,
    FloatArray,
    IntArray,
)

MIN_REPEATS = 2
"""Times a value must be told to count: a damaged frame whose check sum fits tells it once."""
START_SCATTER_TICKS = 20
"""Ticks by which the first tick that status frames imply may scatter."""
END_STATES = (BitState.COMPLETE, BitState.ABORTED)


class Episode(msgspec.Struct, frozen=True):
    """One test."""

    first: int
    """Tick of row 0."""
    ticks: int
    """Length; 0 if the test never ran."""
    test_id: int | None
    """None if the bus does not say."""
    serial: int | None
    outcome: BitOutcome
    ended: int | None = None
    """Row of the status frame that told of the end; None without one."""
    notes: tuple[str, ...] = ()
    """What a reader should know."""
    refused: tuple[str, ...] = ()
    """Why it is not one test on one unit."""


class _Span(msgspec.Struct, frozen=True):
    """Ticks of a test as one source tells them; `after` and `before` are the idle neighbours."""

    start: int
    stop: int
    test_id: int | None
    after: int | None = None
    before: int | None = None


def find_episodes(
    decoded: DecodedTable,
    axis: TickAxis | None,
    status: StatusTable,
    *,
    no_status_is_test: bool = True,
) -> tuple[Episode, ...]:
    """Find all tests, in order of time, refused ones (without ticks) among them.

    Command test ids bound a test exactly where its neighbours arrived; status frames tell the
    first tick where they did not. Frames with neither are one test if `no_status_is_test`.
    """
    running = np.flatnonzero((status.state == BitState.RUNNING) & np.isfinite(status.elapsed))
    running, second = main_time_base(status, running)
    spans: list[_Span] = []
    if axis is not None:
        spans = _spans_by_id(decoded, axis)
        spans = _merge(spans, _spans_by_status(status, running, axis))
        if not spans and no_status_is_test and _lacks_test_messages(decoded, status):
            spans = [_Span(int(axis.tick.min()), int(axis.tick.max()) + 1, None)]
    found = []
    for index, span in enumerate(spans):
        limit = spans[index + 1].start if index + 1 < len(spans) else None
        item = _episode(span, limit, status, axis)
        found.append(replace(item, refused=(*item.refused, second)) if second else item)
    found += _refusals(status, found)
    return tuple(sorted(found, key=lambda item: item.first)) if found else (_never_ran(status),)


def _lacks_test_messages(decoded: DecodedTable, status: StatusTable) -> bool:
    """Whether neither commands nor status could have told of a test."""
    command = decoded.messages.get(decoded.message_of.get("command.test_id", ""))
    commands = command is not None and len(command.row) > 0
    return not commands and len(status.row) == 0


def _spans_by_id(decoded: DecodedTable, axis: TickAxis) -> list[_Span]:
    name = decoded.message_of.get("command.test_id")
    if name is None or name not in axis.ticks:
        return []
    item = decoded.messages[name]
    tick, value = axis.ticks[name], item.values["command.test_id"]
    known = np.isfinite(value) & (tick > NO_POSITION // 2)
    order = np.argsort(tick[known], kind="stable")
    tick, ids = tick[known][order], value[known][order].astype(np.int64)
    runs = _runs(ids)
    spans = []
    for index, (begin, end) in enumerate(runs):
        test_id = int(ids[begin])
        if test_id == 0:
            continue
        after = int(tick[begin - 1]) if index > 0 else None
        before = int(tick[end]) if index + 1 < len(runs) else None
        spans.append(_Span(int(tick[begin]), int(tick[end - 1]) + 1, test_id, after, before))
    return spans


def _runs(ids: IntArray) -> list[tuple[int, int]]:
    """Begin and end of stretches of one id; blips inside a stretch belong to it."""
    if len(ids) == 0:
        return []
    edges = np.flatnonzero(np.diff(ids)) + 1
    bounds = [0, *edges.tolist(), len(ids)]
    runs: list[tuple[int, int]] = []
    index = 0
    while index + 1 < len(bounds):
        begin, end = bounds[index], bounds[index + 1]
        while (
            index + 3 < len(bounds)
            and bounds[index + 2] - bounds[index + 1] <= 2
            and ids[bounds[index + 2]] == ids[begin]
        ):
            index += 2
            end = bounds[index + 1]
        runs.append((begin, end))
        index += 1
    return runs


def _spans_by_status(status: StatusTable, running: IntArray, axis: TickAxis) -> list[_Span]:
    if len(running) == 0:
        return []
    start = status.start[running].astype(np.int64)
    cuts = np.flatnonzero(np.abs(np.diff(start)) > START_SCATTER_TICKS) + 1
    spans = []
    for group in np.split(np.arange(len(running)), cuts):
        first = _most_common(start[group])
        rows = running[group]
        stop = _stop(status, int(rows[-1]), first, axis)
        ids = status.test_id[rows]
        test_id = _most_common(ids) if np.any(ids >= 0) else None
        spans.append(_Span(first, stop, test_id))
    return spans


def _stop(status: StatusTable, last_running: int, first: int, axis: TickAxis) -> int:
    """One past the last tick of a test whose last running frame is given."""
    after = last_running + 1
    if after < len(status.row):
        if status.state[after] == BitState.COMPLETE and np.isfinite(status.elapsed[after]):
            return first + int(status.elapsed[after])
        return int(status.following[after])
    return int(axis.tick.max()) + 1


def _most_common(values: IntArray) -> int:
    unique, count = np.unique(values, return_counts=True)
    return int(unique[np.argmax(count)])


def _merge(by_id: list[_Span], by_status: list[_Span]) -> list[_Span]:
    """Ids lead; a run of one id with several starts is split; status alone stands in for ids."""
    merged: list[_Span] = []
    for span in by_id:
        inside = [
            item
            for item in by_status
            if item.stop - item.start > START_SCATTER_TICKS
            and span.start + START_SCATTER_TICKS < item.start < span.stop - START_SCATTER_TICKS
            and item.test_id in (None, span.test_id)
        ]
        edges = [span.start, *(item.start for item in inside), span.stop]
        for index in range(len(edges) - 1):
            first, last = index == 0, index == len(edges) - 2
            merged.append(
                replace(
                    span,
                    start=edges[index],
                    stop=edges[index + 1],
                    after=span.after if first else None,
                    before=span.before if last else None,
                )
            )
    for item in by_status:
        if not any(item.start < other.stop and other.start < item.stop for other in merged):
            merged.append(item)
    return sorted(merged, key=lambda item: item.start)


def _episode(span: _Span, limit: int | None, status: StatusTable, axis: TickAxis | None) -> Episode:
    notes: list[str] = []
    mine = _status_rows(span, limit, status)
    running = mine[(status.state[mine] == BitState.RUNNING) & np.isfinite(status.elapsed[mine])]
    first = span.start
    low = span.after + 1 if span.after is not None else None
    if len(running):
        stated = _most_common(status.start[running].astype(np.int64))
        first = min(stated, span.start) if low is None else min(max(stated, low), span.start)
        if abs(stated - first) > 2:
            apart = abs(stated - first)
            notes.append(f"status and command ids differ by {apart} ticks on the start")
    elif low is not None and low < span.start:
        notes.append(f"start of the test uncertain by {span.start - low} ticks")
    stop = span.stop
    outcome, final = _outcome(mine, status)
    if outcome.state is BitState.COMPLETE and final is not None and status.elapsed[final] > 0:
        stop = first + int(status.elapsed[final])
        if span.before is not None:
            stop = min(stop, span.before)
        if span.test_id is not None and abs(stop - span.stop) > 2 and span.before == span.stop:
            notes.append(f"status and command ids differ by {span.stop - stop} ticks on the end")
    elif span.before is None and axis is not None and limit is None and len(mine) == 0:
        stop = (
            max(stop, int(axis.tick.max()) + 1)
            if axis.tick.max() - stop < START_SCATTER_TICKS
            else stop
        )
    ticks = stop - first
    if ticks > MAX_GRID_TICKS:
        notes.append(f"test cut off at {MAX_GRID_TICKS} ticks")
        ticks = MAX_GRID_TICKS
    following = status.following[mine]
    inside = mine[(following > first) & (following <= stop)]
    refused, odd = contradictions(status, inside, final, first, stop, span.test_id)
    serials = status.serial[inside if len(inside) else mine]
    return Episode(
        first=first,
        ticks=max(ticks, 0),
        test_id=span.test_id,
        serial=_most_common(serials[serials >= 0]) if np.any(serials >= 0) else None,
        outcome=outcome,
        ended=int(status.row[final]) if final is not None and outcome.state in END_STATES else None,
        notes=(*notes, *_end_notes(status, outcome), *odd),
        refused=refused,
    )


NO_STATUS_NOTE = "no status frames: nothing says how the test ended"


def _end_notes(status: StatusTable, outcome: BitOutcome) -> tuple[str, ...]:
    """Note where nothing tells how a test ended."""
    if len(status.row) == 0:
        return (NO_STATUS_NOTE,)
    if outcome.state is BitState.RUNNING:
        return ("the status frame that tells of the test's end is missing",)
    return ()


def _status_rows(span: _Span, limit: int | None, status: StatusTable) -> IntArray:
    """Status frames of a test; its end may be told right before the first tick of the next."""
    mine = status.following >= span.start - START_SCATTER_TICKS
    if limit is not None:
        ended = (status.following == limit) & (status.state != BitState.RUNNING)
        mine &= (status.following < limit) | ended
    return np.flatnonzero(mine)


def _outcome(mine: IntArray, status: StatusTable) -> tuple[BitOutcome, int | None]:
    """How a test ended: the first end after it ran."""
    state = status.state[mine]
    begun = np.flatnonzero(state == BitState.RUNNING)
    begin = int(begun[0]) if len(begun) else 0
    ends = np.flatnonzero(np.isin(state, END_STATES) & (np.arange(len(state)) >= begin))
    if len(ends):
        final = int(mine[ends[0]])
        return BitOutcome(BitState(int(status.state[final])), _reason(status, final)), final
    if len(begun):
        return BitOutcome(BitState.RUNNING), None
    known = mine[state >= 0]
    if len(known):
        final = int(known[-1])
        return BitOutcome(BitState(int(status.state[final])), _reason(status, final)), final
    return BitOutcome(None), None


def _reason(status: StatusTable, index: int) -> BitReason:
    number = int(status.reason[index])
    return BitReason(number) if number in BitReason.__members__.values() else BitReason.NONE


def _refusals(status: StatusTable, ran: list[Episode]) -> list[Episode]:
    """Episodes without ticks: requests that were refused while no test ran."""
    refused = status.state == BitState.REFUSED
    begins = np.flatnonzero(refused & ~np.concatenate(([False], refused[:-1])))
    return [
        _without_ticks(status, int(index))
        for index in begins
        if not any(item.first <= status.following[index] <= item.first + item.ticks for item in ran)
    ]


def _never_ran(status: StatusTable) -> Episode:
    """One episode without ticks: the last state known."""
    known = np.flatnonzero(status.state >= 0)
    if len(known) == 0:
        return Episode(0, 0, None, None, BitOutcome(None))
    return _without_ticks(status, int(known[-1]))


def _without_ticks(status: StatusTable, index: int) -> Episode:
    test_id, serial = int(status.test_id[index]), int(status.serial[index])
    return Episode(
        first=int(status.following[index]),
        ticks=0,
        test_id=test_id if test_id > 0 else None,
        serial=serial if serial >= 0 else None,
        outcome=BitOutcome(BitState(int(status.state[index])), _reason(status, index)),
    )


def main_time_base(status: StatusTable, running: IntArray) -> tuple[IntArray, str]:
    """Running frames of one time base, and what a second one beside it means; empty for none.

    Each running frame implies the test's first tick. Tests that follow one another imply one after
    the other; two first ticks in turn come from two senders.

    status: all status frames, in columns; running: rows of `status` that say so and give the
    elapsed time. Returns rows of one time base, and the reason against the recording (empty: none).
    """
    start = status.start[running].astype(np.int64)
    order = np.argsort(start, kind="stable")
    cuts = np.flatnonzero(np.diff(start[order]) > START_SCATTER_TICKS) + 1
    groups = [np.sort(group) for group in np.split(order, cuts)]
    groups = sorted((group for group in groups if len(group) >= MIN_REPEATS), key=len, reverse=True)
    dropped = np.zeros(len(running), dtype=np.bool_)
    kept: list[IntArray] = []
    reason = ""
    for group in groups:
        beside = [
            other
            for other in kept
            if np.count_nonzero((group > other[0]) & (group < other[-1])) >= MIN_REPEATS
        ]
        if not beside:
            kept.append(group)
            continue
        dropped[group] = True
        apart = int(np.median(start[group]) - np.median(start[beside[0]]))
        reason = (
            "the status tells of two time bases in turn, their tests begun"
            f" {abs(apart)} ticks apart: a second sender of the status"
        )
    return running[~dropped], reason


def contradictions(
    status: StatusTable,
    inside: IntArray,
    final: int | None,
    first: int,
    stop: int,
    test_id: int | None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons why what was said is not of one test on one unit, and notes on single odd frames.

    status: all status frames, in columns; inside: rows of `status` between first and last tick;
    final: row that told of the end; None without one; first: ticks of the test; stop: see `first`;
    test_id: what the commands say; None: nothing. Returns reasons and notes, a sentence each.
    """
    counted = inside if final is None else np.append(inside[inside != final], final)
    reasons, notes = [], []
    for what, values, expected in (
        ("serial number", status.serial[counted], None),
        ("test number", _numbers(status, counted), test_id),
    ):
        reason, note = _one_value(what, values, expected, final is not None)
        reasons += [reason] * bool(reason)
        notes += [note] * bool(note)
    amidst = inside[
        (status.following[inside] > first + START_SCATTER_TICKS)
        & (status.following[inside] < stop - START_SCATTER_TICKS)
    ]
    for state in (BitState.IDLE, BitState.ARMING):
        count = int(np.count_nonzero(status.state[amidst] == state))
        if count >= MIN_REPEATS:
            reasons.append(f"the status says {state.name.lower()} {count} times amidst the test")
    if np.any(status.state[amidst] == BitState.REFUSED):
        notes.append("another request was refused while the test ran")
    if final is not None:
        later = np.arange(final + 1, len(status.row))
        same = np.abs(status.start[later] - first) <= START_SCATTER_TICKS
        count = int(np.count_nonzero((status.state[later] == BitState.RUNNING) & same))
        if count >= MIN_REPEATS:
            word = BitState(int(status.state[final])).name.lower()
            reasons.append(f"the status says that the test runs after it was {word}")
    return tuple(reasons), tuple(notes)


def _numbers(status: StatusTable, counted: IntArray) -> IntArray:
    """Test numbers of frames that speak of a test; -1 for the others."""
    speaks = np.isin(status.state[counted], (BitState.RUNNING, BitState.COMPLETE))
    return np.where(speaks, status.test_id[counted], -1)


def _one_value(what: str, values: IntArray, expected: int | None, ends: bool) -> tuple[str, str]:
    """Reason and note on a value that must not change; `ends`: the last frame weighs."""
    known = values[values >= 0]
    unique, count = np.unique(known, return_counts=True)
    if len(unique) == 0:
        return "", ""
    usual = int(unique[np.argmax(count)])
    if expected is not None and usual != expected:
        return f"commands say {what} {expected}, the status {usual}", ""
    odd = [int(value) for value, times in zip(unique, count, strict=True) if times >= MIN_REPEATS]
    odd = [value for value in odd if value != usual]
    last = int(values[-1])
    if ends and last >= 0 and last != usual and last not in odd:
        odd.append(last)
    if odd:
        # More changes to and fro: two senders in turn.
        if np.count_nonzero(np.diff(known[np.isin(known, [usual, *odd])])) > 2:
            return (
                f"the status tells {what} {usual} and {odd[0]} in turn: a second sender of the"
                " status"
            ), ""
        return f"the {what} changes within the test: {usual} and {odd[0]}", ""
    if len(unique) > 1:
        other = int(unique[unique != usual][0])
        return "", f"one status frame says {what} {other}, all others {usual}"
    return "", ""


MAX_HOLE_TICKS = 3
"""Ticks without a frame up to which the next frame still tells the present tick."""


class StatusTable(msgspec.Struct, frozen=True, eq=False):
    """Status frames as columns, shape (n,); NaN or -1 where the bus does not say."""

    row: IntArray
    """Row of the frame table."""
    state: IntArray
    """BitState, -1 unknown."""
    reason: IntArray
    """Numbers, -1 unknown."""
    test_id: IntArray
    serial: IntArray
    elapsed: FloatArray
    """Ticks, NaN unknown."""
    following: IntArray
    """Tick of the next telemetry or command frame."""

    @property
    def start(self) -> FloatArray:
        """First tick of the test that each frame implies."""
        return self.following - self.elapsed


def read_status(decoded: DecodedTable, axis: TickAxis | None, bus_map: BusMap) -> StatusTable:
    """Collect the status frames; the message that carries the state leads."""
    of = decoded.message_of
    lead = of.get("status.state") or of.get("status.elapsed", "")
    return _status_of(decoded.messages.get(lead), axis, bus_map)


def _status_of(item: Decoded | None, axis: TickAxis | None, bus_map: BusMap) -> StatusTable:
    count = 0 if item is None else len(item.row)

    def column(key: str) -> FloatArray:
        if item is None or f"status.{key}" not in item.values:
            return np.full(count, np.nan)
        return item.values[f"status.{key}"]

    def numbers(key: str) -> IntArray:
        return np.nan_to_num(column(key), nan=-1.0).astype(np.int64)

    raw = numbers("state")
    state = np.full(count, -1, dtype=np.int64)
    for number, meaning in bus_map.states.items():
        state[raw == number] = int(meaning)
    row = np.empty(0, dtype=np.int64) if item is None else item.row
    following = np.zeros(count, dtype=np.int64)
    if axis is not None and item is not None:
        following = _next_tick(axis, item, bus_map.tick_ns)
    return StatusTable(
        row=row,
        state=state,
        reason=numbers("reason"),
        test_id=numbers("test_id"),
        serial=numbers("serial"),
        elapsed=np.rint(column("elapsed") * 1e9 / bus_map.tick_ns),
        following=following,
    )


def _next_tick(axis: TickAxis, item: Decoded, tick_ns: int) -> IntArray:
    """Tick that begins after each status frame; by time where the frames around it are missing."""
    fraction, following = axis.at(item.row, item.time_ns, tick_ns)
    after = np.searchsorted(axis.row, item.row)
    before = np.maximum(after - 1, 0)
    hole = np.abs(following - axis.tick[before]) > MAX_HOLE_TICKS
    wait = axis.time_ns[np.minimum(after, len(axis.row) - 1)] - item.time_ns
    by_time = np.ceil(fraction).astype(np.int64)
    return np.where(
        hole & (after > 0) & (np.abs(wait) > MAX_HOLE_TICKS * tick_ns), by_time, following
    )


def resolve_turns(axis: TickAxis, status: StatusTable) -> TickAxis:
    """Take back counter turns that the elapsed time of a running test contradicts.

    Host time chooses the turns that a gap hides; a host clock that steps by nearly whole turns
    looks like a gap. The computer's own elapsed time tells them apart.
    """
    running = np.flatnonzero((status.state == BitState.RUNNING) & np.isfinite(status.elapsed))
    start, elapsed = status.start[running], status.elapsed[running]
    offset = np.diff(start)
    turns = np.rint(offset / max(axis.turn, 1))
    wrong = (turns != 0) & (np.abs(offset - axis.turn * turns) <= MAX_HOLE_TICKS)
    wrong &= (np.diff(elapsed) >= 0) & (np.diff(status.test_id[running]) == 0)
    if not axis.turn or not wrong.any():
        return axis
    tick = axis.tick.copy()
    shift_from: list[tuple[int, int]] = []
    for index in np.flatnonzero(wrong):
        low, high = np.searchsorted(axis.row, status.row[running[index : index + 2]])
        low = max(int(low), 1)
        if high < low:
            continue
        jumps = np.diff(axis.tick[low - 1 : high + 1])
        if len(jumps):
            place = low + int(np.argmax(np.abs(jumps)))
            shift_from.append((int(axis.row[place]), int(turns[index]) * axis.turn))
    ticks = dict(axis.ticks)
    for row, shift in shift_from:
        tick[axis.row >= row] -= shift
        ticks = {
            name: np.where(axis.rows[name] >= row, values - shift, values)
            for name, values in ticks.items()
        }
    note = "the computer's elapsed time took back a gap that the host clock suggested"
    return replace(axis, tick=tick, ticks=ticks, notes=(*axis.notes, note))
