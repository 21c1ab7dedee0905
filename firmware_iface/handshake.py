"""The handshake that requests a test, and the limits that end it, without bus, threads or clock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import msgspec

from firmware_iface.live_decode import BitStatus, Sample
from firmware_iface.recording import (
    ACTIVE_BIT_STATES,
    CHANNELS,
    MAX_SAMPLE_GAP_S,
    BitReason,
    BitState,
    Channel,
)

LIMIT_WORDS = "beyond its limit"
LIMITED_CHANNELS = ("position", "pressure", "current")
"""Channels that can have a limit."""


class ChannelLimits(msgspec.Struct, frozen=True):
    """Magnitudes that end the test when exceeded; None is not watched.

    A limit counts as exceeded after `samples` successive samples of its channel beyond it: the CRC
    keeps out corrupted ones, a spike of the converter is not yet a surface that runs away.
    """

    position: float | None = None
    """m."""
    pressure: float | None = None
    """Pa, differential."""
    current: float | None = None
    """A."""
    samples: int = 3

    def watched(self) -> Iterator[tuple[str, float]]:
        """Channels with a limit."""
        for name in LIMITED_CHANNELS:
            limit: float | None = getattr(self, name)
            if limit is not None:
                yield name, limit


@dataclass(slots=True)
class ChannelWatch:
    """Counts the samples of each watched channel; times in ns on one clock.

    A message counts for the channels that it brings: where each has a message of its own, those of
    the others neither add to its count nor end it. What is not a number is no sample.
    """

    limits: ChannelLimits
    silence: float
    """s without a sample of a watched channel that end the test."""
    _beyond: dict[str, int] = field(init=False, default_factory=dict)
    _last_ns: dict[str, int] = field(init=False, default_factory=dict)

    def begin(self, now: int) -> None:
        """Begin anew: the test runs from now on."""
        self._beyond = {name: 0 for name, _ in self.limits.watched()}
        self._last_ns = dict.fromkeys(self._beyond, now)

    def excuse(self, pause_ns: int) -> None:
        """Take out a time in which the reader itself did not run."""
        for name in self._last_ns:
            self._last_ns[name] += pause_ns

    def on_sample(self, now: int, sample: Sample) -> str:
        """Take a sample; return why the test must end, empty if it need not."""
        for name, limit in self.limits.watched():
            value: float = getattr(sample, name)
            if name not in sample.brought or math.isnan(value):
                continue
            self._last_ns[name] = now
            self._beyond[name] = self._beyond[name] + 1 if abs(value) > limit else 0
            if self._beyond[name] >= self.limits.samples:
                channel: Channel = getattr(CHANNELS, name)
                found, most = value / channel.per_unit, limit / channel.per_unit
                unit = channel.unit
                return f"{name} {found:.4g} {unit} {LIMIT_WORDS} ±{most:.4g} {unit}"
        return ""

    def on_time(self, now: int) -> str:
        """Let time pass; return why the test must end, empty if it need not."""
        for name, last_ns in self._last_ns.items():
            if (now - last_ns) / 1e9 >= self.silence:
                return f"telemetry lost: no {name} for {self.silence:g} s, and its limit is watched"
        return ""


REASON_TEXTS = {
    BitReason.NONE: "no reason given",
    BitReason.UNKNOWN_TEST: "unknown test",
    BitReason.SUPPLY_PRESSURE_LOW: "supply pressure low",
    BitReason.OIL_TOO_COLD: "oil too cold",
    BitReason.NOT_CENTRED: "surface not centred",
    BitReason.ALREADY_RUNNING: "a test is already running",
    BitReason.INTERLOCK_OPEN: "interlock open",
}
END_TEXTS = {
    BitState.COMPLETE: "complete without having run",
    BitState.ABORTED: "aborted by the flight-control computer",
    BitState.IDLE: "the flight-control computer fell back to idle",
}
MIN_CONTRADICTIONS = 2
"""Times a status must contradict those before, 1: one damaged or late frame does it once."""

SLOWEST = 10.0
"""Times its length, 1, that a test may take while the computer says that it goes on: an emulated
one falls behind on a busy machine."""


class Phase(Enum):
    """Step that the handshake has reached."""

    SETTLING = "settling"
    WAITING = "waiting"
    REQUESTED = "requested"
    ARMING = "arming"
    RUNNING = "running"
    TRAILING = "trailing"
    CLOSING = "closing"
    ABORTING = "aborting"
    DONE = "done"


class HandshakeAction(Enum):
    """Message that the handshake sends next."""

    START = "start"
    ABORT = "abort"


class TimeLimits(msgspec.Struct, frozen=True):
    """Longest durations of each step, s."""

    settle: float = 0.06
    """Listening before the request: three status periods."""
    wait: float = 60.0
    """Listen only: until someone starts a test."""
    status: float = 1.0
    """Request to first answer."""
    pending: float = 5.0
    """Response pending to the answer."""
    arming: float = 10.0
    """Answer to running."""
    telemetry: float = MAX_SAMPLE_GAP_S
    """Silence of the telemetry, or of a watched channel, while the test runs."""
    finish: float = 1.0
    """End of the test's duration to the word that it is complete."""
    trail: float = 0.03
    """Listening after the end, for frames still under way, where there may be some."""
    quiet: float = 0.1
    """An unexpected end, or an obeyed abort, to the word that no test runs: five status periods."""
    abort: float = 1.0
    """Abort, or the last status of the running test after it, to the word that it was obeyed."""
    repeat: float = 0.1
    """Between two abort requests."""


