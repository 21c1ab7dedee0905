"""A forged status that ends the watch: the test goes on, so an abort is requested and watched."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from fault_cases import NUMBER
from test_live_handshake import IDLE, MS, Driver, status
from test_live_session_limits import OURS, STATUS, SharedBus

from ehadiag_sim.emulator import FccCore
from firmware_iface import tester
from firmware_iface.handshake import ChannelLimits, HandshakeAction, Phase
from firmware_iface.live_decode import BitStatus, Sample
from firmware_iface.recording import BitState
from firmware_iface.transport.frames import Frame

START, ABORT = HandshakeAction.START, HandshakeAction.ABORT
FORGED = {
    "complete": (BitState.COMPLETE, 0, "complete too early"),
    "idle": (BitState.IDLE, 0, "fell back to idle"),
    "aborted": (BitState.ABORTED, 0, "aborted by the flight-control computer"),
    "other number": (BitState.RUNNING, 7, "the status changed to test"),
}


class Forger:
    """Sends one status of its own in the midst of the test, with the counter of the next one."""

    def __init__(self, state: BitState, shift: int, every: int = 1000) -> None:
        self.state, self.shift, self.every, self.running = state, shift, every, 0

    def __call__(self, frame: Frame) -> Iterator[Frame]:
        if frame.can_id == STATUS and frame.data[0] == BitState.RUNNING:
            self.running += 1
            if self.running % self.every == 5:
                number, later = NUMBER + self.shift, frame.time_ns + 50_000
                yield OURS.status(self.state, 0, number, 0.1, 77, later)[0]


@pytest.mark.parametrize("kind", FORGED)
@pytest.mark.parametrize("every", [6, 1000])
def test_one_forged_status_gets_an_abort_and_the_computer_is_watched_until_it_is_quiet(
    make_core: Callable[..., FccCore], kind: str, every: int
) -> None:
    state, shift, words = FORGED[kind]
    core = make_core()
    with SharedBus(core, Forger(state, shift, every)) as bus:
        outcome = tester.run_test(bus, test_id=NUMBER, duration=0.4, transmit=True)
    assert not outcome.complete
    assert words in outcome.why
    assert "yet the test goes on: a second sender on the bus" in outcome.why
    assert outcome.abort_confirmed
    assert core.state is BitState.ABORTED


@pytest.mark.parametrize("kind", FORGED)
def test_limits_are_looked_at_after_it(kind: str) -> None:
    state, shift, _ = FORGED[kind]
    driver = Driver(limits=ChannelLimits(position=0.01)).running().wait(0.3)
    driver.hear(status(state, 1 + shift))
    assert driver.machine.phase is Phase.CLOSING
    for _ in range(3):
        driver.sample(Sample(0.0, 0.0, 0.0, 0.02))
    assert driver.sent == [START, ABORT]
    driver.hear(status(BitState.ABORTED))
    assert "position 20 mm beyond its limit ±10 mm" in driver.ended()


def test_a_limit_exceeded_after_an_abort_request_is_part_of_the_reason_once() -> None:
    driver = Driver(limits=ChannelLimits(position=0.01)).running()
    driver.sent += driver.machine.stop(driver.now, "stopped")
    for size in range(20, 40):
        driver.sample(Sample(0.0, 0.0, 0.0, 0.001 * size))
    why = driver.hear(status(BitState.ABORTED)).ended()
    assert why == "stopped; position 22 mm beyond its limit ±10 mm"


@pytest.mark.parametrize("kind", ["aborted", "idle"])
def test_a_forged_answer_to_the_abort_ends_no_watch(kind: str) -> None:
    driver = Driver().running()
    driver.sent += driver.machine.stop(driver.now, "stopped")
    for _ in range(20):
        driver.hear(status(FORGED[kind][0])).wait(0.02)
        driver.hear(BitStatus(BitState.RUNNING, test_id=1, elapsed=0.1)).wait(0.02)
    assert driver.machine.phase is Phase.ABORTING
    assert driver.sent.count(ABORT) >= 7
    assert driver.hear(status(BitState.ABORTED)).ended() == "stopped"
    assert driver.machine.verdict.abort_confirmed


def test_a_computer_that_does_not_obey_is_watched_to_the_end_of_its_test() -> None:
    driver = Driver().running()
    driver.sent += driver.machine.stop(driver.now, "stopped")
    begin = driver.now
    for _ in range(100):
        driver.hear(status(BitState.RUNNING)).wait(0.02)
    driver.wait(2.0)
    assert driver.ended() == "stopped; the abort was not confirmed"
    assert driver.sent.count(ABORT) >= 20
    assert driver.now - begin >= 2000 * MS


@pytest.mark.parametrize("state", [BitState.REFUSED, BitState.RUNNING])
def test_a_forged_answer_to_the_request_does_not_leave_the_test_alone(state: BitState) -> None:
    driver = Driver().requested().hear(status(state, 1 if state is BitState.REFUSED else 2))
    assert driver.machine.phase is Phase.CLOSING
    driver.hear(status(BitState.ARMING)).hear(status(BitState.ARMING))
    assert driver.sent == [START, ABORT]


def test_a_forged_request_does_not_either() -> None:
    driver = Driver().requested()
    driver.machine.on_foreign_request(driver.now)
    driver.hear(status(BitState.ARMING)).hear(status(BitState.RUNNING))
    assert driver.sent == [START, ABORT]


def test_telemetry_shows_that_a_test_goes_on_where_there_is_none_at_rest() -> None:
    driver = Driver().hear(IDLE).wait(0.1, telemetry=False)
    driver.hear(status(BitState.RUNNING)).wait(0.3).hear(status(BitState.ABORTED)).wait(0.05)
    assert driver.sent == [START, ABORT]
    driver.hear(status(BitState.ABORTED)).wait(0.2, telemetry=False)
    assert "yet the test goes on" in driver.ended()


def test_one_late_status_is_no_contradiction() -> None:
    driver = Driver().running().wait(0.3).hear(status(BitState.ABORTED))
    driver.hear(status(BitState.RUNNING))
    assert driver.ended() == "aborted by the flight-control computer"
    assert driver.sent == [START]


def test_a_true_end_that_seems_early_is_the_end() -> None:
    driver = Driver().running().wait(0.5).hear(status(BitState.COMPLETE))
    assert driver.machine.phase is Phase.CLOSING
    assert driver.ended() == ""
    assert driver.sent == [START]


def test_a_listener_says_it_too() -> None:
    driver = Driver(transmit=False, test_id=None).hear(status(BitState.RUNNING)).wait(0.3)
    driver.hear(status(BitState.IDLE)).hear(status(BitState.RUNNING)).hear(status(BitState.RUNNING))
    assert "yet the test goes on" in driver.ended()
    assert driver.sent == []
