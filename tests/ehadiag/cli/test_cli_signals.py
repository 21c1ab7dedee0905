"""Ctrl-C, SIGTERM and a hang-up: alike, and none of them costs what is known."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_result import COMMAND, Run
from places import LOGS

from ehadiag.cli.result_output import ResultWriter
from ehadiag.core.interruption import (
    defer_signals,
    interrupt_on_signals,
    signals_restored,
    stop_on_signals,
)
from ehadiag.session.bit_run import STOPPED_TWICE_REASON, EarlyIdentification
from firmware_iface.recording import BitState
from firmware_iface.signals.recordings import read_recording

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
ALL = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ONE = (
    signal.SIGTERM,
    *(pytest.param(item, marks=pytest.mark.slow) for item in (signal.SIGINT, signal.SIGHUP)),
)
"""What each of them does is in `test_what_signals_do`; a process with each takes its time."""
ATTEMPTS = 5
FAST = ("bit", "--json", "--no-picture", "--simulate", "--fast", "--test", "open", "--out", "o")
BIT = (*COMMAND, "bit", "--test", "open", "--simulate", "--json", "--record", "cut.blf")


@pytest.fixture(scope="module", autouse=True)
def _as_in_a_terminal() -> Iterator[None]:
    """Under nohup, or in the background of a shell, a process begins with some ignored."""
    handlers = (signal.default_int_handler, signal.SIG_DFL, signal.SIG_DFL)
    before = [signal.signal(*item) for item in zip(ALL, handlers, strict=True)]
    yield
    for item in zip(ALL, before, strict=True):
        signal.signal(*item)


@pytest.fixture
def _restored() -> Iterator[None]:
    with signals_restored():
        yield


class Bit:
    """`ehadiag bit` in a process, its test under way."""

    def __init__(self, folder: Path, environment: dict[str, str], *before: str) -> None:
        self.recording = folder / "cut.blf"
        self.process = subprocess.Popen(
            [*before, *BIT],
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stderr is not None
        while "recording to" not in self.process.stderr.readline():
            assert self.process.poll() is None
        # Some hundred frames on disk: the test has been requested and is on its way.
        while self.recording.stat().st_size < 4000:
            assert self.process.poll() is None
            time.sleep(0.01)

    def end(self) -> dict:
        output, errors = self.process.communicate(timeout=60)
        assert "Traceback" not in errors
        return json.loads(output)


@pytest.mark.parametrize("number", ONE)
def test_a_signal_aborts_the_test(
    number: signal.Signals, tmp_path: Path, environment: dict[str, str]
) -> None:
    bit = Bit(tmp_path, environment)
    try:
        bit.process.send_signal(number)
        found = bit.end()
    finally:
        bit.process.kill()
    assert bit.process.returncode == 30
    assert (found["verdict"], found["reasons"]) == ("NOT_TESTED", ["stopped by the user"])
    assert json.loads((tmp_path / "ehadiag-out/cut.json").read_text()) == found
    assert read_recording(bit.recording).outcome.state is BitState.ABORTED


@pytest.mark.slow
def test_a_hang_up_that_is_ignored_stays_ignored(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        bit = Bit(folder, environment, "nohup")
        try:
            for _ in range(3):
                bit.process.send_signal(signal.SIGHUP)
            found = bit.end()
        finally:
            bit.process.kill()
        # The simulator's time is real: on a busy machine the end of the test may come too late.
        if not any("too busy to simulate" in reason for reason in found["reasons"]):
            break
    else:
        pytest.skip(f"this machine was too busy for the simulator {ATTEMPTS} times")
    assert (bit.process.returncode, found["verdict"]) == (0, "HEALTHY")


def send(*numbers: signal.Signals) -> None:
    for number in numbers:
        os.kill(os.getpid(), number)


@pytest.mark.usefixtures("_restored")
@pytest.mark.parametrize("second", ALL)
def test_the_second_one_does_not_wait_for_the_abort(
    second: signal.Signals, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The computer obeys, but its word does not come."""
    from firmware_iface import tester

    asked = tester._BitSession._request
    requests = []

    def request(session, action) -> None:
        requests.append(action)
        asked(session, action)
        if action is tester.HandshakeAction.ABORT and len(requests) == 2:
            send(second)

    def watch(_ahead, progress) -> None:
        if progress.elapsed > 0.5 and len(requests) == 1:
            send(signal.SIGINT)

    monkeypatch.setattr(tester._BitSession, "_request", request)
    monkeypatch.setattr(EarlyIdentification, "watch", watch)
    result = run(*FAST)
    assert result.code == 30
    assert result.objects[0]["reasons"] == [STOPPED_TWICE_REASON]
    assert [action.value for action in requests] == ["start", "abort", "abort"]
    (written,) = Path("o").glob("*.json")
    assert json.loads(written.read_text()) == result.objects[0]
    assert len(list(Path("o").glob("*.blf"))) == 1


