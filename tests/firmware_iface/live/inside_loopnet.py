"""Tests on udp_multicast: run by test_live_contract.py inside tools/loopnet.sh, nowhere else."""

from __future__ import annotations

import multiprocessing
import socket
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest
from fault_cases import DURATION, NUMBER, short_test
from live_ends import LOADED_MACHINE
from test_live_contract import FRAMES, TwoWay, collect, content

from ehadiag import default_actuator
from ehadiag_sim.emulator import FccCore, run_emulator
from firmware_iface.logs.recorder import Recorder
from firmware_iface.signals.recordings import read_recording
from firmware_iface.tester import run_test
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Transport, TransportState
from firmware_iface.transport.python_can import PythonCanTransport


class TestMulticast(TwoWay):
    @pytest.fixture
    def options(self) -> BusOptions:
        return BusOptions("udp_multicast")

    def test_what_is_no_frame_degrades_and_does_not_end_the_bus(
        self, receiving: Transport, other: Transport
    ) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"\xff not a frame", ("239.74.163.2", 43113))
        other.send(FRAMES[0])
        assert content(collect(receiving, 1)) == content(FRAMES[:1])
        assert receiving.state is TransportState.DEGRADED
        assert "1 messages on the line" in receiving.detail


def node(stop: Event, ready: Event) -> None:
    with PythonCanTransport(BusOptions("udp_multicast"), transmit=True) as bus:
        core = FccCore(default_actuator(), [short_test()], serial=4711)
        core.step()  # compiles
        ready.set()
        run_emulator(core, bus, stop)


def test_a_test_between_two_processes_loses_no_sample(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    stop, ready = context.Event(), context.Event()
    process = context.Process(target=node, args=(stop, ready))
    process.start()
    try:
        assert ready.wait(100)
        with PythonCanTransport(BusOptions("udp_multicast"), transmit=True) as bus:
            outcome = run_test(
                bus,
                test_id=NUMBER,
                duration=DURATION,
                transmit=True,
                recorder=Recorder(tmp_path / "live.blf"),
                times=LOADED_MACHINE,
            )
    finally:
        stop.set()
        process.join()
    assert outcome.why == ""
    assert outcome.serial == 4711
    assert outcome.dropped == 0
    assert process.exitcode == 0
    recording = read_recording(tmp_path / "live.blf")
    assert recording.quality.total("lost") == 0
    assert recording.samples is not None
    assert recording.samples.ticks == short_test().ticks
