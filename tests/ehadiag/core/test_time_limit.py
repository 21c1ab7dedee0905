"""A time limit holds whatever the computation does; Ctrl-Break stops as Ctrl-C does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import LOGS

from ehadiag.core.interruption import interrupt_on_signals, is_computing, stop_on_signals
from ehadiag.setup import Deadline
from firmware_iface.errors import NotTestedError


def test_a_computation_that_reports_nothing_ends_at_its_time() -> None:
    release, begin = threading.Event(), time.monotonic()

    def work(report):
        report("search", 0.0)
        release.wait(60.0)
        report("search", 0.5)
        raise AssertionError("went on after its time")

    with pytest.raises(NotTestedError, match=r"within 0\.2 s: given up in the search"):
        Deadline(0.2).run(work, lambda _stage, _share: None)
    assert time.monotonic() - begin < 30.0
    release.set()
    assert not is_computing(30.0)


def test_results_reports_and_errors_come_through() -> None:
    reports = []
    found = Deadline(60.0).run(
        lambda report: report("search", 0.5) or 7, lambda *item: reports.append(item)
    )
    assert (found, reports) == (7, [("search", 0.5)])

    def failing(_report):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        Deadline(60.0).run(failing, lambda _stage, _share: None)


def test_an_interrupt_does_not_wait_for_the_computation(restored_sigint: None) -> None:
    release = threading.Event()
    threading.Timer(0.3, signal.raise_signal, (signal.SIGINT,)).start()
    with pytest.raises(KeyboardInterrupt):
        Deadline(60.0).run(lambda _report: release.wait(60.0), lambda _stage, _share: None)
    release.set()
    assert not is_computing(30.0)


@pytest.fixture
def restored_sigint() -> Iterator[None]:
    """Python's own handler: a shell's background job begins with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def hostile_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path(".numba_config.yaml").write_text("disable_jit: 1\n")


def test_numba_takes_no_configuration_from_the_working_folder(hostile_folder: None) -> None:
    script = (
        "import ehadiag.compile.frontend, numba, sys, yaml;"
        "print(numba.config.DISABLE_JIT, yaml.__name__, sys.modules['yaml'] is yaml)"
    )
    for line in (script, f"import yaml; {script}"):
        program = [sys.executable, "-W", "error", "-P", "-c", line]
        done = subprocess.run(program, capture_output=True, text=True, timeout=120, check=False)
        assert (done.stdout, done.stderr) == ("0 yaml True\n", "")


@pytest.mark.slow
def test_the_limit_holds_without_a_compiler(tmp_path: Path) -> None:
    program = [sys.executable, "-m", "ehadiag", "diagnose", "--time-limit", "2"]
    begin = time.monotonic()
    done = subprocess.run(
        [*program, str(LOGS / "paper-open-4.blf")],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 30, done.stderr
    assert "no estimate within 2 s" in done.stdout
    assert time.monotonic() - begin < 60.0


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="a signal that stands for Ctrl-Break")
def test_ctrl_break_is_handled_as_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    if not hasattr(signal, "SIGBREAK"):
        monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    before = signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        with stop_on_signals() as stop:
            signal.raise_signal(signal.SIGBREAK)
            assert stop.is_set()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGBREAK)
        interrupt_on_signals()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGBREAK)
    finally:
        signal.signal(signal.SIGUSR1, before)
