"""Decides which frames are valid: length, CRC, sequence counter, two senders of one identifier.

The counter is unwrapped beyond its range.
"""

from __future__ import annotations

import struct
from collections import OrderedDict

import msgspec
import numpy as np
from numpy.typing import NDArray

from firmware_iface.bus_map import MessageMap
from firmware_iface.recording import BoolArray, FloatArray, IntArray
from firmware_iface.transport.frames import FrameTable

CRC_INITIAL = 0xFF
CRC_FINAL_XOR = 0xFF
"""Check sums by name. `crc8-j1850-id`: CRC-8 SAE J1850 over the low byte of the identifier, its
next byte, and the payload without the check sum's own byte (BUS-6)."""


class CounterLimits(msgspec.Struct, frozen=True):
    """Limits by which counters are unwrapped."""

    trusted_step: int = 16
    """Largest step, counts, that goes before a host clock that contradicts it."""
    stray_run: int = 8
    """Most frames in a row out of line; more are a counter that started again."""
    stray_rounds: int = 50
    """Most searches for frames out of line: noise could go on until no frame is left."""
    notes: int = 3
    """Most notes on the clock, of one message."""
    clock_slack: float = 8.0
    """Host-time jitter that a real gap may show, ticks."""
    clock_drift: float = 2e-4
    """The same as a share of the gap, as clocks drift apart; a whole turn past ten minutes."""


COUNTERS = CounterLimits()


