"""End-to-end protection: the CRC, and the sequence counter unwrapped beyond its range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["CRC_KINDS", "OUTSIDE", "crc8", "crc8_rows", "unwrap"]

POLYNOMIAL = 0x1D
INITIAL = 0xFF
FINAL_XOR = 0xFF
CRC_KINDS = ("crc8-j1850-id",)
"""Check sums by name. `crc8-j1850-id`: CRC-8 SAE J1850 over the low byte of the identifier, its
next byte, and the payload without the check sum's own byte (BUS-6)."""

NEAR = 16
"""Counter steps up to this are taken at their word when the host's clock contradicts them."""
LONGEST_RUN = 8
"""Frames in a row that may be out of line; more of them are a counter that started again."""
MOST_ROUNDS = 50
"""How often frames out of line are looked for: noise could go on until nothing is left."""
MOST_NOTES = 3
"""On the clock, of one message."""
SLACK_TICKS = 8.0
"""Host-time jitter that a real gap may show, in ticks."""
SLACK_RATE = 2e-4
"""The same as a share of the gap: two clocks drift apart. Past some ten minutes it covers a whole
turn, and a step of the host clock that long looks like a gap."""


OUTSIDE = -(1 << 62)
"""Position of a frame that has none."""


def _table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = ((value << 1) ^ POLYNOMIAL if value & 0x80 else value << 1) & 0xFF
        table.append(value)
    return tuple(table)


TABLE = _table()
TABLE_COLUMN = np.array(TABLE, dtype=np.uint8)
TABLE_COLUMN.setflags(write=False)


def crc8(data: bytes) -> int:
    """CRC-8 SAE J1850 of a byte string."""
    value = INITIAL
    for byte in data:
        value = TABLE[value ^ byte]
    return value ^ FINAL_XOR


def crc8_rows(
    can_id: int, data: NDArray[np.uint8], crc_byte: int, length: int
) -> NDArray[np.uint8]:
    """`crc8-j1850-id` of each payload.

    Parameters
    ----------
    can_id : int
        Identifier that all rows share.
    data : NDArray[np.uint8]
        Payloads, shape (n, width).
    crc_byte : int
        Position of the check sum, left out of the sum.
    length : int
        Payload bytes.

    Returns
    -------
    NDArray[np.uint8]
        Check sums, shape (n,).
    """
    start = TABLE[TABLE[INITIAL ^ (can_id & 0xFF)] ^ (can_id >> 8 & 0xFF)]
    value = np.full(len(data), start, dtype=np.uint8)
    for column in range(length):
        if column != crc_byte:
            value = TABLE_COLUMN[value ^ data[:, column]]
    value ^= np.uint8(FINAL_XOR)
    return value


