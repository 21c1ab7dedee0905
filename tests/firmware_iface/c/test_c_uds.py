"""UDS of the C computer in step with the Python emulator: the same frames in the same ticks."""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import c_side
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from test_c_node import SERIAL, TELEMETRY, rig

from ehadiag import bundled_tests, default_actuator
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface.recording import BitState
from firmware_iface.tester import run_test
from firmware_iface.transport.frames import Frame
from firmware_iface.uds.client import IsoTpLink
from firmware_iface.uds.services import OFFSETS

REQUEST, RESPONSE, STATUS = 0x7E0, 0x7E8, 0x201
FAULTS = Faults(0.3, 0.8, 0.1)
OFFSETS_LSB = (3.0, 0.0, -2.0, 1.0)
START, STOP, RESULTS = b"\x31\x01\x02\x01\x01", b"\x31\x02\x02\x01", b"\x31\x03\x02\x01"
ONBOARD = b"\x22\x01\x20"


class Pair:
    """Both nodes; the C one gets the samples and the findings of the Python one."""

    def __init__(self, library: Any, effects: Effects | None = None, *, interlock: bool = False):
        effects = effects or Effects()
        self.python = FccCore(
            default_actuator(),
            bundled_tests().values(),
            faults=FAULTS,
            effects=effects,
            sensors=Sensors(offsets_lsb=OFFSETS_LSB),
            serial=SERIAL,
            protocol="uds",
        )
        self.python.interlock_open = interlock
        self.c = c_side.UdsNode(library, SERIAL, rig(effects, interlock))
        self._library = library
        self.link = IsoTpLink(REQUEST, RESPONSE)
        self._last = BitState.IDLE
        uds = self.c.uds
        uds.software = self.ask(b"\x22\xf1\x95", compare=False)[3:].rstrip(b"\0")
        offsets = self.ask(b"\x22\x01\x21", compare=False)[3:]
        values = OFFSETS.numbers(offsets)
        for place, item in enumerate(OFFSETS.fields):
            uds.offsets[place] = round(values[item.name] / item.scale)
        uds.found.severity[:] = [round(value * 1e7) for value in astuple(FAULTS)[:3]]
        uds.found.deviation[:] = [10_000] * 3
        uds.found.verdict = 20

    def take(self, frame: Frame) -> None:
        self.python.take(frame)
        self.c.take(frame)

    def step(self, *, compare: bool = True) -> list[tuple[int, bytes]]:
        self._last = self.python.state or self._last
        stages = {BitState.ARMING: 1, BitState.RUNNING: 1, BitState.COMPLETE: 3}
        self.c.uds.found.state = stages.get(self._last, 4 if self._last else 0)
        answers = self.c.answers()
        self.c.begin()
        wanted = [(item.can_id, item.data) for item in self.python.step()]
        sample = next(data for can_id, data in wanted if can_id == TELEMETRY)
        raw = c_side.unpack(self._library, "telemetry", Frame(0, TELEMETRY, sample))
        rest = self.c.end((raw.current, raw.spool, raw.pressure, raw.position))
        frames = answers + [item for item in rest if item[0] != STATUS]
        if compare:
            assert frames == wanted
        return wanted

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.step()

    def ask(self, payload: bytes, *, compare: bool = True) -> bytes:
        """Send a request; return the answer, as far as both agree; empty: there was none."""
        self.link.send(payload)
        for _ in range(6):
            for frame in self.link.frames():
                self.take(frame)
            for can_id, data in self.step(compare=compare):
                self.link.take(Frame(0, can_id, data))
            answer = self.link.message()
            if answer is not None:
                return answer
        return b""


def test_a_whole_test_its_result_and_its_codes(library: Any) -> None:
    pair = Pair(library)
    pair.run(150)
    assert pair.ask(RESULTS) == b"\x7f\x31\x24"
    assert pair.ask(ONBOARD)[3] == 0
    assert pair.ask(START)[4] == BitState.ARMING
    assert pair.ask(START) == b"\x7f\x31\x21"
    for _ in range(29):
        pair.run(200)
        assert pair.ask(RESULTS)[:4] == b"\x71\x03\x02\x01"
    assert pair.ask(RESULTS) == b"\x71\x03\x02\x01\x03\x00\x01\x15\x7c\x12\x67"
    assert pair.ask(ONBOARD)[3:6] == b"\x03\x01\x14"
    assert pair.ask(b"\x19\x02\xff") == b"\x59\x02\x19\x5a\x02\x00\x09"
    assert len(pair.ask(b"\x19\x04\x5a\x02\x00\x01")) == 33
    assert len(pair.ask(b"\x22\x01\x20\x01\x20\xf1\x8c")) == 55
    pair.run(600)
    pair.ask(START)
    pair.run(300)
    assert pair.ask(STOP)[4] == BitState.ABORTED
    assert pair.ask(b"\x19\x02\x01")[3:6] == b"\x5a\x03\x00"


@pytest.mark.parametrize(
    ("effects", "interlock", "test_id", "code", "reason"),
    [
        (Effects(), False, 3, 0x31, 1),
        (Effects(supply_pressure=15.69e6), False, 1, 0x22, 2),
        (Effects(oil_temperature=-20.1), False, 1, 0x22, 3),
        (Effects(), True, 1, 0x22, 6),
    ],
)
def test_refusals(
    library: Any, effects: Effects, interlock: bool, test_id: int, code: int, reason: int
) -> None:
    pair = Pair(library, effects, interlock=interlock)
    pair.run(3)
    assert pair.ask(START[:4] + bytes([test_id])) == bytes([0x7F, 0x31, code])
    assert pair.ask(RESULTS)[4:7] == bytes([BitState.REFUSED, reason, test_id])


