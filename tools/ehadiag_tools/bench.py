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
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import can
import numpy as np
import psutil
from msgspec.structs import replace
from numpy.typing import NDArray

import ehadiag
from ehadiag.compile.vector import LANES
from ehadiag.core.actuator import default_actuator
from ehadiag.history.records import Entry, Usage, history_entry
from ehadiag.history.store import History
from ehadiag.identify.experiment import Experiment, build_experiment, lay_out_spans, unknowns_of
from ehadiag.identify.identification_result import Identification
from ehadiag.identify.identification_session import identify
from ehadiag.identify.solvers import SEARCH_CAP
from ehadiag.model.registry import FAULT_NAMES, FAULTS, ResidualModel
from ehadiag.model.residual_models import ScalarModel, SimdModel
from ehadiag.monitor.streaming import Monitor, Tick
from ehadiag_tools.accuracy.figures import NOT_TESTED
from ehadiag_tools.study import Options, Record, Study, case_of, markdown
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.codec import decode
from firmware_iface.errors import InputOutputError
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder, ReplayTransport
from firmware_iface.recording import Recording, Samples
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test
from firmware_iface.transport.frames import FrameTable

LOGS = Path(__file__).parents[2] / "tests" / "data" / "logs"
OPEN = "paper-open-2"
"""The recording that most figures are of."""
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
    folder: Path
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


