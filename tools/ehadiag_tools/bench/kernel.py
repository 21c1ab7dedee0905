"""Benchmark of the scalar kernel: against C and against slow reference solvers."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.core.stored_test import resolve_test
from ehadiag.model.anchor import FREE_RUN
from ehadiag.model.scalar.jack import jack_response
from ehadiag.model.scalar.spool import spool_response
from ehadiag.model.scalar.spool_tick import NODE_COLUMNS, NODES_PER_TICK
from ehadiag.model.scalar.transition import spool_tables
from ehadiag_tools.bench.c_model import CModel, NoCompilerError
from ehadiag_tools.bench.figures import Figure, Sizes, cpu_median, each
from ehadiag_tools.damaged import damaged_unit
from ehadiag_tools.simulator.stiff_reference import StiffReference

__all__ = ["FAULTS", "CompiledModel", "measure"]

FAULTS = (0.3, 0.6, 0.3)
SECTION = "kernel"
IN_C = "the same in C (cc -O3 -march=native, scalar)"
WITHOUT_COMPILER = """
import time, sys
from ehadiag.core.stored_test import resolve_test
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.response import respond
current = resolve_test("open").command()[: int(sys.argv[1])]
constants = PlantConstants(*map(float, sys.argv[2:]))
begin = time.thread_time()
respond(constants, current, 1e-3)
print(time.thread_time() - begin)
"""


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    current = resolve_test("open").command()
    compiled = CompiledModel(current)
    took = cpu_median(compiled, sizes.repeats)
    return [
        Figure(
            SECTION,
            "one run of the 5.5 s test, numba, scalar",
            took * 1e3,
            "ms",
            each(took, len(current)),
        ),
        *_against_c(compiled, current, took, sizes),
        *_against_oracles(current, sizes),
        Figure(
            SECTION,
            "matrices of a candidate",
            cpu_median(compiled.make_tables, sizes.repeats) * 1e6,
            "µs",
            "once for each candidate",
        ),
    ]


class CompiledModel:
    """The project's kernels on arrays made beforehand."""

    def __init__(self, current: np.ndarray) -> None:
        n = len(current)
        self.current = current
        self.constants = damaged_unit(FAULTS)
        self.spool, self.pressure, self.position = np.empty(n), np.empty(n), np.empty(n)
        self._nodes = np.empty((n * NODES_PER_TICK, NODE_COLUMNS))
        self._node_end = np.empty(n, dtype=np.int64)
        self._measured = np.full(n, np.nan)
        self._anchor = FREE_RUN.as_array()
        self._history = np.zeros(0)
        self.make_tables()

    def make_tables(self) -> None:
        """Find the matrices of the candidate."""
        self.tables = spool_tables(self.constants, 1e-3)

    def __call__(self) -> None:
        """Run."""
        spool_response(
            self.constants,
            self.tables,
            self.current,
            1e-3,
            0.0,
            self._history,
            self._measured,
            self._anchor,
            self.spool,
            self._nodes,
            self._node_end,
        )
        jack_response(
            self.constants,
            1e-3,
            0.0,
            0.0,
            0.0,
            self._measured,
            self._nodes,
            self._node_end,
            self.pressure,
            self.position,
        )


def _against_c(
    compiled: CompiledModel, current: np.ndarray, took: float, sizes: Sizes
) -> list[Figure]:
    name = IN_C
    try:
        model = CModel(compiled.constants, compiled.tables, current)
    except NoCompilerError as error:
        return [Figure(SECTION, name, None, "ms", f"left out: {error}")]
    in_c = cpu_median(model, sizes.repeats)
    spool = np.abs(model.spool - compiled.spool).max() / SPOOL.lsb
    pressure = np.abs(model.pressure - compiled.pressure).max() / PRESSURE.lsb
    return [
        Figure(SECTION, name, in_c * 1e3, "ms", each(in_c, len(current))),
        Figure(SECTION, "numba faster than C", in_c / took, "times", "same algorithm, one lane"),
        Figure(
            SECTION,
            "farthest apart of both",
            max(spool, pressure),
            "LSB",
            "spool or pressure, whole test",
        ),
    ]


def _against_oracles(current: np.ndarray, sizes: Sizes) -> list[Figure]:
    part = current[: sizes.ticks]
    took = cpu_median(CompiledModel(part), sizes.repeats)
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_COMPILER, str(len(part)), *map(repr, damaged_unit(FAULTS))],
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
