"""`ehadiag bit` on a bus: verdicts, refusals, silence, other testers.

A time limit ends a search between two of its steps, wherever it runs out.
"""

from __future__ import annotations

import re
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import can
import can.interfaces.virtual
import pytest
from cli_result import Run
from identify_cases import own_experiment
from places import LOGS, ROOT

from ehadiag import NotTestedError, bundled_tests, default_actuator
from ehadiag.identify.identification_session import NuisanceMode, identify
from ehadiag.model.residual_models import SimdModel
from ehadiag.setup import Deadline
from ehadiag_sim.emulator import FccCore, emulator_in_thread
from firmware_iface.codec import Encoder
from firmware_iface.recording import BitState
from firmware_iface.signals.recordings import read_recording
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import PythonCanTransport

FAST = ("bit", "--simulate", "--fast", "--json", "--no-picture")
NAMES = ("Kintas", "FSS", "FDJ")


@pytest.fixture
def channel() -> str:
    return f"cli-{uuid.uuid4()}"


@pytest.fixture
def computer(channel: str) -> Iterator[FccCore]:
    """A flight-control computer on the virtual bus."""
    core = FccCore(default_actuator(), bundled_tests().values(), serial=12)
    core.step()
    with ExitStack() as stack:
        bus = PythonCanTransport(BusOptions("virtual", channel), transmit=True)
        stack.enter_context(bus)
        stack.enter_context(emulator_in_thread(core, bus))
        yield core


@pytest.mark.parametrize(
    ("test", "faults", "verdict", "code"),
    [
        ("open", (0.1, 0.05, 0.2), "HEALTHY", 0),
        pytest.param("open", (0.1, 0.5, 0.2), "DEGRADED", 10, marks=pytest.mark.slow),
        ("closed", (0.2, 0.1, 0.9), "FAULT", 20),
    ],
)
def test_verdict_on_the_simulated_actuator(
    test: str, faults: tuple[float, float, float], verdict: str, code: int, run: Run
) -> None:
    """A limit that is not exceeded lets the test pass."""
    options = [f"--{name}={value}" for name, value in zip(NAMES, faults, strict=True)]
    result = run(*FAST, "--test", test, *options, "--unit", 815, "--max-position", 15)
    (found,) = result.objects
    assert (found["verdict"], result.code) == (verdict, code)
    assert (found["test"], found["serial"]) == (test, 815)
    estimates = [fault["estimate"] for fault in found["faults"].values()]
    assert estimates == pytest.approx(faults, abs=2e-3)


def test_everything_is_written_and_the_recording_gives_the_same_digits(
    run: Run, tmp_path: Path
) -> None:
    result = run(*FAST[:-1], "--test", "closed", "--Kintas", 0.3, "--out", "runs")
    stem = re.fullmatch(r"runs/\d{8}T\d{6}Z-closed\.blf", result.objects[0]["source"])
    assert stem is not None
    assert sorted(path.suffix for path in (tmp_path / "runs").iterdir()) == [
        ".blf", ".json", ".png",
    ]  # fmt: skip
    again = run("diagnose", "--json", stem.group())
    assert again.objects[0]["faults"] == result.objects[0]["faults"]
    assert again.objects[0]["quality"] == result.objects[0]["quality"]


@pytest.mark.slow
def test_the_simulated_noise_follows_its_seed(run: Run) -> None:
    one, again, other = (
        run(*FAST, "--test", "open", "--FDJ", 0.3, "--simulator-seed", seed).objects[0]["faults"]
        for seed in (3, 3, 4)
    )
    assert one == again
    assert one != other


