"""Study of speed: kernels, estimate, live verdict, push, decoder, processes, folders, histories.

Times are medians of CPU time of the thread or process, so that a machine shared with others still
compares; wall time where it says so. Only ratios of one run count.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path

import can
import numpy as np
import psutil
from msgspec.structs import replace
from numpy.typing import NDArray

import ehadiag
from ehadiag.cli.main import main
from ehadiag.compile.vector import LANES
from ehadiag.core.actuator import default_actuator
from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, Usage, history_entry
from ehadiag.history.store import History
from ehadiag.identify.experiment import Experiment, build_experiment, lay_out_spans, unknowns_of
from ehadiag.identify.identification_session import identify
from ehadiag.identify.solvers import SEARCH_CAP
from ehadiag.model.registry import FAULTS, ResidualModel
from ehadiag.model.residual_models import ScalarModel, SimdModel
from ehadiag.monitor.streaming import Monitor, Tick
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.codec import decode
from firmware_iface.errors import InputOutputError
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import Recording, Samples
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test
from firmware_iface.transport.frames import FrameTable

LOGS = Path(__file__).parents[2] / "tests" / "data" / "logs"
OPEN = "paper-open-2"
"""The recording that most figures are of."""
TRUTH = (0.3, 0.6, 0.3)
"""Its severities, 1."""
HEALTHY = "healthy-closed"
"""Recording of a healthy actuator, whose spool keeps breaking away."""
TIMEOUT_S = 60.0
"""Longest time of a process, s."""
COMMAND = (sys.executable, "-m", "ehadiag")
Figure = tuple[str, float | None, str, str]
"""Name, value (None: not measured, the remark says why), unit, remark."""


@dataclass(frozen=True, slots=True)
class BenchCase:
    """A section, and the options of the study, see `_options`."""

    section: str
    repeats: int
    seconds: float
    frames: int
    recordings: int
    diagnoses: int
    folder: str
    seed: int


def perform(case: BenchCase) -> Record:
    """Measure one section."""
    return {"figures": list(SECTIONS[case.section](case)), "machine": _machine()}


def _recording(name: str) -> tuple[Recording, Samples]:
    recording = read_recording(LOGS / f"{name}.blf")
    assert recording.samples is not None
    return recording, recording.samples


def reference_experiment(name: str = OPEN) -> Experiment:
    """Prepare a reference recording for the identification."""
    recording, samples = _recording(name)
    test = resolve_test("closed" if "closed" in name else "open")
    return build_experiment(samples, recording.environment, test, default_actuator())


def _cpu_median(work: Callable[[], object], repeats: int) -> float:
    """Median CPU time (s) of this thread for a call, after one that does not count."""
    work()
    spent = []
    for _ in range(repeats):
        begin = time.thread_time()
        work()
        spent.append(time.thread_time() - begin)
    return statistics.median(spent)


def _each(seconds: float, ticks: int) -> str:
    """Say what a time of so many ticks is for one."""
    return f"{seconds * 1e9 / ticks:.3g} ns a tick"


def _kernels(case: BenchCase) -> Iterator[Figure]:
    """The model on the recording, candidates in blocks and one alone."""
    experiment = reference_experiment()
    batch, unknowns = lay_out_spans([experiment]), unknowns_of([experiment], FAULTS)
    lanes = SimdModel(batch, unknowns, threads=1)
    ticks, took = experiment.ticks, 0.0
    for size in (1, LANES // 4, LANES, LANES + 1, 4 * LANES):
        took = _evaluation(lanes, size, case.repeats)
        name = f"one evaluation of the 5.5 s test, population {size}"
        yield name, took * 1e3, "ms", _each(took, ticks)
    alone = _evaluation(ScalarModel(batch, unknowns), LANES, max(1, case.repeats // 3))
    yield "one run of the 5.5 s test alone", alone * 1e3, "ms", _each(alone, ticks)
    yield "blocks faster than one alone", alone / took, "times", ""


def _evaluation(model: ResidualModel, size: int, repeats: int) -> float:
    """CPU time of one candidate of a population, s."""
    population = np.random.default_rng(0).uniform(0.0, 1.0, (size, len(FAULTS)))
    return _cpu_median(partial(model.costs, population, SEARCH_CAP), repeats) / size


def _estimate(case: BenchCase) -> Iterator[Figure]:
    """From samples to interval, wall and CPU time by stage; the file is read before."""
    times = max(1, case.repeats // 3)
    result = identify([reference_experiment()])
    recording, samples = _recording(OPEN)
    walls, cpus, stages = [], [], []
    for _ in range(times):
        wall, cpu = time.perf_counter(), time.process_time()  # the search has its own thread
        item = build_experiment(
            samples, recording.environment, resolve_test("open"), default_actuator()
        )
        prepared = time.perf_counter() - wall
        timing = identify([item]).timing
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
        stages.append((prepared, timing.first, timing.search, timing.refine))
    remark = f"{result.evaluations} runs of the model, {result.attempts} attempt(s)"
    yield "samples to estimate and interval, wall", statistics.median(walls) * 1e3, "ms", remark
    yield "samples to estimate and interval, CPU", statistics.median(cpus) * 1e3, "ms", OPEN
    names = ("prepare", "first approximation", "genetic search", "refinement and interval")
    for name, value in zip(names, np.median(stages, axis=0), strict=True):
        yield f"{name}, wall", float(value) * 1e3, "ms", "part of it"
    healthy, spent = reference_experiment(HEALTHY), []
    for _ in range(times):
        cpu = time.process_time()
        identify([healthy])
        spent.append(time.process_time() - cpu)
    yield "a healthy actuator in closed loop, CPU", statistics.median(spent) * 1e3, "ms", HEALTHY
    error = max(abs(e.value - true) for e, true in zip(result.estimates, TRUTH, strict=True))
    yield "largest error of the three constants", 100.0 * error, "%", ""


def _push(case: BenchCase) -> Iterator[Figure]:
    """Latency of the monitor's push, alone and in a thread at 1 kHz while this one diagnoses."""
    recording, s = _recording(OPEN)
    rows = zip(s.command, s.current, s.spool, s.pressure, s.position, strict=True)
    ticks = [Tick(*map(float, row)) for row in rows]
    monitor = Monitor(default_actuator(), TRUTH, recording.environment)
    yield from _latencies("push, back to back", _push_ticks(monitor, ticks, 40 * len(ticks), 0))
    if case.seconds > 0.0:
        count, found = max(1, round(case.seconds * 1e3)), []
        thread = threading.Thread(
            target=lambda: found.append(_push_ticks(monitor, ticks, count, 1_000_000))
        )
        item, diagnoses = reference_experiment(), 0
        thread.start()
        while thread.is_alive():
            identify([item])
            diagnoses += 1
        thread.join()
        remark = f"{count} pushes at 1 kHz, {diagnoses} diagnoses meanwhile"
        yield from _latencies("push while another thread diagnoses", found[0], remark)


