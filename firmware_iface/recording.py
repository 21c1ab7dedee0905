"""The recording that is diagnosed: samples per control tick, their converters, their quality."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import NotTestedError, install_command

if TYPE_CHECKING:
    import pandas

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MAX_STANDARD_CAN_ID: Final = 0x7FF
"""Largest identifier of a frame with 11 bits (ISO 11898-1)."""
MAX_CAN_ID: Final = 0x1FFFFFFF
"""Largest identifier of a frame with 29 bits (ISO 11898-1)."""
DEFAULT_LEVELS: Final = 4096.0
"""Codes of the 12-bit converters of PHY-21."""


class Channel(msgspec.Struct, frozen=True, dict=True):
    """One converter channel: mid-tread rounding, saturating at its ends."""

    name: str
    """Identifier used in tables, files and reports."""
    full_scale: float
    """Half range, SI unit of the channel; codes cover [-full_scale, full_scale - lsb]."""
    unit: str
    """Engineering unit shown to people."""
    per_unit: float
    """SI value of one engineering unit."""
    levels: float = DEFAULT_LEVELS
    """Steps in the whole range; no whole number where the step was seen in data."""

    @cached_property
    def lsb(self) -> float:
        """One code step, SI unit."""
        return 2.0 * self.full_scale / self.levels

    @property
    def half(self) -> int:
        """Code of zero; the largest code is 2 half - 1."""
        return round(0.5 * self.levels)

    @cached_property
    def grain(self) -> float:
        """Step of a 12-bit converter of this range, or its own where that is coarser, SI unit.

        Limits in LSB that allow for more than rounding are meant in these.
        """
        return 2.0 * self.full_scale / min(self.levels, DEFAULT_LEVELS)

    @property
    def ends(self) -> tuple[float, float]:
        """Values at and beyond which the converter stands at its lower and upper end, SI unit."""
        return end_thresholds(-self.full_scale, self.full_scale - self.lsb, self.lsb)

    def encode(self, value: FloatArray) -> IntArray:
        """Digitise SI values to codes 0 … 2 half - 1 (zero is code half)."""
        code = np.floor(np.asarray(value) / self.lsb + 0.5) + self.half
        return np.clip(code, 0, 2 * self.half - 1).astype(np.int64)

    def decode(self, code: IntArray) -> FloatArray:
        """SI value of each code."""
        centred: FloatArray = np.asarray(code, dtype=np.float64) - self.half
        return centred * self.lsb


def end_thresholds(low: float, high: float, step: float) -> tuple[float, float]:
    """Values half a step inside both ends of a range: what is at or beyond one stands at an end."""
    return low + 0.5 * step, high - 0.5 * step


class Channels(NamedTuple):
    """The four channels, in the order of all tables."""

    current: Channel
    spool: Channel
    pressure: Channel
    position: Channel


class StatedConverter(msgspec.Struct, frozen=True):
    """What a mapping says of one converter, SI; None: nothing."""

    low: float | None = None
    """Value at its lower end."""
    high: float | None = None
    """Value at its upper end."""
    step: float | None = None
    """Resolution."""


CHANNELS = Channels(
    Channel("current", 12e-3, "mA", 1e-3), Channel("spool", 0.5e-3, "mm", 1e-3),
    Channel("pressure", 25e6, "MPa", 1e6), Channel("position", 60e-3, "mm", 1e-3),
)  # fmt: skip
"""Converters of PHY-23, of a bus and an actuator file that state none."""
CHANNEL_NAMES = tuple(channel.name for channel in CHANNELS)
CHANNEL_ROLES = tuple(f"channels.{name}" for name in CHANNEL_NAMES)
MAX_GRID_TICKS = 1_000_000
"""Most ticks onto which a recording is laid, 1: about a quarter of an hour at 1 kHz."""
MAX_SAMPLE_GAP_S = 0.25
"""Longest span of a test without a sample, s; a longer one makes it NOT TESTED."""


class Scales(msgspec.Struct, frozen=True):
    """How finely, and how far, a flight-control computer sees its actuator and its commands."""

    channels: Channels = CHANNELS
    current_step: float = 0.5e-6
    """Resolution of commanded currents on its bus (BUS-8), A; 0: exact."""
    position_step: float = 2e-6
    """Of commanded positions, m; 0: exact."""


DEFAULT_SCALES = Scales()
"""Those of the default bus."""


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


ACTIVE_BIT_STATES = (BitState.ARMING, BitState.RUNNING)


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


class RecordedSignal(msgspec.Struct, frozen=True, eq=False):
    """One signal as recorded."""

    time: FloatArray
    """s, ascending, shape (n,)."""
    value: FloatArray
    """SI, finite, shape (n,)."""
    jitter: float = 0.0
    """Deviation of the stamps from the even clock that took their place, s; 0: they are as read."""


class Acquisition(NamedTuple):
    """How samples were measured that are not the computer's own.

    Attributes
    ----------
    rate : float
        Samples of each signal, Hz.
    lead : float
        Time before the end of each tick at which the channels were sampled, s.
    lead_std : float
        Its standard deviation, s.
    drift_std : float
        Standard deviation of the clock's rate against the computer's, 1.
    signals : tuple[RecordedSignal, ...]
        Spool, pressure and position as they were measured, on the clock of `Samples.host_ns`.
    """

    rate: float
    lead: float
    lead_std: float
    drift_std: float
    signals: tuple[RecordedSignal, ...]


class Samples(msgspec.Struct, frozen=True, eq=False):
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
    current : FloatArray
        Servovalve current, A.
    spool : FloatArray
        Spool position, m.
    pressure : FloatArray
        Differential pressure, Pa.
    position : FloatArray
        Jack position, m.
    command : FloatArray
        Command, A (current mode) or m (position mode).
    saturated : BoolArray
        Shape (4, ticks), the channel's converter stood at its end.
    host_ns : IntArray
        Host time stamp of each telemetry row, ns; -1 where none arrived.
    stated : tuple[StatedConverter | None, ...]
        What the mapping says of each channel's converter; empty: nothing of any.
    acquired : Acquisition | None
        How the channels were measured separately; None: these are the computer's own samples.
    """

    period_ns: int
    mode: CommandMode
    current: FloatArray
    spool: FloatArray
    pressure: FloatArray
    position: FloatArray
    command: FloatArray
    saturated: BoolArray
    host_ns: IntArray
    stated: tuple[StatedConverter | None, ...] = ()
    acquired: Acquisition | None = None

    @property
    def ticks(self) -> int:
        """Number of rows."""
        return len(self.spool)

    @property
    def time(self) -> FloatArray:
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
            raise ImportError(f"a data frame needs pandas: {install_command('pandas')}") from None
        names = ("command", "current", "spool", "pressure", "position")
        return pandas.DataFrame(
            {name: getattr(self, name) for name in names},
            index=pandas.Index(self.time, name="time"),
        )