def test_own_test_file_is_played_and_diagnosed(run: Run, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(
        'name = "own"\nid = 9\nmode = "current"\nunit = "mA"\n'
        '[[segment]]\nkind = "line"\n'
        "points = [[0, 0], [0.2, 0], [0.7, 2], [1.2, 0], [1.2, 10], [1.3, 10], [1.3, -10],"
        " [1.5, -10], [1.5, 0], [2.0, 0]]\n"
        '[[segment]]\nkind = "sine"\nstart = 2.0\nend = 3.0\namplitude = 5.0\nfrequency = 12.0\n'
        "[windows]\nFDJ = [[0.2, 1.2]]\nKintas = [[1.2, 1.6]]\nFSS = [[0.2, 1.2]]\n"
        "refinement = [[2.0, 3.0]]\n"
    )
    result = run(*FAST, "--test", "own.toml", "--FSS", 0.4, "--record", "own.blf")
    assert result.objects[0]["test"] == "own"
    assert result.objects[0]["faults"]["FSS"]["estimate"] == pytest.approx(0.4, abs=2e-3)
    unknown = run("diagnose", "own.blf")
    assert unknown.code == 30
    assert "test 9 is none of the stored tests: name its file by --test" in unknown.out
    known = run("diagnose", "--json", "--test", "own.toml", "own.blf")
    assert known.objects[0]["faults"] == result.objects[0]["faults"]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--supply", "10"], "refused: supply pressure low"),
        (["--oil-temperature", "-30"], "refused: oil too cold"),
        (["--oil-temperature", "-30", "--protocol", "uds"], "refused: oil too cold"),
    ],
)
def test_refusal_is_not_tested(options: list[str], reason: str, run: Run) -> None:
    result = run(*FAST, "--test", "open", *options)
    (found,) = result.objects
    assert (result.code, found["verdict"], found["reasons"]) == (30, "NOT_TESTED", [reason])
    assert (found["test"], found["serial"]) == ("open", 1)


def test_a_test_by_uds_has_its_verdict_and_the_computers_own(run: Run) -> None:
    faults = ("--Kintas", "0.1", "--FSS", "0.05", "--FDJ", "0.2")
    (found,) = run(*FAST, "--test", "open", "--protocol", "uds", *faults).objects
    truth = [0.1, 0.05, 0.2]
    estimates = [found["faults"][name]["estimate"] for name in NAMES]
    assert estimates == pytest.approx(truth, abs=1e-3)
    assert found["verdict"] == "HEALTHY"
    onboard = found["recordings"][0]["onboard"]
    assert [onboard["faults"][name]["estimate"] for name in NAMES] == pytest.approx(truth)
    assert "software ehadiag" in " ".join(found["quality"]["notes"])


def test_uds_cannot_listen(run: Run) -> None:
    done = run("bit", "--test", "open", "--listen", "--protocol", "uds", "-i", "virtual", "-c", "x")
    assert done.code == 2
    assert "--listen sends nothing, --protocol uds asks" in done.message


def test_exceeded_limit_aborts(run: Run) -> None:
    result = run(*FAST, "--test", "closed", "--max-position", "5", "--record", "a.blf")
    assert result.code == 30
    (reason,) = result.objects[0]["reasons"]
    assert re.fullmatch(r"position -?5\.\d+ mm beyond its limit ±5 mm", reason)
    assert read_recording("a.blf").outcome.state is BitState.ABORTED


def test_computer_that_does_not_know_the_test_refuses(
    run: Run, computer: FccCore, channel: str, tmp_path: Path
) -> None:
    data = (ROOT / "firmware_iface/data/tests/open.toml").read_text()
    (tmp_path / "own.toml").write_text(data.replace("id = 1", "id = 77"))
    result = run("bit", "--json", "--test", "own.toml", "-i", "virtual", "-c", channel)
    assert (result.code, result.objects[0]["reasons"]) == (30, ["refused: unknown test"])
    assert result.objects[0]["serial"] == 12


def test_silent_bus(run: Run, channel: str) -> None:
    result = run("bit", "--json", "--test", "open", "-i", "virtual", "-c", channel)
    (reason,) = result.objects[0]["reasons"]
    assert result.code == 30
    assert reason.startswith("no answer within 1 s of the request")
    assert re.search(rf"; virtual {channel} was silent for \d+\.\d s$", reason)


