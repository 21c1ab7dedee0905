"""The package's calls on a bus: what they return, and that nothing is sent unasked."""

from __future__ import annotations

import math
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import msgspec
import pytest
from places import LOGS

import ehadiag
from ehadiag.core.actuator import Calibration, CalibrationSource, FitQuality, default_actuator
from ehadiag.live import Snapshot
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import EmulatorTransport, emulated_computer
from firmware_iface.bus_map import default_map
from firmware_iface.live_decode import BitRequest, LiveDecoder
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import BitState, Environment
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import bundled_tests
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.frames import Frame
from firmware_iface.xcp import XcpIds

REQUEST_ID = 0x200
TESTS = bundled_tests()


@contextmanager
def opened(channel: str, **options: object) -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=channel, **options) as bus:
        yield bus


@pytest.fixture
def channel() -> str:
    return f"calls-{uuid.uuid4()}"


@pytest.fixture
def computer(channel: str) -> Iterator[None]:
    """The simulated computer in a thread, on an open bus of python-can."""
    stop, done = threading.Event(), []
    with opened(channel) as bus, opened(channel) as witness:

        def work() -> None:
            conditions = {"faults": Faults(FSS=0.5), "serial": 12}
            done.append(ehadiag.run_simulator(bus, stop=stop, conditions=conditions))

        thread = threading.Thread(target=work)
        thread.start()
        assert witness.recv(60.0) is not None  # its kernels are loaded
        yield
        stop.set()
        thread.join()
        assert done[0].ticks > 0
        bus.send(can.Message(arbitration_id=1))  # the bus is still the caller's


class SimulatedBus(EmulatorTransport):
    """A computer in simulated time, and what it was sent."""

    def __init__(self, **faults: float) -> None:
        core = emulated_computer(
            default_actuator(), [TESTS["open"]], faults=Faults(**faults), serial=12
        )
        super().__init__(core)
        self.requests: list[str] = []

    def _send(self, frame: Frame) -> None:
        request = LiveDecoder(default_map()).decode(frame)
        assert isinstance(request, BitRequest)
        self.requests.append(request.code)
        super()._send(frame)


def requests_on(witness: can.BusABC) -> int:
    count = 0
    while (message := witness.recv(0.0)) is not None:
        count += message.arbitration_id == REQUEST_ID
    return count


def test_a_test_is_run_recorded_and_diagnosed(tmp_path: Path) -> None:
    stages: list[str] = []
    snapshots: list[Snapshot] = []
    with SimulatedBus(FSS=0.5) as bus:
        result = ehadiag.run_test(
            bus,
            "open",
            transmit=True,
            record=tmp_path / "run.blf",
            progress=lambda stage, _share: stages.append(stage),
            snapshots=snapshots.append,
        )
    assert bus.requests == ["start"]
    assert result.verdict is ehadiag.Verdict.DEGRADED
    assert result.faults["FSS"].value == pytest.approx(0.5, abs=0.02)
    assert (result.serial, result.request.test) == (12, ("open",))
    assert (stages[0], len(set(stages)) > 1) == ("test open", True)
    assert snapshots[-1].ending is not None
    assert snapshots[-1].ending.verdict == "DEGRADED"
    running = snapshots[-1].test
    assert running is not None
    assert (running.left_s, running.elapsed_s, snapshots[-1].working) == (None, 5.5, "")
    again = ehadiag.diagnose(tmp_path / "run.blf")
    assert again.faults["FSS"].value == result.faults["FSS"].value
    checked = ehadiag.check_bus(tmp_path / "run.blf")
    assert (checked.usable, checked.test) == (True, "open")
    assert checked.samples is not None
    assert checked.to_dict()["schema"] == "ehadiag.bus/1"


