"""The recording that is diagnosed: one sample of each channel per control tick, and its quality."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.channels import Stated
from ehadiag.core.errors import NotTestedError

if TYPE_CHECKING:
    import pandas

__all__ = [
    "BitReason",
    "BitState",
    "CommandMode",
    "Environment",
    "MessageCounts",
    "OnboardResult",
    "OnboardState",
    "Outcome",
    "Quality",
    "Recording",
    "Samples",
]


class CommandMode(IntEnum):
    """What a command is (BUS-4, `CommandMode`)."""

    CURRENT = 1
    POSITION = 2


class BitState(IntEnum):
    """State of the built-in test (BUS-10, `BitState`)."""

    IDLE = 0
    ARMING = 1
    RUNNING = 2
    COMPLETE = 3
    ABORTED = 4
    REFUSED = 5


class BitReason(IntEnum):
    """Why the flight-control computer refused (BUS-11, `BitReason`)."""

    NONE = 0
    UNKNOWN_TEST = 1
    SUPPLY_PRESSURE_LOW = 2
    OIL_TOO_COLD = 3
    NOT_CENTRED = 4
    ALREADY_RUNNING = 5
    INTERLOCK_OPEN = 6


class OnboardState(IntEnum):
    """How far the computer's own identification is (BUS-17, `OnboardState`)."""

    NOTHING = 0
    RECORDING = 1
    IDENTIFYING = 2
    DONE = 3
    GIVEN_UP = 4


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples of one test on its own tick grid: row k is control tick k of the test.

    All arrays have shape (ticks,). A row that did not arrive, or that failed a check, is NaN:
    nothing is interpolated. Row k of the four channels holds what the converters read at the
    *end* of tick k, `command` what was active *during* it.

    Attributes
    ----------
    period_ns : int
        Length of a tick, ns.
    mode : CommandMode
        What the command is.
    current : NDArray[np.float64]
        Servovalve current, A.
    spool : NDArray[np.float64]
        Spool position, m.
    pressure : NDArray[np.float64]
        Differential pressure, Pa.
    position : NDArray[np.float64]
        Jack position, m.
    command : NDArray[np.float64]
        Command, A (current mode) or m (position mode).
    saturated : NDArray[np.bool_]
        Shape (4, ticks), the channel's converter stood at its end.
    host_ns : NDArray[np.int64]
        Host time stamp of each telemetry row, ns; -1 where none arrived.
    stated : tuple[Stated | None, ...]
        What the mapping says of each channel's converter; empty: nothing of any.
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
    stated: tuple[Stated | None, ...] = ()

    @property
    def ticks(self) -> int:
        """Number of rows."""
        return len(self.spool)

    @property
    def time(self) -> NDArray[np.float64]:
        """Start of each tick, s from the start of the test, shape (ticks,)."""
        return np.arange(self.ticks, dtype=np.float64) * (self.period_ns * 1e-9)

    def to_frame(self) -> pandas.DataFrame:
        """Return the samples as a data frame, one row a tick.

        Returns
        -------
        pandas.DataFrame
            Index `time`, the start of each tick in s; columns `command`, `current`, `spool`,
            `pressure`, `position` as the arrays hold them: SI, NaN where nothing arrived.

        Raises
        ------
        ImportError
            pandas is not installed.
        """
        try:
            import pandas  # noqa: PLC0415 - optional, and slow
        except ImportError:
            raise ImportError("a data frame needs pandas: pip install 'ehadiag[pandas]'") from None
        names = ("command", "current", "spool", "pressure", "position")
        return pandas.DataFrame(
            {name: getattr(self, name) for name in names},
            index=pandas.Index(self.time, name="time"),
        )


@dataclass(frozen=True, slots=True)
class Environment:
    """Median over the test; None where the bus did not say."""

    supply_pressure: float | None = None
    """Pa."""
    return_pressure: float | None = None
    """Pa."""
    oil_temperature: float | None = None
    """degC: the scale of the viscosity laws."""
    temperature_std: float = 0.0
    """Standard deviation of rounding it to another scale than the computer's own, K."""


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


@dataclass(frozen=True, slots=True)
class OnboardResult:
    """What the flight-control computer says that it has found itself in a test (BUS-18).

    Attributes
    ----------
    test_id : int | None
        Number of the test; None where it does not say.
    verdict : int | None
        0 healthy, 10 degraded, 20 fault, 30 not tested; None where it does not say.
    runs : int | None
        Runs of the model that it took; None where it does not say.
    severities : Mapping[str, float]
        Kintas, FSS, FDJ; 0 … 1.
    std : Mapping[str, float]
        Their standard deviations.
    """

    test_id: int | None
    verdict: int | None
    runs: int | None
    severities: Mapping[str, float]
    std: Mapping[str, float]

    def is_of(self, test_id: int | None) -> bool:
        """Whether it can be that of a test; None: the test's number is not known."""
        return None in (test_id, self.test_id) or test_id == self.test_id


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
    onboard: OnboardResult | None = None
    """What the computer has found itself; None where it did not say."""
    by_time: bool = False
    """No counter told the samples' ticks: one message's may be placed later than another's."""
    out_of_order: float = 0.0
    """Share of the ticks whose command is another tick's: the frames' order is not the bus's."""

    @property
    def duration(self) -> float:
        """Length of the test, s; 0 without samples."""
        return 0.0 if self.samples is None else self.samples.ticks * self.samples.period_ns * 1e-9

    def to_frame(self) -> pandas.DataFrame:
        """Return the samples as a data frame, see `Samples.to_frame`.

        Returns
        -------
        pandas.DataFrame
            One row a tick.

        Raises
        ------
        NotTestedError
            There are no samples.
        ImportError
            pandas is not installed.
        """
        if self.samples is None:
            raise NotTestedError(f"{self.source}: no telemetry of a test in it")
        return self.samples.to_frame()