PARTS = st.sampled_from(
    [
        *(START, STOP, RESULTS, ONBOARD, b"\x22\xf1\x8c", b"\x22\x01\x21\xf1\x95", b"\x22\x01"),
        *(b"\x19\x02\x09", b"\x19\x0a", b"\x19\x04\x5a\x03\x00\xff", b"\x19\x04\x5a\x09\x00\x01"),
        *(b"\x31\x03\x02", b"\x31\x81\x02\x01"),
    ]
)
STEPS = st.tuples(st.integers(0, 200), PARTS | st.binary(min_size=1, max_size=7))


@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])
@given(
    steps=st.lists(
        st.tuples(st.integers(0, 200), PARTS | st.binary(min_size=1, max_size=7)), max_size=12
    )
)
@example(steps=[(0, START), (150, STOP), (0, STOP), (0, b"\x19\x0a"), (600, START), (0, RESULTS)])
def test_any_request_has_the_same_answer(library: Any, steps: list[tuple[int, bytes]]) -> None:
    pair = Pair(library)
    for ticks, payload in steps:
        pair.run(ticks)
        assert pair.ask(payload) != b""


@settings(max_examples=50)
@given(frames=st.lists(st.binary(min_size=8, max_size=8), max_size=40), stop=st.booleans())
def test_no_frame_breaks_it_and_a_flood_keeps_out_no_stop(
    library: Any, frames: list[bytes], stop: bool
) -> None:
    node = c_side.UdsNode(library, SERIAL, rig(Effects()))
    node.take(Frame(0, REQUEST, b"\x05" + START + b"\0\0"))
    node.answers()
    for data in frames:
        node.take(Frame(0, REQUEST, data))
    if stop:
        node.take(Frame(0, REQUEST, b"\x04" + STOP + b"\0\0\0"))
        node.answers()
        node.take(Frame(0, REQUEST, b"\x04" + RESULTS + b"\0\0\0"))
        ((_, first),) = node.answers()
        assert first[6] == BitState.ABORTED
    for _ in range(3):
        assert all(can_id == RESPONSE and len(data) == 8 for can_id, data in node.answers())


def test_a_longer_request_overflows_and_flow_control_is_obeyed(library: Any) -> None:
    node = c_side.UdsNode(library, SERIAL, rig(Effects()))
    node.take(Frame(0, REQUEST, b"\x10\x09\x22\x01\x20\x01\x21\xf1"))
    assert [data[:3] for _, data in node.answers()] == [b"\x32\x00\x00"]
    node.take(Frame(0, REQUEST, b"\x03\x22\x01\x20\0\0\0\0"))
    ((_, first),) = node.answers()
    assert first[:2] == b"\x10\x1a"
    assert node.answers() == []
    node.take(Frame(0, REQUEST, b"\x30\x01\x00" + bytes(5)))  # one frame, then another word
    assert [data[0] for _, data in node.answers()] == [0x21]
    assert node.answers() == []
    node.take(Frame(0, REQUEST, b"\x31\x00\x00" + bytes(5)))  # wait
    assert node.answers() == []
    node.take(Frame(0, REQUEST, b"\x30\x00\x03" + bytes(5)))  # all, 3 ms apart
    sent = [[data[0] for _, data in node.answers()] for _ in range(9)]
    assert [item for item in sent if item] == [[0x22], [0x23]]
    assert sent.index([0x23]) - sent.index([0x22]) == 3
    node.take(Frame(0, REQUEST, b"\x03\x22\x01\x20\0\0\0\0"))
    assert len(node.answers()) == 1
    assert [node.answers() for _ in range(1001)] == [[]] * 1001
    node.take(Frame(0, REQUEST, b"\x30\x00\x00" + bytes(5)))
    assert node.answers() == []  # too late


class CBus(EmulatorTransport):
    """The bus of the C computer alone, with the samples of the Python one's actuator."""

    def __init__(self, pair: Pair) -> None:
        super().__init__(pair.python)
        self._pair, self._queue = pair, []

    def _receive(self, timeout: float) -> Frame | None:
        limit = self.now_ns() + round(timeout * 1e9)
        while not self._queue and self._pair.python.now_ns < limit:
            begin = self._pair.python.now_ns
            self._queue += [Frame(begin, *item) for item in self._pair.step()]
        self._now = max(self._now, self._queue[0].time_ns if self._queue else limit)
        return self._queue.pop(0) if self._queue else None

    def _send(self, frame: Frame) -> None:
        self._pair.take(frame)


def test_the_tester_runs_a_test_of_it(library: Any) -> None:
    pair = Pair(library)
    with CBus(pair) as bus:
        outcome = run_test(
            bus, test_id=1, duration=5.5, transmit=True, protocol="uds", onboard_wait=5.0
        )
    assert outcome.why == ""
    assert (outcome.serial, outcome.onboard.verdict) == (SERIAL, 20)
    assert outcome.onboard.severities == pytest.approx({"Kintas": 0.3, "FSS": 0.8, "FDJ": 0.1})
