"""What the acquisition hands to the diagnosis: aligned samples and how good they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BitReason",
    "BitState",
    "CommandMode",
    "Environment",
    "MessageCounts",
    "Outcome",
    "Quality",
    "Recording",
    "Samples",
]


class CommandMode(IntEnum):
    """What a command is (bus.md, `CommandMode`)."""

    CURRENT = 1
    POSITION = 2


class BitState(IntEnum):
    """State of the built-in test (bus.md, `BitState`)."""

    IDLE = 0
    ARMING = 1
    RUNNING = 2
    COMPLETE = 3
    ABORTED = 4
    REFUSED = 5


class BitReason(IntEnum):
    """Why the flight-control computer refused (bus.md, `BitReason`)."""

    NONE = 0
    UNKNOWN_TEST = 1
    SUPPLY_PRESSURE_LOW = 2
    OIL_TOO_COLD = 3
    NOT_CENTRED = 4
    ALREADY_RUNNING = 5
    INTERLOCK_OPEN = 6


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples of one test on its own tick grid: row k is control tick k of the test.

    All arrays have shape (ticks,). A row that did not arrive, or that failed a check, is NaN:
    nothing is interpolated. Row k of the four channels holds what the converters read at the
    *end* of tick k, `command` what was active *during* it.

    Attributes
    ----------
    period_ns: length of a tick, ns.
    current: servovalve current, A.
    spool: spool position, m.
    pressure: differential pressure, Pa.
    position: jack position, m.
    command: command, A (current mode) or m (position mode).
    mode: what the command is.
    saturated: shape (4, ticks), the channel's converter stood at its end.
    host_ns: host time stamp of each telemetry row, ns; -1 where none arrived.
    """

    period_ns: int
    mode: CommandMode
    current: NDArray[np.float64]
    spool: NDArray[np.float64]
    pressure: NDArray[np.float64]
    position: NDArray[np.float64]
    command: NDArray[np.float64]
    saturated: NDArray[np.bool_]
    host_ns: NDArray[np.int64]

    @property
    def ticks(self) -> int:
        """Number of rows."""
        return len(self.spool)


@dataclass(frozen=True, slots=True)
class Environment:
    """Median over the test; None where the bus did not say."""

    supply_pressure: float | None = None
    """Pa."""
    return_pressure: float | None = None
    """Pa."""
    oil_temperature: float | None = None
    """degC: the scale of the viscosity laws."""


@dataclass(frozen=True, slots=True)
class MessageCounts:
    """Validity of one message over the span of a recording."""

    received: int = 0
    """Frames with the message's identifier, good or bad."""
    accepted: int = 0
    lost: int = 0
    """Counter gaps, and frames missing at the ends of the test."""
    repeated: int = 0
    out_of_order: int = 0
    conflicts: int = 0
    """Counter values that came with different payloads; all their frames are dropped, and lost."""
    crc_errors: int = 0
    length_errors: int = 0
    range_errors: int = 0


@dataclass(frozen=True, slots=True)
class Quality:
    """How good a recording is: counts per message and per channel."""

    messages: Mapping[str, MessageCounts] = field(default_factory=dict)
    saturated: Mapping[str, int] = field(default_factory=dict)
    """Samples at a converter's end, per channel."""
    foreign: int = 0
    """Frames with other identifiers."""
    error_frames: int = 0
    notes: tuple[str, ...] = ()
    """What else a reader should know, one sentence each."""
    refused: tuple[str, ...] = ()
    """Why the user's own policy wants no verdict on this recording, one sentence each."""

    def total(self, count: str) -> int:
        """Sum of one of the counts of `MessageCounts` over all messages."""
        return sum(int(getattr(item, count)) for item in self.messages.values())


@dataclass(frozen=True, slots=True)
class Outcome:
    """How the test ended, as the flight-control computer says."""

    state: BitState | None = None
    """None: no status on the bus."""
    reason: BitReason = BitReason.NONE


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One test of one actuator, as acquired."""

    source: str
    """File name or bus."""
    samples: Samples | None
    """None: no telemetry of a test was found."""
    test_id: int | None
    serial: int | None
    outcome: Outcome
    environment: Environment
    quality: Quality
    channel: int | None = None
    """Adapter channel of the recording; None where it has only one or does not say."""
    start_ns: int | None = None
    """Host time of the test's first sample, ns since the epoch (or the log's start)."""

    @property
    def duration(self) -> float:
        """Length of the test, s; 0 without samples."""
        return 0.0 if self.samples is None else self.samples.ticks * self.samples.period_ns * 1e-9