@pytest.mark.usefixtures("_restored")
@pytest.mark.parametrize("number", ONE)
@pytest.mark.parametrize("command", ["diagnose", "bit"])
def test_one_in_the_identification(
    command: str, number: signal.Signals, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ehadiag.assess import diagnosis

    monkeypatch.setattr(diagnosis.DiagnosisSession, "finish", lambda *_, **__: send(number))
    if command == "bit":
        result = run(*FAST)
    else:
        logs = [LOGS / "healthy-open.blf", LOGS / "paper-open-1.blf"]
        result = run("diagnose", "--json", "--no-picture", "--out", "o", *logs)
        assert "paper-open-1.blf is not diagnosed" in result.err
    (found,) = result.objects
    assert result.code == (30 if command == "bit" else 130)  # a log was left
    assert (found["verdict"], found["reasons"]) == ("NOT_TESTED", ["stopped by the user"])
    assert found["quality"]["frames"] > 10_000
    assert len(list(Path("o").glob("*.json"))) == 1


@pytest.mark.usefixtures("_restored")
@pytest.mark.parametrize("number", ALL)
@pytest.mark.parametrize("times", [1, 2])
def test_one_after_the_verdict(
    times: int, number: signal.Signals, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between result and picture; the code is the verdict's."""
    show = ResultWriter._print

    def shown(results, *arguments) -> None:
        show(results, *arguments)
        send(*[number] * times)

    monkeypatch.setattr(ResultWriter, "_print", shown)
    result = run("diagnose", "--json", "--out", "o", LOGS / "paper-open-1.blf")
    assert result.code == 10
    assert [path.name for path in Path("o").iterdir()] == ["paper-open-1.json"]


@pytest.mark.parametrize("number", ONE)
def test_one_while_nobody_reads_the_result(
    number: signal.Signals, tmp_path: Path, environment: dict[str, str]
) -> None:
    """The pipe is full: the process waits in the middle of its output, and can be ended there."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    try:
        while True:
            os.write(writing, bytes(1 << 16))
    except BlockingIOError:
        os.set_blocking(writing, True)
    process = subprocess.Popen(
        [*COMMAND, "diagnose", "--json", "--out", "o", str(LOGS / "paper-open-1.blf")],
        cwd=tmp_path, env=environment, stdout=writing, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        written = tmp_path / "o/paper-open-1.json"
        while not written.exists():
            assert process.poll() is None
            time.sleep(0.02)
        while process.poll() is None:
            process.send_signal(number)
            time.sleep(0.2)
    finally:
        process.kill()
        process.communicate()
        os.close(reading)
        os.close(writing)
    assert process.returncode == 10
    assert json.loads(written.read_text())["verdict"] == "DEGRADED"


ENTRY = """
import os, signal, sys
import ehadiag.cli.main as program
from ehadiag.cli import setup_commands
class Exiting:
    def __del__(self):
        os.kill(os.getpid(), signal.{name})
def run(_):
    from ehadiag.core.interruption import defer_signals
    defer_signals()
    os.kill(os.getpid(), signal.{name})
    return 20
setup_commands.run_tests = run
sys.argv = ["ehadiag", "tests"]
sys.last = Exiting()
program.process()
"""


@pytest.mark.parametrize("number", ALL)
def test_one_on_the_way_out(number: signal.Signals, environment: dict[str, str]) -> None:
    """Before the command returns, and when the interpreter is already being taken down."""
    code = ENTRY.format(name=number.name)
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=False, timeout=60)
    assert done.returncode == 20


@pytest.mark.usefixtures("_restored")
@pytest.mark.parametrize("number", ALL)
def test_what_signals_do(number: signal.Signals) -> None:
    interrupt_on_signals()
    with pytest.raises(KeyboardInterrupt):
        send(number)
    with stop_on_signals() as stop:
        send(number)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            send(number)
        send(number)  # a third must not get in the way of the abort
    with pytest.raises(KeyboardInterrupt):
        send(number)
    came = defer_signals()
    assert not came.is_set()
    send(number)
    assert came.is_set()
    with pytest.raises(KeyboardInterrupt):
        send(number)


@pytest.mark.usefixtures("_restored")
def test_an_ignored_hang_up_is_left_alone() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    interrupt_on_signals()
    with stop_on_signals() as stop:
        defer_signals()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        send(signal.SIGHUP)
        assert not stop.is_set()


def test_in_a_thread_signals_are_left_alone() -> None:
    before = [signal.getsignal(number) for number in ALL]
    seen = []

    def work() -> None:
        with stop_on_signals(after_s=0.01) as stop:
            interrupt_on_signals()
            seen.append(stop.wait(60.0))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [True]
    assert [signal.getsignal(number) for number in ALL] == before


@pytest.mark.parametrize("number", ONE)
def test_sim_ends_in_order(number: signal.Signals, environment: dict[str, str]) -> None:
    process = subprocess.Popen(
        [*COMMAND, "sim", "-i", "virtual"], env=environment, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        assert "Ctrl-C stops it" in process.stderr.readline()
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    (line,) = errors.splitlines()
    assert line.startswith("ehadiag: stopped after ")
