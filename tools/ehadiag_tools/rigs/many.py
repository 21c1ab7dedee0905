"""`tools/many_recordings`: how fast a folder of recordings is diagnosed, and what may go wrong.

    tools/many_recordings --folder DIR                      400 recordings, some four minutes
    tools/many_recordings --folder DIR --count 1000

`ehadiag diagnose` with `--jobs 1`, with `--jobs 2`, and on a Dask cluster of two local workers of
which one is killed when a third of the results are there: wall time, processor time of all its
processes, and the most memory that they had together. Then 100 recordings of which ten are broken.
The recordings are simulated, random severities, open and closed loop in turn; there are 40 of them,
each copied as often as asked for. A ratio of wall times is one of the machine only where nothing
else runs on it.
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
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil

from ehadiag.cli.main import main as ehadiag

__all__ = ["BREAKS", "Figures", "main", "measured", "prepared"]

DISTINCT = 40
BROKEN = 10
"""Of `AMONG`."""
AMONG = 100
LOOK_S = 0.1
"""Between two looks at the processes."""
PATIENCE_S = 60.0
KILL_AT = 1 / 3
"""Share of the results at which a Dask worker is killed."""
COMMAND = (
    sys.executable, "-m", "ehadiag", "diagnose",
    "--json", "--no-history", "--no-picture",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Figures:
    """What one call took.

    Attributes
    ----------
    count : int
        Recordings.
    wall_s, processor_s : float
        Of the call and of the processes that it started.
    memory_mb : float
        Most that they had together.
    results : tuple[tuple[str, str], ...]
        Path and verdict of each, in their order; `null` where a recording could not be read.
    """

    count: int
    wall_s: float
    processor_s: float
    memory_mb: float
    results: tuple[tuple[str, str], ...]

    @property
    def sources(self) -> tuple[str, ...]:
        """Paths of the recordings."""
        return tuple(source for source, _ in self.results)

    def row(self, name: str) -> str:
        """Line of the table."""
        often = Counter(verdict for _, verdict in self.results)
        cells = (
            name, str(self.count), f"{self.wall_s:.1f}", f"{self.count / self.wall_s:.1f}",
            f"{self.processor_s:.1f}", f"{self.memory_mb:.0f}",
            ", ".join(f"{count} {verdict}" for verdict, count in sorted(often.items())),
        )  # fmt: skip
        return "| " + " | ".join(cells) + " |"


def _truncated(data: bytes) -> bytes:
    return data[: len(data) // 3]


def _no_log(data: bytes) -> bytes:
    return bytes(reversed(data))


BREAKS = (
    _truncated,
    _no_log,
    lambda _data: b"",
    lambda _data: b"time;current\n1;2\n",
    lambda _data: b"PK\x03\x04" + bytes(200),
)
"""What a copy that broke off, a wrong file and an empty disk make of a recording."""


def prepared(folder: Path, count: int, seed: int, distinct: int = DISTINCT) -> list[Path]:
    """Simulate recordings and copy them, as far as they are not there yet; their paths."""
    pool = folder / "simulated"
    pool.mkdir(parents=True, exist_ok=True)
    copies = folder / f"of-{count}"
    copies.mkdir(exist_ok=True)
    for number in range(min(distinct, count)):
        log = pool / f"{number:03}.blf"
        if not log.exists():
            _simulate(log, number, seed)
    for number in range(count):
        copy = copies / f"{number:05}.blf"
        if not copy.exists():
            shutil.copy(pool / f"{number % distinct:03}.blf", copy)
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


def measured(folder: Path, *options: str, killed: int | None = None) -> Figures:
    """Diagnose a folder.

    Parameters
    ----------
    folder : Path
        Of recordings.
    *options : str
        Of `ehadiag diagnose`.
    killed : int, optional
        Process that is killed when a third of the results are there.
    """
    count = sum(1 for _ in folder.iterdir())
    # Files and not pipes: a pipe that nobody reads would hold the call up.
    out, said = (folder.with_name(f"{folder.name}.{end}") for end in ("jsonl", "log"))
    begin = time.perf_counter()
    with out.open("wb") as file, said.open("wb") as errors:
        call = subprocess.Popen([*COMMAND, str(folder), *options], stdout=file, stderr=errors)
        watch = _Watch(call.pid)
        while call.poll() is None:
            watch.look()
            if killed is not None and out.read_bytes().count(b"\n") >= KILL_AT * count:
                psutil.Process(killed).kill()
                killed = None
            time.sleep(LOOK_S)
    wall = time.perf_counter() - begin
    if not out.stat().st_size:
        raise RuntimeError(said.read_text(encoding="utf-8", errors="replace"))
    objects = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    return Figures(
        count,
        wall,
        watch.processor_s,
        watch.memory_mb,
        tuple((str(item["source"]), str(item["verdict"] or "null")) for item in objects),
    )


class _Watch:
    """Memory and processor time of a process and those that it has started."""

    def __init__(self, pid: int) -> None:
        self._root = psutil.Process(pid)
        self._spent: dict[int, float] = {}
        self.memory_mb = 0.0

    @property
    def processor_s(self) -> float:
        """So far, as of the last look at each."""
        return sum(self._spent.values())

    def look(self) -> None:
        """Take both."""
        together = 0
        try:
            family = [self._root, *self._root.children(recursive=True)]
        except psutil.Error:
            return
        for item in family:
            try:
                times = item.cpu_times()
                self._spent[item.pid] = times.user + times.system
                together += item.memory_info().rss
            except psutil.Error:
                continue
        self.memory_mb = max(self.memory_mb, together / 2**20)


def _on_dask(folder: Path) -> Figures:
    """Diagnose on two local Dask workers, one of which is killed meanwhile."""
    with ExitStack() as stack:
        place = Path(stack.enter_context(TemporaryDirectory(prefix="ehadiag-")))

        def started(name: str, word: str, *words: str) -> tuple[int, str]:
            """Process and the line of its log that has the word."""
            log = place / name
            process = subprocess.Popen(
                [sys.executable, "-m", *words, "--no-dashboard"],
                stdout=subprocess.DEVNULL,
                stderr=stack.enter_context(log.open("wb")),
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process.pid, _said(log, word)

        alone = ("--host", "127.0.0.1", "--port", "0")
        _, line = started("scheduler", "Scheduler at:", "distributed.cli.dask_scheduler", *alone)
        worker = ("distributed.cli.dask_worker", line.split()[-1], "--nthreads", "1", "--no-nanny")
        first, _ = started("one", "Registered to:", *worker)
        started("two", "Registered to:", *worker)
        return measured(folder, "--cluster", line.split()[-1], killed=first)


def _said(log: Path, word: str) -> str:
    """Wait for a line of a log."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            if word in line:
                return line
        time.sleep(LOOK_S)
    raise RuntimeError(f"no {word!r} within {PATIENCE_S:g} s")