def _medians(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median wall and processor time (s) of a call, after one that does not count."""
    work()
    spent = []
    for _ in range(max(1, repeats)):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        spent.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = np.median(spent, axis=0).tolist()
    return wall, cpu


def _kernels(case: BenchCase) -> Iterator[Figure]:
    """The model on the recording, candidates in blocks and one alone."""
    experiment = reference_experiment()
    batch, unknowns = lay_out_spans([experiment]), unknowns_of([experiment], FAULTS)
    lanes, alone = SimdModel(batch, unknowns, threads=1), ScalarModel(batch, unknowns)
    evaluation = "one evaluation of the 5.5 s test"
    models: dict[str, tuple[ResidualModel, int, int]] = {
        f"{evaluation}, population {size}": (lanes, size, case.repeats)
        for size in (1, LANES // 4, LANES, LANES + 1, 4 * LANES)
    }
    models["one run of the 5.5 s test alone"] = alone, LANES, case.repeats // 3
    took = []
    for name, (model, size, repeats) in models.items():
        population = np.random.default_rng(0).uniform(0.0, 1.0, (size, len(FAULTS)))
        _, cpu = _medians(partial(model.costs, population, SEARCH_CAP), repeats)
        took.append(cpu / size)
        yield name, took[-1] * 1e3, "ms", f"{took[-1] * 1e9 / experiment.ticks:.3g} ns a tick"
    yield "blocks faster than one alone", took[-1] / took[-2], "times", ""


def _estimate(case: BenchCase) -> Iterator[Figure]:
    """From samples to interval; the file is read before."""
    recording, samples = _recording(OPEN)

    def estimated() -> Identification:
        test = resolve_test("open")
        return identify(
            [build_experiment(samples, recording.environment, test, default_actuator())]
        )

    result, times = estimated(), case.repeats // 3
    wall, cpu = _medians(estimated, times)
    remark = f"{result.evaluations} runs of the model, {result.attempts} attempt(s)"
    yield "samples to estimate and interval, wall", wall * 1e3, "ms", remark
    yield "samples to estimate and interval, CPU", cpu * 1e3, "ms", OPEN
    _, cpu = _medians(partial(identify, [reference_experiment(HEALTHY)]), times)
    yield "a healthy actuator in closed loop, CPU", cpu * 1e3, "ms", HEALTHY


def _push(case: BenchCase) -> Iterator[Figure]:
    """Latency of the monitor's push, alone and in a thread at 1 kHz while this one diagnoses."""
    recording, s = _recording(OPEN)
    rows = zip(s.command, s.current, s.spool, s.pressure, s.position, strict=True)
    ticks = [Tick(*map(float, row)) for row in rows]
    monitor = Monitor(default_actuator(), (0.3, 0.6, 0.3), recording.environment)
    yield from _latencies("push, back to back", _push_ticks(monitor, ticks, 40 * len(ticks), 0))
    if case.seconds > 0.0:
        count = max(1, round(case.seconds * 1e3))
        item, diagnoses = reference_experiment(), 0
        with ThreadPoolExecutor(1) as thread:
            pushed = thread.submit(_push_ticks, monitor, ticks, count, 1_000_000)
            while not pushed.done():
                identify([item])
                diagnoses += 1
        remark = f"{count} pushes at 1 kHz, {diagnoses} diagnoses meanwhile"
        yield from _latencies("push while another thread diagnoses", pushed.result(), remark)


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
    for label, value in zip(
        ("p50", "p99", "p99.9", "largest"), percentiles(latency / 1e3), strict=True
    ):
        yield f"{name}, {label}", value, "µs", remark


def percentiles(values: NDArray[np.floating]) -> list[float]:
    """Values that half, 99 and 99.9 % do not exceed, and the largest."""
    found: list[float] = np.percentile(values, (50.0, 99.0, 99.9, 100.0)).tolist()
    return found


def _decode(case: BenchCase) -> Iterator[Figure]:
    """Reading and bulk decoding of long recordings."""
    short, bus_map = read_frames(LOGS / f"{OPEN}.blf"), default_map()
    table, written = tiled(short, case.frames), tiled(short, min(60_000, case.frames))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.blf"
        with Recorder(path) as recorder, ReplayTransport(written, "tiled") as source:
            while (frame := source.receive(0.0)) is not None:
                recorder.write(frame)
        reading: dict[str, tuple[int, Callable[[], object]]] = {
            "decode in bulk": (len(table), lambda: decode(table, bus_map)),
            "decode, find tests and align": (
                len(table), lambda: assemble(table, bus_map, "tiled", ()),
            ),
            "read BLF into columns": (len(written), lambda: read_frames(path)),
            "python-can reads the same": (len(written), lambda: _read_with_python_can(path)),
        }  # fmt: skip
        took = []
        for name, (frames, work) in reading.items():
            took.append(_medians(work, case.repeats // 5)[1])
            yield name, frames / took[-1] / 1e6, "million frames/s", f"{frames} frames"
    yield "faster than python-can's reader", took[-1] / took[-2], "times", ""


def tiled(table: FrameTable, frames: int) -> FrameTable:
    """Repeat a table up to so many frames, each copy a second after the one before."""
    row, copy = np.arange(frames) % len(table), np.arange(frames) // len(table)
    span = int(table.time_ns[-1] - table.time_ns[0]) + 1_000_000_000
    names = ("can_id", "length", "data", "extended", "fd", "error", "remote", "sent", "channel")
    columns = {name: getattr(table, name)[row] for name in names}
    return replace(table, time_ns=table.time_ns[row] + copy * span, **columns)


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
    for test, faults in (("open", worn), ("closed", worn), ("closed", ())):
        with tempfile.TemporaryDirectory() as folder, _computer(os.ttyname(left[1]), faults):
            port = os.ttyname(right[1])
            runs = [_bit(test, port, folder) for _ in range(max(1, case.repeats // 5))]
        delays = [item for item in runs if item is not None]
        value = statistics.median(delays) * 1e3 if delays else None
        unit = "" if faults else ", healthy actuator"
        name = f"last frame of a live test ({test}{unit}) to verdict"
        yield name, value, "ms", f"median of {len(delays)} tests; wall time"


def _bit(test: str, port: str, folder: str) -> float | None:
    """Seconds from the end of a test to its verdict; None if it was not tested."""
    done = subprocess.run(
        [*COMMAND, "bit", "--test", test, "--port", port, "--json", "--out", folder],
        capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    result = json.loads(done.stdout or "{}")
    tested = result.get("verdict", NOT_TESTED) != NOT_TESTED
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
child = subprocess.Popen(sys.argv[2:], stdout=open(sys.argv[1], "wb"))
_, status, usage = os.wait4(child.pid, 0)
wall = time.perf_counter() - begin
child.returncode = os.waitstatus_to_exitcode(status)
print(child.returncode, wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss)
"""
"""Measures one process. It is small itself: a child starts with its parent's peak of memory."""


def _measured(words: Sequence[str], out: str = os.devnull) -> tuple[float, float, float, float]:
    """Wall and CPU time (s) of `ehadiag` with those it starts; its peak memory, theirs together."""
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, "-S", "-c", WATCH, out, *COMMAND, *words],
            stdout=subprocess.PIPE, stderr=errors, text=True,
        )  # fmt: skip
        together = 0.0
        while process.poll() is None:
            together = max(together, _memory_of_children(process.pid))
            time.sleep(POLL_S)
        errors.seek(0)
        code, wall, cpu, peak = process.communicate()[0].split()
        if int(code) not in (0, 10, 20):
            raise InputOutputError(f"ehadiag {words[0]} ended with {code}: {errors.read().strip()}")
    per_mb = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return float(wall), float(cpu), float(peak) / per_mb, together


def _memory_of_children(pid: int) -> float:
    """Memory, MB, of what a process has started."""
    together = 0
    with suppress(psutil.Error):
        for item in psutil.Process(pid).children(recursive=True):
            with suppress(psutil.Error):
                together += item.memory_info().rss
    return together / 2**20


def _spent(name: str, words: Sequence[str], repeats: int) -> Iterator[Figure]:
    """Median figures of a process, after one that fills the caches."""
    _measured(words)
    runs = [_measured(words) for _ in range(max(1, repeats))]
    wall, cpu, peak, _ = np.median(runs, axis=0).tolist()
    yield f"{name}, wall", wall, "s", ""
    yield f"{name}, CPU", cpu, "s", ""
    yield f"{name}, peak memory", peak, "MB", ""


def _process(case: BenchCase) -> Iterator[Figure]:
    """Processes from start to end."""
    yield from _spent("help", ("--help",), case.repeats // 3)
    log = str(LOGS / f"{OPEN}.blf")
    yield from _spent("diagnose one log", ("diagnose", log), case.repeats // 3)


SIMULATED = 40
"""Number of different recordings in the folder that is diagnosed."""
POLL_S = 0.1
"""Time between two looks at the processes, s."""


def _batch(case: BenchCase) -> Iterator[Figure]:
    """A folder of recordings, by one process and by two."""
    logs = prepare(case.folder, case.recordings, case.seed)
    folder, count, walls = logs[0].parent, len(logs), []
    out = folder.with_suffix(".jsonl")
    words = ("diagnose", "--json", "--no-history", "--no-picture", str(folder), "--jobs")
    for jobs in ("1", "2"):
        wall, cpu, _, memory = _measured((*words, jobs), str(out))
        walls.append(wall)
        results = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
        if [item["source"] for item in results] != [str(log) for log in logs]:
            raise InputOutputError("a result is missing, comes twice or out of order")
        name = f"{count} recordings, --jobs {jobs}"
        yield f"{name}, wall", wall, "s", ""
        yield f"{name}, rate", count / wall, "recordings/s", ""
        yield f"{name}, CPU of all processes", cpu, "s", ""
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
    for name, value in zip(FAULT_NAMES, severities.tolist(), strict=True):
        words += [f"--{name}", str(value)]
    partly = log.with_name(f"partly-{log.name}")
    words += ["--simulator-seed", str(seed + number), "--record", str(partly)]
    words += ["--out", str(log.parent / "bit"), "--no-history", "--no-picture"]
    subprocess.run([*COMMAND, *words], capture_output=True, check=False, timeout=TIMEOUT_S)
    partly.rename(log)


DIAGNOSES = 50
"""Number of diagnoses of a unit in the history: one every 100 h."""
UNITS = 100
"""Number of units that are appended together."""
UNIT = ("--unit", "7")
QUESTIONS = {
    "one row": ("show", "301"),
    "list of one unit": ("list", *UNIT),
    "export of one unit": ("export", *UNIT),
}
"""Words behind `ehadiag history` by question."""


def _history(case: BenchCase) -> Iterator[Figure]:
    """Questions to a health history of many diagnoses, each a process from start to end."""
    path = case.folder / f"{case.diagnoses}.sqlite"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        _fill(path, case.diagnoses, case.seed)
    yield f"history of {case.diagnoses} diagnoses", path.stat().st_size / 1e6, "MB", ""
    store = ("--history", str(path))
    for name, words in QUESTIONS.items():
        yield from _spent(name, ("history", *words, *store), 3)
    picture = ("history", "plot", *UNIT, *store, "--out", str(path.with_suffix(".png")))
    yield from _spent("picture of one unit", picture, 3)
    yield from _spent("remaining life of one unit", ("rul", *UNIT, *store), 3)


def _fill(path: Path, count: int, seed: int) -> None:
    """Append diagnoses of units that wear steadily, each at its own rate."""
    result = ehadiag.diagnose(ehadiag.simulate("open", FSS=0.3))
    like = history_entry(result, Usage(), simulated=False)
    rng = np.random.default_rng(seed)
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    with History(part, create=True) as history:
        serials = range(1, count // DIAGNOSES + 1)
        for first in range(0, len(serials), UNITS):
            history.append_all(list(_block(like, serials[first : first + UNITS], rng)))
    part.rename(path)


def _block(like: Entry, serials: range, rng: np.random.Generator) -> Iterator[Entry]:
    """Diagnoses of some units, one of each unit after the other."""
    tree = json.loads(like.result)
    rates = rng.uniform(0.3, 1.0, (len(serials), len(like.severities))) / DIAGNOSES
    (source,) = like.sources
    for visit, place in itertools.product(range(1, DIAGNOSES + 1), range(len(serials))):
        values = rates[place] * visit + rng.normal(0.0, 2e-4, len(like.severities))
        points = np.clip([values - 4e-4, values, values + 4e-4], 0.0, 1.0).T.tolist()
        serial = serials[place]
        yield replace(
            like,
            serial=serial,
            usage=Usage(100.0 * visit),
            tested=f"{2000 + visit // 12}-{visit % 12 + 1:02}-01T12:00:00.000Z",
            sources=(replace(source, samples=f"{serial}-{visit}", sha256=None),),
            severities=tuple(
                replace(item, estimate=value, std=2e-4, interval95=(low, high))
                for item, (low, value, high) in zip(like.severities, points, strict=True)
            ),
            result=json.dumps(tree | {"serial": serial}),
        )


def _machine() -> str:
    """Processor, its cores, and how busy they are."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.*)", cpuinfo.read_text() if cpuinfo.exists() else "")
    model = found[1] if found else platform.processor() or platform.machine()
    load, _, _ = psutil.getloadavg()
    version = platform.python_version()
    return f"{model}, {os.cpu_count()} cores, load {load:.1f}; Python {version}"


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
    names = options.only or list(SECTIONS)[:-2]
    return [case_of(BenchCase, options, section=name) for name in names]


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
