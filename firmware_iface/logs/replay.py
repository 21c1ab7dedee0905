"""Plays logs: as a source of frames, or onto a bus."""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from ehadiag.core.errors import ConfigurationError, InputOutputError
from firmware_iface.logs.blocks import LogReader
from firmware_iface.logs.budget import Budget
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.interface import Transport

__all__ = ["ReplayTransport", "StoredLog", "play"]

BLOCK = 4096
"""Rows turned into frames at a time."""
STEP = 0.05
"""s; how fast playing notices that it shall stop."""


def _frames(table: FrameTable) -> Iterator[Frame]:
    for start in range(0, len(table), BLOCK):
        rows = slice(start, start + BLOCK)
        for time_ns, can_id, length, data, extended, fd, error, remote, sent, channel in zip(
            table.time_ns[rows].tolist(),
            table.can_id[rows].tolist(),
            table.length[rows].tolist(),
            table.data[rows],
            table.extended[rows].tolist(),
            table.fd[rows].tolist(),
            table.error[rows].tolist(),
            table.remote[rows].tolist(),
            table.sent[rows].tolist(),
            table.channel[rows].tolist(),
            strict=True,
        ):
            payload = data[:length].tobytes()
            yield Frame(time_ns, can_id, payload, extended, fd, error, remote, sent, channel)


class ReplayTransport(Transport):
    """A recorded log as a transport: as fast as it is read, or in the log's own time.

    `now_ns` is the time in the log: of the frame read last, or, in real time, of the moment.
    Nothing can be sent.

    Parameters
    ----------
    table : FrameTable
        The log's frames.
    name : str
        Name of the log.
    speed : float | None
        1: real time; 10: ten times as fast; None: as fast as possible.

    Raises
    ------
    ConfigurationError
        Speed not positive.
    """

    def __init__(self, table: FrameTable, name: str, *, speed: float | None = None) -> None:
        super().__init__(f"replay of {name}", transmit=False)
        if speed is not None and not speed > 0:
            raise ConfigurationError(f"{self.name}: speed {speed:g}, need more than 0")
        self._rows = _frames(table)
        self._next: Frame | None = next(self._rows, None)
        self._speed = speed
        self._first_ns = 0 if self._next is None else self._next.time_ns
        self._now = self._first_ns
        self._started = time.monotonic_ns()

    @property
    def at_end(self) -> bool:
        """Whether the last frame was read."""
        return self._next is None

    @property
    def real_time(self) -> bool:
        """Whether the log's own rhythm is kept."""
        return self._speed is not None

    def now_ns(self) -> int:
        """Time in the log, ns."""
        if self._speed is None:
            return self._now
        return self._first_ns + int((time.monotonic_ns() - self._started) * self._speed)

    def _receive(self, timeout: float) -> Frame | None:
        frame = self._next
        if frame is None:
            self._now += round(timeout * 1e9)  # a silent bus, as fast as it is read
            return None
        if self._speed is not None:
            wait = (frame.time_ns - self.now_ns()) / 1e9 / self._speed
            time.sleep(max(0.0, min(wait, timeout)))
            if wait > timeout:
                return None
        self._now = max(self._now, frame.time_ns)
        self._next = next(self._rows, None)
        return frame

    def _send(self, frame: Frame) -> None:
        raise AssertionError(f"not opened to send {frame}")

    def _close(self) -> None:
        self._next = None


class StoredLog:
    """The frames of a log on one adapter channel, as often as they are asked for.

    Parameters
    ----------
    path : Path | str
        File to read.
    channel : int | None
        Adapter channel to read; None: the only one.
    budget : Budget | None
        Bytes, frames and seconds that reading may cost; None: the default.

    Attributes
    ----------
    frames : int
        How many there are.

    Raises
    ------
    InputOutputError
        The log cannot be read, or has no frame on that channel.
    ConfigurationError
        Several channels and none chosen: on one bus they would be two senders.
    """

    frames: int

    def __init__(self, path: Path | str, channel: int | None, budget: Budget | None = None) -> None:
        self._path, self._budget = path, budget
        self._channel = channel
        counts: Counter[int] = Counter()
        for table in LogReader(path, budget):
            numbers, count = np.unique(table.channel, return_counts=True)
            counts.update(dict(zip(numbers.tolist(), count.tolist(), strict=True)))
        named = sorted(set(counts) - {0})
        if channel is None and len(named) > 1:
            listed = ", ".join(map(str, named))
            raise ConfigurationError(
                f"log {path}: frames of the adapter channels {listed}: choose one by --log-channel"
            )
        if channel is not None and named and channel not in named:
            listed = ", ".join(map(str, named))
            raise InputOutputError(
                f"log {path}: no frame on adapter channel {channel}, only on {listed}"
            )
        self.frames = sum(counts.values())
        if channel is not None:
            self.frames = counts[channel] + counts[0]

    def __iter__(self) -> Iterator[FrameTable]:
        for table in LogReader(self._path, self._budget):
            if self._channel is None:
                yield table
            else:
                yield table.rows((table.channel == self._channel) | (table.channel == 0))


def play(
    log: FrameTable | Iterable[FrameTable],
    transport: Transport,
    *,
    speed: float | None = 1.0,
    stop: threading.Event | None = None,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Send a log's frames onto a bus in their own rhythm; return how many were sent.

    Absolute deadlines: lateness is made up, not added up. Error frames are left out, no bus can
    be told to send them. `speed` None sends as fast as the bus takes them. `progress` gets the
    number sent, after every block.

    Parameters
    ----------
    log : FrameTable | Iterable[FrameTable]
        The log's frames, whole or in blocks.
    transport : Transport
        The bus to send and receive on.
    speed : float | None
        1: real time; 10: ten times as fast; None: as fast as the bus takes them.
    stop : threading.Event | None
        Set from outside to end early.
    progress : Callable[[int], None] | None
        Gets the number sent after every block.

    Returns
    -------
    int
        Number of frames sent.

    Raises
    ------
    ConfigurationError
        The transport was opened to listen only; speed not positive.
    BusLostError
        The bus failed.
    """
    if speed is not None and not speed > 0:
        raise ConfigurationError(f"speed {speed:g}, need more than 0")
    halt = stop or threading.Event()
    started = time.monotonic()
    first_ns: int | None = None
    sent = 0
    tables = (log,) if isinstance(log, FrameTable) else log
    for frame in itertools.chain.from_iterable(map(_frames, tables)):
        if frame.error:
            continue
        first_ns = frame.time_ns if first_ns is None else first_ns
        if speed is not None:
            due = started + (frame.time_ns - first_ns) / 1e9 / speed
            while (wait := due - time.monotonic()) > 0 and not halt.is_set():
                time.sleep(min(wait, STEP))
        if halt.is_set():
            break
        transport.send(frame)
        sent += 1
        if progress is not None and sent % BLOCK == 0:
            progress(sent)
    return sent