def test_a_test_is_requested_by_uds() -> None:
    core = emulated_computer(default_actuator(), [TESTS["open"]], faults=Faults(FSS=0.5),
                             serial=12, protocol="uds")  # fmt: skip
    with EmulatorTransport(core) as bus:
        result = ehadiag.run_test(bus, "open", transmit=True, protocol="uds")
    assert result.verdict is ehadiag.Verdict.DEGRADED
    assert result.faults["FSS"].value == pytest.approx(0.5, abs=0.02)
    assert result.serial == 12
    assert any("trouble codes C1A01-00 DEGRADED" in note for note in result.notes)
    assert not any("how the test ended" in note for note in result.notes)
    with pytest.raises(ehadiag.ConfigurationError, match="need one of native, uds"):
        ehadiag.run_test(bus, "open", transmit=True, protocol="xyz")  # type: ignore[arg-type]


def test_a_test_is_measured_by_xcp() -> None:
    core = emulated_computer(
        default_actuator(), [TESTS["open"]], faults=Faults(FSS=0.5), xcp=XcpIds(0x700, 0x701)
    )
    with EmulatorTransport(core) as bus:
        result = ehadiag.run_test(bus, "open", transmit=True, xcp=(0x700, 0x701))
    assert result.faults["FSS"].value == pytest.approx(0.5, abs=0.02)
    with pytest.raises(ehadiag.ConfigurationError, match="0x700, 0x700: need two different ones"):
        ehadiag.run_test(bus, "open", transmit=True, xcp=(0x700, 0x700))
    with (
        EmulatorTransport(emulated_computer(default_actuator(), [TESTS["open"]])) as bus,
        pytest.raises(ehadiag.InputOutputError, match="no XCP slave answers"),
    ):
        ehadiag.run_test(bus, "open", transmit=True, xcp=(0x700, 0x701))


@pytest.mark.slow  # a whole test in real time
def test_a_test_on_an_open_bus_of_python_can(computer: None, channel: str) -> None:
    with opened(channel) as bus, opened(channel) as witness:
        result = ehadiag.run_test(bus, "open", transmit=True)
        bus.send(can.Message(arbitration_id=1))  # still open
        assert requests_on(witness) == 1
    assert result.verdict is ehadiag.Verdict.DEGRADED
    assert result.faults["FSS"].value == pytest.approx(0.5, abs=0.02)
    assert result.recordings[0].source == "bus test open"


def test_a_test_on_an_open_bus_is_requested_and_aborted(computer: None, channel: str) -> None:
    stop = threading.Event()
    with opened(channel) as bus, opened(channel) as witness:
        result = ehadiag.run_test(
            bus,
            "open",
            transmit=True,
            stop=stop,
            progress=lambda _stage, share: share and stop.set(),
        )
        bus.send(can.Message(arbitration_id=1))  # still open
        assert requests_on(witness) == 2
    assert result.verdict is ehadiag.Verdict.NOT_TESTED


def test_transmitting_must_be_said(channel: str) -> None:
    with opened(channel) as bus, opened(channel) as witness:
        with pytest.raises(TypeError, match="transmit"):
            ehadiag.run_test(bus, "open")  # type: ignore[call-arg]
        assert requests_on(witness) == 0


def test_without_transmitting_it_listens_and_sends_nothing(channel: str) -> None:
    stop = threading.Event()
    with opened(channel) as bus, opened(channel) as witness:
        timer = threading.Timer(0.3, stop.set)
        timer.start()
        result = ehadiag.run_test(bus, "open", transmit=False, stop=stop)
        timer.join()
        assert requests_on(witness) == 0
    assert result.verdict is ehadiag.Verdict.NOT_TESTED
    assert "silent" in result.reasons[0]


def test_a_bus_that_was_opened_to_listen_is_not_sent_to() -> None:
    core = emulated_computer(default_actuator(), [TESTS["open"]])
    with (
        EmulatorTransport(core, transmit=False) as bus,
        pytest.raises(ehadiag.ConfigurationError, match="listen only"),
    ):
        ehadiag.run_test(bus, "open", transmit=True)
    assert core.tests_started == 0


