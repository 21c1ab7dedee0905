"""Runs one built-in test on a bus: requests it, records it, watches it, and says how it ended."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

import msgspec
from msgspec.structs import replace

from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import BusMap, default_map
from firmware_iface.codec import Encoder
from firmware_iface.errors import BusLostError, ConfigurationError, EhadiagError
from firmware_iface.handshake import ChannelLimits, Handshake, HandshakeAction, Phase, TimeLimits
from firmware_iface.live_decode import BitRequest, BitStatus, LiveDecoder, OnboardReader, Sample
from firmware_iface.logs.recorder import Recorder
from firmware_iface.recording import BitOutcome, OnboardResult, Recording
from firmware_iface.signals.recordings import choose_recording
from firmware_iface.transport.base import FrameSource, Transport, open_source
from firmware_iface.transport.frames import ColumnBuilder, Frame, FrameTable, concatenate

MAX_HELD_FRAMES = 4_000_000
"""Half an hour of this bus, 120 MB."""


class Assembler:
    """Collects frames as they come; bounded memory, about 1 µs a frame.

    Of more than `max_frames` frames the oldest are forgotten, at least half of them kept.
    One thread adds; the recordings are read when it has stopped, or by the same thread.
    """

    def __init__(
        self, source: str, bus_map: BusMap | None = None, max_frames: int = MAX_HELD_FRAMES
    ) -> None:
        self._source = source
        self._map = bus_map or default_map()
        self._half = max(max_frames // 2, 1)
        self._old: FrameTable | None = None
        self._new = ColumnBuilder()
        self._forgotten = 0

    def __len__(self) -> int:
        return len(self._new) + (0 if self._old is None else len(self._old))

    def add(self, frame: Frame) -> None:
        """Take one frame."""
        if len(self._new) >= self._half:
            self._forgotten += 0 if self._old is None else len(self._old)
            self._old, self._new = self._new.table(), ColumnBuilder()
        self._new.add_frame(frame)

    def extend(self, frames: Iterable[Frame]) -> None:
        """Take several frames, in order of arrival."""
        for frame in frames:
            self.add(frame)

    def table(self) -> FrameTable:
        """All frames kept, as columns."""
        new = self._new.table()
        return new if self._old is None else concatenate((self._old, new))

    def recordings(self) -> tuple[Recording, ...]:
        """All tests so far, at least one recording (see `align.assemble`)."""
        return self._recordings_of(self.table())

    def recording(self) -> Recording:
        """Last complete test so far; the last one begun if none was completed."""
        return self.recording_of(self.table())

    def recording_of(self, table: FrameTable) -> Recording:
        """As `recording`, of what `table` gave earlier; any thread may call this."""
        return choose_recording(self._recordings_of(table))

    def _recordings_of(self, table: FrameTable) -> tuple[Recording, ...]:
        notes: tuple[str, ...] = ()
        if self._forgotten:
            notes = (f"the first {self._forgotten} frames were too old to keep",)
        return assemble(table, self._map, self._source, notes)


TESTER_POLL_S = 0.02
"""s; longest wait for a frame before the time limits are looked at."""
MIN_STALL_NS = 100_000_000
"""A wait so much longer than `TESTER_POLL_S`: this process did not run, which is no silence of the
bus."""

MAX_BEHIND_S = 10.0
"""Longest time, s, by which a busy machine is taken to read frames late: a host clock that was set
back looks the same."""


class BitProgress(msgspec.Struct, frozen=True):
    """What a display shows while a test runs."""

    phase: Phase
    elapsed: float
    """s since the test began to run; 0 before."""
    duration: float
    frames: int
    sample: Sample | None


RequestProtocol: TypeAlias = Literal["native", "uds"]
"""How a test is requested and watched; telemetry comes from the bus with either."""


class Requester(Protocol):
    """A protocol's side of a session: its requests, and what it receives besides telemetry."""

    @property
    def second_sender(self) -> str:
        """Evidence that another node answers in the computer's place; empty if there is none."""

    @property
    def pending(self) -> bool:
        """Whether the last frame said that the answer to the request takes longer."""

    @property
    def awaited(self) -> bool:
        """Whether the computer's own result is still to come."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Identification data of the computer, one sentence each."""

    def request(self, action: HandshakeAction, test_id: int, now: int) -> Sequence[Frame]:
        """Return the frames to send for a request of a test."""

    def take(self, frame: Frame, now: int) -> Sequence[BitStatus | BitRequest]:
        """Take any frame of the bus, and return what it says of the test."""

    def due(self, now: int) -> Sequence[Frame]:
        """Return the frames to send now without a request of the handshake."""

    def withdraw(self) -> None:
        """Forget a start that is not sent yet: the session has decided to end."""

    def request_results(self) -> None:
        """Begin to ask for the computer's own result of the test, which is over."""

    def onboard(self, test_id: int | None) -> OnboardResult | None:
        """Return the computer's own result of a test; None: there is none."""


