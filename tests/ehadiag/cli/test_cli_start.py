"""Start-up loads no heavy library that a command does not need.

`ehadiag --version`: one line, the package first, then what its digits depend on. The command line
without the names that only POSIX has, as on Windows.
"""

from __future__ import annotations

import json
import platform
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from cli_result import COMMAND, Run
from places import LOGS

import ehadiag
from ehadiag.compile.libraries import cache_folder
from firmware_iface.bus_map import default_map

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


def loaded(arguments: list[str], environment: dict[str, str]) -> set[str]:
    return set(printed(SHOW, arguments, environment).split())


def printed(script: str, arguments: list[str], environment: dict[str, str]) -> str:
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


def test_the_help_of_all_commands_loads_none(environment: dict[str, str]) -> None:
    found = loaded(["--help"], environment)
    assert not {name for name in found if name.endswith(("_command", "_commands"))}
    assert not found & {"numpy", "msgspec", "importlib.metadata"}


@pytest.fixture(scope="module")
def _dbc_is_kept() -> None:
    """The first diagnosis may have to read the DBC."""
    default_map()


@pytest.mark.usefixtures("_dbc_is_kept")
@pytest.mark.parametrize("name", ["paper-open-1.blf", "paper-closed-1.blf"])
def test_diagnosis_of_a_recording_loads_no_bus_and_compiles_nothing(
    name: str, environment: dict[str, str]
) -> None:
    """The compiler alone would take half a second, and 70 MB."""
    modules = loaded(["diagnose", "--json", str(LOGS / name)], environment)
    assert "ehadiag.identify.identification_session" in modules
    heavy = {"rich", "joblib", "numba", "llvmlite"}
    assert not modules & (BUSES | REPORTS | PAGES | NUMERICS | heavy)


def test_a_picture_does_load_what_draws_it(environment: dict[str, str], tmp_path: Path) -> None:
    log = str(LOGS / "healthy-open.blf")
    assert loaded(["diagnose", "--out", str(tmp_path), log], environment) > REPORTS


@pytest.mark.parametrize(
    "command",
    [
        ["diagnose", "--json", str(LOGS / "paper-open-1.blf"), str(LOGS / "paper-closed-1.blf")],
        ["diagnose", "--json", "--solver", "pygad", str(LOGS / "paper-open-1.blf")],
        pytest.param(
            ["bit", "--json", "--simulate", "--fast", "--test", "closed"], marks=pytest.mark.slow
        ),
    ],
)
def test_after_warmup_nobody_waits_for_the_compiler(
    command: list[str], environment: dict[str, str], tmp_path: Path
) -> None:
    """A kernel that is compiled is kept; so what is kept afterwards is what was compiled."""
    ours = cache_folder()
    assert ours is not None
    kept = tmp_path / "cache" / ours.path.name
    shutil.copytree(ours.path, kept)  # other tests compile into the folder
    kept.parent.chmod(0o700)
    kernels = {path.name for path in kept.iterdir()}
    assert any(name.endswith(".kernel") for name in kernels)
    done = subprocess.run(
        [*COMMAND, *command],
        cwd=tmp_path,
        env=environment | {"EHADIAG_CACHE_DIR": str(kept.parent)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode in (0, 10), done.stderr
    assert "compil" not in done.stderr
    assert {path.name for path in kept.iterdir()} == kernels


def test_versions_of_the_package_python_and_libraries(run: Run) -> None:
    result = run("--version")
    assert (result.code, result.err) == (0, "")
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "python-can"))
    expected = f"ehadiag {ehadiag.__version__} (Python {platform.python_version()}, {libraries})\n"
    assert result.out == expected
    assert re.match(r"ehadiag \d+\.\d+", result.out)


WITHOUT = """
import os, pathlib, signal, subprocess, sys, tempfile

# The libraries' own builds for this system may use its names; ours may not.
for name in sys.argv.pop(1).split():
    __import__(name)

for name in ("fcntl", "pwd", "grp", "resource", "termios", "tty", "pty", "syslog", "readline"):
    sys.modules[name] = None
for name in (
    "getuid", "geteuid", "getgid", "getegid", "fork", "forkpty", "mkfifo", "mknod", "fchmod",
    "fchown", "chown", "lchown", "nice", "sched_getaffinity", "sched_setaffinity", "getpgid",
    "setsid", "killpg", "wait3", "wait4", "statvfs", "fstatvfs", "posix_fadvise", "sendfile",
    "O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "O_CLOEXEC", "O_SYNC", "getloadavg", "uname",
    "confstr", "sysconf", "ttyname", "get_blocking", "getresuid", "posix_spawn",
):
    if hasattr(os, name):
        delattr(os, name)
os.supports_dir_fd.clear()
os.supports_follow_symlinks.discard(os.link)
for name in ("SIGHUP", "SIGKILL", "SIGALRM", "SIGUSR1", "SIGUSR2", "SIGPIPE", "SIGCHLD"):
    if hasattr(signal, name):
        delattr(signal, name)


def refuse_links(link):
    def other(source, target, *, src_dir_fd=None, dst_dir_fd=None, follow_symlinks=True):
        if not follow_symlinks or src_dir_fd is not None or dst_dir_fd is not None:
            raise NotImplementedError("link: follow_symlinks unavailable on this platform")
        link(source, target)
    return other


os.link = refuse_links(os.link)
import ehadiag.cli.main
sys.exit(ehadiag.cli.main.main(sys.argv[1:]))
"""

START = "numpy msgspec platformdirs rich.console"
DIAGNOSIS = f"{START} numba joblib cantools matplotlib.figure"
"""What the commands load of others."""


def run_without_posix(
    environment: dict[str, str], folder: Path, libraries: str, *arguments: object
) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, libraries, *map(str, arguments)], env=environment,
        cwd=folder, capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("arguments", [["--help"], ["tests"], ["init", "mapping"]])
def test_commands_start(arguments: list[str], environment: dict[str, str], tmp_path: Path) -> None:
    assert run_without_posix(environment, tmp_path, START, *arguments)[0] == 0


@pytest.mark.slow
def test_a_diagnosis_with_its_files(environment: dict[str, str], tmp_path: Path) -> None:
    log = LOGS / "healthy-open.blf"
    code, out, err = run_without_posix(
        environment, tmp_path, DIAGNOSIS, "diagnose", "--json", "--out", "out",
        "--resume", "r.jsonl", "--summary", "s.json", log, log,
    )  # fmt: skip
    assert code == 0, err
    assert [json.loads(line)["verdict"] for line in out.splitlines()] == ["HEALTHY"] * 2
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"healthy-open.json"}
    code, again, _ = run_without_posix(
        environment, tmp_path, DIAGNOSIS, "diagnose", "--json", "--resume", "r.jsonl", log
    )
    assert (code, again) == (0, out.splitlines(keepends=True)[1])
    assert len((tmp_path / "r.jsonl").read_text().splitlines()) == 1