def test_a_bus_with_its_own_echoes_is_refused(channel: str) -> None:
    with (
        opened(channel, receive_own_messages=True) as bus,
        pytest.raises(ehadiag.ConfigurationError, match="receive_own_messages"),
    ):
        ehadiag.run_test(bus, "open", transmit=True)


def test_options_of_a_bus_are_opened_and_closed(channel: str) -> None:
    found = ehadiag.check_bus(BusOptions("virtual", channel), duration_s=0.1)
    assert not found.usable
    assert str(found).startswith(f"listened to virtual {channel} for 0.")


def test_a_stop_aborts_the_test_and_the_recording_is_complete(tmp_path: Path) -> None:
    stop = threading.Event()

    def progress(_stage: str, share: float) -> None:
        if share > 0.1:
            stop.set()

    with SimulatedBus() as bus:
        result = ehadiag.run_test(
            bus, "open", transmit=True, record=tmp_path / "cut.blf", stop=stop, progress=progress
        )
    assert (result.verdict.name, result.reasons) == ("NOT_TESTED", ("stopped by the user",))
    assert bus.requests == ["start", "abort"]
    assert read_recording(tmp_path / "cut.blf").outcome.state is BitState.ABORTED


def test_ctrl_c_asks_for_the_abort_and_goes_on_to_the_caller(tmp_path: Path) -> None:
    def progress(_stage: str, share: float) -> None:
        if share > 0.1:
            raise KeyboardInterrupt

    with SimulatedBus() as bus, pytest.raises(KeyboardInterrupt):
        ehadiag.run_test(bus, "open", transmit=True, record=tmp_path / "cut.blf", progress=progress)
    assert bus.requests == ["start", "abort"]
    assert read_recording(tmp_path / "cut.blf").outcome.state is BitState.RUNNING


def test_what_could_not_be_judged_is_refused_before_the_bus_is_opened(channel: str) -> None:
    with pytest.raises(ehadiag.InputOutputError, match="nothing"):
        ehadiag.run_test(BusOptions("virtual", channel), "nothing.toml", transmit=True)


def test_watching_a_log_raises_alarms() -> None:
    alarms: list[str] = []
    found = ehadiag.watch(
        LOGS / "paper-closed-4.blf", on_alarm=lambda alarm: alarms.append(alarm.signal)
    )
    assert found.alarm_count == len(alarms) > 0
    assert set(alarms) <= {"spool", "pressure"}
    assert found.monitored > 1000


def decoded_ticks(samples: ehadiag.Samples) -> Iterator[Any]:
    yield samples.mode
    yield Environment(20.7e6, 0.7e6, 40.0)
    for row in samples.to_frame().to_numpy().tolist():
        yield ehadiag.Tick(*row)


def test_decoded_signals_are_watched_live_as_the_frames_are(tmp_path: Path) -> None:
    """The unit as its own diagnosis says: a file of it, or the result itself."""
    log = LOGS / "paper-closed-4.blf"
    (recording,) = ehadiag.read(log)
    assert recording.samples is not None
    result = ehadiag.diagnose(recording)
    (tmp_path / "r.json").write_text(result.to_json())
    for unit in (result, tmp_path / "r.json", str(tmp_path / "r.json")):
        found = ehadiag.watch(decoded_ticks(recording.samples), unit=unit)
        assert (found.ticks, found.alarm_count) == (recording.samples.ticks, 0)
        assert found.monitored > 0.9 * found.ticks
        assert found.enough


