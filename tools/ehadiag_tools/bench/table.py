"""`tools/bench`: speed of the project and its alternatives, measured in one run, as one table.

Times are medians of CPU time of the thread or process, so that a machine shared with others still
compares; wall time where it says so. Only ratios of one run count.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from ehadiag.core.errors import ConfigurationError, EhadiagError
from ehadiag_tools.bench import decode, estimate, kernel, live, process, push, search, simd
from ehadiag_tools.bench.figures import Figure, Sizes

__all__ = ["SECTIONS", "main"]

SECTIONS: dict[str, Callable[[Sizes], list[Figure]]] = {
    "kernel": kernel.measure,
    "lanes": simd.measure,
    "search": search.measure,
    "estimate": estimate.measure,
    "live": live.measure,
    "push": push.measure,
    "decode": decode.measure,
    "process": process.measure,
}
LOGS = Path(__file__).parents[3] / "tests" / "data" / "logs"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, or that of the error."""
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument(
        "--only",
        default=",".join(SECTIONS),
        metavar="SECTIONS",
        help=f"sections, comma between them ({','.join(SECTIONS)})",
    )
    parser.add_argument("--json", metavar="FILE", help="write the figures there, - for stdout")
    parser.add_argument(
        "--logs", type=Path, default=LOGS, help="folder of recordings (%(default)s)"
    )
    full = Sizes(LOGS)
    parser.add_argument("--repeats", type=int, default=full.repeats, help="runs of a median")
    parser.add_argument("--ticks", type=int, default=full.ticks, help="of slow oracles")
    parser.add_argument("--seeds", type=int, default=full.seeds, help="of a search")
    parser.add_argument("--budget", type=int, default=full.budget, help="evaluations of a rival")
    parser.add_argument("--pushes", type=int, default=full.pushes, help="back to back")
    parser.add_argument(
        "--seconds", type=float, default=full.seconds, help="of pushes in time with the bus"
    )
    parser.add_argument("--frames", type=int, default=full.frames, help="to decode")
    options = parser.parse_args(argv)
    try:
        names = options.only.split(",")
        for name in names:
            if name not in SECTIONS:
                raise ConfigurationError(f"--only {name}: choose of {', '.join(SECTIONS)}")
        figures = run(names, _sizes(options))
    except EhadiagError as error:
        print(f"bench: {error}", file=sys.stderr)
        return error.exit_code
    if options.json:
        text = json.dumps({"machine": machine(), "figures": [asdict(item) for item in figures]})
        if options.json == "-":
            print(text)
            return 0
        Path(options.json).write_text(text + "\n", encoding="utf-8")
    print_table(figures)
    return 0


def _sizes(options: argparse.Namespace) -> Sizes:
    sizes = Sizes(
        logs=options.logs,
        repeats=options.repeats,
        ticks=options.ticks,
        seeds=options.seeds,
        budget=options.budget,
        pushes=options.pushes,
        seconds=options.seconds,
        frames=options.frames,
    )
    for name in ("repeats", "ticks", "seeds", "budget", "pushes", "frames"):
        if getattr(sizes, name) < 1:
            raise ConfigurationError(f"--{name} {getattr(sizes, name)}: need at least 1")
    if not sizes.logs.is_dir():
        raise ConfigurationError(f"--logs {sizes.logs}: no such folder")
    return sizes


def run(names: Sequence[str], sizes: Sizes) -> list[Figure]:
    """Measure section by section; a note on stderr tells which."""
    figures = []
    for name in names:
        print(f"bench: {name} …", file=sys.stderr)
        figures += SECTIONS[name](sizes)
    return figures


def machine() -> str:
    """Processor, its cores that this process may use, and how busy they are."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{model}, {os.cpu_count()} cores{load}; Python {platform.python_version()}"


def print_table(figures: Sequence[Figure]) -> None:
    """Markdown."""
    print(f"{machine()}\n")
    print("| section | figure | value | unit | remark |\n| --- | --- | --- | --- | --- |")
    for item in figures:
        value = "–" if item.value is None else f"{item.value:.4g}"
        print(f"| {item.section} | {item.name} | {value} | {item.unit} | {item.remark} |")