def test_bus_of_others(run: Run, channel: str) -> None:
    stop = threading.Event()

    def chatter() -> None:
        with can.Bus(interface="virtual", channel=channel) as bus:
            while not stop.wait(0.002):
                bus.send(can.Message(arbitration_id=0x321, data=b"12345678", is_extended_id=False))

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        result = run("bit", "--json", "--test", "open", "-i", "virtual", "-c", channel)
        checked = run("check-bus", "-i", "virtual", "-c", channel, "--duration", "0.3")
    finally:
        stop.set()
        thread.join()
    (reason,) = result.objects[0]["reasons"]
    assert result.code == 30
    assert re.search(r"; \d+ frames heard on virtual .* none that the mapping knows", reason)
    assert result.objects[0]["quality"]["foreign"] > 100
    assert checked.code == 30
    assert "ServoTelemetry (0x110) does not come" in checked.out
    assert "not mapped: 0x321 (" in checked.out


def test_busy_computer(run: Run, computer: FccCore, channel: str) -> None:
    with PythonCanTransport(BusOptions("virtual", channel), transmit=True) as other:
        for frame in Encoder().request("start", 2, 0):
            other.send(frame)
        while computer.state is not BitState.RUNNING:
            time.sleep(0.01)
        result = run("bit", "--json", "--test", "open", "-i", "virtual", "-c", channel)
    assert result.code == 30
    assert result.objects[0]["reasons"] == ["test 2 of another tester is running"]


@pytest.mark.slow  # a whole test in real time
def test_listening_sends_nothing(run: Run, computer: FccCore, channel: str) -> None:
    def request() -> None:
        while len(can.interfaces.virtual.channels[channel]) == buses:  # nobody listens yet
            time.sleep(0.01)
        with PythonCanTransport(BusOptions("virtual", channel), transmit=True) as other:
            for frame in Encoder().request("start", 1, 0):
                other.send(frame)

    starter = threading.Thread(target=request, daemon=True)
    with can.Bus(interface="virtual", channel=channel) as witness:
        buses = len(can.interfaces.virtual.channels[channel])
        starter.start()
        result = run("bit", "--json", "--listen", "--test", "open", "-i", "virtual", "-c", channel)
        starter.join()
        requests = 0
        while (message := witness.recv(0)) is not None:
            requests += message.arbitration_id == 0x200
    assert requests == 1
    assert (result.code, result.objects[0]["verdict"]) == (0, "HEALTHY")


def test_check_bus_finds_all_that_a_diagnosis_needs(
    run: Run, computer: FccCore, channel: str
) -> None:
    result = run("check-bus", "-i", "virtual", "-c", channel, "--duration", "0.5")
    assert result.code == 0
    assert result.out.startswith(f"listened to virtual {channel} for 0.")
    assert result.out.splitlines()[-1] == "everything that a diagnosis needs is there"


def test_check_bus_says_how_long_a_bus_was_silent(run: Run, channel: str) -> None:
    result = run("check-bus", "-i", "virtual", "-c", channel, "--duration", "0.2")
    assert result.code == 30
    first, *_, last = result.out.splitlines()
    assert re.fullmatch(rf"listened to virtual {channel} for \d+\.\d s, sent nothing", first)
    assert last == "the bus is silent"


def test_check_bus_reads_logs(run: Run) -> None:
    assert run("check-bus", "--log", LOGS / "paper-open-1.blf").code == 0
    lossy = run("check-bus", "--log", LOGS / "lossy-open.blf")
    assert lossy.code == 0  # as a diagnosis bears it
    assert re.search(r"ServoTelemetry: \d+ frames lost", lossy.out)


def test_replay_puts_every_frame_on_the_bus(run: Run, channel: str) -> None:
    log = LOGS / "paper-open-1.blf"
    with can.Bus(interface="virtual", channel=channel) as listener:
        result = run(
            "replay", log, "-i", "virtual", "-c", channel, "--speed", "0", "--with-requests"
        )
        heard = []
        while (message := listener.recv(0)) is not None:
            heard.append((message.arbitration_id, bytes(message.data)))
    assert result.code == 0
    assert result.message == f"ehadiag: played 11331 of 11331 frames on virtual {channel}"
    with can.BLFReader(log) as reader:
        assert heard == [(item.arbitration_id, bytes(item.data)) for item in reader]