class HandshakeResult(msgspec.Struct, frozen=True):
    """How the handshake ended."""

    complete: bool
    """The computer said so for our test, and telemetry flowed until then."""
    why: str
    """One clause for NOT TESTED; empty when complete."""
    status: BitStatus | None
    """Last word of the computer on the test, None when there was none."""
    abort_confirmed: bool | None = None
    """An abort was requested and obeyed; None when none was requested."""


@dataclass(slots=True)
class Handshake:
    """State machine of the handshake; times in ns on the clock of the frames.

    Each input returns the actions to carry out now, in order. `verdict` is set once `phase` is
    DONE. `test_id` None: listen only, whatever test someone else starts.
    """

    test_id: int | None
    duration: float
    transmit: bool
    now: int
    times: TimeLimits = field(default_factory=TimeLimits)
    limits: ChannelLimits = field(default_factory=ChannelLimits)
    phase: Phase = field(init=False)
    verdict: HandshakeResult | None = field(init=False, default=None)
    running_since: int | None = field(init=False, default=None)
    behind: float = field(init=False, default=0.0)
    """How much later than they came frames are read, s: what came since is not known yet."""
    _since: int = field(init=False)
    _answer_limit: float = field(init=False, default=0.0)
    _last_ns: int = field(init=False, default=0)
    _aborted_at: int = field(init=False, default=0)
    _before: BitStatus | None = field(init=False, default=None)
    _status: BitStatus | None = field(init=False, default=None)
    _serial: int | None = field(init=False, default=None)
    _other_serial: int = field(init=False, default=0)
    _elapsed: float = field(init=False, default=0.0)
    _counted_ns: int = field(init=False, default=0)
    _went_back: int = field(init=False, default=0)
    _why: str = field(init=False, default="")
    _rest_telemetry: bool = field(init=False, default=False)
    _goes_on: int = field(init=False, default=0)
    _going_on_at: int = field(init=False, default=0)
    _quiet_since: int | None = field(init=False, default=None)
    _watch: ChannelWatch = field(init=False)

    def __post_init__(self) -> None:
        if self.transmit and self.test_id is None:
            raise ValueError("a test that is requested needs its number")
        self.phase = Phase.SETTLING if self.transmit else Phase.WAITING
        self._since = self.now
        self._watch = ChannelWatch(self.limits, self.times.telemetry)
        self._watch.begin(self.now)

    def on_time(self, now: int) -> list[HandshakeAction]:
        """Let time pass; to be called at least every 50 ms."""
        waited = (now - self._since) / 1e9
        heard = waited - self.behind
        times = self.times
        actions: list[HandshakeAction] = []
        match self.phase:
            case Phase.SETTLING if waited >= times.settle:
                self._enter(Phase.REQUESTED, now)
                actions = [HandshakeAction.START]
            case Phase.WAITING if waited >= times.wait:
                self._end(f"no test was started within {times.wait:g} s")
            case Phase.REQUESTED if heard >= (limit := max(times.status, self._answer_limit)):
                actions = self._abort(f"no answer within {limit:.3g} s of the request", now)
            case Phase.ARMING if heard >= times.arming:
                actions = self._abort(f"still arming after {times.arming:g} s", now)
            case Phase.RUNNING if (now - self._last_ns) / 1e9 >= times.telemetry:
                actions = self._abort(f"telemetry lost for {times.telemetry:g} s", now)
            case Phase.RUNNING if why := self._read_late() or self._watch.on_time(now):
                actions = self._abort(why, now)
            case Phase.RUNNING if self._overdue(now, heard):
                late = f"not complete {times.finish:g} s after its {self.duration:g} s"
                actions = self._abort(late, now)
            case Phase.TRAILING if waited >= times.trail:
                self._end("")
            case Phase.CLOSING if waited >= times.quiet:
                self._end(self._why)
            case Phase.ABORTING if self._is_quiet(now):
                self._end(self._why, confirmed=True)
            case Phase.ABORTING if self._abort_failed(now):
                self._end(f"{self._why}; the abort was not confirmed", confirmed=False)
            case Phase.ABORTING if self._is_repeat_due(now):
                self._aborted_at = now
                actions = [HandshakeAction.ABORT]
        return actions

    def excuse(self, pause_ns: int) -> None:
        """Take out a time in which the reader itself did not run: what came then still waits."""
        self._since += pause_ns
        self._last_ns += pause_ns
        self._counted_ns += pause_ns
        self._watch.excuse(pause_ns)

    def on_status(self, now: int, status: BitStatus) -> list[HandshakeAction]:
        """Take a valid status message."""
        if second := self._second_status(status):
            return self.on_second_sender(now, second)
        match self.phase:
            case Phase.SETTLING:
                self._before = status
                if status.state in ACTIVE_BIT_STATES:
                    return self._end(f"test {status.test_id} of another tester is running")
            case Phase.WAITING:
                wanted = self.test_id is None or self._ours(status)
                # A later listener has missed the start, and waits for the next test.
                fresh = status.elapsed <= 0.1
                if status.state in ACTIVE_BIT_STATES and wanted and fresh:
                    self._follow(now, status)
            case Phase.REQUESTED:
                return self._answered(now, status)
            case Phase.ARMING | Phase.RUNNING:
                return self._progressed(now, status)
            case Phase.CLOSING | Phase.ABORTING:
                if status.state in ACTIVE_BIT_STATES and self._ours(status):
                    return self._runs_on(now)
                if self.phase is Phase.ABORTING and status.state not in ACTIVE_BIT_STATES:
                    self._status = status
                    self._quiet_since = self._quiet_since or now
        return []

    def on_sample(self, now: int, sample: Sample) -> list[HandshakeAction]:
        """Take a valid telemetry message."""
        self._last_ns = now
        if self.phase in (Phase.SETTLING, Phase.WAITING):
            self._rest_telemetry = True
        if self.phase not in (Phase.RUNNING, Phase.CLOSING, Phase.ABORTING):
            return []
        why = self._watch.on_sample(now, sample)
        if self.phase is Phase.ABORTING:
            self._why += f"; {why}" if why and LIMIT_WORDS not in self._why else ""
        elif why:
            return self._abort(f"{self._why}; {why}" if self._why else why, now)
        late = (now - self._since) / 1e9 < self.times.trail
        if self._rest_telemetry or late or self.phase is Phase.RUNNING:
            return []
        return self._runs_on(now)

    def on_pending(self, now: int) -> None:
        """Extend the time limit of the answer to the request; as long as a test may arm."""
        longer = (now - self._since) / 1e9 + self.times.pending
        self._answer_limit = min(longer, self.times.arming)

    def on_foreign_request(self, now: int) -> list[HandshakeAction]:
        """Take a request that someone else sent."""
        why = "another tester is on the bus"
        if not self.transmit:
            return []
        match self.phase:
            case Phase.SETTLING:
                return self._end(why)
            case Phase.REQUESTED:
                return self._close(why, now)
            case Phase.ARMING | Phase.RUNNING:
                return self._abort(why, now)
        return []

    def on_second_sender(self, now: int, why: str) -> list[HandshakeAction]:
        """Hear that somebody else sends as the computer does: nothing it says can be trusted."""
        match self.phase:
            case Phase.REQUESTED | Phase.ARMING | Phase.RUNNING:
                return self._abort(why, now)
            case Phase.SETTLING | Phase.TRAILING:
                return self._end(why)
        return []

    def _second_status(self, status: BitStatus) -> str:
        """What a status tells of a second computer on the bus; empty for nothing."""
        before = self._status
        if before is None or self.phase not in (Phase.ARMING, Phase.RUNNING, Phase.TRAILING):
            return ""
        self._serial = before.serial if self._serial is None else self._serial
        if None not in (self._serial, status.serial) and status.serial != self._serial:
            self._other_serial += 1
            if self._other_serial >= MIN_CONTRADICTIONS:
                return (
                    f"status of two actuators, serial {self._serial} and {status.serial}: a second"
                    " sender on the bus"
                )
        both_run = before.state is BitState.RUNNING is status.state
        # Late status frames go back by no more.
        if both_run and status.elapsed < before.elapsed - 0.1:
            self._went_back += 1
            if self._went_back >= MIN_CONTRADICTIONS:
                back = before.elapsed - status.elapsed
                return (
                    f"the status goes back by {back:.2f} s again and again: two time bases, a"
                    " second sender on the bus"
                )
        return ""

    def all_there(self) -> None:
        """Listen no longer for frames still under way: there are none."""
        if self.phase is Phase.TRAILING:
            self._end("")

    def stop(self, now: int, why: str) -> list[HandshakeAction]:
        """End the test early: the user wants it, or the host cannot go on."""
        match self.phase:
            case Phase.REQUESTED | Phase.ARMING | Phase.RUNNING | Phase.CLOSING:
                return self._abort(why, now)
            case Phase.SETTLING | Phase.WAITING:
                return self._end(why)
        return []

    def lost(self, why: str) -> None:
        """Give up: nothing can be sent any more."""
        if self.phase is Phase.CLOSING:
            self._end(self._why)
        elif self.phase is not Phase.DONE:
            confirmed = False if self.phase is Phase.ABORTING else None
            self._end(why, confirmed=confirmed)

    def _ours(self, status: BitStatus) -> bool:
        """Whether a status is of our test; a bus that names no test has only one."""
        return status.test_id is None or status.test_id == self.test_id

    def _answered(self, now: int, status: BitStatus) -> list[HandshakeAction]:
        ours = self._ours(status)
        if status.state in ACTIVE_BIT_STATES:
            if not ours:
                return self._close(f"test {status.test_id} of another tester is running", now)
            self._follow(now, status)
        elif status.state is BitState.REFUSED and ours:
            # The refusal of an earlier request may still be on its way.
            stale = self._before is not None and self._before.state is BitState.REFUSED
            if not (stale and (now - self._since) / 1e9 < self.times.settle):
                self._status = status
                why = status.refusal or REASON_TEXTS[status.reason]
                return self._close(f"refused: {why}", now)
        return []

    def _progressed(self, now: int, status: BitStatus) -> list[HandshakeAction]:
        if status.state is BitState.REFUSED:
            # The answer to another request; the computer goes on with the running test.
            return self.on_foreign_request(now)
        if not self._ours(status) and status.state is not BitState.IDLE:
            return self._close(f"the status changed to test {status.test_id}", now)
        self._status = status
        if status.elapsed > self._elapsed:
            self._elapsed, self._counted_ns = status.elapsed, now
        match status.state, self.phase:
            case BitState.RUNNING, Phase.ARMING:
                self._run(now)
            case BitState.COMPLETE, Phase.RUNNING:
                return self._complete(now)
            case BitState.ARMING, Phase.RUNNING:
                return self._abort("the test began anew", now)
            case (BitState.COMPLETE | BitState.ABORTED | BitState.IDLE) as state, _:
                return self._close(END_TEXTS[state], now)
        return []

    def _complete(self, now: int) -> list[HandshakeAction]:
        """Listen for frames still under way; longer where the test cannot be over yet."""
        since = self.running_since
        # Statuses are late by less than 0.1 s.
        if since is not None and (now - since) / 1e9 < self.duration - 0.1:
            return self._close("", now)
        self._enter(Phase.TRAILING, now)
        return []

    def _follow(self, now: int, status: BitStatus) -> None:
        if status.test_id is not None:
            self.test_id = status.test_id
        self._status = status
        if status.state is BitState.RUNNING:
            self._run(now)
        else:
            self._enter(Phase.ARMING, now)

    def _run(self, now: int) -> None:
        self._enter(Phase.RUNNING, now)
        self.running_since = now
        self._last_ns = now
        self._watch.begin(now)

    def _close(self, why: str, now: int) -> list[HandshakeAction]:
        """Listen whether the test has ended indeed: nobody signs a status."""
        self._why = why
        self._goes_on = 0
        self._enter(Phase.CLOSING, now)
        return []

    def _runs_on(self, now: int) -> list[HandshakeAction]:
        """Take a sign that the test goes on, though its end was announced or an abort requested."""
        self._going_on_at, self._quiet_since = now, None
        self._goes_on += 1
        if self.phase is Phase.ABORTING or self._goes_on < MIN_CONTRADICTIONS:
            return []
        announced = self._why or "complete too early"
        return self._abort(f"{announced}, yet the test goes on: a second sender on the bus", now)

    def _is_quiet(self, now: int) -> bool:
        """Whether the computer has said for long enough that no test runs."""
        since = self._quiet_since
        return since is not None and (now - since) / 1e9 >= self.times.quiet

    def _is_repeat_due(self, now: int) -> bool:
        return self._quiet_since is None and (now - self._aborted_at) / 1e9 >= self.times.repeat

    def _abort_failed(self, now: int) -> bool:
        """Whether the abort was not obeyed; a test that goes on is watched to its end."""
        whole = self.times.arming + self.duration + self.times.finish
        last = min(max(self._since, self._going_on_at), self._since + round(whole * 1e9))
        return (now - last) / 1e9 >= self.times.abort

    def _read_late(self) -> str:
        """Why limits cannot be watched; empty: they can, or there are none."""
        if self.behind <= self.times.finish or not any(self.limits.watched()):
            return ""
        return f"frames are read {self.behind:.1f} s late: limits cannot be watched"

    def _overdue(self, now: int, heard: float) -> bool:
        """Whether the test should be complete; not while the computer counts on to its end."""
        counts = self._elapsed < self.duration
        counts &= (now - self._counted_ns) / 1e9 - self.behind < self.times.finish
        return heard >= (SLOWEST if counts else 1.0) * self.duration + self.times.finish

    def _enter(self, phase: Phase, now: int) -> None:
        self.phase = phase
        self._since = now

    def _abort(self, why: str, now: int) -> list[HandshakeAction]:
        if not self.transmit:
            return self._end(why)
        self._why = why
        self._enter(Phase.ABORTING, now)
        self._aborted_at, self._quiet_since = now, None
        return [HandshakeAction.ABORT]

    def _end(self, why: str, *, confirmed: bool | None = None) -> list[HandshakeAction]:
        self.phase = Phase.DONE
        self.verdict = HandshakeResult(not why, why, self._status, confirmed)
        return []
