"""The monitoring model and its lanes in C (`tools/bench_c`), compiled where asked for."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch
from ehadiag.model.constants import PlantConstants
from ehadiag.model.lanejack import STAGES
from ehadiag.model.transition import SpoolTables

__all__ = ["CLanes", "CModel", "NoCompilerError"]

SOURCES = Path(__file__).parent.parent / "bench_c"
OPTIONS = ("-O3", "-march=native", "-shared", "-fPIC")


class NoCompilerError(Exception):
    """C cannot be compiled here; the text says why."""


class CModel:
    """One run of the model over given currents; leaves `spool`, `pressure` and `position`.

    Raises
    ------
    NoCompilerError: there is no C compiler, or it fails.
    """

    def __init__(
        self,
        constants: PlantConstants,
        tables: SpoolTables,
        fdj: float,
        current: NDArray[np.float64],
    ) -> None:
        n = len(current)
        self.spool, self.pressure, self.position = np.empty(n), np.empty(n), np.empty(n)
        self._function = _build("model.c").eha_respond
        self._function.restype = None
        # Arrays that the pointers below point into.
        self._kept = (
            np.array(constants),
            np.array(tables.scalars),
            *(np.ascontiguousarray(part) for part in tables[:3]),
            np.ascontiguousarray(current),
        )
        plant, scalars, moving, stuck, decay, currents = map(_pointer, self._kept)
        self._arguments = (
            *(plant, scalars, moving, stuck, decay, ctypes.c_double(fdj)),
            *(currents, ctypes.c_long(n), ctypes.c_double(1e-3)),
            *map(_pointer, (self.spool, self.pressure, self.position)),
        )

    def __call__(self) -> None:
        """Run."""
        self._function(*self._arguments)


class CLanes:
    """Costs of candidates by the algorithm of `ehadiag.identify.lanes`, one at a time.

    levels: of `LaneWork`; candidates: shape (n, 5). Leaves `costs`, shape (n,), and, if wanted,
    `gaps`, shape (n, 2, N), 0 where a sample is missing.

    Raises
    ------
    NoCompilerError: there is no C compiler, or it fails.
    """

    def __init__(
        self,
        batch: Batch,
        levels: NDArray[np.int64],
        candidates: NDArray[np.float64],
        cap: float,
        *,
        gaps: bool = False,
    ) -> None:
        n = len(candidates)
        self.costs = np.zeros(n)
        self.gaps = np.zeros((n, 2, len(batch.current))) if gaps else None
        self._function = _build("lanes.c").eha_lane_costs
        self._function.restype = None
        # Arrays that the pointers below point into.
        self._kept = [np.ascontiguousarray(part) for part in (*batch, levels, STAGES, candidates)]
        *inputs, rows = map(_pointer, self._kept)
        self._arguments = (
            *inputs,
            *(ctypes.c_long(len(batch.tick)), ctypes.c_double(cap), ctypes.c_long(n)),
            *(rows, _pointer(self.costs), None if self.gaps is None else _pointer(self.gaps)),
        )

    def __call__(self) -> None:
        """Evaluate all."""
        self._function(*self._arguments)


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _build(source: str) -> ctypes.CDLL:
    compiler = shutil.which("cc")
    if compiler is None:
        raise NoCompilerError("no cc on the path")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "model.so"
        done = subprocess.run(
            [compiler, *OPTIONS, str(SOURCES / source), "-lm", "-o", str(library)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            first = (done.stderr.strip().splitlines() or ["without a word"])[0]
            raise NoCompilerError(f"cc failed: {first}")
        return ctypes.CDLL(str(library))