class Environment(msgspec.Struct, frozen=True):
    """Median over the test; None where the bus did not say."""

    supply_pressure: float | None = None
    """Pa."""
    return_pressure: float | None = None
    """Pa."""
    oil_temperature: float | None = None
    """degC: the scale of the viscosity laws."""
    temperature_std: float = 0.0
    """Standard deviation of the oil temperature by its steps on the bus, K."""
    supply_std: float = 0.0
    """Standard deviation of supply less return pressure by their steps on the bus, Pa."""


class MessageCounts(msgspec.Struct, frozen=True):
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


class Quality(msgspec.Struct, frozen=True):
    """How good a recording is: counts per message and per channel."""

    messages: Mapping[str, MessageCounts] = msgspec.field(default_factory=dict)
    saturated: Mapping[str, int] = msgspec.field(default_factory=dict)
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


class BitOutcome(msgspec.Struct, frozen=True):
    """How the test ended, as the flight-control computer says."""

    state: BitState | None = None
    """None: no status on the bus."""
    reason: BitReason = BitReason.NONE


class OnboardResult(msgspec.Struct, frozen=True):
    """The flight-control computer's own result of a test (BUS-18)."""

    test_id: int | None
    """Number of the test; None where it does not say."""
    verdict: int | None
    """0 healthy, 10 degraded, 20 fault, 30 not tested; None where it does not say."""
    runs: int | None
    """Runs of the model that it took; None where it does not say."""
    severities: Mapping[str, float]
    """Kintas, FSS, FDJ; 0 … 1; NaN where it has no estimate."""
    std: Mapping[str, float]
    """Their standard deviations, or NaN."""

    def is_of(self, test_id: int | None) -> bool:
        """Whether it can be that of a test; None: the test's number is not known."""
        return None in (test_id, self.test_id) or test_id == self.test_id


class Recording(msgspec.Struct, frozen=True, eq=False):
    """One test of one actuator, as acquired."""

    source: str
    """File name or bus."""
    samples: Samples | None
    """None: no telemetry of a test was found."""
    test_id: int | None
    serial: int | None
    outcome: BitOutcome
    environment: Environment
    quality: Quality
    channel: int | None = None
    """Adapter channel of the recording; None where it has only one or does not say."""
    start_ns: int | None = None
    """Host time of the test's first sample, ns since the epoch (or the log's start)."""
    onboard: OnboardResult | None = None
    """The computer's own result; None: it sent none."""
    by_time: bool = False
    """No counter told the samples' ticks: one message's may be placed later than another's."""
    out_of_order: float = 0.0
    """Share of the ticks whose command is another tick's: the frames' order is not the bus's."""
    as_measured: Recording | None = None
    """The same as measured by converters of an acquisition, where the values may be of either."""

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


