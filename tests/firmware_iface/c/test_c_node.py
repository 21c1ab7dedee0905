"""The C computer in step with the Python emulator: the same frames, but for the samples."""

from __future__ import annotations

from typing import Any

import c_side
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ehadiag import bundled_tests, default_actuator
from ehadiag_sim.conditions import Effects
from ehadiag_sim.emulator import FccCore
from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.live_decode import BitStatus, LiveDecoder
from firmware_iface.recording import BitReason, BitState
from firmware_iface.transport.frames import Frame

SERIAL = 4711
TELEMETRY = 0x110
BUS = default_map()
DECODER = LiveDecoder(BUS)


def rig(effects: Effects, interlock_open: bool = False) -> c_side.CRig:
    return c_side.CRig(
        round(effects.supply_pressure / 1e4),
        round(effects.return_pressure / 1e4),
        round((effects.oil_temperature + 100.0) * 10.0),
        interlock_open,
    )


class Pair:
    """Both nodes; the C one gets the samples of the Python one's actuator."""

    def __init__(self, library: Any, effects: Effects | None = None, *, interlock: bool = False):
        effects = effects or Effects()
        self.python = FccCore(
            default_actuator(),
            bundled_tests().values(),
            effects=effects,
            serial=SERIAL,
            bus_map=BUS,
        )
        self.python.interlock_open = interlock
        self.c = c_side.Node(library, SERIAL, rig(effects, interlock))
        self._library = library
        self._requests = Encoder(BUS)

    def request(self, code: str | int, test_id: int) -> None:
        self.take(self._requests.request(code, test_id)[0])

    def take(self, frame: Frame) -> None:
        self.python.take(frame)
        self.c.take(frame)

    def step(self) -> list[tuple[int, bytes]]:
        self.c.begin()
        wanted = [(item.can_id, item.data) for item in self.python.step()]
        sample = next(data for can_id, data in wanted if can_id == TELEMETRY)
        raw = c_side.unpack(self._library, "telemetry", Frame(0, TELEMETRY, sample))
        frames = self.c.end((raw.current, raw.spool, raw.pressure, raw.position))
        assert frames == wanted
        return frames

    def run(self, ticks: int) -> list[BitStatus]:
        """States that were told, as often as they changed."""
        told: list[BitStatus] = []
        for _ in range(ticks):
            for item in statuses(self.step()):
                key = (item.state, item.reason, item.test_id)
                if not told or key != (told[-1].state, told[-1].reason, told[-1].test_id):
                    told.append(item)
        return told


def statuses(frames: list[tuple[int, bytes]]) -> list[BitStatus]:
    found = [DECODER.decode(Frame(0, can_id, data)) for can_id, data in frames]
    return [item for item in found if isinstance(item, BitStatus)]


def command_of(library: Any, frames: list[tuple[int, bytes]]) -> tuple[int, int, int]:
    data = next(data for can_id, data in frames if can_id == 0x111)
    raw = c_side.unpack(library, "command", Frame(0, 0x111, data))
    return raw.mode, raw.current, raw.test_id


