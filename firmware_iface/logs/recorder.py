"""Records raw frames as they arrive, shares one bus among listeners, and plays logs."""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import (
    BusLostError,
    ConfigurationError,
    EhadiagError,
    InputOutputError,
    install_command,
    reason_of,
)
from firmware_iface.files import create_file
from firmware_iface.logs.can_readers import mf4_library
from firmware_iface.logs.log_files import Budget
from firmware_iface.logs.reader import FrameLog
from firmware_iface.transport.base import QUEUE_CAPACITY, RECEIVE_POLL_S, Transport
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.python_can import message_of

RECORDER_SUFFIXES = (".blf", ".asc", ".csv", ".trc", ".mf4")
DEFERRED_SUFFIX = ".mf4"
"""Its library writes when the file is closed, nothing before."""
MAX_RECORDER_FILES = 10_000
MIN_RECORDER_FILE_BYTES = 65_536
"""Bytes below which rotation makes no sense."""


def _open_writer(path: Path) -> Any:
    """Create a file, which must not exist, and return python-can's (or asammdf's) writer for it."""
    import can  # noqa: PLC0415 - half a second, only where a recording is written

    class FlushingBlfWriter(can.BLFWriter):
        """A BLF file that is readable up to its last flush.

        python-can's own keeps up to 128 KiB in memory and writes the true header at its end;
        without the header's start time a reader takes frame times as relative ones.
        """

        def flush(self) -> None:
            """Write all frames so far and a header that fits them."""
            while self._buffer_size:
                self._flush()
            end = self.file.tell()
            self.file.seek(0)
            self._write_header(end)
            self.file.seek(end)
            self.file.flush()

    descriptor = create_file(path)

    def begin(mode: Any, **text: Any) -> Any:
        # More than comes between two flushes: each is one write, and a killed process leaves no
        # half line or half container.
        return open(path, mode, 1 << 20, opener=lambda *_: descriptor, **text)

    suffix = path.suffix.lower()
    if suffix == ".mf4":
        file = begin("w+b")
        try:
            return mf4_library().MF4Writer(file)
        except (ImportError, NotImplementedError):
            file.close()
            path.unlink()
            raise ConfigurationError(
                f"recording {path}: MF4 needs asammdf: {install_command('mf4')}"
            ) from None
    if suffix == ".blf":
        return FlushingBlfWriter(begin("wb"))
    kinds: dict[str, Any] = {".asc": can.ASCWriter, ".csv": can.CSVWriter, ".trc": can.TRCWriter}
    return kinds[suffix](begin("w", encoding="utf-8", newline=""))


