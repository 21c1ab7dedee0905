"""The handshake by UDS: refusals, aborts, forged answers, without bus and clock."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from damaged_bus import FaultyTransport, message_silence
from fault_cases import DURATION, NUMBER
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from test_live_session_limits import SharedBus

from ehadiag import ConfigurationError, default_actuator
from ehadiag_sim.emulator import EmulatorTransport, FccCore, Preconditions
from ehadiag_sim.uds_server import UdsServer
from firmware_iface.bus_map import default_map
from firmware_iface.handshake import ChannelLimits, Phase, TimeLimits
from firmware_iface.live_decode import BitStatus
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.mapping_file import UdsIdentifiers
from firmware_iface.recording import BitReason, BitState
from firmware_iface.tester import BitProgress, RequestOutcome, requester_of, run_test
from firmware_iface.transport.base import Transport
from firmware_iface.transport.frames import Frame
from firmware_iface.uds.client import IsoTpLink, UdsClient

CoreFactory = Callable[..., FccCore]
REQUEST, RESPONSE = 0x7E0, 0x7E8
START = bytes((0x31, 0x01, 0x02, 0x01, NUMBER))
STOP = bytes((0x31, 0x02, 0x02, 0x01))
RESULTS = bytes((0x31, 0x03, 0x02, 0x01))


def outcome_of(bus: Transport, **options: object) -> RequestOutcome:
    settings = {"test_id": NUMBER, "duration": DURATION, "transmit": True, "protocol": "uds"}
    return run_test(bus, **(settings | options))  # type: ignore[arg-type]


class Between(EmulatorTransport):
    """The computer's bus, with somebody who answers some requests in its place."""

    def __init__(self, core: FccCore, answer: Callable[[bytes], list[bytes] | None]) -> None:
        super().__init__(core)
        self._answer = answer
        self.waiting: list[Frame] = []
        self._other = IsoTpLink(RESPONSE, REQUEST)
        self.requests: list[bytes] = []

    def _receive(self, timeout: float) -> Frame | None:
        if self.waiting:
            return replace(self.waiting.pop(0), time_ns=self.now_ns())
        return super()._receive(timeout)

    def _send(self, frame: Frame) -> None:
        length = frame.data[0]
        request = frame.data[1 : 1 + length] if length < 8 else b""
        if request:
            self.requests.append(request)
        answers = self._answer(request) if request else None
        if answers is None:
            super()._send(frame)
            return
        for item in answers:
            self._other.send(item)
        self.waiting += self._other.frames()


def one_way(
    request: bytes, answers: list[bytes], times: int = 1
) -> Callable[..., list[bytes] | None]:
    """Answer a request so, the first times that it comes."""
    left = [times]

    def answer(asked: bytes) -> list[bytes] | None:
        if asked != request or not left[0]:
            return None
        left[0] -= 1
        return answers

    return answer


def test_a_test_is_started_once_watched_and_nothing_else_is_sent(
    make_core: CoreFactory, tmp_path: Path
) -> None:
    with Between(make_core(protocol="uds"), lambda _: None) as bus:
        outcome = outcome_of(bus, recorder=Recorder(tmp_path / "x.blf"), onboard_wait=5.0)
    assert outcome.why == ""
    assert outcome.outcome.state is BitState.COMPLETE
    assert outcome.serial == 77
    assert outcome.onboard is not None
    assert outcome.onboard.severities == pytest.approx({"Kintas": 0.3, "FSS": 0.3, "FDJ": 0.3})
    assert (outcome.onboard.verdict, outcome.onboard.test_id) == (10, NUMBER)
    assert "trouble codes C1A01-00 DEGRADED" in outcome.notes[0]
    assert bus.requests.count(START) == 1
    assert STOP not in bus.requests
    assert bus.requests.count(RESULTS) > 20
    sent = read_frames(tmp_path / "x.blf")
    assert set(sent.can_id[sent.sent].tolist()) == {REQUEST}
    assert set(sent.length[sent.sent].tolist()) == {8}
    assert RESPONSE in sent.can_id[~sent.sent]