@pytest.mark.parametrize("test_id", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_whole_test_and_the_time_around_it(library: Any, test_id: int) -> None:
    pair = Pair(library)
    assert [item.state for item in pair.run(333)] == [BitState.IDLE]
    pair.request("start", test_id)
    told = pair.run(6300)
    assert [(item.state, item.test_id) for item in told] == [
        (BitState.ARMING, test_id),
        (BitState.RUNNING, test_id),
        (BitState.COMPLETE, test_id),
        (BitState.IDLE, 0),
    ]
    assert told[2].elapsed == pytest.approx(5.5)


STEPS = st.lists(
    st.tuples(
        st.integers(0, 700),
        st.sampled_from(["start", "start", "abort", 0, 7]),
        st.sampled_from([1, 1, 2, 2, 3, 0]),
    ),
    max_size=6,
)


@settings(max_examples=6, suppress_health_check=[HealthCheck.too_slow])
@given(steps=STEPS)
@example(steps=[(0, "start", 1), (0, "start", 1), (0, "abort", 1)])
def test_random_requests(library: Any, steps: list[tuple[int, str | int, int]]) -> None:
    pair = Pair(library)
    for ticks, code, test_id in steps:
        pair.run(ticks)
        # A request while a refusal stands has a test of its own.
        while pair.python.state is BitState.REFUSED:
            pair.step()
        pair.request(code, test_id)
    pair.run(700)


@pytest.mark.parametrize(
    ("effects", "interlock", "test_id", "reason"),
    [
        (Effects(), False, 3, BitReason.UNKNOWN_TEST),
        (Effects(supply_pressure=15.69e6), False, 1, BitReason.SUPPLY_PRESSURE_LOW),
        (Effects(oil_temperature=-20.1), False, 1, BitReason.OIL_TOO_COLD),
        (Effects(), True, 1, BitReason.INTERLOCK_OPEN),
    ],
)
def test_refusals(
    library: Any, effects: Effects, interlock: bool, test_id: int, reason: BitReason
) -> None:
    pair = Pair(library, effects, interlock=interlock)
    pair.run(5)
    pair.request("start", test_id)
    told = pair.run(600)
    assert [(item.state, item.reason) for item in told] == [
        (BitState.REFUSED, reason),
        (BitState.IDLE, BitReason.NONE),
    ]


@pytest.mark.parametrize(
    "effects", [Effects(supply_pressure=15.7e6), Effects(oil_temperature=-20.0)]
)
def test_at_the_limit_a_test_starts(library: Any, effects: Effects) -> None:
    pair = Pair(library, effects)
    pair.request("start", 1)
    assert [item.state for item in pair.run(10)] == [BitState.ARMING]


@pytest.fixture
def node(library: Any) -> c_side.Node:
    return c_side.Node(library, SERIAL, rig(Effects()))


def bare(node: c_side.Node, position: int = 2048) -> list[tuple[int, bytes]]:
    node.begin()
    return node.end((2048, 2048, 2048, position))


@pytest.mark.parametrize(
    ("code", "state"),
    [
        (2048 + 34, BitState.ARMING),
        (2048 + 35, BitState.REFUSED),
        (2048 - 34, BitState.ARMING),
        (2048 - 35, BitState.REFUSED),
    ],
)
def test_a_surface_off_centre(node: c_side.Node, code: int, state: BitState) -> None:
    bare(node, code)
    node.take(Encoder(BUS).request("start", 1)[0])
    told = statuses(bare(node))[0]
    assert told.state is state
    refused = state is BitState.REFUSED
    assert told.reason is (BitReason.NOT_CENTRED if refused else BitReason.NONE)


def test_an_abort_commands_zero_current_in_the_next_tick(library: Any, node: c_side.Node) -> None:
    requests = Encoder(BUS)
    node.take(requests.request("start", 1)[0])
    frames = [bare(node) for _ in range(100 + 701)]
    assert command_of(library, frames[-1]) == (1, 3000, 1)  # 1.5 mA at 0.7 s
    node.take(requests.request("abort", 1)[0])
    after = bare(node)
    assert command_of(library, after) == (1, 0, 0)
    assert statuses(after)[0].state is BitState.ABORTED


def test_a_start_right_after_a_refusal_is_answered_by_arming_alone(node: c_side.Node) -> None:
    requests = Encoder(BUS)
    node.take(requests.request("start", 9)[0])
    assert statuses(bare(node))[0].state is BitState.REFUSED
    node.take(requests.request("start", 1)[0])
    answers = statuses(bare(node))
    assert [(item.state, item.reason) for item in answers] == [(BitState.ARMING, BitReason.NONE)]


def test_an_abort_gets_in_beside_a_flood_of_requests(library: Any, node: c_side.Node) -> None:
    requests = Encoder(BUS)
    node.take(requests.request("start", 1)[0])
    for _ in range(300):
        bare(node)
    for _ in range(50):
        node.take(requests.request("start", 2)[0])
    node.take(requests.request("abort", 1)[0])
    assert statuses(bare(node))[-1].state is BitState.ABORTED


def test_requests_with_a_wrong_check_sum_are_ignored(library: Any) -> None:
    pair = Pair(library)
    good = Encoder(BUS).request("start", 1)[0]
    for bit in range(64):
        data = bytearray(good.data)
        data[bit // 8] ^= 1 << bit % 8
        pair.take(Frame(0, good.can_id, bytes(data)))
    assert [item.state for item in pair.run(30)] == [BitState.IDLE]
