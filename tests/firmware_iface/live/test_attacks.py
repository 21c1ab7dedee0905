"""Attacks on a running test beside those of the bus faults: two testers, bus-off, clocks."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Iterator

import can
import pytest
from fault_cases import DURATION, NUMBER, TELEMETRY
from live_ends import LOADED_MACHINE, computer_on
from msgspec.structs import replace
from test_live_session_limits import OURS, SharedBus

from ehadiag_sim.emulator import FccCore
from firmware_iface import tester
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.recording import BitState
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.frames import Frame, FrameTable
from firmware_iface.transport.python_can import PythonCanTransport

MakeCore = Callable[..., FccCore]


def test_two_tests_at_once_on_a_bus_are_never_both_complete(make_core: MakeCore) -> None:
    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    outcomes: list[tester.RequestOutcome] = []

    def request(bus: PythonCanTransport) -> None:
        # With the usual time limits: an answer that does not come is one of the right outcomes.
        outcomes.append(tester.run_test(bus, test_id=NUMBER, duration=DURATION, transmit=True))

    with (
        PythonCanTransport(options, transmit=True) as bus,
        PythonCanTransport(options, transmit=True) as one,
        PythonCanTransport(options, transmit=True) as two,
        computer_on(bus, make_core()),
    ):
        threads = [threading.Thread(target=request, args=(item,)) for item in (one, two)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(outcomes) == 2
    assert sum(item.complete for item in outcomes) <= 1
    assert all(item.why for item in outcomes if not item.complete)


@pytest.mark.parametrize("at", [50, 400])
def test_bus_off_ends_the_test_in_one_line(
    make_core: MakeCore, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    options = BusOptions("virtual", channel=str(uuid.uuid4()))
    with (
        PythonCanTransport(options, transmit=True) as bus,
        PythonCanTransport(options, transmit=True) as ours,
        computer_on(bus, make_core()),
    ):
        received, receive = [0], ours._bus._recv_internal

        def off(timeout: float | None) -> object:
            received[0] += 1
            if received[0] > at:
                raise can.CanOperationError("bus off", 5)
            return receive(timeout)

        monkeypatch.setattr(ours._bus, "_recv_internal", off)
        outcome = tester.run_test(
            ours, test_id=NUMBER, duration=DURATION, transmit=True, times=LOADED_MACHINE
        )
    assert not outcome.complete
    assert "bus off" in outcome.why
    assert "\n" not in outcome.why


def stamped(shift_ns: int) -> Callable[[Frame], Iterator[Frame]]:
    """Telemetry once more, its stamp an hour away: a clock that is set amidst the test."""

    def beside(frame: Frame) -> Iterator[Frame]:
        if frame.can_id == TELEMETRY and frame.data[6] % 16 == 3:
            yield replace(frame, time_ns=frame.time_ns + shift_ns)

    return beside


@pytest.mark.parametrize("shift_ns", [-3_600_000_000_000, 3_600_000_000_000])
def test_repeats_with_stamps_an_hour_away_do_not_change_a_sample(
    make_core: MakeCore, shift_ns: int
) -> None:
    def frames_of(beside: Callable[[Frame], Iterator[Frame]]) -> FrameTable:
        seen: list[Frame] = []
        with SharedBus(make_core(start_ns=10**18), beside) as bus:
            tester.run_test(
                bus, test_id=NUMBER, duration=DURATION, transmit=True, on_frame=seen.append
            )
        return FrameTable.from_frames(seen)

    def silent(_: Frame) -> Iterator[Frame]:
        yield from ()

    sound, shifted = (
        assemble(frames_of(item), default_map(), "x")[-1] for item in (silent, stamped(shift_ns))
    )
    assert sound.samples is not None
    if shifted.samples is not None and not shifted.quality.refused:
        known = shifted.samples.spool == shifted.samples.spool
        assert (shifted.samples.spool[known] == sound.samples.spool[known]).all()


def test_a_status_of_another_serial_before_the_request_is_named(make_core: MakeCore) -> None:
    def beside(frame: Frame) -> Iterator[Frame]:
        if frame.can_id == TELEMETRY and frame.data[6] % 5 == 0:
            yield OURS.status(BitState.RUNNING, 0, NUMBER, 0.05, 99, frame.time_ns + 40_000)[0]

    with SharedBus(make_core(), beside) as bus:
        outcome = tester.run_test(bus, test_id=NUMBER, duration=DURATION, transmit=True)
    assert not outcome.complete
    assert outcome.why


def test_requests_of_a_flood_do_not_reach_the_verdict(make_core: MakeCore) -> None:
    def beside(frame: Frame) -> Iterator[Frame]:
        if frame.can_id == TELEMETRY and frame.data[6] == 90:
            for _ in range(200):
                yield OURS.request("start", 3, frame.time_ns + 10_000)[0]

    with SharedBus(make_core(), beside) as bus:
        outcome = tester.run_test(bus, test_id=NUMBER, duration=DURATION, transmit=True)
    assert "another tester" in outcome.why
    assert outcome.abort_confirmed