def _push_ticks(
    monitor: Monitor, ticks: Sequence[Tick], count: int, period_ns: int
) -> NDArray[np.int64]:
    """Latencies, ns; the recording again and again, from rest each time."""
    latency = np.empty(count, dtype=np.int64)
    clock = time.perf_counter_ns
    due = clock()
    for k, tick in zip(range(count), itertools.cycle(ticks), strict=False):
        if k % len(ticks) == 0:
            monitor.reset()
        due += period_ns
        while period_ns and (wait := due - clock()) > 0:
            time.sleep(wait * 1e-9)
        begin = clock()
        monitor.push(tick)
        latency[k] = clock() - begin
    return latency


def _latencies(name: str, latency: NDArray[np.int64], remark: str = "") -> Iterator[Figure]:
    for label, share in (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9), ("largest", 100.0)):
        yield f"{name}, {label}", float(np.percentile(latency, share)) / 1e3, "µs", remark


def _decode(case: BenchCase) -> Iterator[Figure]:
    """Reading and bulk decoding of long recordings."""
    short, bus_map = read_frames(LOGS / f"{OPEN}.blf"), default_map()
    table, repeats = tiled(short, case.frames), max(1, case.repeats // 5)
    unit = "million frames/s"
    rate = len(table) / _cpu_median(lambda: decode(table, bus_map), repeats) / 1e6
    yield "decode in bulk", rate, unit, f"{len(table)} frames"
    begin = time.thread_time()
    found = assemble(table, bus_map, "tiled", ())
    rate = len(table) / (time.thread_time() - begin) / 1e6
    yield "decode, find tests and align", rate, unit, f"{len(found)} recordings"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.blf"
        written = tiled(short, min(60_000, case.frames))
        _write(written, path)
        own = _cpu_median(lambda: read_frames(path), repeats)
        theirs = _cpu_median(lambda: _read_with_python_can(path), repeats)
    yield "read BLF into columns", len(written) / own / 1e6, unit, ""
    yield "python-can reads the same", len(written) / theirs / 1e6, unit, ""
    yield "faster than python-can's reader", theirs / own, "times", ""


def tiled(table: FrameTable, frames: int) -> FrameTable:
    """Repeat a table up to so many frames, each copy a second after the one before."""
    row, copy = np.arange(frames) % len(table), np.arange(frames) // len(table)
    span = int(table.time_ns[-1] - table.time_ns[0]) + 1_000_000_000
    names = ("can_id", "length", "data", "extended", "fd", "error", "remote", "sent", "channel")
    columns = {name: getattr(table, name)[row] for name in names}
    return replace(table, time_ns=table.time_ns[row] + copy * span, **columns)


def _write(table: FrameTable, path: Path) -> None:
    with can.BLFWriter(path) as writer:
        for k in range(len(table)):
            writer.on_message_received(
                can.Message(
                    timestamp=float(table.time_ns[k]) * 1e-9,
                    arbitration_id=int(table.can_id[k]),
                    data=table.data[k, : table.length[k]].tobytes(),
                    is_extended_id=bool(table.extended[k]),
                )
            )


def _read_with_python_can(path: Path) -> int:
    with can.BLFReader(path) as reader:
        return sum(1 for _ in reader)


def _live(case: BenchCase) -> Iterator[Figure]:
    """Last frame of a live test to its verdict: two processes on a serial line."""
    if not hasattr(os, "openpty"):
        yield "last frame of a live test to verdict", None, "ms", "needs a pseudo-terminal"
        return
    import tty  # noqa: PLC0415 - not on every system

    left, right = os.openpty(), os.openpty()
    for end in (*left, *right):
        tty.setraw(end)
    for source, sink in ((left[0], right[0]), (right[0], left[0])):
        threading.Thread(target=_carry, args=(source, sink), daemon=True).start()
    worn = ("--Kintas", "0.3", "--FSS", "0.6", "--FDJ", "0.3")
    for test, label, faults in (
        ("open", "", worn), ("closed", "", worn), ("closed", ", healthy actuator", ()),
    ):  # fmt: skip
        with tempfile.TemporaryDirectory() as folder, _computer(os.ttyname(left[1]), faults):
            port = os.ttyname(right[1])
            runs = [_bit(test, port, folder) for _ in range(max(1, case.repeats // 5))]
        delays = [item for item in runs if item is not None]
        value = statistics.median(delays) * 1e3 if delays else None
        name = f"last frame of a live test ({test}{label}) to verdict"
        yield name, value, "ms", f"median of {len(delays)} tests; wall time"


def _bit(test: str, port: str, folder: str) -> float | None:
    """Seconds from the end of a test to its verdict; None if it was not tested."""
    done = subprocess.run(
        [*COMMAND, "bit", "--test", test, "--port", port, "--json", "--out", folder],
        capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    try:
        result = json.loads(done.stdout)
    except ValueError:
        return None
    tested = result["verdict"] != "NOT_TESTED"
    return float(result["timing_s"]["after_test"]) if tested else None


@contextmanager
def _computer(port: str, faults: Sequence[str]) -> Iterator[None]:
    """Run the emulated flight-control computer; three seconds until it sends."""
    process = subprocess.Popen(
        [*COMMAND, "sim", "--port", port, *faults],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        time.sleep(3.0)
        yield
    finally:
        process.terminate()
        process.wait(timeout=TIMEOUT_S)


def _carry(source: int, sink: int) -> None:
    """Carry bytes from one end to the other until it closes."""
    while True:
        try:
            os.write(sink, os.read(source, 65536))
        except OSError:
            return


WATCH = """
import os, subprocess, sys, time
begin = time.perf_counter()
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(child.pid, 0)
wall = time.perf_counter() - begin
child.returncode = os.waitstatus_to_exitcode(status)
print(child.returncode, wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss)
"""
"""Measures one process. It is small itself: a child starts with its parent's peak of memory."""


def _process(case: BenchCase) -> Iterator[Figure]:
    """Processes from start to end: `ehadiag diagnose`, first ever and with its kernels cached."""
    diagnose, times = ("diagnose", str(LOGS / f"{OPEN}.blf")), max(1, case.repeats // 3)
    with tempfile.TemporaryDirectory() as folder:
        first_wall, first_cpu, _ = _measured(diagnose, folder)
        wall, cpu, _ = np.median([_measured(diagnose, folder) for _ in range(times)], axis=0)
        peak = max(_measured(diagnose, folder)[2] for _ in range(times))
        helps = np.median([_measured(("--help",), folder) for _ in range(times)], axis=0)
        size = sum(item.stat().st_size for item in Path(folder).glob("kernels-*/*")) / 2**20
    yield "help, wall", float(helps[0]), "s", ""
    yield "diagnose one log, kernels cached, wall", float(wall), "s", OPEN
    yield "diagnose one log, kernels cached, CPU", float(cpu), "s", ""
    yield "diagnose one log, peak memory", peak, "MB", ""
    yield "first run ever, wall", first_wall, "s", ""
    yield "first run ever, CPU", first_cpu, "s", ""
    yield "kernels in the cache", size, "MB", ""


def _measured(arguments: Sequence[str], cache: str) -> tuple[float, float, float]:
    """Wall and CPU time (s), peak memory (MB) of a process."""
    done = subprocess.run(
        [sys.executable, "-S", "-c", WATCH, *COMMAND, *arguments],
        env={**os.environ, "EHADIAG_CACHE_DIR": cache},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    code, wall, cpu, peak = done.stdout.split()
    if int(code) not in (0, 10, 20):
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputOutputError(f"ehadiag {arguments[0]} ended with {code}: {last}")
    per_mb = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return float(wall), float(cpu), float(peak) / per_mb


SIMULATED = 40
"""Number of different recordings in the folder that is diagnosed."""
POLL_S = 0.1
"""Time between two looks at the processes, s."""


def _batch(case: BenchCase) -> Iterator[Figure]:
    """A folder of recordings, by one process and by two."""
    logs = prepare(Path(case.folder), case.recordings, case.seed)
    walls, count = [], len(logs)
    for jobs in (1, 2):
        wall, processor, memory, results = _diagnosed_folder(logs[0].parent, jobs)
        walls.append(wall)
        if [item["source"] for item in results] != [str(log) for log in logs]:
            raise InputOutputError("a result is missing, comes twice or out of order")
        verdicts = Counter(str(item["verdict"]) for item in results)
        name = f"{count} recordings, {jobs} {'job' if jobs == 1 else 'jobs'}"
        yield f"{name}, wall", wall, "s", ", ".join(f"{n} {v}" for v, n in sorted(verdicts.items()))
        yield f"{name}, rate", count / wall, "recordings/s", ""
        yield f"{name}, CPU of all processes", processor, "s", ""
        yield f"{name}, peak memory of all processes", memory, "MB", ""
    yield "two jobs faster than one", walls[0] / walls[1], "times", ""


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
        main(words)
    partly.rename(log)


def _diagnosed_folder(folder: Path, jobs: int) -> tuple[float, float, float, list[Record]]:
    """Wall and CPU time (s), memory (MB) of all processes together, results."""
    # Files and not pipes: a pipe that nobody reads would hold the call up.
    out, errors = (folder.with_name(f"{folder.name}.{end}") for end in ("jsonl", "log"))
    words = ("diagnose", "--json", "--no-history", "--no-picture", str(folder), "--jobs", str(jobs))
    begin = time.perf_counter()
    with out.open("wb") as stdout, errors.open("wb") as stderr:
        process = subprocess.Popen([*COMMAND, *words], stdout=stdout, stderr=stderr)
        spent: dict[int, float] = {}
        memory = 0.0
        while process.poll() is None:
            memory = max(memory, _usage(process.pid, spent))
            time.sleep(POLL_S)
    wall = time.perf_counter() - begin
    if not out.stat().st_size:
        raise InputOutputError(errors.read_text(encoding="utf-8", errors="replace"))
    results = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    return wall, sum(spent.values()), memory, results


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


DIAGNOSES = 50
"""Number of diagnoses of a unit in the history: one every 100 h."""
UNITS = 100
"""Number of units that are appended together."""
UNIT = ("--unit", "7")
QUESTIONS = {
    "one row": ("show", "301"),
    "list of one unit": ("list", *UNIT),
    "picture of one unit": ("plot", *UNIT),
    "export of one unit": ("export", *UNIT),
}
"""Words behind `ehadiag history` by question."""


def _history(case: BenchCase) -> Iterator[Figure]:
    """Questions to a health history of many diagnoses, each a process from start to end."""
    path = Path(case.folder) / f"{case.diagnoses}.sqlite"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        _fill(path, case.diagnoses, case.seed)
    yield f"history of {case.diagnoses} diagnoses", path.stat().st_size / 1e6, "MB", ""
    commands = {name: ("history", *words) for name, words in QUESTIONS.items()}
    commands["picture of one unit"] += ("--out", str(path.with_suffix(".png")))
    for name, words in (commands | {"remaining life of one unit": ("rul", *UNIT)}).items():
        with tempfile.TemporaryDirectory() as cache:
            command = (*words, "--history", str(path))
            _measured(command, cache)  # fills the caches of the system
            runs = [_measured(command, cache) for _ in range(3)]
        wall, processor, peak = np.median(runs, axis=0).tolist()
        yield f"{name}, wall", wall, "s", ""
        yield f"{name}, CPU", processor, "s", ""
        yield f"{name}, peak memory", peak, "MB", ""


def _fill(path: Path, count: int, seed: int) -> None:
    """Append diagnoses of units that wear steadily, each at its own rate."""
    result = ehadiag.diagnose(ehadiag.simulate("open", FSS=0.3))
    like = history_entry(result, Usage(), simulated=False)
    rng = np.random.default_rng(seed)
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    with History(part, create=True) as history:
        for first in range(0, count, UNITS * DIAGNOSES):
            number = min(UNITS * DIAGNOSES, count - first)
            history.append_all(list(_block(like, first // DIAGNOSES, number, rng)))
    part.rename(path)


def _block(like: Entry, unit: int, number: int, rng: np.random.Generator) -> Iterator[Entry]:
    tree = json.loads(like.result)
    rates = rng.uniform(0.3, 1.0, (UNITS, len(like.severities))) / DIAGNOSES
    for visit in range(DIAGNOSES):
        for place in range(number // DIAGNOSES):
            noise = rng.normal(0.0, 2e-4, len(like.severities))
            values = np.clip(rates[place] * (visit + 1) + noise, 0.0, 1.0).tolist()
            serial, hours = unit + place + 1, 100.0 * (visit + 1)
            yield replace(
                like,
                serial=serial,
                usage=Usage(hours),
                tested=f"{2000 + visit // 12}-{visit % 12 + 1:02}-01T12:00:00.000Z",
                sources=tuple(
                    replace(item, samples=f"{serial}-{visit}", sha256=None) for item in like.sources
                ),
                severities=tuple(
                    Severity(name=item.name, estimate=value, std=2e-4,
                             interval95=(max(value - 4e-4, 0.0), min(value + 4e-4, 1.0)))
                    for item, value in zip(like.severities, values, strict=True)
                ),
                result=json.dumps(tree | {"serial": serial}),
            )  # fmt: skip


def _machine() -> str:
    """Processor, its cores that this process may use, and how busy they are."""
    model, cpuinfo = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        model = next(iter(names), model)
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{model}, {os.cpu_count()} cores{load}; Python {platform.python_version()}"


SECTIONS: dict[str, Callable[[BenchCase], Iterator[Figure]]] = {
    "kernels": _kernels,
    "estimate": _estimate,
    "live": _live,
    "push": _push,
    "decode": _decode,
    "process": _process,
    "batch": _batch,
    "history": _history,
}


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--only", action="append", choices=list(SECTIONS),
        help="may be repeated (all but batch and history)")  # fmt: skip
    add("--repeats", type=int, default=15, help="runs of a median (%(default)d)")
    add("--seconds", type=float, default=20.0, help="of pushes at 1 kHz (%(default)g)")
    add("--frames", type=int, default=1_000_000, help="to decode (%(default)d)")
    add("--recordings", type=int, default=400, help="in the folder of batch (%(default)d)")
    add("--diagnoses", type=int, default=100_000, help="in the history, 5 kB each (%(default)d)")
    add("--folder", type=Path, default=Path("out", "bench"), help="of both (%(default)s)")


def _cases(options: Options) -> list[BenchCase]:
    return [
        BenchCase(
            name, max(1, options.repeats), options.seconds, max(1, options.frames),
            options.recordings, options.diagnoses, str(options.folder), options.seed,
        )
        for name in options.only or list(SECTIONS)[:-2]
    ]  # fmt: skip


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    yield f"{records[0]['machine']}\n"
    rows = (
        (record["section"], name, "–" if value is None else f"{value:.4g}", unit, remark)
        for record in records
        for name, value, unit, remark in record["figures"]
    )
    yield from markdown(("section", "figure", "value", "unit", "remark"), rows)


BENCH = Study(
    "bench",
    "Speed of kernels, estimate, live verdict, push, decoder, processes, folders, histories.",
    _cases, perform, _report, _options, count=None, measures_time=True,
)  # fmt: skip