def test_its_own_result_is_not_asked_where_it_is_not_awaited(make_core: CoreFactory) -> None:
    with Between(make_core(protocol="uds"), lambda _: None) as bus:
        outcome = outcome_of(bus)
    assert (outcome.complete, outcome.onboard, outcome.notes) == (True, None, ())
    assert {request[0] for request in bus.requests} == {0x31}


@pytest.mark.parametrize(
    ("conditions", "number", "code", "reason"),
    [
        ({"supply": 99e6}, NUMBER, 0x22, BitReason.SUPPLY_PRESSURE_LOW),
        ({"oil_temperature": 200.0}, NUMBER, 0x22, BitReason.OIL_TOO_COLD),
        ({"off_centre": -1.0}, NUMBER, 0x22, BitReason.NOT_CENTRED),
        ({}, 99, 0x31, BitReason.UNKNOWN_TEST),
    ],
)
def test_a_refusal_has_the_words_of_the_native_protocol(
    make_core: CoreFactory, conditions: dict[str, float], number: int, code: int, reason: BitReason
) -> None:
    refusals, codes = [], []

    def listen(frame: Frame) -> Iterator[Frame]:
        if frame.can_id == RESPONSE and frame.data[1] == 0x7F:
            codes.append(frame.data[3])
        yield from ()

    for protocol in ("native", "uds"):
        core = make_core(protocol=protocol, preconditions=Preconditions(**conditions))
        with SharedBus(core, listen) as bus:
            refusals.append(outcome_of(bus, test_id=number, protocol=protocol))
        assert core.tests_started == 0
    assert refusals[0].why == refusals[1].why
    assert refusals[1].why.startswith("refused: ")
    assert refusals[1].outcome.reason is reason
    assert [code for code in codes if code != 0x24] == [code]


def test_a_refusal_does_not_stand_in_the_way_of_the_next_start(make_core: CoreFactory) -> None:
    core = make_core(protocol="uds")
    core.interlock_open = True
    with EmulatorTransport(core) as bus:
        assert outcome_of(bus).why == "refused: interlock open"
        core.interlock_open = False
        assert outcome_of(bus).why == ""


@pytest.mark.parametrize(
    ("answers", "why"),
    [
        ([b"\x7f\x31\x21"], "refused: a test is already running"),
        ([b"\x7f\x31\x22"], "refused: conditions not correct (0x22)"),
        ([b"\x7f\x31\x24"], "refused: request sequence error (0x24)"),
        ([b"\x7f\x31\x31"], "refused: unknown test"),
        ([b"\x7f\x31\x33"], "refused: negative response (0x33)"),
        ([b"\x7f\x31\x78", b"\x7f\x31\x31"], "refused: unknown test"),
        ([], "no answer within 1 s of the request"),
    ],
)
def test_a_negative_response_is_a_refusal_in_plain_words(
    make_core: CoreFactory, answers: list[bytes], why: str
) -> None:
    core = make_core(protocol="uds")
    with Between(core, one_way(START, answers)) as bus:
        outcome = outcome_of(bus)
    assert outcome.why == why
    assert core.tests_started == 0
    assert bus.requests.count(START) == 1


def test_a_refusal_that_comes_late_is_one(make_core: CoreFactory) -> None:
    core, asked = make_core(protocol="uds"), []

    def answer(request: bytes) -> list[bytes] | None:
        if request == START or asked:
            asked.append(request)
            return [b"\x7f\x31\x31"] if len(asked) == 3 else []
        return None

    with Between(core, answer) as bus:
        assert outcome_of(bus).why == "refused: unknown test"
    assert asked[1:3] == [RESULTS, RESULTS]