class NativeRequester:
    """The own messages: requests are frames of the mapping, all else comes unasked."""

    second_sender = ""
    pending = False
    notes = ()

    def __init__(self, bus_map: BusMap) -> None:
        self._encoder = Encoder(bus_map)
        self._onboard = OnboardReader(bus_map)

    @property
    def awaited(self) -> bool:
        """Whether the computer still identifies, or has not yet sent all of its result."""
        return self._onboard.awaited

    def request(self, action: HandshakeAction, test_id: int, now: int) -> Sequence[Frame]:
        """Return the frames to send for a request of a test."""
        return self._encoder.request(action.value, test_id, now)

    def take(self, frame: Frame, _now: int) -> Sequence[BitStatus | BitRequest]:
        """Take any frame; the status is decoded with the telemetry."""
        self._onboard.take(frame)
        return ()

    def due(self, _now: int) -> Sequence[Frame]:
        """Return nothing: the computer sends its status of its own."""
        return ()

    def withdraw(self) -> None:
        """Do nothing: a request is sent at once."""

    def request_results(self) -> None:
        """Ask nothing: the computer sends its result of its own."""

    def onboard(self, test_id: int | None) -> OnboardResult | None:
        """Return the computer's own result of a test; None: there is none."""
        return self._onboard.of_test(test_id)


def requester_of(bus_map: BusMap, protocol: RequestProtocol) -> Requester:
    """Return a protocol's side of a session; ConfigurationError: its packages are not there."""
    if protocol == "native":
        return NativeRequester(bus_map)
    if protocol != "uds":
        raise ConfigurationError(f"protocol {protocol!r}: need one of native, uds")
    from firmware_iface.uds.client import UdsClient  # noqa: PLC0415 - optional packages

    return UdsClient(bus_map.uds_identifiers)


class RequestOutcome(msgspec.Struct, frozen=True):
    """How the request ended."""

    complete: bool
    """The computer completed our test while telemetry flowed: worth diagnosing."""
    why: str
    """One clause for NOT TESTED; empty when complete."""
    outcome: BitOutcome
    """Last state and reason that the computer gave for the test."""
    test_id: int | None
    """Number of the test and of the actuator; None where the bus did not say."""
    serial: int | None
    abort_confirmed: bool | None
    """Whether an abort was obeyed; None when none was requested."""
    frames: int
    dropped: int
    """Frames that the reader was too slow for; the recording has them."""
    degraded: str
    """What the transport said of itself, empty if nothing."""
    recorded: tuple[Path, ...]
    """Files that hold the raw frames."""
    onboard: OnboardResult | None = None
    """The computer's own result; None: it sent none."""
    notes: tuple[str, ...] = ()
    """Identification data of the computer, one sentence each."""


