"""State machine of the handshake: every way a request can end."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from firmware_iface.handshake import ChannelLimits, Handshake, HandshakeAction, Phase, TimeLimits
from firmware_iface.live_decode import BitStatus, Sample
from firmware_iface.recording import BitReason, BitState

MS = 1_000_000
QUIET = Sample(0.0, 0.0, 0.0, 0.0)
IDLE = BitStatus(BitState.IDLE)


def status(state: BitState, test_id: int = 1, reason: BitReason = BitReason.NONE) -> BitStatus:
    return BitStatus(state, reason, test_id)


class Driver:
    """Runs a machine on a clock of its own, and collects what it wants sent."""

    def __init__(self, *, transmit: bool = True, test_id: int | None = 1, **options: object):
        self.now = 1_000_000 * MS
        self.sent: list[HandshakeAction] = []
        self.machine = Handshake(
            test_id=test_id, duration=1.0, transmit=transmit, now=self.now, **options
        )

    def wait(self, seconds: float, *, telemetry: bool = True) -> Driver:
        end = self.now + round(seconds * 1e9)
        while self.now < end:
            self.now += 10 * MS
            if telemetry:
                self.sample(QUIET)
            self.sent += self.machine.on_time(self.now)
        return self

    def sample(self, sample: Sample) -> Driver:
        self.sent += self.machine.on_sample(self.now, sample)
        return self

    def hear(self, message: BitStatus) -> Driver:
        self.sent += self.machine.on_status(self.now, message)
        return self

    def requested(self) -> Driver:
        self.hear(IDLE).wait(0.1)
        assert self.sent == [HandshakeAction.START]
        return self

    def running(self) -> Driver:
        self.requested().hear(status(BitState.ARMING)).hear(status(BitState.RUNNING))
        assert self.machine.phase is Phase.RUNNING
        return self

    def ended(self) -> str:
        if self.machine.phase in (Phase.CLOSING, Phase.ABORTING):
            self.wait(TimeLimits().quiet, telemetry=False)
        assert self.machine.phase is Phase.DONE
        assert self.machine.verdict is not None
        assert self.machine.verdict.complete == (self.machine.verdict.why == "")
        return self.machine.verdict.why


def test_a_test_that_goes_well_is_complete_and_sends_one_start() -> None:
    driver = Driver().running().wait(1.0).hear(status(BitState.COMPLETE)).wait(0.1)
    assert driver.ended() == ""
    assert driver.sent == [HandshakeAction.START]


def test_nothing_is_sent_before_the_bus_was_listened_to() -> None:
    driver = Driver()
    driver.wait(0.05)
    assert driver.sent == []


@pytest.mark.parametrize(("until", "complete"), [(1.0, True), (0.5, False)])
def test_a_slow_computer_is_waited_for_as_long_as_it_counts(until: float, complete: bool) -> None:
    driver = Driver().running()
    for k in range(1, 101):
        elapsed = min(0.01 * k, until)
        driver.wait(0.05).hear(replace(status(BitState.RUNNING), elapsed=elapsed))
    assert (driver.machine.phase is Phase.RUNNING) is complete
    assert (HandshakeAction.ABORT in driver.sent) is not complete


def test_a_pause_of_the_reader_is_no_end_of_the_counting() -> None:
    driver = Driver().running()
    for k in range(1, 41):
        driver.wait(0.05).hear(replace(status(BitState.RUNNING), elapsed=0.01 * k))
    driver.now += 1_500 * MS
    driver.machine.excuse(1_500 * MS)
    assert driver.wait(0.05).machine.phase is Phase.RUNNING
    assert driver.wait(1.0).sent[-1] is HandshakeAction.ABORT  # it counts no more


def test_what_is_still_to_be_read_is_not_late() -> None:
    driver = Driver().requested()
    driver.machine.behind = 2.0
    assert driver.wait(2.9).sent == [HandshakeAction.START]
    assert driver.wait(0.1).sent == [HandshakeAction.START, HandshakeAction.ABORT]


@pytest.mark.parametrize("watched", [True, False])
def test_a_reader_too_late_to_watch_limits_ends_the_test(watched: bool) -> None:
    driver = Driver().running()
    driver.machine.limits = ChannelLimits(position=0.02 if watched else None)
    driver.machine.behind = 1.1
    driver.wait(0.01)
    assert (HandshakeAction.ABORT in driver.sent) is watched


def test_nothing_missing_ends_the_listening_at_once() -> None:
    driver = Driver().running().wait(1.0).hear(status(BitState.COMPLETE))
    assert driver.machine.phase is Phase.TRAILING
    driver.machine.all_there()
    assert driver.ended() == ""


def test_nothing_missing_ends_no_test_that_is_not_complete() -> None:
    driver = Driver().running()
    driver.machine.all_there()
    assert driver.machine.phase is Phase.RUNNING


@pytest.mark.parametrize("reason", list(BitReason))
def test_a_refusal_ends_with_its_reason(reason: BitReason) -> None:
    driver = Driver().requested().hear(status(BitState.REFUSED, reason=reason))
    assert driver.ended().startswith("refused: ")
    assert driver.machine.verdict.status.reason is reason
    assert driver.sent == [HandshakeAction.START]


def test_each_refusal_reads_differently() -> None:
    texts = {
        Driver().requested().hear(status(BitState.REFUSED, reason=item)).ended()
        for item in BitReason
    }
    assert len(texts) == len(BitReason)


def test_a_refusal_from_before_the_request_is_not_taken_for_an_answer() -> None:
    driver = Driver().hear(status(BitState.REFUSED)).wait(0.07)
    driver.hear(status(BitState.REFUSED))
    assert driver.machine.phase is Phase.REQUESTED
    driver.hear(status(BitState.RUNNING))
    assert driver.machine.phase is Phase.RUNNING


def test_an_end_from_before_the_request_is_not_taken_for_an_answer() -> None:
    driver = Driver().requested()
    driver.hear(status(BitState.COMPLETE)).hear(status(BitState.ABORTED)).hear(IDLE)
    assert driver.machine.phase is Phase.REQUESTED


def test_no_answer_asks_for_an_abort() -> None:
    driver = Driver().requested().wait(1.0)
    assert HandshakeAction.ABORT in driver.sent
    driver.hear(IDLE)
    assert driver.ended() == "no answer within 1 s of the request"
    assert driver.machine.verdict.abort_confirmed is True


def test_an_abort_is_repeated_until_its_time_limit() -> None:
    driver = Driver().requested().wait(3.0)
    assert driver.ended().endswith("the abort was not confirmed")
    assert driver.machine.verdict.abort_confirmed is False
    assert 5 <= driver.sent.count(HandshakeAction.ABORT) <= 11


def test_arming_for_ever_is_aborted() -> None:
    driver = Driver().requested().hear(status(BitState.ARMING)).wait(10.1)
    assert HandshakeAction.ABORT in driver.sent
    assert driver.hear(IDLE).ended() == "still arming after 10 s"


def test_lost_telemetry_is_aborted() -> None:
    driver = Driver().running().wait(0.3, telemetry=False)
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]
    assert driver.hear(status(BitState.ABORTED)).ended() == "telemetry lost for 0.25 s"


def test_a_short_pause_of_the_telemetry_is_none_of_the_handshakes_business() -> None:
    driver = Driver().running().wait(0.2, telemetry=False).wait(0.2, telemetry=True)
    assert driver.machine.phase is Phase.RUNNING


def test_time_in_which_the_reader_did_not_run_is_no_silence() -> None:
    driver = Driver().running().wait(0.1)
    driver.now += 400 * MS
    driver.machine.excuse(400 * MS)
    driver.sent += driver.machine.on_time(driver.now)
    assert driver.machine.phase is Phase.RUNNING
    assert driver.wait(0.3, telemetry=False).sent == [HandshakeAction.START, HandshakeAction.ABORT]


def test_a_test_that_never_ends_is_aborted() -> None:
    driver = Driver().running().wait(2.05)
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]
    assert "not complete 1 s after its 1 s" in driver.hear(IDLE).ended()


def test_an_abort_by_the_computer_ends_the_test() -> None:
    driver = Driver().running().hear(status(BitState.ABORTED))
    assert driver.ended() == "aborted by the flight-control computer"
    assert driver.sent == [HandshakeAction.START]


def test_a_restart_of_the_computer_ends_the_test() -> None:
    assert "fell back to idle" in Driver().running().hear(IDLE).ended()


def test_a_test_that_begins_anew_is_aborted() -> None:
    driver = Driver().running().hear(status(BitState.ARMING))
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]
    assert driver.hear(IDLE).ended() == "the test began anew"


def test_complete_without_running_is_no_test() -> None:
    driver = Driver().requested().hear(status(BitState.ARMING)).hear(status(BitState.COMPLETE))
    assert driver.ended() == "complete without having run"


def test_someone_elses_running_test_is_left_alone() -> None:
    driver = Driver().hear(status(BitState.RUNNING, test_id=2))
    assert "another tester" in driver.ended()
    assert driver.sent == []


def test_an_answer_with_another_number_is_someone_elses() -> None:
    driver = Driver().requested().hear(status(BitState.ARMING, test_id=2))
    assert "another tester" in driver.ended()
    assert driver.sent == [HandshakeAction.START]


def test_a_change_of_the_tests_number_while_it_runs_ends_it() -> None:
    assert "changed to test 2" in Driver().running().hear(status(BitState.RUNNING, 2)).ended()


def test_a_foreign_request_before_the_answer_ends_without_an_abort_that_could_hit_theirs() -> None:
    driver = Driver().requested()
    driver.sent += driver.machine.on_foreign_request(driver.now)
    assert driver.ended() == "another tester is on the bus"
    assert driver.sent == [HandshakeAction.START]


def test_a_foreign_request_while_our_test_runs_aborts_it() -> None:
    driver = Driver().running()
    driver.sent += driver.machine.on_foreign_request(driver.now)
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]
    assert driver.hear(status(BitState.ABORTED)).ended() == "another tester is on the bus"


def test_a_foreign_request_seen_only_by_its_refusal_aborts_too() -> None:
    driver = Driver().running().hear(status(BitState.REFUSED, 2, BitReason.ALREADY_RUNNING))
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]


@pytest.mark.parametrize(
    ("limits", "sample", "why"),
    [
        (
            ChannelLimits(position=0.01),
            Sample(0, 0, 0, -0.02531),
            "position -25.31 mm beyond its limit ±10 mm",
        ),
        (
            ChannelLimits(pressure=1e6),
            Sample(0, 0, 2e6, 0),
            "pressure 2 MPa beyond its limit ±1 MPa",
        ),
        (
            ChannelLimits(current=1e-3),
            Sample(-2e-3, 0, 0, 0),
            "current -2 mA beyond its limit ±1 mA",
        ),
    ],
)
def test_a_limit_is_exceeded_at_the_third_successive_sample(
    limits: ChannelLimits, sample: Sample, why: str
) -> None:
    driver = Driver(limits=limits).running()
    driver.sample(sample).sample(sample).sample(QUIET).sample(sample).sample(sample)
    assert driver.sent == [HandshakeAction.START]
    driver.sample(sample)
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]
    assert driver.hear(IDLE).ended() == why


def test_messages_of_other_channels_neither_add_to_a_count_nor_end_it() -> None:
    beyond = Sample(0, 0, 0, 0.02, frozenset({"position"}))
    other = replace(beyond, brought=frozenset({"spool"}))
    driver = Driver(limits=ChannelLimits(position=0.01)).running()
    for _ in range(2):
        driver.sample(beyond).sample(other).sample(other)
    assert driver.sent == [HandshakeAction.START]  # two samples of the position, six messages
    driver.sample(beyond)
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]


@pytest.mark.parametrize("position", [math.nan, 0.0])
def test_a_watched_channel_that_ends_is_lost_telemetry(position: float) -> None:
    """The others go on; a number that is none is no sample either."""
    driver = Driver(limits=ChannelLimits(position=0.01)).running()
    brought = {"position"} if math.isnan(position) else {"current", "spool"}
    for _ in range(24):
        driver.wait(0.01, telemetry=False).sample(Sample(0, 0, 0, position, frozenset(brought)))
    assert driver.sent == [HandshakeAction.START]
    driver.wait(0.01, telemetry=False)
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]
    why = "telemetry lost: no position for 0.25 s, and its limit is watched"
    assert driver.hear(status(BitState.ABORTED)).ended() == why


def test_a_channel_that_ends_is_let_go_where_nobody_watches_it() -> None:
    driver = Driver(limits=ChannelLimits(current=0.01)).running()
    for _ in range(40):
        sample = Sample(0, 0, 0, math.nan, frozenset({"current", "spool", "pressure"}))
        driver.wait(0.01, telemetry=False).sample(sample)
    assert driver.machine.phase is Phase.RUNNING


def test_one_number_that_is_none_does_not_begin_the_count_anew() -> None:
    beyond = Sample(0, 0, 0, 0.02)
    driver = Driver(limits=ChannelLimits(position=0.01)).running()
    driver.sample(beyond).sample(beyond).sample(replace(beyond, position=math.nan)).sample(beyond)
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]


def test_a_reader_that_did_not_run_has_not_lost_a_watched_channel() -> None:
    driver = Driver(limits=ChannelLimits(position=0.01)).running().wait(0.1)
    driver.now += 400 * MS
    driver.machine.excuse(400 * MS)
    driver.sent += driver.machine.on_time(driver.now)
    assert driver.machine.phase is Phase.RUNNING


def test_limits_do_not_count_at_their_very_value() -> None:
    driver = Driver(limits=ChannelLimits(position=0.01)).running()
    for _ in range(5):
        driver.sample(Sample(0, 0, 0, 0.01))
    assert driver.machine.phase is Phase.RUNNING


def test_a_stop_before_the_request_sends_nothing() -> None:
    driver = Driver()
    driver.sent += driver.machine.stop(driver.now, "stopped")
    assert driver.ended() == "stopped"
    assert driver.sent == []


def test_a_stop_while_running_is_aborted_once() -> None:
    driver = Driver().running()
    for _ in range(3):
        driver.sent += driver.machine.stop(driver.now, "stopped")
    assert driver.sent == [HandshakeAction.START, HandshakeAction.ABORT]
    assert driver.hear(status(BitState.ABORTED)).ended() == "stopped"


def test_a_lost_bus_ends_everything_but_keeps_the_first_verdict() -> None:
    driver = Driver().running()
    driver.machine.lost("unplugged")
    assert driver.ended() == "unplugged"
    driver.machine.lost("again")
    assert driver.ended() == "unplugged"


class TestListening:
    def test_follows_any_test_from_its_start_and_sends_nothing(self) -> None:
        driver = Driver(transmit=False, test_id=None).wait(5.0).hear(status(BitState.ARMING, 7))
        driver.hear(status(BitState.RUNNING, 7)).wait(1.0).hear(status(BitState.COMPLETE, 7))
        assert driver.wait(0.1).ended() == ""
        assert driver.machine.test_id == 7
        assert driver.sent == []

    def test_waits_for_the_number_it_was_told(self) -> None:
        driver = Driver(transmit=False, test_id=3).hear(status(BitState.RUNNING, 7))
        assert driver.machine.phase is Phase.WAITING

    def test_a_test_that_has_begun_long_ago_is_let_pass(self) -> None:
        late = BitStatus(BitState.RUNNING, test_id=7, elapsed=2.0)
        driver = Driver(transmit=False, test_id=None).hear(late)
        assert driver.machine.phase is Phase.WAITING

    def test_gives_up_waiting(self) -> None:
        driver = Driver(transmit=False, test_id=None, times=TimeLimits(wait=2.0)).wait(2.1)
        assert driver.ended() == "no test was started within 2 s"

    def test_lost_telemetry_ends_it_without_an_abort(self) -> None:
        driver = Driver(transmit=False, test_id=None).hear(status(BitState.RUNNING))
        assert "telemetry lost" in driver.wait(0.3, telemetry=False).ended()
        assert driver.sent == []

    def test_requests_of_others_are_what_it_waits_for(self) -> None:
        driver = Driver(transmit=False, test_id=None)
        assert driver.machine.on_foreign_request(driver.now) == []
        assert driver.machine.phase is Phase.WAITING


def test_a_requesting_machine_needs_a_number() -> None:
    with pytest.raises(ValueError, match="number"):
        Driver(test_id=None)


events = st.one_of(
    st.builds(
        lambda state, reason, number, elapsed: (
            "status",
            BitStatus(state, reason, number, elapsed),
        ),
        st.sampled_from(BitState),
        st.sampled_from(BitReason),
        st.integers(0, 3),
        st.floats(0, 65),
    ),
    st.builds(lambda value: ("sample", Sample(value, value, value, value)), st.floats()),
    st.just(("foreign", None)),
    st.just(("stop", None)),
    st.builds(lambda ms: ("time", ms), st.integers(1, 400)),
)


@given(st.lists(events, max_size=60), st.booleans())
def test_whatever_comes_the_machine_ends_in_time_and_never_sends_when_listening(
    script: list[tuple[str, object]], transmit: bool
) -> None:
    driver = Driver(transmit=transmit, test_id=1, times=TimeLimits(wait=5.0))
    machine = driver.machine
    for kind, what in script:
        match kind:
            case "status":
                driver.hear(what)
            case "sample":
                driver.sample(what)
            case "foreign":
                driver.sent += machine.on_foreign_request(driver.now)
            case "stop":
                driver.sent += machine.stop(driver.now, "stopped")
            case "time":
                driver.now += what * MS
                driver.sent += machine.on_time(driver.now)
    driver.wait(25.0, telemetry=False)
    driver.ended()
    assert transmit or driver.sent == []
    assert driver.sent.count(HandshakeAction.START) <= 1
    if HandshakeAction.ABORT in driver.sent:
        assert driver.sent[0] is HandshakeAction.START, "an abort without a request"