class Recorder:
    """Writes frames to `path` in the format of its suffix (BLF, ASC, CSV, TRC, MF4).

    Flushed every half second, so that a killed process leaves a readable file up to then; MF4 is
    the exception. With `max_bytes` a file that has grown beyond it is closed and the next one begun
    (`name.blf`, `name-2.blf`, …). An existing file is never overwritten. Any thread may call.

    path: file to write; the suffix chooses the format; max_bytes: size at which the next file is
    begun; None: never; channel: adapter channel to write for frames of a bus that has only one.
    ConfigurationError: unknown suffix; MF4 without its library; `max_bytes` too small;
    InputOutputError: the file exists, or cannot be written, now or later.
    """

    def __init__(
        self, path: Path | str, *, max_bytes: int | None = None, channel: int | None = None
    ) -> None:
        self._first = Path(path)
        self._suffix = self._first.suffix.lower()
        if self._suffix not in RECORDER_SUFFIXES:
            raise ConfigurationError(
                f"recording {path}: suffix unknown, need one of {' '.join(RECORDER_SUFFIXES)}"
            )
        if max_bytes is not None and max_bytes < MIN_RECORDER_FILE_BYTES:
            raise ConfigurationError(
                f"recording {path}: files of {max_bytes} bytes, need at least "
                f"{MIN_RECORDER_FILE_BYTES}"
            )
        self._max_bytes = max_bytes
        self._channel = channel or 0
        self._lock = threading.RLock()
        self._paths: list[Path] = []
        self._frames = 0
        self._skipped = 0
        self._flushed = time.monotonic()
        self._dirty = False
        self._closed = False
        self._writer: Any = None
        with self._guarded():
            try:
                self._begin()
            except BaseException:
                self._remove_files()
                raise

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files written so far, in order."""
        return tuple(self._paths)

    @property
    def frames(self) -> int:
        """Frames written."""
        return self._frames

    @property
    def skipped(self) -> int:
        """Frames that the format cannot hold: error, remote and FD frames in TRC."""
        return self._skipped

    def write(self, frame: Frame) -> None:
        """Take one frame; after `close` nothing is taken.

        frame: the frame to write. InputOutputError: the file cannot be written.
        """
        with self._guarded():
            if self._closed:
                return
            if self._suffix == ".trc" and (frame.error or frame.remote or frame.fd):
                self._skipped += 1
                return
            message = message_of(frame)
            if number := frame.channel or self._channel:
                # python-can counts channels from 0, and its MF4 writer as they are in the file.
                message.channel = number if self._suffix == ".mf4" else number - 1
            self._writer.on_message_received(message)
            self._frames += 1
            self._dirty = True
            # The first one at once: it gives a BLF header its start time.
            if self._frames == 1 or self._due():
                self._flush()

    def idle(self) -> None:
        """Flush if it is time; called while the bus is silent."""
        if self._dirty and self._due():
            self.flush()

    def flush(self) -> None:
        """Bring everything so far to the file."""
        with self._guarded():
            if not self._closed:
                self._flush()

    def close(self) -> None:
        """Finish the file; may be called twice."""
        with self._guarded():
            if not self._closed:
                self._closed = True
                try:
                    self._writer.stop()
                finally:  # a full disk must not leave the file open
                    self._let_go()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self) -> None:
        number = len(self._paths) + 1
        path = self._first
        if number > 1:
            path = path.with_name(f"{path.stem}-{number}{path.suffix}")
        self._writer = _open_writer(path)
        self._paths.append(path)
        self._flush()

    def _let_go(self) -> None:
        """Close the file, though what is left in memory cannot be written."""
        if self._suffix != DEFERRED_SUFFIX:
            with contextlib.suppress(OSError):
                self._writer.file.close()

    def _remove_files(self) -> None:
        """Remove the first file, into which not even its header could be written."""
        for path in self._paths:
            self._let_go()
            with contextlib.suppress(OSError):
                path.unlink()

    def _due(self) -> bool:
        # A second is the most that may be lost.
        return time.monotonic() - self._flushed >= 0.5

    def _flush(self) -> None:
        self._flushed = time.monotonic()
        self._dirty = False
        if self._suffix == DEFERRED_SUFFIX:
            return
        writer = self._writer
        (writer if hasattr(writer, "flush") else writer.file).flush()
        if self._max_bytes is not None and writer.file.tell() >= self._max_bytes:
            if len(self._paths) >= MAX_RECORDER_FILES:
                raise InputOutputError(
                    f"recording {self._first}: more than {MAX_RECORDER_FILES} files"
                )
            writer.stop()
            self._begin()

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """One caller at a time; errors of the file as ours."""
        with self._lock:
            try:
                yield
            except FileExistsError:
                raise InputOutputError(
                    f"recording {self._first}: exists, and is not overwritten; name another file"
                ) from None
            except OSError as error:
                raise InputOutputError(f"recording {self._first}: {reason_of(error)}") from None


class SharedBus:
    """Reads a bus in a thread of its own, records each frame once, and passes it to all branches.

    Nothing is sent. A bus or a recording that fails ends every branch with the error. While the
    context is open the branches may be read, each by one thread.

    transport: open; to be closed by the caller; branches: number of listeners; recorder: gets each
    frame before any listener; closed at the end of the context.
    """

    def __init__(self, transport: Transport, branches: int, recorder: Recorder) -> None:
        self._transport = transport
        self._recorder = recorder
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f"share {transport.name}", daemon=True
        )
        self.branches: tuple[Transport, ...] = tuple(_Branch(transport) for _ in range(branches))
        """What the listeners read."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._recorder.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                frame = self._transport.receive(RECEIVE_POLL_S)
                if frame is None:
                    self._recorder.idle()
                    continue
                self._recorder.write(frame)
                self._hand_on(frame)
        except EhadiagError as error:
            self._hand_on(error)

    def _hand_on(self, item: Frame | EhadiagError) -> None:
        for branch in self.branches:
            assert isinstance(branch, _Branch)
            branch.take(item)