def run_test(
    transport: Transport,
    *,
    test_id: int | None,
    duration: float,
    transmit: bool = False,
    recorder: Recorder | None = None,
    bus_map: BusMap | None = None,
    limits: ChannelLimits | None = None,
    times: TimeLimits | None = None,
    on_frame: Callable[[Frame], None] | None = None,
    stop: threading.Event | None = None,
    progress: Callable[[BitProgress], None] | None = None,
    all_there: Callable[[], bool] | None = None,
    onboard_wait: float = 0.0,
    protocol: RequestProtocol = "native",
) -> RequestOutcome:
    """Run one test, or with `transmit` false wait for one that someone else starts.

    The end of a bus, the stop, an exceeded limit and a computer that does not answer are outcomes,
    not exceptions.

    transport: open; to be closed by the caller; test_id: number of the test; None (listening only):
    any; duration: of the test, s; transmit: request the test, or only listen; recorder: gets every
    frame before anything else does, own requests included; it is closed at the end, whatever
    happens; limits: values beyond which the test is aborted; None: none; times: time limits of the
    handshake; None: the defaults; on_frame: gets every frame in order, in the caller's thread;
    stop: when set, the test is aborted; progress: called with the state of the test as it runs;
    all_there: asked once, when the computer has said that the test is complete: whether no frame of
    it may still come, so that there is nothing left to listen for; onboard_wait: how long to listen
    on, s, for the computer's own result, where it says that it identifies. Returns how the test
    ended, and the frames that were recorded. ConfigurationError: `transmit` without a test number
    or on a transport that listens only, a protocol whose packages are not there; InputOutputError:
    the recording cannot be written (an abort was requested).
    """
    if transmit and not transport.transmits:
        raise ConfigurationError(f"{transport.name}: opened to listen only, nothing is sent")
    if transmit and test_id is None:
        raise ConfigurationError("a test can be requested only by its number")
    machine = Handshake(
        test_id=test_id,
        duration=duration,
        transmit=transmit,
        now=transport.now_ns(),
        times=times or TimeLimits(),
        limits=limits or ChannelLimits(),
    )
    session = _BitSession(transport, recorder, bus_map or default_map(), machine, protocol)
    session.on_frame, session.progress, session.all_there = on_frame, progress, all_there
    session.onboard_wait = onboard_wait
    try:
        return session.run(stop or threading.Event())
    finally:
        if recorder is not None:
            recorder.close()