def test_an_answer_that_is_pending_is_waited_for_and_not_for_ever(make_core: CoreFactory) -> None:
    with Between(make_core(protocol="uds"), one_way(START, [b"\x7f\x31\x78"])) as bus:
        began = bus.now_ns()
        outcome = outcome_of(bus)
        took = (bus.now_ns() - began) / 1e9
    assert outcome.why.startswith("no answer within 5")
    assert 5.0 < took < 8.0
    assert STOP in bus.requests


def test_a_start_whose_answer_is_lost_is_found_out_by_the_results(make_core: CoreFactory) -> None:
    core = make_core(protocol="uds")

    def answer(request: bytes) -> list[bytes] | None:
        if request == START:
            core.start(NUMBER)
            return []
        return None

    with Between(core, answer) as bus:
        assert outcome_of(bus).why == ""


def test_a_session_that_ends_sends_no_start_that_waits(make_core: CoreFactory) -> None:
    def watch(progress: BitProgress) -> None:
        if progress.phase is Phase.REQUESTED:
            bus.requests.clear()
            bus.waiting.append(Frame(0, REQUEST, b"\x03\x22\xf1\x8c".ljust(8, b"\xcc")))

    core = make_core(protocol="uds")
    with Between(core, one_way(RESULTS, [])) as bus:
        outcome = outcome_of(bus, progress=watch, times=TimeLimits(quiet=1.0))
    assert outcome.why == "another tester is on the bus"
    assert RESULTS in bus.requests
    assert START not in bus.requests
    assert core.tests_started == 0


class Slow(EmulatorTransport):
    """The bus of a computer each of whose answers comes late."""

    def __init__(self, core: FccCore) -> None:
        super().__init__(core)
        self._late: list[Frame] = []

    def _receive(self, timeout: float) -> Frame | None:
        if self._late and self._late[0].time_ns + 80_000_000 <= self.now_ns():
            return replace(self._late.pop(0), time_ns=self.now_ns())
        frame = super()._receive(timeout)
        if frame is not None and frame.can_id == RESPONSE:
            self._late.append(frame)
            return None
        return frame


def test_the_refusal_of_an_earlier_test_is_not_taken_for_this_ones(make_core: CoreFactory) -> None:
    core = make_core(protocol="uds")
    core.interlock_open = True
    core.take(Frame(0, REQUEST, b"\x05" + START + b"\0\0"))
    core.step()
    assert core.state is BitState.REFUSED
    core.interlock_open = False
    with Slow(core) as bus:
        assert outcome_of(bus).why == ""


def test_a_limit_ends_in_a_stop(make_core: CoreFactory) -> None:
    core = make_core(protocol="uds")
    with Between(core, lambda _: None) as bus:
        outcome = outcome_of(bus, limits=ChannelLimits(current=1.5e-3))
    assert "mA beyond its limit ±1.5 mA" in outcome.why
    assert outcome.abort_confirmed
    assert outcome.outcome.state is BitState.ABORTED
    assert core.plant.truth[0] == 0.0
    assert STOP in bus.requests


def test_a_stop_is_repeated_until_the_computer_is_quiet(make_core: CoreFactory) -> None:
    core, stop = make_core(protocol="uds"), threading.Event()

    def watch(progress: BitProgress) -> None:
        if progress.elapsed > 0.05:
            stop.set()

    with Between(core, one_way(STOP, [], times=2)) as bus:
        outcome = outcome_of(bus, stop=stop, progress=watch)
    assert outcome.why == "stopped by the user"
    assert outcome.abort_confirmed
    assert core.state is BitState.ABORTED
    assert bus.requests.count(STOP) == 3


def test_lost_telemetry_ends_in_a_stop(make_core: CoreFactory) -> None:
    core = make_core(protocol="uds")
    gap = message_silence(0x110, 0.25)
    with FaultyTransport(EmulatorTransport(core), [gap]) as bus:
        outcome = outcome_of(bus, duration=5.0)
    assert outcome.why.startswith("telemetry lost")
    assert core.state is not BitState.RUNNING


