"""The command line without the names that only POSIX has, as on Windows."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from places import LOGS

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


def ran(
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
    assert ran(environment, tmp_path, START, *arguments)[0] == 0


@pytest.mark.slow
def test_a_diagnosis_with_its_files(environment: dict[str, str], tmp_path: Path) -> None:
    log = LOGS / "healthy-open.blf"
    code, out, err = ran(
        environment, tmp_path, DIAGNOSIS, "diagnose", "--json", "--out", "out",
        "--resume", "r.jsonl", "--summary", "s.json", log, log,
    )  # fmt: skip
    assert code == 0, err
    assert [json.loads(line)["verdict"] for line in out.splitlines()] == ["HEALTHY"] * 2
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"healthy-open.json"}
    code, again, _ = ran(
        environment, tmp_path, DIAGNOSIS, "diagnose", "--json", "--resume", "r.jsonl", log
    )
    assert (code, again) == (0, out.splitlines(keepends=True)[1])
    assert len((tmp_path / "r.jsonl").read_text().splitlines()) == 1
