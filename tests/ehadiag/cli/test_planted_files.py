"""Files of other users in the working folder: nothing there is loaded, by no process of a call."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from places import LOGS

COMMAND = """
from ehadiag.cli.main import process
if __name__ == "__main__":
    process()
"""
"""The installed script `ehadiag`."""
OF_PYTHON_M = ("numpy", "numba", "joblib", "can", "msgspec", "cantools", "argparse", "scipy")
"""Modules that `python -m` itself does not load before the first line of ours."""


@pytest.fixture
def loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """File that names each planted module that was loaded."""
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    place = tmp_path / "shared"
    place.mkdir()
    monkeypatch.chdir(place)
    mark = tmp_path / "loaded"
    names = {*sys.stdlib_module_names, *OF_PYTHON_M, "ehadiag", "firmware_iface", "cloudpickle"}
    for name in names:
        text = f"open({str(mark)!r}, 'a').write({name + chr(10)!r})\nraise SystemExit(9)\n"
        Path(f"{name}.py").write_text(text)
    return mark


def called(loaded: Path, script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a script that lies in another folder, as an installed one does."""
    place = loaded.with_name("bin")
    place.mkdir()
    (place / "program").write_text(script)
    program = [sys.executable, str(place / "program"), *arguments]
    return subprocess.run(program, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
def test_workers_and_resource_trackers_load_nothing_from_the_working_folder(loaded: Path) -> None:
    logs = [str(LOGS / "healthy-open.blf"), str(LOGS / "paper-open-4.blf")]
    done = called(loaded, COMMAND, "diagnose", "--jobs", "2", *logs)
    assert done.returncode == 10, done.stderr
    assert not loaded.exists(), loaded.read_text()


SESSION = """
import operator
from ehadiag.serve.sessions import Session, SessionRunner
if __name__ == "__main__":
    with SessionRunner(Session("a session", operator.not_, ()), {}) as sessions:
        status = sessions.wait(0, 60.0)
        while not any("ended" in line for line in status.lines):
            status = sessions.wait(status.number, 60.0)
    print(status.lines[-1])
"""


def test_sessions_of_the_page_load_nothing_from_the_working_folder(loaded: Path) -> None:
    done = called(loaded, SESSION)
    assert (done.stdout, done.stderr) == ("ended with exit code 0\n", "")
    assert not loaded.exists(), loaded.read_text()


def test_python_m_loads_nothing_of_ours_from_the_working_folder(loaded: Path) -> None:
    for path in Path.cwd().iterdir():
        if path.stem not in OF_PYTHON_M:
            path.unlink()
    program = [sys.executable, "-m", "ehadiag", "--version"]
    done = subprocess.run(program, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert not loaded.exists(), loaded.read_text()


COMPILING = """
from ehadiag.compile.worker import ObjectFile, Processor, object_code
if __name__ == "__main__":
    print(object_code(ObjectFile((), Processor("", shared=True), {}))[0][:4])
"""


def test_the_compiling_process_loads_nothing_from_the_working_folder(loaded: Path) -> None:
    done = called(loaded, COMPILING)
    assert (done.stdout, done.stderr) == ("b'\\x7fELF'\n", "")
    assert not loaded.exists(), loaded.read_text()


SCREEN = """
from ehadiag.terminal.screen import _ScreenProcess
if __name__ == "__main__":
    _ScreenProcess.begun().close()
"""


def test_the_process_of_the_screen_loads_nothing_from_the_working_folder(loaded: Path) -> None:
    done = called(loaded, SCREEN)
    assert (done.returncode, done.stderr) == (0, "")
    assert not loaded.exists(), loaded.read_text()