def test_a_second_tester_ends_the_test(make_core: CoreFactory) -> None:
    core, heard = make_core(protocol="uds"), []

    def beside(frame: Frame) -> Iterator[Frame]:
        heard.append(frame)
        if core.state is BitState.RUNNING and len(heard) % 100 == 0:
            yield Frame(frame.time_ns, REQUEST, b"\x03\x22\xf1\x8c".ljust(8, b"\xcc"))

    with SharedBus(core, beside) as bus:
        outcome = outcome_of(bus)
    assert outcome.why == "another tester is on the bus"
    assert outcome.abort_confirmed


def test_unsolicited_answers_are_a_second_sender(make_core: CoreFactory) -> None:
    core, count = make_core(protocol="uds"), [0]

    def beside(frame: Frame) -> Iterator[Frame]:
        if core.state is BitState.RUNNING and frame.can_id == 0x110:
            count[0] += 1
            if count[0] % 7 == 0:
                yield Frame(
                    frame.time_ns, RESPONSE, bytes((3, 0x7F, 0x22, count[0] % 50, 0, 0, 0, 0))
                )

    with SharedBus(core, beside) as bus:
        outcome = outcome_of(bus)
    assert "unsolicited answers of 0x7e8: a second sender on the bus" in outcome.why
    assert outcome.abort_confirmed
    assert core.state is BitState.ABORTED


class Forged(EmulatorTransport):
    """The computer's bus, on which the state in one of its answers is another."""

    state = BitState.COMPLETE

    def __init__(self, core: FccCore) -> None:
        super().__init__(core)
        self._core_of_bus, self.forged = core, 0

    def _receive(self, timeout: float) -> Frame | None:
        frame = super()._receive(timeout)
        if frame is not None and frame.can_id == RESPONSE and frame.data[:1] == b"\x10":
            running = frame.data[6] == BitState.RUNNING
            if running and not self.forged and self._core_of_bus.status.elapsed > 0.05:
                self.forged += 1
                data = frame.data[:6] + bytes([self.state]) + frame.data[7:]
                return replace(frame, data=data)
        return frame


@pytest.mark.parametrize("state", [BitState.COMPLETE, BitState.ABORTED, BitState.IDLE])
def test_a_forged_end_lets_no_surface_move_on_unwatched(
    make_core: CoreFactory, state: BitState
) -> None:
    core = make_core(protocol="uds")
    with Forged(core) as bus:
        bus.state = state
        outcome = outcome_of(bus)
        assert bus.forged == 1
    assert "yet the test goes on: a second sender on the bus" in outcome.why
    assert outcome.abort_confirmed
    assert core.state is BitState.ABORTED


def test_a_computer_without_uds_does_not_answer(make_core: CoreFactory) -> None:
    with EmulatorTransport(make_core()) as bus:
        assert outcome_of(bus).why.startswith("no answer within 1 s of the request")
    with EmulatorTransport(make_core(protocol="uds")) as bus:
        outcome = run_test(bus, test_id=NUMBER, duration=DURATION, transmit=True)
    assert outcome.why.startswith("no answer within 1 s of the request")


@pytest.mark.parametrize(
    ("given", "offset", "pair"),
    [
        (None, 0, (0x7E0, 0x7E8)),
        (None, 1, (0x7E1, 0x7E9)),
        ((0x6F0, 0x6F1), 2, (0x6F2, 0x6F3)),
        ((0x18DA10F1, 0x18DAF110), 0, (0x18DA10F1, 0x18DAF110)),
    ],
)
def test_the_mapping_has_the_identifiers(
    make_core: CoreFactory, given: tuple[int, int] | None, offset: int, pair: tuple[int, int]
) -> None:
    uds = msgspec.UNSET if given is None else UdsIdentifiers(*given)
    bus_map = replace(default_map(), uds=uds).shifted(offset)
    seen: set[tuple[int, bool]] = set()

    def listen(frame: Frame) -> Iterator[Frame]:
        seen.add((frame.can_id, frame.extended))
        yield from ()

    with SharedBus(make_core(protocol="uds", bus_map=bus_map), listen) as bus:
        assert outcome_of(bus, bus_map=bus_map).why == ""
    assert bus_map.uds_identifiers == UdsIdentifiers(*pair)
    assert (pair[1], pair[1] > 0x7FF) in seen


