"""Start-up loads no heavy library that a command does not need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from cli_result import COMMAND
from places import LOGS

from ehadiag.compile.kernel_cache import kept_kernels

SHOW = """
import sys
from ehadiag.cli.main import main
try:
    code = main(sys.argv[1:])
except SystemExit as stop:
    code = stop.code or 0
print(*sys.modules, sep="\\n", file=sys.stderr)
sys.exit(code)
"""
BUSES = {"can", "cantools", "serial", "asammdf", "pandas"}
REPORTS = {"matplotlib"}
PAGES = {"bokeh", "jinja2", "sqlite3"}
NUMERICS = {"scipy.linalg", "scipy.optimize", "scipy.special", "scipy.stats", "pygad"}
COMPILED = """
import sys
from numba.core import event
with event.install_recorder("numba:compile") as recorder:
    from ehadiag.cli.main import main
    code = main(sys.argv[1:])
print(*(item.data["dispatcher"] for _, item in recorder.buffer), sep="\\n", file=sys.stderr)
sys.exit(code)
"""


def loaded(arguments: list[str], environment: dict[str, str]) -> set[str]:
    return set(told(SHOW, arguments, environment).split())


def told(script: str, arguments: list[str], environment: dict[str, str]) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode in (0, 10), done.stderr
    return done.stderr


@pytest.mark.parametrize(
    "arguments", [["--help"], ["diagnose", "--help"], ["tests"], ["tests", "--csv", "open"]]
)
def test_what_needs_no_model_loads_no_compiler(
    arguments: list[str], environment: dict[str, str]
) -> None:
    found = loaded(arguments, environment)
    assert "ehadiag.cli.main" in found
    assert not found & (BUSES | REPORTS | PAGES | NUMERICS | {"numba", "llvmlite", "scipy"})


@pytest.mark.parametrize("name", ["paper-open-1.blf", "paper-closed-1.blf"])
def test_diagnosis_of_a_recording_loads_no_bus(name: str, environment: dict[str, str]) -> None:
    command = ["diagnose", "--json", str(LOGS / name)]
    loaded(command, environment)  # the first one may have to read the DBC
    found = loaded(command, environment)
    assert {"numba", "ehadiag.identify.session"} <= found
    assert not found & (BUSES | REPORTS | PAGES | NUMERICS | {"rich"})


@pytest.mark.parametrize("name", ["paper-open-1.blf", "paper-closed-1.blf"])
def test_a_second_diagnosis_compiles_nothing(name: str, environment: dict[str, str]) -> None:
    """Each kernel that the cache does not hold costs every start a second or more."""
    command = ["diagnose", "--json", str(LOGS / name)]
    loaded(command, environment)
    assert told(COMPILED, command, environment).strip() == ""


def test_a_picture_does_load_what_draws_it(environment: dict[str, str], tmp_path: Path) -> None:
    log = str(LOGS / "healthy-open.blf")
    assert loaded(["diagnose", "--out", str(tmp_path), log], environment) > REPORTS


@pytest.mark.parametrize(
    "command",
    [
        ["diagnose", "--json", str(LOGS / "paper-open-1.blf"), str(LOGS / "paper-closed-1.blf")],
        ["diagnose", "--json", "--solver", "pygad", str(LOGS / "paper-open-1.blf")],
        ["bit", "--json", "--simulate", "--fast", "--test", "closed"],
    ],
)
def test_after_warmup_nobody_waits_for_the_compiler(
    command: list[str], environment: dict[str, str], tmp_path: Path
) -> None:
    """A kernel that is compiled is kept; so what is kept afterwards is what was compiled."""
    before = set(kept_kernels())
    assert before
    done = subprocess.run(
        [*COMMAND, *command],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode in (0, 10), done.stderr
    assert "compil" not in done.stderr
    assert set(kept_kernels()) == before