def test_what_the_calibration_left_is_no_change_of_the_unit() -> None:
    """A worn unit is no alarm to a model that errs by as much of the unit as new."""
    alarms = []
    for excess in (1.16, 1e6):
        fit = FitQuality(excess=excess, outliers=0.0, spool_rms=1.0, pressure_rms=1.0)
        calibration = Calibration(
            date="2026-01-02T03:04:05Z", start="reference-31", effects={"hysteresis": 0.0},
            parameters=("hysteresis",), std=(1e-5,), root=((1.0,),), fit=fit,
            recordings=(CalibrationSource(name="a.blf", test="open"),),
        )  # fmt: skip
        unit = msgspec.structs.replace(default_actuator(), calibration=calibration)
        found = ehadiag.watch(LOGS / "paper-closed-4.blf", actuator=unit)
        alarms.append(found.alarm_count)
    assert alarms[0] > 0 == alarms[1]


def test_a_list_of_decoded_signals_is_watched() -> None:
    found = ehadiag.watch([Environment(20.7e6, 0.7e6, 40.0), *[ehadiag.Tick(*[0.0] * 5)] * 400])
    assert (found.ticks, found.monitored) == (400, 101)


@pytest.mark.parametrize(
    "item",
    [(1.0,) * 4, "12345", {}, None, ehadiag.Tick(None, *[0.0] * 4), Environment("hot")],  # type: ignore[arg-type]
)
def test_what_is_no_decoded_signal_is_said(item: Any) -> None:
    with pytest.raises(ehadiag.ConfigurationError, match=r"^decoded item .*need a Tick") as caught:
        ehadiag.watch([item])
    assert "\n" not in str(caught.value)


def test_what_cannot_be_watched_is_said() -> None:
    log = LOGS / "paper-closed-4.blf"
    for wrong, said in (
        ({"duration_s": -1.0}, "duration_s -1: need more than 0 s"),
        ({"duration_s": math.nan}, "duration_s nan"),
        ({"least_monitored": 2.0}, "least_monitored 2: need a share"),
        ({"unit": "missing.json"}, "missing.json"),
    ):
        with pytest.raises(ehadiag.EhadiagError, match=said):
            ehadiag.watch(log, **wrong)


def test_watching_a_bus_sends_nothing_and_ends_in_time(computer: None, channel: str) -> None:
    snapshots: list[Snapshot] = []
    stop = threading.Event()

    def take(snapshot: Snapshot) -> None:
        snapshots.append(snapshot)
        if snapshot.residuals is not None:
            stop.set()

    with opened(channel) as bus, opened(channel) as witness:
        found = ehadiag.watch(bus, stop=stop, snapshots=take)
        ehadiag.watch(bus, duration_s=0.05)
        assert requests_on(witness) == 0
        bus.send(can.Message(arbitration_id=1))  # still open
    assert found.monitored > 0
    assert found.bus_lost == ""
    assert snapshots[-1].ending is not None


def test_a_bus_is_recorded_until_the_stop(computer: None, channel: str, tmp_path: Path) -> None:
    stop = threading.Event()
    count = 0

    def on_frame(_frame: object) -> None:
        nonlocal count
        count += 1
        if count == 200:
            stop.set()

    with opened(channel) as bus, opened(channel) as witness:
        recording = ehadiag.record(bus, tmp_path / "bus.blf", stop=stop, on_frame=on_frame)
        assert requests_on(witness) == 0
    assert recording.source == str(tmp_path / "bus.blf")
    assert len(read_frames(str(tmp_path / "bus.blf"))) >= 200
    with pytest.raises(ehadiag.InputOutputError, match="exists"):
        ehadiag.record(BusOptions("virtual", channel), tmp_path / "bus.blf", duration_s=0.1)


def test_ctrl_c_leaves_a_complete_recording(computer: None, channel: str, tmp_path: Path) -> None:
    count = 0

    def on_frame(_frame: object) -> None:
        nonlocal count
        count += 1
        if count > 50:
            raise KeyboardInterrupt

    with opened(channel) as bus, pytest.raises(KeyboardInterrupt):
        ehadiag.record(bus, tmp_path / "bus.blf", on_frame=on_frame)
    assert len(read_frames(str(tmp_path / "bus.blf"))) > 10