NO_POSITION = -(1 << 62)
"""Position of a frame that has none."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = ((value << 1) ^ 0x1D if value & 0x80 else value << 1) & 0xFF
        table.append(value)
    return tuple(table)


CRC_TABLE = _crc_table()
CRC_TABLE_ARRAY = np.array(CRC_TABLE, dtype=np.uint8)
CRC_TABLE_ARRAY.setflags(write=False)


def crc8(data: bytes) -> int:
    """CRC-8 SAE J1850 of a byte string."""
    value = CRC_INITIAL
    for byte in data:
        value = CRC_TABLE[value ^ byte]
    return value ^ CRC_FINAL_XOR


def crc8_rows(
    can_id: int, data: NDArray[np.uint8], crc_byte: int, length: int
) -> NDArray[np.uint8]:
    """`crc8-j1850-id` of each payload.

    can_id: identifier that all rows share; data: payloads, shape (n, width); crc_byte: position of
    the check sum, left out of the sum; length: payload bytes. Returns check sums, shape (n,).
    """
    start = CRC_TABLE[CRC_TABLE[CRC_INITIAL ^ (can_id & 0xFF)] ^ (can_id >> 8 & 0xFF)]
    value = np.full(len(data), start, dtype=np.uint8)
    for column in range(length):
        if column != crc_byte:
            value = CRC_TABLE_ARRAY[value ^ data[:, column]]
    value ^= np.uint8(CRC_FINAL_XOR)
    return value


def unwrap(
    counter: IntArray, time_ns: IntArray, period_ns: int, modulus: int = 256
) -> tuple[IntArray, tuple[str, ...]]:
    """Continue a wrapping counter without limit, by the host's time where it has turned over.

    Counter steps are exact and time is coarse, so time only chooses how many whole turns a step
    hides. Time may also lie: a stalled receiver hands over frames late and in a burst, and a host
    clock may be set. A stall is told from lost frames by what follows it.

    counter: values in order of arrival, 0 … modulus - 1, shape (n,); time_ns: host time stamps,
    shape (n,); period_ns: time per count; modulus: counts per turn. Returns position of each frame,
    congruent with its counter, the first one its counter value; `NO_POSITION` for a few frames out
    of line with their neighbours (corrupt counters, frames that come much too late); and notes.
    """
    if len(counter) == 0:
        return np.empty(0, dtype=np.int64), ()
    sound, rounds = np.arange(len(counter)), 0
    while True:
        inline, stamps = counter[sound], time_ns[sound]
        jump, residue, ticks, trusted = _counter_steps(inline, stamps, period_ns, modulus)
        astray = _stray_frames(jump, residue, modulus)
        rounds += 1
        if rounds > COUNTERS.stray_rounds or not astray.any():
            break
        sound = sound[~astray]
    rebase, notes = _clock_steps(np.flatnonzero(trusted), ticks, jump, residue, period_ns)
    lateness = np.concatenate(([0.0], np.cumsum(residue - rebase)))
    position = np.concatenate(([0], np.cumsum(jump)))
    breaks = np.flatnonzero(np.abs(jump) > COUNTERS.trusted_step) + 1
    if len(breaks):
        # A stretch between large gaps that stays late or early by whole turns was placed wrongly.
        starts = np.concatenate(([0], breaks))
        earliest = np.minimum.reduceat(lateness, starts)
        turns = np.cumsum(np.rint(np.diff(earliest) / modulus).astype(np.int64))
        # A counter that starts again goes on; frames out of order go back, and so do their stamps.
        back = position[breaks] - position[breaks - 1] + modulus * np.diff(turns, prepend=0)
        back[np.abs(residue[breaks - 1]) <= COUNTERS.clock_slack] = 0
        turns += np.cumsum(np.maximum(-((back + COUNTERS.trusted_step) // modulus), 0))
        lengths = np.diff(np.concatenate((starts, [len(position)])))
        position += modulus * np.repeat(np.concatenate(([0], turns)), lengths)
    position += int(inline[0])
    if len(sound) == len(counter):
        return position, notes
    placed = np.full(len(counter), NO_POSITION, dtype=np.int64)
    placed[sound] = position
    return placed, (*notes, f"{len(counter) - len(sound)} frames with a counter out of line")


def _stray_frames(jump: IntArray, residue: FloatArray, modulus: int) -> BoolArray:
    """Frames, one or a few, whose counter leaps and leaps back, against the host's time."""
    astray = np.zeros(len(jump) + 1, dtype=np.bool_)
    strange = np.abs(residue) > COUNTERS.clock_slack
    leap = np.abs(jump) > COUNTERS.trusted_step // 2
    both = (jump[:-1] + jump[1:] + modulus // 2) % modulus - modulus // 2
    astray[1:-1] = leap[:-1] & leap[1:] & (np.abs(both) <= COUNTERS.trusted_step) & strange[:-1]
    # Of two in a row only the first is judged now: without it the second may be in line.
    astray[1:] &= ~astray[:-1]
    if not astray.any():
        _mark_runs(astray, jump, np.flatnonzero(leap & strange), modulus)
    return astray


def _mark_runs(astray: BoolArray, jump: IntArray, leaps: IntArray, modulus: int) -> None:
    """Mark the frames between a leap and the leap back that soon follows."""
    position = np.concatenate(([0], np.cumsum(jump)))
    begin, end = leaps[:-1], leaps[1:]
    net = (position[end + 1] - position[begin] + modulus // 2) % modulus - modulus // 2
    back = (end - begin <= COUNTERS.stray_run) & (np.abs(net) <= COUNTERS.trusted_step)
    back[1:] &= ~back[:-1]
    for first, last in zip(begin[back], end[back], strict=True):
        astray[first + 1 : last + 1] = True


def _counter_steps(
    counter: IntArray, time_ns: IntArray, period_ns: int, modulus: int
) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    """Counts from each frame to the next, host time beyond that, host time, and where the counter
    was taken at its word against the host's time."""
    step = np.diff(counter) % modulus
    ticks = np.diff(time_ns) / period_ns
    jump = step + modulus * np.rint((ticks - step) / modulus).astype(np.int64)
    signed = np.where(step > modulus // 2, step - modulus, step)
    residue = ticks - jump
    strange = np.abs(residue) > COUNTERS.clock_slack + COUNTERS.clock_drift * np.abs(ticks)
    trusted = strange & (np.abs(signed) <= COUNTERS.trusted_step)
    jump[trusted] = signed[trusted]
    return jump, ticks - jump, ticks, trusted


def _clock_steps(
    places: IntArray,
    ticks: FloatArray,
    jump: IntArray,
    residue: FloatArray,
    period_ns: int,
) -> tuple[FloatArray, tuple[str, ...]]:
    """Steps of the host's time against the counters (in ticks, at the differences they are at).

    Only a stamp before the one before shows that the host's clock was set. Where stamps run ahead
    the computer may have paused: an emulated one on a busy machine does.
    """
    rebase = np.zeros_like(residue)
    notes: list[str] = []
    after = 20
    for place in places:
        size = residue[place]
        following = slice(place + 1, place + 1 + after)
        expected = max(int(jump[following].sum()), 1)
        burst = ticks[following].sum() < 0.5 * expected
        if abs(size) < 2 * COUNTERS.clock_slack or (size > 0 and burst):
            continue
        rebase[place] = size
        seconds = abs(size) * period_ns * 1e-9
        if len(notes) == COUNTERS.notes or 0.0 > size > -jump[place]:
            continue  # a stall, and frames lost in it: they are counted
        if size > 0.0:
            notes.append(
                f"time stamps run {seconds:.3f} s ahead of the counters: the computer paused, or "
                "the host clock was set"
            )
        else:
            notes.append(f"host clock was set back by {seconds:.3f} s")
    return rebase, tuple(notes)


MAX_RESTART_COUNT = 1
"""First count, at most, of a counter that a computer restarts together with a change of state."""


class ConflictLimits(msgspec.Struct, frozen=True):
    """Limits beyond which conflicting counters show a second sender."""

    share: float = 0.02
    """Largest share of a message's counter values in conflict."""
    chance: int = 3
    """Most conflicts by chance, whatever their share: damaged frames whose check sum fits."""
    standing: int = 3
    """Frames in a row with one counter that stands still; two senders make pairs."""
    watched: int = 128
    """Counter values that the live watch looks back: half a turn of eight bits."""
    half_life: int = 500
    """Frames after which those before weigh half in the live watch."""


CONFLICTS = ConflictLimits()


def rows_of(table: FrameTable, message: MessageMap) -> IntArray:
    """Rows of the data frames that have a message's identifier, on whatever channel."""
    mine = table.can_id == message.can_id
    mine &= table.extended == message.extended
    mine &= ~(table.error | table.remote)
    return np.flatnonzero(mine)


def sound_rows(
    table: FrameTable, received: IntArray, message: MessageMap, *, keep_bad_sums: bool = False
) -> tuple[IntArray, NDArray[np.uint8], IntArray, IntArray]:
    """Check length and check sum of frames in columns.

    table: frames in columns; received: rows of the message; message: the message that they should
    be; keep_bad_sums: tell frames with a wrong check sum, but let them pass. Returns rows that
    pass, their payloads of shape (n, width), rows of a wrong length, and rows with a wrong check
    sum.
    """
    fits = table.length[received] == message.length
    wrong_length, row = received[~fits], received[fits]
    data = _gather(table.data, row)
    wrong_sum = row[:0]
    if message.crc is not None and len(row):
        at = message.crc.lead // 8
        good = crc8_rows(message.can_id, data, at, message.length) == data[:, at]
        if not good.all():
            wrong_sum = row[~good]
            if not keep_bad_sums:
                row, data = row[good], np.ascontiguousarray(data[good])
    return row, data, wrong_length, wrong_sum


def intact(message: MessageMap, data: bytes) -> bool:
    """Whether one payload has the right length and check sum."""
    if len(data) != message.length:
        return False
    if message.crc is None:
        return True
    at = message.crc.lead // 8
    header = struct.pack("<H", message.can_id & 0xFFFF)
    return crc8(header + data[:at] + data[at + 1 :]) == data[at]


def _gather(data: NDArray[np.uint8], row: IntArray) -> NDArray[np.uint8]:
    if data.shape[1] == 8 and data.flags.c_contiguous:
        return data.view(np.uint64).reshape(-1)[row].view(np.uint8).reshape(-1, 8)
    return np.ascontiguousarray(data[row])


def conflicting(position: IntArray, data: NDArray[np.uint8]) -> BoolArray:
    """Frames whose position another frame has with another payload.

    position: unlimited counter (and page, where a message has several) of each frame, shape (n,);
    data: payloads, shape (n, width). Returns frames in conflict, shape (n,).
    """
    marked = np.zeros(len(position), dtype=np.bool_)
    order = np.argsort(position, kind="stable")
    same = np.diff(position[order]) == 0
    if not same.any():
        return marked
    begins = np.flatnonzero(np.concatenate(([True], ~same)))
    lengths = np.diff(np.concatenate((begins, [len(order)])))
    several = np.repeat(lengths > 1, lengths)
    order, group = order[several], np.repeat(np.arange(len(begins)), lengths)[several]
    differs = (data[order[1:]] != data[order[:-1]]).any(axis=1) & (group[1:] == group[:-1])
    marked[order] = np.isin(group, group[1:][differs])
    return marked


def event_positions(
    counter: IntArray, time_ns: IntArray, modulus: int, state: NDArray[np.float64] | None = None
) -> tuple[BoolArray, IntArray]:
    """Positions of a message that counts its own frames, the nearest number counting.

    After a silence of half a turn the positions begin anew, and where the counter restarts with a
    change of state; a counter that stands still says nothing.

    counter: counter of each frame, shape (n,); time_ns: time stamp of each frame, ns, shape (n,);
    modulus: number of values of the counter; state: state of the test in each frame, shape (n,);
    None where the message does not say. Returns frames that have a position, shape (n,), and those
    positions.
    """
    has = np.ones(len(counter), dtype=np.bool_)
    if len(counter) < 2:
        return has, np.zeros(len(counter), dtype=np.int64)
    edges = np.flatnonzero(np.diff(counter)) + 1
    begins = np.concatenate(([0], edges))
    lengths = np.diff(np.concatenate((begins, [len(counter)])))
    has = np.repeat(lengths < CONFLICTS.standing, lengths)
    has[begins] = True
    counter, time_ns = counter[has], time_ns[has]
    step = np.diff(counter) % modulus
    step = np.where(step > modulus // 2, step - modulus, step)
    waited = np.diff(time_ns)
    usual = max(float(np.median(np.abs(waited))), 1.0) if len(waited) else 1.0
    anew = np.abs(waited) > usual * modulus / 2
    if state is not None:
        anew |= (np.diff(state[has]) != 0) & (counter[1:] <= MAX_RESTART_COUNT)
    step[anew] = 2 * modulus  # beyond the reach of any frame before
    return has, np.concatenate(([0], np.cumsum(step)))


class SenderWatch:
    """Looks for a second sender under one identifier, a frame at a time; memory is constant.

    modulus: counts per turn; period_ns: usual time between two counts. conflicts: counter values
    that came with two payloads within half a turn.
    """

    conflicts: int

    def __init__(self, modulus: int, period_ns: int) -> None:
        self._reach = min(CONFLICTS.watched, max(modulus // 2, 1))
        self._half_turn_ns = self._reach * period_ns
        self._seen: OrderedDict[tuple[int, ...], tuple[bytes, int]] = OrderedDict()
        self._last: tuple[int, ...] = ()
        self._state: float | None = None
        self._standing = 0
        self._recent = [0, 0]
        self.conflicts = 0

    def take(
        self, counter: tuple[int, ...], data: bytes, time_ns: int, state: float | None = None
    ) -> bool:
        """Take a sound frame; return whether its counter was just used with another payload.

        `counter` is the counter's value, and the page that it counts where there are several;
        `state` that of the test, where the message says it: with a change of it the counter may
        restart. Of two senders in turn each restarts only once a turn, and is found between.
        """
        if state is not None:
            if self._state not in (None, state) and counter[0] <= MAX_RESTART_COUNT:
                self._seen.clear()
            self._state = state
        known = self._seen.pop(counter, None)
        self._seen[counter] = (data, time_ns)
        if len(self._seen) > self._reach:
            self._seen.popitem(last=False)
        if known is not None and known[0] == data:
            return False
        self._standing = self._standing + 1 if counter == self._last else 1
        self._last = counter
        conflict = known is not None and abs(time_ns - known[1]) <= self._half_turn_ns
        if conflict and self._standing >= CONFLICTS.standing:
            if self._standing == CONFLICTS.standing:
                self._count(-1)  # what looked like a pair is a counter that stands still
            return False
        self._count(int(conflict))
        return conflict

    def _count(self, conflicts: int) -> None:
        self.conflicts += conflicts
        self._recent[0] += 1
        self._recent[1] += conflicts
        if self._recent[0] >= CONFLICTS.half_life:
            self._recent = [item // 2 for item in self._recent]

    @property
    def second_sender(self) -> bool:
        """Whether there are more conflicts of late than chance makes."""
        frames, conflicts = self._recent
        return conflicts > max(CONFLICTS.chance, CONFLICTS.share * frames)
