"""Study of how fast a folder of recordings is diagnosed by one process and by two.

Wall time of `ehadiag diagnose`, processor time of all its processes, and the most memory that they
had together. The recordings are simulated, random severities, open and closed loop in turn; there
are 40 of them, each copied as often as asked for.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
import psutil

from ehadiag.cli.main import main as ehadiag
from ehadiag_tools.study import Options, Record, Study, markdown

SIMULATED = 40
"""Different recordings, 1."""
POLL_S = 0.1
"""Time between two looks at the processes, s."""
CALLS = ("--jobs 1", "--jobs 2")
COMMAND = (
    sys.executable, "-m", "ehadiag", "diagnose", "--json", "--no-history", "--no-picture",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CallCase:
    """One of `CALLS` on a folder with so many recordings of a seed."""

    call: str
    folder: str
    count: int
    seed: int


def perform(case: CallCase) -> Record:
    """Diagnose the recordings by one call."""
    folder = Path(case.folder)
    logs = prepare(folder, case.count, case.seed)
    return diagnose_folder(logs[0].parent, *case.call.split())


def prepare(folder: Path, count: int, seed: int, simulated: int = SIMULATED) -> list[Path]:
    """Simulate recordings and copy them, as far as they are not there yet; their paths."""
    pool, copies = folder / "simulated", folder / f"of-{count}"
    pool.mkdir(parents=True, exist_ok=True)
    copies.mkdir(exist_ok=True)
    for number in range(min(simulated, count)):
        log = pool / f"{number:03}.blf"
        if not log.exists():
            _simulate(log, number, seed)
    for number in range(count):
        copy = copies / f"{number:05}.blf"
        if not copy.exists():
            shutil.copy(pool / f"{number % simulated:03}.blf", copy)
    return sorted(copies.iterdir())


def _simulate(log: Path, number: int, seed: int) -> None:
    severities = np.random.default_rng([seed, number]).uniform(0.0, 0.9, 3).round(3)
    words = ["bit", "--test", ("open", "closed")[number % 2], "--simulate", "--fast", "--plain"]
    for name, value in zip(("Kintas", "FSS", "FDJ"), severities.tolist(), strict=True):
        words += [f"--{name}", str(value)]
    partly = log.with_name(f"partly-{log.name}")
    words += ["--simulator-seed", str(seed + number), "--record", str(partly)]
    words += ["--out", str(log.parent / "bit"), "--no-history", "--no-picture"]
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        ehadiag(words)
    partly.rename(log)


def diagnose_folder(folder: Path, *options: str) -> Record:
    """Diagnose a folder by the command."""
    count = sum(1 for _ in folder.iterdir())
    # Files and not pipes: a pipe that nobody reads would hold the call up.
    out, errors = (folder.with_name(f"{folder.name}.{end}") for end in ("jsonl", "log"))
    begin = time.perf_counter()
    with out.open("wb") as stdout, errors.open("wb") as stderr:
        process = subprocess.Popen([*COMMAND, str(folder), *options], stdout=stdout, stderr=stderr)
        spent: dict[int, float] = {}
        memory = 0.0
        while process.poll() is None:
            memory = max(memory, _usage(process.pid, spent))
            time.sleep(POLL_S)
    wall = time.perf_counter() - begin
    if not out.stat().st_size:
        raise RuntimeError(errors.read_text(encoding="utf-8", errors="replace"))
    results = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    return {
        "recordings": count,
        "wall_s": wall,
        "processor_s": sum(spent.values()),
        "memory_mb": memory,
        "sources": [str(item["source"]) for item in results],
        "verdicts": [str(item["verdict"] or "null") for item in results],
    }


def _usage(pid: int, spent: dict[int, float]) -> float:
    """Memory, MB, of a process and those that it has started; `spent`: their processor time, s."""
    together = 0
    with suppress(psutil.Error):
        root = psutil.Process(pid)
        for item in (root, *root.children(recursive=True)):
            with suppress(psutil.Error):
                times = item.cpu_times()
                spent[item.pid] = times.user + times.system
                together += item.memory_info().rss
    return together / 2**20


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--folder", type=Path, required=True, help="for the recordings")


def _cases(options: Options) -> list[CallCase]:
    return [CallCase(call, str(options.folder), options.cases, options.seed) for call in CALLS]


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    yield f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}\n"
    headings = ("call", "recordings", "wall, s", "a second", "processor, s", "memory, MB")
    yield from markdown((*headings, "verdicts"), map(call_row, records))
    one, two = records
    yield f"\nspeed-up of two processes: {one['wall_s'] / two['wall_s']:.2f}"
    yield f"every recording once and in order: {'NO' if _is_incomplete(records) else 'yes'}"


def call_row(record: Record) -> tuple[str, ...]:
    """Row of the table."""
    count, wall = record["recordings"], record["wall_s"]
    verdicts: list[tuple[str, int]] = sorted(Counter(record["verdicts"]).items())
    return (
        record["call"], str(count), f"{wall:.1f}", f"{count / wall:.1f}",
        f"{record['processor_s']:.1f}", f"{record['memory_mb']:.0f}",
        ", ".join(f"{number} {verdict}" for verdict, number in verdicts),
    )  # fmt: skip


def _is_incomplete(records: Sequence[Record]) -> bool:
    """Whether a result is lost, comes twice or stands elsewhere."""
    one, two = records
    folder, count = Path(one["folder"]) / f"of-{one['count']}", one["count"]
    expected = [str(folder / f"{number:05}.blf") for number in range(count)]
    return not one["sources"] == two["sources"] == expected


MANY_RECORDINGS = Study(
    "many-recordings",
    "How fast a folder of recordings is diagnosed by one process and by two.",
    _cases, perform, _report, _options, count=400, counted="recordings", failed=_is_incomplete,
    measures_time=True,
)  # fmt: skip
