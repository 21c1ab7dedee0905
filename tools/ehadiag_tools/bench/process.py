"""Whole processes: `ehadiag --help`; `ehadiag diagnose` with kernels cached, and its first run."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from ehadiag.core.errors import InputOutputError
from ehadiag_tools.bench.figures import Figure, Sizes
from ehadiag_tools.bench.problem import LOG

__all__ = ["measure"]

SECTION = "process"
PER_MB = 1 << 20 if sys.platform == "darwin" else 1 << 10
"""Units of `ru_maxrss` in a megabyte."""
COMMAND = "import sys; from ehadiag.cli.main import main; sys.exit(main(sys.argv[1:]))"

WATCH = """
import os, subprocess, sys, time
begin = time.perf_counter()
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(child.pid, 0)
wall = time.perf_counter() - begin
child.returncode = os.waitstatus_to_exitcode(status)
print(child.returncode, wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss)
"""
"""Watches one process. It is small itself: a child starts with its parent's peak of memory."""


class _Run(NamedTuple):
    """Wall and CPU time (s), peak memory (MB) and stderr of one process."""

    wall: float
    cpu: float
    peak: float
    said: str


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    diagnose, times = ("diagnose", str(sizes.logs / LOG)), max(1, sizes.repeats // 3)
    with tempfile.TemporaryDirectory() as folder:
        first = _run(diagnose, Path(folder))
        runs = [_run(diagnose, Path(folder)) for _ in range(times)]
        helps = [_run(("--help",), Path(folder)) for _ in range(times)]
        sizes_mb = sum(item.stat().st_size for item in Path(folder).glob("kernels-*/*")) / (1 << 20)
    hint = (
        "says that it compiles"
        if "compil" in first.said.lower()
        else "does not say that it compiles"
    )
    return [
        Figure(SECTION, "help, wall", statistics.median(run.wall for run in helps), "s"),
        Figure(
            SECTION,
            "diagnose one log, kernels cached, wall",
            statistics.median(run.wall for run in runs),
            "s",
            LOG,
        ),
        Figure(
            SECTION,
            "diagnose one log, kernels cached, CPU",
            statistics.median(run.cpu for run in runs),
            "s",
        ),
        Figure(SECTION, "diagnose one log, peak memory", max(run.peak for run in runs), "MB"),
        Figure(SECTION, "first run ever, wall", first.wall, "s", hint),
        Figure(SECTION, "first run ever, CPU", first.cpu, "s"),
        Figure(SECTION, "kernels in the cache", sizes_mb, "MB"),
    ]


def _run(arguments: tuple[str, ...], cache: Path) -> _Run:
    """Run one process."""
    done = subprocess.run(
        [sys.executable, "-S", "-c", WATCH, sys.executable, "-c", COMMAND, *arguments],
        env={**os.environ, "EHADIAG_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=True,
    )
    code, wall, cpu, peak = done.stdout.split()
    if int(code) not in (0, 10, 20):
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputOutputError(f"ehadiag {arguments[0]} ended with {code}: {last}")
    return _Run(float(wall), float(cpu), float(peak) / PER_MB, done.stderr)