class SamplingLimits(msgspec.Struct, frozen=True):
    """Limits between the rules by which measured signals come to ticks."""

    nearest: float = 0.75
    """Samples a tick below which each goes to the nearest tick."""
    averaged: float = 16.0
    """Samples a tick from which on the mean of several is taken."""
    averaging: float = 1.0 / 16.0
    """Ticks on either side of an instant whose samples are averaged."""
    gap: float = 2.5
    """Sampling intervals between neighbours beyond which nothing is interpolated."""
    quiet: float = 0.2
    """Share of the second differences that are noise: tests rest and creep for longer."""
    quiet_second: float = 0.253 * math.sqrt(6.0)
    """That quantile of the size of second differences of white noise, in its deviations."""
    error: float = 1.0
    """Largest error of a cubic, in deviations of the noise: as much as that again."""


SAMPLING = SamplingLimits()


def sampling_interval(signal: RecordedSignal) -> float:
    """Usual time between two samples, s."""
    return float(np.median(np.diff(signal.time))) if len(signal.time) > 1 else np.inf


def values_at(
    signal: RecordedSignal, instants: FloatArray, period: float
) -> tuple[FloatArray, str]:
    """Values of a signal at instants, and the rule by which they came.

    signal: as recorded; instants: s, ascending, a tick apart, shape (n,); period: length of a tick,
    s. Returns NaN where there is none, shape (n,); the rule in words, with its error.
    """
    step = sampling_interval(signal)
    rate = period / step
    if rate < SAMPLING.nearest:
        return _nearest(signal, instants, period), (
            "each sample at the nearest tick, off by up to half a tick"
        )
    if rate >= SAMPLING.averaged:
        return _mean(signal, instants, SAMPLING.averaging * period), (
            f"mean of the samples within {SAMPLING.averaging * period * 1e3:.3g} ms of each"
            " tick's end"
        )
    return _cubic(signal, instants, SAMPLING.gap * step), "a cubic through four samples"


def _cubic(signal: RecordedSignal, instants: FloatArray, most: float) -> FloatArray:
    """Values of cubics through two samples on either side (Lagrange).

    NaN next to gaps, and where fourth differences say that the cubic is off by more than noise: an
    edge between two samples is not to be read.
    """
    time, value = signal.time, signal.value
    right = np.clip(np.searchsorted(time, instants), 3, len(time) - 3)
    place = [time[right + k] for k in (-2, -1, 0, 1)]
    out = np.zeros(len(instants))
    for own in range(4):
        weight = np.ones(len(instants))
        for other in range(4):
            if other != own:
                weight *= (instants - place[other]) / (place[own] - place[other])
        out += weight * value[right - 2 + own]
    part = np.clip((instants - place[1]) / (place[2] - place[1]), 0.0, 1.0)
    fourth = np.abs(np.diff(value, 4))
    turn = np.maximum(fourth[right - 3], fourth[right - 2])
    error = part * (1.0 - part) * (1.0 + part) * (2.0 - part) / 24.0 * turn
    second = np.abs(np.diff(value, 2))
    noise = float(np.quantile(second, SAMPLING.quiet)) / SAMPLING.quiet_second
    noise = max(noise, float(np.diff(np.unique(value)).min(initial=np.inf)) / math.sqrt(12.0))
    inside = (instants >= time[0]) & (instants <= time[-1]) & (place[3] - place[0] <= 2.0 * most)
    return np.where(inside & (error <= SAMPLING.error * noise), out, np.nan)


def _mean(signal: RecordedSignal, instants: FloatArray, width: float) -> FloatArray:
    low = np.searchsorted(signal.time, instants - width)
    high = np.searchsorted(signal.time, instants + width, side="right")
    total = np.concatenate([[0.0], np.cumsum(signal.value - signal.value[0])])
    count = high - low
    mean = (total[high] - total[low]) / np.maximum(count, 1) + signal.value[0]
    return np.where(count > 0, mean, np.nan)


def _nearest(signal: RecordedSignal, instants: FloatArray, period: float) -> FloatArray:
    out = np.full(len(instants), np.nan)
    index = np.rint(np.interp(signal.time, instants, np.arange(len(instants)))).astype(np.int64)
    near = np.abs(instants[index] - signal.time) <= 0.5 * period
    out[index[near]] = signal.value[near]
    return out
