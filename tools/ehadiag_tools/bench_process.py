"""`ehadiag diagnose` as a whole process: kernels cached, and the first run ever."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ehadiag.errors import InputOutputError
from ehadiag_tools.bench_figures import Figure, Sizes
from ehadiag_tools.bench_problem import LOG

__all__ = ["measure"]

SECTION = "process"
PER_MB = 1 << 20 if sys.platform == "darwin" else 1 << 10
"""Units of `ru_maxrss` in a megabyte."""
COMMAND = "import sys; from ehadiag.cli.main import main; sys.exit(main(sys.argv[1:]))"


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    log = sizes.logs / LOG
    with tempfile.TemporaryDirectory() as folder:
        first, first_cpu, _, said = _diagnose(log, Path(folder))
        runs = [_diagnose(log, Path(folder)) for _ in range(max(1, sizes.repeats // 5))]
        sizes_mb = sum(item.stat().st_size for item in Path(folder).rglob("*")) / (1 << 20)
    hint = "says that it compiles" if "compil" in said.lower() else "does not say that it compiles"
    return [
        Figure(SECTION, "diagnose one log, kernels cached, wall", _median(runs, 0), "s", LOG),
        Figure(SECTION, "diagnose one log, kernels cached, CPU", _median(runs, 1), "s"),
        Figure(SECTION, "diagnose one log, peak memory", max(run[2] for run in runs), "MB"),
        Figure(SECTION, "first run ever, wall", first, "s", hint),
        Figure(SECTION, "first run ever, CPU", first_cpu, "s"),
        Figure(SECTION, "kernels in the cache", sizes_mb, "MB"),
    ]


def _median(runs: list[tuple[float, float, float, str]], column: int) -> float:
    return statistics.median(float(run[column]) for run in runs)


def _diagnose(log: Path, cache: Path) -> tuple[float, float, float, str]:
    """Wall and CPU time (s), peak memory (MB) and what one process said on stderr."""
    with tempfile.TemporaryFile() as said:
        begin = time.perf_counter()
        child = subprocess.Popen(
            [sys.executable, "-c", COMMAND, "diagnose", str(log)],
            env={**os.environ, "EHADIAG_CACHE_DIR": str(cache)},
            stdout=subprocess.DEVNULL,
            stderr=said,
        )
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.perf_counter() - begin
        child.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read().decode(errors="replace")
    if child.returncode not in (0, 10, 20):
        last = (text.strip().splitlines() or ["no message"])[-1]
        raise InputOutputError(f"ehadiag diagnose ended with {child.returncode}: {last}")
    return wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / PER_MB, text