@pytest.mark.parametrize("pair", [(0x7E0, 0x7E0), (0x110, 0x7E8), (0x7FF, 0x7FE)])
def test_identifiers_of_something_else_are_refused(pair: tuple[int, int]) -> None:
    bus_map = replace(default_map(), uds=UdsIdentifiers(*pair)).shifted(
        1 if pair[0] == 0x7FF else 0
    )
    with pytest.raises(ConfigurationError, match="must be two identifiers of no mapped message"):
        _ = bus_map.uds_identifiers


@pytest.mark.parametrize("module", ["isotp", "udsoncan.Request"])
def test_without_its_packages_it_says_what_to_install(
    module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "firmware_iface.uds.client")
    with pytest.raises(ConfigurationError, match=r"needs can-isotp and udsoncan: .* install"):
        requester_of(default_map(), "uds")


def test_a_result_that_is_still_being_found_is_asked_for_anew(make_core: CoreFactory) -> None:
    asked = bytes((0x22, 0x01, 0x20))
    busy = bytes((0x62, 0x01, 0x20, 2, NUMBER, 0, 0, 0)) + bytes(18)
    link = IsoTpLink(RESPONSE, REQUEST)
    core = make_core(protocol="uds")
    left = [2]

    class Busy(Between):
        """Answers so twice, in frames as the flow control asks for them."""

        def _send(self, frame: Frame) -> None:
            if frame.data[1:4] == asked and left[0]:
                left[0] -= 1
                link.send(busy)
                self.waiting += link.frames()
                self.requests.append(asked)
            elif frame.data[0] >> 4 == 3 and link.take(frame) and (more := link.frames()):
                self.waiting += more
            else:
                super()._send(frame)

    with Busy(core, lambda _: None) as bus:
        outcome = outcome_of(bus, onboard_wait=5.0)
    assert outcome.onboard is not None
    assert outcome.onboard.severities["FSS"] == pytest.approx(0.3)
    assert bus.requests.count(asked) == 3


@given(
    frames=st.lists(st.binary(max_size=8), max_size=40),
    identifier=st.sampled_from([REQUEST, RESPONSE]),
)
def test_no_frame_breaks_client_or_server(frames: list[bytes], identifier: int) -> None:
    client = UdsClient(UdsIdentifiers())
    server = FccCore(default_actuator(), [], protocol="uds")
    for number, data in enumerate(frames):
        now = 30_000_000 * number
        frame = Frame(now, identifier, data)
        client.take(frame, now)
        assert all(item.can_id == REQUEST for item in client.due(now))
        server.take(frame)
        if number % 5 == 0:
            server.step()


class ForeignComputer:
    """What a server sees of a computer whose plant is another maker's: it has completed a test."""

    state = BitState.COMPLETE
    status = BitStatus(BitState.COMPLETE, test_id=NUMBER, elapsed=DURATION, serial=77)
    faults = None
    offsets = (0.0,) * 4


def test_of_a_foreign_plant_there_is_no_own_result() -> None:
    server = UdsServer(ForeignComputer(), UdsIdentifiers())  # type: ignore[arg-type]
    for request, answer in (
        (b"\x03\x22\x01\x20", b"\x10\x1a\x62\x01\x20\x04\x09\x1e"),
        (b"\x03\x19\x02\x09", b"\x03\x59\x02\x19"),
    ):
        server.take(Frame(0, REQUEST, b"\x32" + bytes(7)))  # ends an answer under way
        server.step()
        server.take(Frame(0, REQUEST, request.ljust(8, b"\0")))
        (frame,) = server.step()
        assert frame.data[: len(answer)] == answer
