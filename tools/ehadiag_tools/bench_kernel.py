"""The monitoring model's kernels: against C, against oracles, and how they grow."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from ehadiag.actuator import default_actuator
from ehadiag.channels import PRESSURE, SPOOL
from ehadiag.identify.objective import Objective
from ehadiag.model.constants import plant_constants
from ehadiag.model.jack import jack_response
from ehadiag.model.monitoring import FREE_RUN
from ehadiag.model.spool import NODE_COLUMNS, NODES_PER_TICK, spool_response
from ehadiag.model.transition import spool_tables
from ehadiag.storedtest import resolve_test
from ehadiag_tools.bench_c_model import CModel, NoCompilerError
from ehadiag_tools.bench_figures import Figure, Sizes, cpu_median
from ehadiag_tools.bench_lanes import measure_lanes
from ehadiag_tools.bench_problem import whole_test
from ehadiag_tools.stiff_reference import StiffReference

__all__ = ["measure"]

FAULTS = (0.3, 0.6, 0.3)
SECTION = "kernel"
IN_C = "the same in C (cc -O3 -march=native, scalar)"
SUBSTEPS = 10
"""Sub-steps of 100 µs in a tick: times are also given for one of these."""
POPULATIONS = (1, 8, 64)
TESTS = (1, 2, 4)
WITHOUT_COMPILER = """
import time, sys
import numpy as np
from ehadiag.actuator import default_actuator
from ehadiag.model.constants import plant_constants
from ehadiag.model.monitoring import respond
from ehadiag.storedtest import resolve_test
current = resolve_test("open").command()[: int(sys.argv[1])]
begin = time.thread_time()
respond(plant_constants(default_actuator()), np.array({faults}), current, 1e-3)
print(time.thread_time() - begin)
"""


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    current = resolve_test("open").command()
    compiled = _Compiled(current)
    took = cpu_median(compiled, sizes.repeats)
    out = [
        Figure(SECTION, "one run of the 5.5 s test, numba, scalar", took * 1e3, "ms", _each(took)),
        *_against_c(compiled, current, took, sizes),
        *_against_oracles(current, sizes),
        Figure(
            SECTION,
            "matrices of a candidate",
            cpu_median(compiled.make_tables, sizes.repeats) * 1e6,
            "µs",
            "once for each value of Kintas and FSS",
        ),
    ]
    in_c = next((row.value for row in out if row.name == IN_C and row.value is not None), None)
    lanes = measure_lanes(sizes, None if in_c is None else in_c * 1e-3)
    return out + lanes + _growth(sizes) + _cores(sizes)


class _Compiled:
    """The project's kernels on arrays made beforehand."""

    def __init__(self, current: np.ndarray) -> None:
        n = len(current)
        self.current = current
        self.constants = plant_constants(default_actuator())
        self.spool, self.pressure, self.position = np.empty(n), np.empty(n), np.empty(n)
        self._nodes = np.empty((n * NODES_PER_TICK, NODE_COLUMNS))
        self._node_end = np.empty(n, dtype=np.int64)
        self._measured = np.full(n, np.nan)
        self._anchor = FREE_RUN.as_array()
        self.make_tables()

    def make_tables(self) -> None:
        self.tables = spool_tables(self.constants, FAULTS[0], FAULTS[1], 1e-3)

    def __call__(self) -> None:
        spool_response(
            self.constants,
            self.tables,
            self.current,
            1e-3,
            0.0,
            0.0,
            self._measured,
            self._anchor,
            self.spool,
            self._nodes,
            self._node_end,
        )
        jack_response(
            self.constants,
            FAULTS[2],
            0.0,
            self._nodes,
            self._node_end,
            self.pressure,
            self.position,
        )


def _each(seconds: float, ticks: int = 5500) -> str:
    tick = seconds * 1e9 / ticks
    return f"{tick:.0f} ns a tick, {tick / SUBSTEPS:.1f} ns for 100 µs"


def _against_c(compiled: _Compiled, current: np.ndarray, took: float, sizes: Sizes) -> list[Figure]:
    name = IN_C
    try:
        model = CModel(compiled.constants, compiled.tables, FAULTS[2], current)
    except NoCompilerError as error:
        return [Figure(SECTION, name, None, "ms", f"left out: {error}")]
    in_c = cpu_median(model, sizes.repeats)
    gap = np.abs(model.spool - compiled.spool).max() / SPOOL.lsb
    pressure_gap = np.abs(model.pressure - compiled.pressure).max() / PRESSURE.lsb
    return [
        Figure(SECTION, name, in_c * 1e3, "ms", _each(in_c)),
        Figure(SECTION, "numba faster than C", in_c / took, "times", "same algorithm, one lane"),
        Figure(
            SECTION,
            "largest gap between both",
            max(gap, pressure_gap),
            "LSB",
            "spool or pressure, whole test",
        ),
    ]


def _against_oracles(current: np.ndarray, sizes: Sizes) -> list[Figure]:
    part = current[: sizes.ticks]
    took = cpu_median(_Compiled(part), sizes.repeats)
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_COMPILER.format(faults=list(FAULTS)), str(len(part))],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    reference = StiffReference(default_actuator(), *FAULTS)
    begin = time.thread_time()
    reference.respond(part)
    stiff = time.thread_time() - begin
    remark = f"first {len(part)} ticks"
    return [
        Figure(
            SECTION,
            "faster than itself as plain Python",
            float(done.stdout) / took,
            "times",
            remark,
        ),
        Figure(SECTION, "faster than the stiff solver (oracle)", stiff / took, "times", remark),
    ]


def _growth(sizes: Sizes) -> list[Figure]:
    rng = np.random.default_rng(0)
    objective = Objective(whole_test(sizes.logs, 1))
    out = []
    for size in POPULATIONS:
        rows = rng.uniform(0.2, 0.7, (size, 3))
        took = _evaluations(objective, rows, sizes)
        name = f"one evaluation of the whole test, population {size}"
        out.append(Figure(SECTION, name, took * 1e3, "ms", "matrices, model, cost"))
    for tests in TESTS[1:]:
        rows = rng.uniform(0.2, 0.7, (8, 3))
        took = _evaluations(Objective(whole_test(sizes.logs, tests)), rows, sizes)
        name = f"the same of {tests} tests, population 8"
        out.append(Figure(SECTION, name, took * 1e3, "ms"))
    return out


def _evaluations(objective: Objective, rows: np.ndarray, sizes: Sizes) -> float:
    return cpu_median(partial(objective, rows), max(1, sizes.repeats // 3)) / len(rows)


def _cores(sizes: Sizes) -> list[Figure]:
    """Wall time of one thread's work against that of two threads' twice the work."""
    rows = np.random.default_rng(0).uniform(0.2, 0.7, (64, 3))
    objectives = [Objective(whole_test(sizes.logs, 1)) for _ in range(2)]
    ratios = []
    for _ in range(max(1, sizes.repeats // 3)):
        alone = _wall([partial(objectives[0], rows)])
        both = _wall([partial(item, rows) for item in objectives])
        ratios.append(2.0 * alone / both)
    return [
        Figure(
            SECTION,
            "two cores against one",
            float(np.max(ratios)),
            "times",
            f"wall time, best of {len(ratios)}, median {np.median(ratios):.2f}; needs idle cores",
        )
    ]


def _wall(works: list[Callable[[], object]]) -> float:
    threads = [threading.Thread(target=work) for work in works]
    begin = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return time.perf_counter() - begin