class _Branch(Transport):
    """One listener's view of a bus; too slow a one loses the newest frames, and says so."""

    def __init__(self, transport: Transport) -> None:
        super().__init__(transport.name, transmit=False)
        self._frames: queue.Queue[Frame] = queue.Queue(QUEUE_CAPACITY)
        self._lost = 0
        self._error: EhadiagError | None = None

    def take(self, item: Frame | EhadiagError) -> None:
        """Queue a frame, or the error that ends the bus; in the thread that reads it."""
        if isinstance(item, EhadiagError):
            self._error = item
            return
        try:
            self._frames.put_nowait(item)
        except queue.Full:
            self._lost += 1

    def _receive(self, timeout: float) -> Frame | None:
        if self._lost:
            self._degrade(f"{self._lost} frames came faster than they were read")
        try:
            return self._frames.get(timeout > 0.0, timeout or None)
        except queue.Empty:
            if isinstance(self._error, BusLostError):
                raise self._fail(str(self._error).removeprefix(f"{self.name}: ")) from None
            if self._error is not None:
                raise self._error from None
            return None

    def _send(self, frame: Frame) -> None:
        raise AssertionError(f"a branch sends nothing, {frame} neither")

    def _close(self) -> None:
        """The bus is the caller's."""


REPLAY_BATCH_ROWS = 4096
"""Rows turned into frames at a time."""


def _frames(table: FrameTable) -> Iterator[Frame]:
    for start in range(0, len(table), REPLAY_BATCH_ROWS):
        rows = slice(start, start + REPLAY_BATCH_ROWS)
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

    table: the log's frames; name: name of the log; speed: 1: real time; 10: ten times as fast;
    None: as fast as possible. ConfigurationError: speed not positive.
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
    excluded : Collection[tuple[int, bool]]
        Identifiers, and whether they are extended, of frames that are left out.

    Attributes
    ----------
    frames : int
        How many there are, also those left out.
    left_out : int
        How many of them are left out.

    Raises
    ------
    InputOutputError
        The log cannot be read, or has no frame on that channel.
    ConfigurationError
        Several channels and none chosen: on one bus they would be two senders.
    """

    frames: int
    left_out: int

    def __init__(
        self,
        path: Path | str,
        channel: int | None,
        budget: Budget | None = None,
        excluded: Collection[tuple[int, bool]] = (),
    ) -> None:
        self._path, self._budget = path, budget
        self._channel = channel
        self._excluded = excluded
        self.left_out = 0
        counts: Counter[int] = Counter()
        for table in FrameLog(path, budget):
            numbers, count = np.unique(table.channel, return_counts=True)
            counts.update(dict(zip(numbers.tolist(), count.tolist(), strict=True)))
            self.left_out += int(np.count_nonzero(self._of_channel(table) & self._is_out(table)))
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
        for table in FrameLog(self._path, self._budget):
            yield table.rows(self._of_channel(table) & ~self._is_out(table))

    def _of_channel(self, table: FrameTable) -> NDArray[np.bool_]:
        if self._channel is None:
            return np.ones(len(table), dtype=np.bool_)
        return (table.channel == self._channel) | (table.channel == 0)

    def _is_out(self, table: FrameTable) -> NDArray[np.bool_]:
        out = np.zeros(len(table), dtype=np.bool_)
        for can_id, extended in self._excluded:
            out |= (table.can_id == can_id) & (table.extended == extended)
        return out


def play_log(
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

    log: the log's frames, whole or in blocks; speed: 1: real time; 10: ten times as fast; None: as
    fast as the bus takes them; stop: set from outside to end early; progress: gets the number sent
    after every block. ConfigurationError: the transport was opened to listen only; speed not
    positive; BusLostError: the bus failed.
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
                time.sleep(min(wait, RECEIVE_POLL_S))
        if halt.is_set():
            break
        transport.send(frame)
        sent += 1
        if progress is not None and sent % REPLAY_BATCH_ROWS == 0:
            progress(sent)
    return sent
