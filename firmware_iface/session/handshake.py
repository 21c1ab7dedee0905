"""The handshake that requests a test, as a state machine without bus, threads or clock.

    SETTLING -> REQUESTED -> ARMING -> RUNNING -> TRAILING -> DONE
                     \\_________\\_________\\-> ABORTING -> DONE

Every step has a time limit. A listen-only tester starts in WAITING instead, follows a test that
someone else requested, and sends nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from ehadiag.core.recording import BitReason, BitState
from firmware_iface.codec.live_messages import BitStatus, Sample
from firmware_iface.session.limits import Limits, Watch

__all__ = [
    "Action",
    "Handshake",
    "Phase",
    "TimeLimits",
    "Verdict",
]

REASONS = {
    BitReason.NONE: "no reason given",
    BitReason.UNKNOWN_TEST: "unknown test",
    BitReason.SUPPLY_PRESSURE_LOW: "supply pressure low",
    BitReason.OIL_TOO_COLD: "oil too cold",
    BitReason.NOT_CENTRED: "surface not centred",
    BitReason.ALREADY_RUNNING: "a test is already running",
    BitReason.INTERLOCK_OPEN: "interlock open",
}
ACTIVE = (BitState.ARMING, BitState.RUNNING)
TWICE = 2
"""Times a status must contradict those before: one damaged frame does it once."""
BACK_S = 0.1
"""s by which the elapsed time of late status frames goes back."""
FRESH_S = 0.1
"""A listener that comes later to a test waits for the next one: it has missed the start."""


class Phase(Enum):
    """Where the handshake is."""

    SETTLING = "settling"
    WAITING = "waiting"
    REQUESTED = "requested"
    ARMING = "arming"
    RUNNING = "running"
    TRAILING = "trailing"
    ABORTING = "aborting"
    DONE = "done"


class Action(Enum):
    """What the machine wants sent."""

    START = "start"
    ABORT = "abort"


@dataclass(frozen=True, slots=True)
class TimeLimits:
    """Longest durations of each step, s."""

    settle: float = 0.06
    """Listening before the request: three status periods."""
    wait: float = 60.0
    """Listen only: until someone starts a test."""
    status: float = 1.0
    """Request to first answer."""
    arming: float = 10.0
    """Answer to running."""
    telemetry: float = 0.25
    """Silence of the telemetry, or of a watched channel, while the test runs."""
    finish: float = 1.0
    """End of the test's duration to the word that it is complete."""
    trail: float = 0.03
    """Listening after the end, for frames still under way, where there may be some."""
    abort: float = 1.0
    """Abort to the word that it was obeyed."""
    repeat: float = 0.1
    """Between two abort requests."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """How the handshake ended.

    Attributes
    ----------
    complete : bool
        The computer said so for our test, and telemetry flowed until then.
    why : str
        One clause for NOT TESTED; empty when complete.
    status : BitStatus | None
        Last word of the computer on the test, None when there was none.
    abort_confirmed : bool | None
        An abort was requested and obeyed; None when none was requested.
    """

    complete: bool
    why: str
    status: BitStatus | None
    abort_confirmed: bool | None = None


@dataclass(slots=True)
class Handshake:
    """The machine; times in ns on the clock of the frames.

    Each input returns the actions to carry out now, in order. `verdict` is set once `phase` is
    DONE. `test_id` None: listen only, whatever test someone else starts.
    """

    test_id: int | None
    duration: float
    transmit: bool
    now: int
    times: TimeLimits = field(default_factory=TimeLimits)
    limits: Limits = field(default_factory=Limits)
    phase: Phase = field(init=False)
    verdict: Verdict | None = field(init=False, default=None)
    running_since: int | None = field(init=False, default=None)
    _since: int = field(init=False)
    _heard: int = field(init=False, default=0)
    _aborted_at: int = field(init=False, default=0)
    _before: BitStatus | None = field(init=False, default=None)
    _status: BitStatus | None = field(init=False, default=None)
    _serial: int | None = field(init=False, default=None)
    _other_serial: int = field(init=False, default=0)
    _went_back: int = field(init=False, default=0)
    _why: str = field(init=False, default="")
    _watch: Watch = field(init=False)

    def __post_init__(self) -> None:
        if self.transmit and self.test_id is None:
            raise ValueError("a test that is requested needs its number")
        self.phase = Phase.SETTLING if self.transmit else Phase.WAITING
        self._since = self.now
        self._watch = Watch(self.limits, self.times.telemetry)

    def on_time(self, now: int) -> list[Action]:
        """Let time pass; to be called at least every 50 ms."""
        waited = (now - self._since) / 1e9
        times = self.times
        actions: list[Action] = []
        match self.phase:
            case Phase.SETTLING if waited >= times.settle:
                self._enter(Phase.REQUESTED, now)
                actions = [Action.START]
            case Phase.WAITING if waited >= times.wait:
                self._end(f"no test was started within {times.wait:g} s")
            case Phase.REQUESTED if waited >= times.status:
                actions = self._abort(f"no answer within {times.status:g} s of the request", now)
            case Phase.ARMING if waited >= times.arming:
                actions = self._abort(f"still arming after {times.arming:g} s", now)
            case Phase.RUNNING if (now - self._heard) / 1e9 >= times.telemetry:
                actions = self._abort(f"telemetry lost for {times.telemetry:g} s", now)
            case Phase.RUNNING if why := self._watch.on_time(now):
                actions = self._abort(why, now)
            case Phase.RUNNING if waited >= self.duration + times.finish:
                late = f"not complete {times.finish:g} s after its {self.duration:g} s"
                actions = self._abort(late, now)
            case Phase.TRAILING if waited >= times.trail:
                self._end("")
            case Phase.ABORTING if waited >= times.abort:
                self._end(f"{self._why}; the abort was not confirmed", confirmed=False)
            case Phase.ABORTING if (now - self._aborted_at) / 1e9 >= times.repeat:
                self._aborted_at = now
                actions = [Action.ABORT]
        return actions

    def excuse(self, pause_ns: int) -> None:
        """Take out a time in which the reader itself did not run: what came then still waits."""
        self._since += pause_ns
        self._heard += pause_ns
        self._watch.excuse(pause_ns)

    def on_status(self, now: int, status: BitStatus) -> list[Action]:
        """Take a valid status message."""
        if second := self._second_status(status):
            return self.on_second_sender(now, second)
        match self.phase:
            case Phase.SETTLING:
                self._before = status
                if status.state in ACTIVE:
                    return self._end(f"test {status.test_id} of another tester is running")
            case Phase.WAITING:
                wanted = self.test_id is None or self._ours(status)
                fresh = status.elapsed <= FRESH_S
                if status.state in ACTIVE and wanted and fresh:
                    self._follow(now, status)
            case Phase.REQUESTED:
                return self._answered(now, status)
            case Phase.ARMING | Phase.RUNNING:
                return self._progressed(now, status)
            case Phase.ABORTING if status.state not in ACTIVE:
                self._status = status
                return self._end(self._why, confirmed=True)
        return []

    def on_sample(self, now: int, sample: Sample) -> list[Action]:
        """Take a valid telemetry message."""
        self._heard = now
        if self.phase is not Phase.RUNNING:
            return []
        why = self._watch.on_sample(now, sample)
        return self._abort(why, now) if why else []

    def on_foreign_request(self, now: int) -> list[Action]:
        """Take a request that someone else sent."""
        why = "another tester is on the bus"
        if not self.transmit:
            return []
        match self.phase:
            case Phase.SETTLING | Phase.REQUESTED:
                # Whose test an answer would mean can no longer be told: an abort might hit theirs.
                return self._end(why)
            case Phase.ARMING | Phase.RUNNING:
                return self._abort(why, now)
        return []

    def on_second_sender(self, now: int, why: str) -> list[Action]:
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
            if self._other_serial >= TWICE:
                return (
                    f"status of two actuators, serial {self._serial} and {status.serial}: a second"
                    " sender on the bus"
                )
        both_run = before.state is BitState.RUNNING is status.state
        if both_run and status.elapsed < before.elapsed - BACK_S:
            self._went_back += 1
            if self._went_back >= TWICE:
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

    def stop(self, now: int, why: str) -> list[Action]:
        """End the test early: the user wants it, or the host cannot go on."""
        match self.phase:
            case Phase.REQUESTED | Phase.ARMING | Phase.RUNNING:
                return self._abort(why, now)
            case Phase.SETTLING | Phase.WAITING:
                return self._end(why)
        return []

    def lost(self, why: str) -> None:
        """Give up: nothing can be sent any more."""
        if self.phase is not Phase.DONE:
            confirmed = False if self.phase is Phase.ABORTING else None
            self._end(why, confirmed=confirmed)

    def _ours(self, status: BitStatus) -> bool:
        """Whether a status is of our test; a bus that names no test has only one."""
        return status.test_id is None or status.test_id == self.test_id

    def _answered(self, now: int, status: BitStatus) -> list[Action]:
        ours = self._ours(status)
        if status.state in ACTIVE:
            if not ours:
                return self._end(f"test {status.test_id} of another tester is running")
            self._follow(now, status)
        elif status.state is BitState.REFUSED and ours:
            # The refusal of an earlier request may still be on its way.
            stale = self._before is not None and self._before.state is BitState.REFUSED
            if not (stale and (now - self._since) / 1e9 < self.times.settle):
                self._status = status
                return self._end(f"refused: {REASONS[status.reason]}")
        return []

    def _progressed(self, now: int, status: BitStatus) -> list[Action]:
        if status.state is BitState.REFUSED:
            # The answer to another request; the computer goes on with the running test.
            return self.on_foreign_request(now)
        if not self._ours(status) and status.state is not BitState.IDLE:
            return self._end(f"the status changed to test {status.test_id}")
        self._status = status
        match status.state, self.phase:
            case BitState.RUNNING, Phase.ARMING:
                self._run(now)
            case BitState.COMPLETE, Phase.RUNNING:
                self._enter(Phase.TRAILING, now)
            case BitState.COMPLETE, _:
                self._end("complete without having run")
            case BitState.ABORTED, _:
                self._end("aborted by the flight-control computer")
            case BitState.IDLE, _:
                self._end("the flight-control computer fell back to idle")
            case BitState.ARMING, Phase.RUNNING:
                return self._abort("the test began anew", now)
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
        self._heard = now
        self._watch.begin(now)

    def _enter(self, phase: Phase, now: int) -> None:
        self.phase = phase
        self._since = now

    def _abort(self, why: str, now: int) -> list[Action]:
        if not self.transmit:
            return self._end(why)
        self._why = why
        self._enter(Phase.ABORTING, now)
        self._aborted_at = now
        return [Action.ABORT]

    def _end(self, why: str, *, confirmed: bool | None = None) -> list[Action]:
        self.phase = Phase.DONE
        self.verdict = Verdict(not why, why, self._status, confirmed)
        return []
