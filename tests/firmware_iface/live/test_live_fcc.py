"""The emulated computer: answers, rates, check sums, refusals, aborts."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable

import numpy as np
import pytest

from ehadiag import CommandMode, ConfigurationError, StoredTest, bundled_tests, default_actuator
from ehadiag_sim.conditions import Effects
from ehadiag_sim.emulator import EmulatorTransport, FccCore, run_emulator
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.live_decode import BitStatus, LiveDecoder, Sample
from firmware_iface.recording import BitReason, BitState
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.python_can import PythonCanTransport

CoreFactory = Callable[..., FccCore]
TELEMETRY, COMMAND, ENVIRONMENT, STATUS = 0x110, 0x111, 0x120, 0x201


def request(code: str = "start", test_id: int = 9) -> Frame:
    return Encoder().request(code, test_id)[0]


def run(core: FccCore, ticks: int) -> list[Frame]:
    return [frame for _ in range(ticks) for frame in core.step()]


def statuses(frames: list[Frame]) -> list[BitStatus]:
    decoder = LiveDecoder()
    found = [decoder.decode(item) for item in frames if item.can_id == STATUS]
    return [item for item in found if isinstance(item, BitStatus)]


def states(frames: list[Frame]) -> list[BitState]:
    """States in order, each once."""
    out: list[BitState] = []
    for item in statuses(frames):
        if not out or out[-1] is not item.state:
            out.append(item.state)
    return out


def test_a_test_goes_through_its_states_and_ends_idle(make_core: CoreFactory) -> None:
    core = make_core()
    before = run(core, 10)
    core.take(request())
    frames = before + run(core, 1200)
    assert states(frames) == [
        BitState.IDLE,
        BitState.ARMING,
        BitState.RUNNING,
        BitState.COMPLETE,
        BitState.IDLE,
    ]
    assert {item.serial for item in statuses(frames)} == {77}


def test_rates_order_counters_and_check_sums(make_core: CoreFactory) -> None:
    frames = run(make_core(), 1000)
    count = {item: sum(x.can_id == item for x in frames) for item in (0x110, 0x111, 0x120, 0x201)}
    assert count == {TELEMETRY: 1000, COMMAND: 1000, ENVIRONMENT: 10, STATUS: 50}
    for can_id in count:
        counters = [x.data[6] for x in frames if x.can_id == can_id]
        assert counters == [k % 256 for k in range(len(counters))]
    fast = [item.can_id for item in frames if item.can_id in (TELEMETRY, COMMAND)]
    assert fast == [COMMAND, TELEMETRY] * 1000
    times = [item.time_ns for item in frames]
    assert times == sorted(times)
    assert len(set(times)) == len(times)
    recording = assemble(FrameTable.from_frames(frames), default_map(), "here")[0]
    assert recording.quality.total("crc_errors") == 0
    assert recording.quality.foreign == 0


def test_the_samples_of_a_test_reach_the_decoder_whole(
    make_core: CoreFactory, short_test: StoredTest
) -> None:
    core = make_core()
    core.take(request())
    frames = run(core, 1200)
    recording = assemble(FrameTable.from_frames(frames), default_map(), "here")[0]
    assert recording.outcome.state is BitState.COMPLETE
    assert (recording.test_id, recording.serial) == (9, 77)
    samples = recording.samples
    assert samples is not None
    assert samples.ticks == short_test.ticks
    assert samples.mode is CommandMode.CURRENT
    assert not np.isnan(samples.spool).any()
    # The bus carries the command in steps of 0.5 µA.
    assert np.abs(samples.command - short_test.command()).max() <= 0.25e-6 + 1e-12
    assert recording.quality.total("lost") == 0
    ended = [item for item in statuses(frames) if item.state is BitState.COMPLETE]
    assert {round(item.elapsed, 9) for item in ended} == {0.4}
    assert recording.environment.oil_temperature == pytest.approx(40.0)


def test_a_start_after_a_refusal_is_answered_by_the_start_alone(make_core: CoreFactory) -> None:
    core = make_core()
    core.take(request(test_id=3))
    assert states(run(core, 100)) == [BitState.REFUSED]
    core.take(request())
    answers = statuses(run(core, 300))
    assert {item.state for item in answers} == {BitState.ARMING, BitState.RUNNING}
    assert {item.reason for item in answers} == {BitReason.NONE}
    assert {item.test_id for item in answers} == {9}


def test_a_run_depends_on_seed_and_number_not_on_the_time_before(make_core: CoreFactory) -> None:
    def samples(seed: int, idle: int, runs: int) -> list[bytes]:
        core = make_core(seed=seed)
        out = []
        for _ in range(runs):
            run(core, idle)
            core.take(request())
            frames = [x for x in run(core, 1400) if x.can_id in (TELEMETRY, COMMAND)]
            pairs = zip(frames[::2], frames[1::2], strict=True)
            out.append(b"".join(t.data[:6] for c, t in pairs if c.data[5] == 9))
        return out

    reference = samples(5, 100, 2)
    for idle_ticks in (5, 777):
        assert samples(5, idle_ticks, 2) == reference
    assert reference[0] != reference[1]
    assert samples(6, 100, 1)[0] != reference[0]


@pytest.mark.parametrize(
    ("options", "number", "reason"),
    [
        ({}, 3, BitReason.UNKNOWN_TEST),
        ({"effects": Effects(supply_pressure=9e6)}, 9, BitReason.SUPPLY_PRESSURE_LOW),
        ({"effects": Effects(oil_temperature=-40.0)}, 9, BitReason.OIL_TOO_COLD),
    ],
)
def test_a_request_is_refused_with_the_reason(
    make_core: CoreFactory, options: dict[str, object], number: int, reason: BitReason
) -> None:
    core = make_core(**options)
    run(core, 3)
    core.take(request(test_id=number))
    first = statuses(core.step())[0]
    assert (first.state, first.reason, first.test_id) == (BitState.REFUSED, reason, number)
    assert states(run(core, 700)) == [BitState.REFUSED, BitState.IDLE]


def test_an_open_interlock_is_refused_until_it_closes(make_core: CoreFactory) -> None:
    core = make_core()
    core.interlock_open = True
    core.take(request())
    assert statuses(core.step())[0].reason is BitReason.INTERLOCK_OPEN
    core.interlock_open = False
    run(core, 600)
    core.take(request())
    assert statuses(core.step())[0].state is BitState.ARMING


def test_a_surface_that_is_not_centred_is_refused_and_centred_in_idle(
    short_test: StoredTest,
) -> None:
    core = FccCore(default_actuator(), bundled_tests().values())
    core.take(request(test_id=2))
    run(core, 1300)  # the test's ramp has moved the surface by some 10 mm
    core.take(request("abort"))
    run(core, 510)
    assert core.state is BitState.IDLE
    core.take(request(test_id=2))
    assert statuses(core.step())[0].reason is BitReason.NOT_CENTRED
    run(core, 1500)
    core.take(request(test_id=2))
    assert statuses(core.step())[0].state is BitState.ARMING


def test_a_second_request_is_refused_and_the_first_test_goes_on(make_core: CoreFactory) -> None:
    core = make_core()
    core.take(request())
    run(core, 200)
    core.take(request(test_id=2))
    answers = statuses(core.step())
    assert [item.state for item in answers] == [BitState.REFUSED, BitState.RUNNING]
    assert answers[0].reason is BitReason.ALREADY_RUNNING
    assert answers[1].reason is BitReason.NONE
    assert states(run(core, 600)) == [BitState.RUNNING, BitState.COMPLETE]
    assert core.tests_started == 1


def test_an_abort_brings_the_current_to_zero_in_the_next_tick(make_core: CoreFactory) -> None:
    core = make_core()
    core.take(request())
    run(core, 200)
    decoder = LiveDecoder()
    before = next(decoder.decode(item) for item in core.step() if item.can_id == TELEMETRY)
    assert isinstance(before, Sample)
    assert abs(before.current) > 0.5e-3
    core.take(request("abort"))
    frames = core.step()
    after = next(decoder.decode(item) for item in frames if item.can_id == TELEMETRY)
    assert isinstance(after, Sample)
    assert abs(after.current) < 0.03e-3  # converter noise
    assert statuses(frames)[0].state is BitState.ABORTED


def test_an_abort_of_nothing_changes_nothing(make_core: CoreFactory) -> None:
    core = make_core()
    core.take(request("abort"))
    assert states(run(core, 50)) == [BitState.IDLE]


def test_requests_with_a_wrong_check_sum_length_or_number_are_ignored(
    make_core: CoreFactory,
) -> None:
    core = make_core()
    good = request()
    for bit in range(64):
        data = bytearray(good.data)
        data[bit // 8] ^= 1 << bit % 8
        core.take(Frame(0, good.can_id, bytes(data)))
    core.take(Frame(0, good.can_id, good.data[:7]))
    core.take(Frame(0, good.can_id, good.data, extended=True))
    core.take(Frame(0, good.can_id, b"", remote=True))
    core.take(Frame(0, good.can_id, good.data, error=True))
    core.take(Encoder().request(7, 9)[0])
    assert states(run(core, 300)) == [BitState.IDLE]


def test_telemetry_between_tests_can_be_left_out(make_core: CoreFactory) -> None:
    core = make_core(idle_telemetry=False)
    assert {item.can_id for item in run(core, 200)} == {ENVIRONMENT, STATUS}
    core.take(request())
    frames = run(core, 1000)
    assert sum(item.can_id == TELEMETRY for item in frames) == 400


def test_tests_are_checked(short_test: StoredTest) -> None:
    actuator = default_actuator()
    with pytest.raises(ConfigurationError, match="same id 9"):
        FccCore(actuator, [short_test, short_test])
    with pytest.raises(ConfigurationError, match="serial"):
        FccCore(actuator, [short_test], serial=65536)


def test_as_a_transport_it_runs_on_simulated_time(make_core: CoreFactory) -> None:
    with EmulatorTransport(make_core(start_ns=7_000_000)) as transport:
        assert transport.now_ns() == 7_000_000
        first = transport.receive(0.1)
        assert first is not None
        assert first.time_ns == 8_000_000
        last = None
        while transport.now_ns() < 100_000_000:
            last = transport.receive(0.01)
        assert last is not None
        assert not transport.real_time
    with EmulatorTransport(make_core(idle_telemetry=False)) as transport:
        while transport.receive(0.0005) is not None:
            pass
        before = transport.now_ns()
        assert transport.receive(0.005) is None
        assert transport.now_ns() == before + 5_000_000


def test_on_a_bus_as_fast_as_possible_it_stops_when_told(make_core: CoreFactory) -> None:
    options = BusOptions("virtual", channel=str(uuid.uuid4()), extra={"preserve_timestamps": True})
    stop = threading.Event()
    ticks: list[int] = []
    with PythonCanTransport(options) as listener, PythonCanTransport(options, transmit=True) as bus:

        def node() -> None:
            ticks.append(run_emulator(make_core(), bus, stop, real_time=False))

        thread = threading.Thread(target=node)
        thread.start()
        frames = [item for _ in range(200) if (item := listener.receive(1.0)) is not None]
        stop.set()
        thread.join()
    assert len(frames) == 200
    assert ticks[0] >= 90
    # Simulated stamps: whatever the host does, a tick is a millisecond.
    telemetry = [x.time_ns for x in frames if x.can_id == TELEMETRY]
    assert abs((telemetry[-1] - telemetry[0]) / (len(telemetry) - 1) - 1e6) < 2e4