def _with_broken(folder: Path, logs: Sequence[Path]) -> tuple[Figures, list[str]]:
    """Diagnose recordings of which every tenth is broken; and names of the broken ones."""
    place = folder / "broken"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    spoilt: list[str] = []
    for number in range(AMONG):
        path = place / f"{number:03}.blf"
        data = logs[number % len(logs)].read_bytes()
        if number % (AMONG // BROKEN) == 3:
            data = BREAKS[len(spoilt) % len(BREAKS)](data)
            spoilt.append(path.name)
        path.write_bytes(data)
    return measured(place, "--jobs", "2"), spoilt


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; exit code 1 where a result is lost, comes twice or stands elsewhere."""
    parser = argparse.ArgumentParser(
        prog="many_recordings",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--folder", type=Path, required=True, help="for the recordings")
    parser.add_argument("--count", type=int, default=400, metavar="N", help="(%(default)d)")
    parser.add_argument("--seed", type=int, default=1, help="(%(default)d)")
    given = parser.parse_args(arguments)
    logs = prepared(given.folder, given.count, given.seed)
    print(f"{given.count} recordings, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}\n")
    print("| call | recordings | wall, s | a second | processor, s | memory, MB | verdicts |")
    print("| --- | --- | --- | --- | --- | --- | --- |", flush=True)
    one, two = (measured(logs[0].parent, "--jobs", jobs) for jobs in ("1", "2"))
    print(one.row("`--jobs 1`"), two.row("`--jobs 2`"), sep="\n", flush=True)
    dask = _on_dask(logs[0].parent)
    print(dask.row("Dask, one of two workers killed"), flush=True)
    broken, spoilt = _with_broken(given.folder, logs)
    print(broken.row("ten broken"))
    complete = one.sources == two.sources == dask.sources == tuple(map(str, logs))
    said = [verdict for path, verdict in broken.results if Path(path).name in spoilt]
    print(f"\nspeed-up of two processes: {one.wall_s / two.wall_s:.2f}")
    print(f"every recording once and in order in all three: {'yes' if complete else 'NO'}")
    print(f"broken: {said.count('null')} of {len(said)} cannot be read, ", end="")
    print(f"{said.count('NOT_TESTED')} were cut short and are NOT TESTED")
    return 0 if complete and len(broken.results) == AMONG else 1
