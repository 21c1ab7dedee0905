"""Snapshots of a running session: bus, test, signals, residuals, severities, verdict.

Screens, logs and web pages show them. A publisher makes four snapshots a second and hands the
newest to any number of readers. Names give the unit. A value that is not available is None:
neither `to_dict` nor `to_json` ever holds NaN.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import msgspec

from ehadiag.core.conventions import finite
from ehadiag.estimate import Severity
from firmware_iface.errors import printable
from firmware_iface.recording import CommandMode

LIVE_SCHEMA = "ehadiag.live/1"


class BusState(msgspec.Struct, frozen=True, kw_only=True):
    """How the bus is."""

    name: str
    state: str
    """`connecting`, `open`, `silent` (no frame for a second), `degraded`, `failed`, `closed`."""
    detail: str = ""
    """One sentence on a state that is not open."""
    frames: int = 0
    """Received since the session began."""
    rate_per_s: float | None = None
    """Frames in the last second or so."""
    load: float | None = None
    """Share of the bit rate in use, 0 … 1, without stuff bits; None where no bit rate is known."""
    lost: int | None = None
    """Ticks whose telemetry did not come, or was damaged; None where nobody counts them."""
    dropped: int = 0
    """Frames that this program was too slow for."""


class RunningTest(msgspec.Struct, frozen=True, kw_only=True):
    """The built-in test that is under way, or was last."""

    name: str
    number: int | None = None
    phase: str = ""
    """`requested`, `arming`, `running`, `trailing`, …; of a watched bus the state that the
    flight-control computer reports."""
    elapsed_s: float = 0.0
    """Since the test began to run."""
    duration_s: float | None = None
    """None where the test is not known here."""
    left_s: float | None = None
    """Until its end."""


class Signals(msgspec.Struct, frozen=True):
    """The four signals and the command: a short history, the newest value last.

    All tuples are of one length, some ten seconds long; of each twentieth of a second the least and
    the greatest value of each signal, in the order in which they came. None where all were lost.
    """

    time_s: tuple[float, ...] = ()
    """Since the session began."""
    command_mA: tuple[float | None, ...] = ()
    """In current mode, else None."""
    command_mm: tuple[float | None, ...] = ()
    """In position mode, else None."""
    current_mA: tuple[float | None, ...] = ()
    spool_mm: tuple[float | None, ...] = ()
    pressure_MPa: tuple[float | None, ...] = ()
    position_mm: tuple[float | None, ...] = ()


class Residuals(msgspec.Struct, frozen=True, kw_only=True):
    """What a monitor finds: measured less modelled, and the cumulative sums that raise alarms.

    Residuals are in units of noise, None where the sample was lost. Sums are shares of the
    threshold, 0 … 1: the largest since the snapshot before.
    """

    spool: float | None = None
    pressure: float | None = None
    against: str = ""
    """What the model goes by: a diagnosis, a calibration, a unit as new."""
    spool_above: float = 0.0
    spool_below: float = 0.0
    pressure_above: float = 0.0
    pressure_below: float = 0.0


class Alarm(msgspec.Struct, frozen=True, kw_only=True):
    """An alarm of a monitor."""

    time: str
    """UTC, ISO 8601; of a log that of its frame, seconds where it has no time of day."""
    signal: str = ""
    """`spool` or `pressure` of a sum that alarmed during a test; empty for a change between."""
    side: str = ""
    """`above` or `below` what the model says."""
    causes: tuple[str, ...] = ()
    """What may have changed, the most likely first: `spool friction +0.04 ± 0.01`."""
    during: str = ""
    """Name of the test that ran, empty between tests."""
    recorded: str = ""
    """File with the seconds around it; empty where there is none."""

    @property
    def text(self) -> str:
        """What the alarm says, in a line."""
        if not self.causes:
            return f"{self.signal} {self.side} what the model says"
        return "most likely " + "; or ".join(self.causes)


class Ending(msgspec.Struct, frozen=True, kw_only=True):
    """How the session ended."""

    verdict: str
    """`HEALTHY`, `DEGRADED`, `FAULT`, `INCONCLUSIVE`, `NOT TESTED`; of a monitor `ALARM`,
    `NO ALARM` or, of too few ticks, `NOT MONITORED`."""
    reasons: tuple[str, ...] = ()


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """One look at a session.

    Texts are as others wrote them (names of actuators and tests); `to_dict` and `to_json` have them
    in one line without control characters. A page still has to escape its own markup.
    """

    number: int
    """Counts the snapshots of a session from 1: a greater one is newer."""
    time: str
    """UTC, ISO 8601."""
    command: str
    """`bit` or `monitor`."""
    actuator: str
    serial: int | None
    bus: BusState
    test: RunningTest | None = None
    mode: str | None = None
    """`current` or `position`: what the flight-control computer says that its commands are."""
    signals: Signals = msgspec.field(default_factory=Signals)
    residuals: Residuals | None = None
    alarms: tuple[Alarm, ...] = ()
    """The latest, newest last."""
    alarm_count: int = 0
    severities: tuple[Severity, ...] = ()
    working: str = ""
    """What is worked out now, such as a stage of the identification."""
    ending: Ending | None = None
    """The verdict; None before the end."""
    notes: tuple[str, ...] = ()
    """What the reader should know else, one sentence each."""
    schema: str = LIVE_SCHEMA

    def to_dict(self) -> dict[str, Any]:
        """Return the snapshot as plain dictionaries, lists, texts and numbers."""
        tree: dict[str, Any] = _printable_tree(msgspec.to_builtins(self))
        return tree

    def to_json(self) -> bytes:
        """Return the snapshot as one line of JSON without its end.

        Returns UTF-8, strict JSON.
        """
        return msgspec.json.encode(self.to_dict())

    @classmethod
    def from_json(cls, line: bytes) -> Snapshot:
        """Read what `to_json` wrote.

        line: one object. Returns the snapshot. ValueError: it is none.
        """
        try:
            return msgspec.json.decode(line, type=cls)
        except msgspec.MsgspecError as error:
            raise ValueError(f"no snapshot: {error}") from None


def _printable_tree(tree: Any) -> Any:
    """Make all texts of a tree fit for a terminal and JSON."""
    if isinstance(tree, str):
        return printable(tree)
    if isinstance(tree, dict):
        return {key: _printable_tree(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        if tree and not isinstance(tree[0], str | dict | list | tuple):
            return list(tree)  # numbers, and some of them None
        return [_printable_tree(value) for value in tree]
    return tree


TRACE_SPACING_S = 0.05
TraceRow = tuple[float | None, ...]
"""As the fields of `Signals`."""


class SignalTrace:
    """The least and greatest value in each twentieth of a second, for ten seconds, and the newest.

    One thread takes samples, another may ask for them; takes no lock.
    """

    def __init__(self) -> None:
        self._rows: deque[TraceRow] = deque(maxlen=2 * round(10.0 / TRACE_SPACING_S))
        self._span: list[TraceRow] = []
        self._due_s = TRACE_SPACING_S

    def take(
        self,
        time_s: float,
        mode: CommandMode | None,
        command: float,
        signals: tuple[float, float, float, float],
    ) -> None:
        """Take a sample: time since the session began, command, and the four signals; SI."""
        if time_s >= self._due_s:
            self._due_s = time_s + TRACE_SPACING_S
            span, self._span = self._span, []
            if span:
                self._rows.extend(_extremes(span))
        # To mA or mm.
        sent = finite(command * 1e3)
        self._span.append(
            (
                time_s,
                sent if mode is CommandMode.CURRENT else None,
                sent if mode is CommandMode.POSITION else None,
                *(
                    finite(value * scale)
                    # To mA, mm, MPa, mm.
                    for value, scale in zip(signals, (1e3, 1e3, 1e-6, 1e3), strict=True)
                ),
            )
        )

    def signals(self) -> Signals:
        """Return what was kept, in engineering units."""
        rows = (*self._rows, *self._span[-1:])
        if not rows:
            return Signals()
        times, *columns = zip(*rows, strict=True)
        return Signals(tuple(float(time or 0.0) for time in times), *columns)


def _extremes(span: Sequence[TraceRow]) -> tuple[TraceRow, TraceRow]:
    """Return two rows with the least and greatest value of each column, in their order in time."""
    times, *columns = zip(*span, strict=True)
    pairs: list[tuple[float | None, float | None]] = [(times[0], times[-1])]
    for column in columns:
        present = [value for value in column if value is not None]
        low, high = (min(present), max(present)) if present else (None, None)
        falls = low is not None and column.index(high) < column.index(low)
        pairs.append((high, low) if falls else (low, high))
    first, second = zip(*pairs, strict=True)
    return first, second


STANDARD_FRAME_OVERHEAD_BITS = 47
"""Of a data frame beside its data, the pause behind it included, stuff bits not (ISO 11898-1)."""
EXTENDED_FRAME_OVERHEAD_BITS = 67


class BusTraffic:
    """One thread takes frames, another may ask; takes no lock.

    bitrate: of the bus, bit/s; None where it is not known.
    """

    def __init__(self, bitrate: float | None = None) -> None:
        self._bitrate = bitrate
        self.frames = 0
        """Taken since the beginning."""
        self._bits = 0
        self._before = (time.monotonic(), 0, 0)
        self._changed = (time.monotonic(), 0)
        self._rate: float | None = None
        self._load: float | None = None

    def take(self, size: int, *, extended: bool = False) -> None:
        """Count a frame with so many bytes of data."""
        self.frames += 1
        self._bits += 8 * size + (
            EXTENDED_FRAME_OVERHEAD_BITS if extended else STANDARD_FRAME_OVERHEAD_BITS
        )

    def measure(self) -> tuple[float | None, float | None, bool]:
        """Return rate (frames/s), load (0 … 1) and whether the bus is silent; for one asker.

        Returns None where not known yet, or at all.
        """
        now, frames, bits = time.monotonic(), self.frames, self._bits
        then, frames_then, bits_then = self._before
        if now - then >= 0.5:
            self._rate = (frames - frames_then) / (now - then)
            if self._bitrate:
                self._load = min((bits - bits_then) / (now - then) / self._bitrate, 1.0)
            self._before = (now, frames, bits)
        if frames != self._changed[1]:
            self._changed = (now, frames)
        return self._rate, self._load, now - self._changed[0] >= 1.0


class Publisher:
    """Asks a session for a snapshot four times a second, in a thread of its own.

    The session only answers `look`, from what its own threads keep anyway: the thread that reads
    the bus neither waits for a reader nor knows of one. Readers ask for `latest` as often as they
    like, or `wait` for a newer one; no reader holds up another.

    look: makes the snapshot of a number; called by one thread at a time; period_s: between two
    snapshots.
    """

    def __init__(self, look: Callable[[int], Snapshot], period_s: float = 0.25) -> None:
        self._look = look
        self._period_s = period_s
        self._latest: Snapshot | None = None
        self._count = 0
        self._making = threading.Lock()
        self._ending = threading.Event()
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="ehadiag-live", daemon=True)
        self.ended = False
        """Whether the latest snapshot is the last."""

    def __enter__(self) -> Publisher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def latest(self) -> Snapshot | None:
        """The newest snapshot; None before the first. Takes no lock."""
        return self._latest

    def wait(self, after: int, timeout_s: float) -> Snapshot | None:
        """Wait for a snapshot that is newer than one already seen.

        after: number of the one seen last; 0: none yet; timeout_s: longest wait. Returns the
        newest; None where none came in time, or none will come any more.
        """
        with self._news:
            self._news.wait_for(lambda: self._count > after or self.ended, timeout_s)
            latest = self._latest
        return latest if latest is not None and latest.number > after else None

    def refresh(self) -> None:
        """Make a snapshot now: something happened that readers should see at once."""
        with self._making:
            if self.ended:
                return
            snapshot = self._look(self._count + 1)
            with self._news:
                self._latest, self._count = snapshot, snapshot.number
                self._news.notify_all()

    def close(self) -> None:
        """Make the last snapshot and end; may be called twice."""
        self._ending.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()
        self.refresh()
        with self._news:
            self.ended = True
            self._news.notify_all()

    def _run(self) -> None:
        while not self._ending.wait(self._period_s):
            self.refresh()


@contextmanager
def publish(
    look: Callable[[int], Snapshot], take: Callable[[Snapshot], None] | None
) -> Iterator[Callable[[], None]]:
    """Hand snapshots of a session to a reader, in a thread of its own, while the block runs.

    look: makes a snapshot, see `Publisher`; take: the reader; it gets the newest snapshot, the last
    one for certain. None: no snapshots. Yields makes a snapshot at once.
    """
    if take is None:
        yield lambda: None
        return

    def read() -> None:
        latest = 0
        while True:
            snapshot = publisher.wait(latest, 1.0)
            if snapshot is not None:
                latest = snapshot.number
                take(snapshot)
            elif publisher.ended:
                return

    publisher = Publisher(look)
    reader = threading.Thread(target=read, name="ehadiag-reader", daemon=True)
    try:
        with publisher:
            reader.start()
            yield publisher.refresh
    finally:
        reader.join(5.0)