class _BitSession:
    """Carries frames to the machine and its requests to the bus."""

    def __init__(
        self,
        transport: Transport,
        recorder: Recorder | None,
        bus_map: BusMap,
        machine: Handshake,
        protocol: RequestProtocol,
    ) -> None:
        self._transport = transport
        self._recorder = recorder
        self._machine = machine
        self._decoder = LiveDecoder(bus_map)
        self._requester = requester_of(bus_map, protocol)
        self._frames = 0
        self._sample: Sample | None = None
        self._serial: int | None = None
        self._least_late: float = math.inf
        self._shown = 0
        self._shown_phase: Phase | None = None
        self.on_frame: Callable[[Frame], None] | None = None
        self.progress: Callable[[BitProgress], None] | None = None
        self.all_there: Callable[[], bool] | None = None
        self.onboard_wait = 0.0

    def run(self, stop: threading.Event) -> RequestOutcome:
        """Run to the end of the handshake."""
        recorder = self._recorder
        with open_source(
            self._transport,
            sink=recorder.write if recorder else None,
            idle=recorder.idle if recorder else None,
        ) as source:
            try:
                self._loop(source, stop)
                self._listen_on(source, stop)
            except BusLostError as error:
                self._machine.lost(f"bus lost: {error}")
            except BaseException:
                self._last_abort()
                raise
        return self._outcome(source)

    def _loop(self, source: FrameSource, stop: threading.Event) -> None:
        machine = self._machine
        now = source.now_ns()
        while machine.phase is not Phase.DONE:
            frame = source.receive(TESTER_POLL_S)
            before, now = now, source.now_ns()
            if self._transport.real_time and now - before > MIN_STALL_NS:
                machine.excuse(now - before)
            if stop.is_set():
                self._act(machine.stop(now, "stopped by the user"))
            machine.behind = self._behind(frame, now)
            if frame is not None:
                self._take(frame, now)
            elif source.at_end:
                machine.lost("the recording ends before the test does")
            self._act(machine.on_time(now))
            self._send_due(now)
            self._report(now)

    def _behind(self, frame: Frame | None, now: int) -> float:
        """How much later a frame is read than it came, s; stamps and time may differ by a constant.

        On a busy machine frames wait in the buffers of the system.
        """
        if frame is None or frame.sent or not self._transport.real_time:
            return 0.0
        late = (now - frame.time_ns) / 1e9
        self._least_late = min(self._least_late, late)
        return min(late - self._least_late, MAX_BEHIND_S)

    def _send_due(self, now: int) -> None:
        """Send what the protocol asks for of its own, as long as the handshake goes on."""
        if self._machine.transmit and self._machine.phase is not Phase.DONE:
            if self._machine.phase is Phase.CLOSING:
                self._requester.withdraw()
            self._send(self._requester.due(now))

    def _listen_on(self, source: FrameSource, stop: threading.Event) -> None:
        """Listen for the computer's own result of the complete test."""
        verdict = self._machine.verdict
        if verdict is None or not verdict.complete:
            return
        until = source.now_ns() + round(self.onboard_wait * 1e9)
        if self.onboard_wait and self._machine.transmit:
            self._requester.request_results()
        while self._requester.awaited and source.now_ns() < until and not stop.is_set():
            self._send(self._requester.due(source.now_ns()))
            frame = source.receive(TESTER_POLL_S)
            if frame is not None:
                self._take(frame, source.now_ns())
            elif source.at_end:
                return

    def _take(self, frame: Frame, now: int) -> None:
        self._frames += 1
        if self.on_frame is not None:
            self.on_frame(frame)
        if frame.sent:
            return
        content = self._decoder.decode(frame)
        answers = self._requester.take(frame, now)
        if second := self._decoder.second_sender or self._requester.second_sender:
            self._act(self._machine.on_second_sender(now, second))
        if self._requester.pending:
            self._machine.on_pending(now)
        for item in (content, *answers):
            self._take_content(item, now)

    def _take_content(self, content: BitStatus | Sample | BitRequest | None, now: int) -> None:
        match content:
            case BitStatus():
                if content.serial is not None:
                    self._serial = content.serial
                self._act(self._machine.on_status(now, content))
                self._look_whether_all_is_there()
            case Sample():
                self._sample = content
                self._act(self._machine.on_sample(now, content))
            case BitRequest():
                self._act(self._machine.on_foreign_request(now))

    def _look_whether_all_is_there(self) -> None:
        if self._machine.phase is Phase.TRAILING and self.all_there is not None:
            ask, self.all_there = self.all_there, None
            if ask():
                self._machine.all_there()

    def _act(self, actions: list[HandshakeAction]) -> None:
        for action in actions:
            try:
                self._request(action)
            except BusLostError as error:
                self._machine.lost(f"bus lost: {error}")
                return

    def _request(self, action: HandshakeAction) -> None:
        test_id = self._machine.test_id
        if test_id is None:
            raise AssertionError("a listener requests nothing")
        self._send(self._requester.request(action, test_id, self._transport.now_ns()))

    def _send(self, frames: Iterable[Frame]) -> None:
        for item in frames:
            frame = replace(item, time_ns=self._transport.stamp_ns())
            if self._recorder is not None:
                self._recorder.write(replace(frame, sent=True))
            self._transport.send(frame)

    def _last_abort(self) -> None:
        """Ask for zero current on the way out; nothing may hide the error that leads out."""
        over = (Phase.SETTLING, Phase.TRAILING, Phase.DONE)
        if self._machine.transmit and self._machine.phase not in over:
            recorder, self._recorder = self._recorder, None
            with contextlib.suppress(EhadiagError):
                self._request(HandshakeAction.ABORT)
            self._recorder = recorder

    def _report(self, now: int) -> None:
        machine = self._machine
        same = machine.phase is self._shown_phase
        if self.progress is None or (same and now - self._shown < 20_000_000):
            return
        self._shown, self._shown_phase = now, machine.phase
        since = machine.running_since
        elapsed = 0.0 if since is None else (now - since) / 1e9
        self.progress(
            BitProgress(machine.phase, elapsed, machine.duration, self._frames, self._sample)
        )

    def _outcome(self, source: FrameSource) -> RequestOutcome:
        verdict = self._machine.verdict
        if verdict is None:
            raise AssertionError("the handshake has not ended")
        status = verdict.status
        return RequestOutcome(
            complete=verdict.complete,
            why=verdict.why,
            outcome=BitOutcome(status.state, status.reason) if status else BitOutcome(),
            test_id=self._machine.test_id,
            serial=self._serial,
            abort_confirmed=verdict.abort_confirmed,
            frames=self._frames,
            dropped=source.overflow,
            degraded=source.detail,
            recorded=self._recorder.paths if self._recorder else (),
            onboard=self._requester.onboard(self._machine.test_id) if verdict.complete else None,
            notes=self._requester.notes,
        )