def unwrap(
    counter: NDArray[np.int64], time_ns: NDArray[np.int64], period_ns: int, modulus: int = 256
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Continue a wrapping counter without limit, by the host's time where it has turned over.

    Counter steps are exact and time is coarse, so time only chooses how many whole turns a step
    hides. Time may also lie: a stalled receiver hands over frames late and in a burst, and a host
    clock may be set. A stall is told from lost frames by what follows it.

    Parameters
    ----------
    counter : NDArray[np.int64]
        Values in order of arrival, 0 … modulus - 1, shape (n,).
    time_ns : NDArray[np.int64]
        Host time stamps, shape (n,).
    period_ns : int
        Time per count.
    modulus : int
        Counts per turn.

    Returns
    -------
    tuple[NDArray[np.int64], tuple[str, ...]]
        Position of each frame, congruent with its counter, the first one its counter value;
        OUTSIDE for a few frames out of line with their neighbours (corrupt counters, frames
        that come much too late); and notes.
    """
    if len(counter) == 0:
        return np.empty(0, dtype=np.int64), ()
    sound, rounds = np.arange(len(counter)), 0
    while True:
        inline, stamps = counter[sound], time_ns[sound]
        jump, residue, ticks, trusted = _steps(inline, stamps, period_ns, modulus)
        astray = _astray(jump, residue, modulus)
        rounds += 1
        if rounds > MOST_ROUNDS or not astray.any():
            break
        sound = sound[~astray]
    rebase, notes = _clock_steps(np.flatnonzero(trusted), ticks, jump, residue, period_ns)
    lateness = np.concatenate(([0.0], np.cumsum(residue - rebase)))
    position = np.concatenate(([0], np.cumsum(jump)))
    breaks = np.flatnonzero(np.abs(jump) > NEAR) + 1
    if len(breaks):
        # A stretch between large gaps that stays late or early by whole turns was placed wrongly.
        starts = np.concatenate(([0], breaks))
        earliest = np.minimum.reduceat(lateness, starts)
        turns = np.cumsum(np.rint(np.diff(earliest) / modulus).astype(np.int64))
        # A counter that starts again goes on; frames out of order go back, and so do their stamps.
        back = position[breaks] - position[breaks - 1] + modulus * np.diff(turns, prepend=0)
        back[np.abs(residue[breaks - 1]) <= SLACK_TICKS] = 0
        turns += np.cumsum(np.maximum(-((back + NEAR) // modulus), 0))
        lengths = np.diff(np.concatenate((starts, [len(position)])))
        position += modulus * np.repeat(np.concatenate(([0], turns)), lengths)
    position += int(inline[0])
    if len(sound) == len(counter):
        return position, notes
    placed = np.full(len(counter), OUTSIDE, dtype=np.int64)
    placed[sound] = position
    return placed, (*notes, f"{len(counter) - len(sound)} frames with a counter out of line")


def _astray(
    jump: NDArray[np.int64], residue: NDArray[np.float64], modulus: int
) -> NDArray[np.bool_]:
    """Frames, one or a few, whose counter leaps and leaps back, against the host's time."""
    astray = np.zeros(len(jump) + 1, dtype=np.bool_)
    strange = np.abs(residue) > SLACK_TICKS
    leap = np.abs(jump) > NEAR // 2
    both = (jump[:-1] + jump[1:] + modulus // 2) % modulus - modulus // 2
    astray[1:-1] = leap[:-1] & leap[1:] & (np.abs(both) <= NEAR) & strange[:-1]
    # Of two in a row only the first is judged now: without it the second may be in line.
    astray[1:] &= ~astray[:-1]
    if not astray.any():
        _mark_runs(astray, jump, np.flatnonzero(leap & strange), modulus)
    return astray


def _mark_runs(
    astray: NDArray[np.bool_], jump: NDArray[np.int64], leaps: NDArray[np.int64], modulus: int
) -> None:
    """Mark the frames between a leap and the leap back that soon follows."""
    position = np.concatenate(([0], np.cumsum(jump)))
    begin, end = leaps[:-1], leaps[1:]
    net = (position[end + 1] - position[begin] + modulus // 2) % modulus - modulus // 2
    back = (end - begin <= LONGEST_RUN) & (np.abs(net) <= NEAR)
    back[1:] &= ~back[:-1]
    for first, last in zip(begin[back], end[back], strict=True):
        astray[first + 1 : last + 1] = True


def _steps(
    counter: NDArray[np.int64], time_ns: NDArray[np.int64], period_ns: int, modulus: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Counts from each frame to the next, host time beyond that, host time, and where the counter
    was taken at its word against the host's time."""
    step = np.diff(counter) % modulus
    ticks = np.diff(time_ns) / period_ns
    jump = step + modulus * np.rint((ticks - step) / modulus).astype(np.int64)
    signed = np.where(step > modulus // 2, step - modulus, step)
    residue = ticks - jump
    strange = np.abs(residue) > SLACK_TICKS + SLACK_RATE * np.abs(ticks)
    trusted = strange & (np.abs(signed) <= NEAR)
    jump[trusted] = signed[trusted]
    return jump, ticks - jump, ticks, trusted


def _clock_steps(
    places: NDArray[np.int64],
    ticks: NDArray[np.float64],
    jump: NDArray[np.int64],
    residue: NDArray[np.float64],
    period_ns: int,
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
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
        if abs(size) < 2 * SLACK_TICKS or (size > 0 and burst):
            continue
        rebase[place] = size
        seconds = abs(size) * period_ns * 1e-9
        if len(notes) == MOST_NOTES or 0.0 > size > -jump[place]:
            continue  # a stall, and frames lost in it: they are counted
        if size > 0.0:
            notes.append(
                f"time stamps run {seconds:.3f} s ahead of the counters: the computer paused, or "
                "the host clock was set"
            )
        else:
            notes.append(f"host clock was set back by {seconds:.3f} s")
    return rebase, tuple(notes)