def test_sim_ends_by_itself(run: Run, channel: str) -> None:
    result = run("sim", "-i", "virtual", "-c", channel, "--duration", "0.3")
    assert result.code == 0
    first, last = result.err.splitlines()
    assert first.startswith(f"ehadiag: flight-control computer on virtual {channel}, tests ")
    assert re.fullmatch(r"ehadiag: stopped after \d+ ticks, 0 tests started", last)


TICK_S = 2e-7
"""What a tick of a run takes by the clock of these tests, 1 to 2 ms for a whole test: twice what it
takes a slow machine."""
OVERSHOOT_S = 0.15


class Clock:
    """A clock that only runs of the model move on."""

    def __init__(self, patched: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        for name in ("residuals", "costs"):
            patched.setattr(SimdModel, name, self._timed(getattr(SimdModel, name)))

    def __call__(self) -> float:
        return self.now

    def _timed(self, run):
        def timed(model, points, *rest):
            self.now += TICK_S * len(points) * len(model.batch.current)
            return run(model, points, *rest)

        return timed


@pytest.mark.parametrize(
    ("nuisances", "limit", "stage"),
    [
        (NuisanceMode.AUTO, 0.05, "search"),
        (NuisanceMode.AUTO, 0.165, "refinement"),
        (NuisanceMode.ALL, 0.27, "nuisances"),
        (NuisanceMode.ALL, 0.3, "nuisances"),
    ],
)
def test_a_search_ends_soon_after_its_time(
    nuisances: NuisanceMode, limit: float, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    deadline = Deadline(limit, clock)
    tell = deadline.watch(lambda _stage, _share: None)
    with pytest.raises(NotTestedError, match=f"given up in the {stage}"):
        identify([own_experiment((0.3, 0.4, 0.2))], nuisances=nuisances, progress=tell)
    assert deadline.passed
    assert clock.now < limit + OVERSHOOT_S


def test_a_computer_too_busy_to_simulate_is_not_the_actuators_fault(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = FccCore.step
    ticks = 0

    def slow(core: FccCore) -> list[Frame]:
        nonlocal ticks
        ticks += 1
        if ticks > 600:
            time.sleep(0.3)
        return step(core)

    monkeypatch.setattr(FccCore, "step", slow)
    (found,) = run("bit", "--simulate", "--json", "--test", "open").objects
    assert found["verdict"] == "NOT_TESTED"
    (reason,) = found["reasons"]
    assert reason.startswith("this computer is too busy to simulate in real time")
    assert "--fast" in reason


def test_a_test_measured_by_xcp_has_the_same_result(run: Run) -> None:
    command = ("bit", "--test", "closed", "--simulate", "--fast", "--FSS", "0.4", "--json")
    command = (*command, "--no-picture")
    by_telemetry, by_xcp = run(*command), run(*command, "--xcp")
    assert by_xcp.code == by_telemetry.code == 10
    (expected,), (found,) = by_telemetry.objects, by_xcp.objects
    for name, severity in expected["faults"].items():
        assert found["faults"][name]["estimate"] == pytest.approx(severity["estimate"], abs=1e-6)
    assert "by XCP" in by_xcp.err
    refused = run(*command[:3], "--listen", "-i", "virtual", "--xcp")
    assert refused.code == 2
    assert "--xcp: measures on command" in refused.message


def test_without_an_xcp_slave_nothing_is_recorded(run: Run, tmp_path: Path) -> None:
    found = run("bit", "--test", "open", "-i", "virtual", "-c", "no slave", "--xcp", "--out", "o")
    assert found.code == 3
    assert "no XCP slave answers CONNECT on 6F0:6F1" in found.err
    assert list((tmp_path / "o").iterdir()) == []
    wrong = run("bit", "--test", "open", "-i", "virtual", "-c", "no slave", "--xcp", "6F0")
    assert wrong.code == 2
    assert "need two different ones in hexadecimal" in wrong.message
