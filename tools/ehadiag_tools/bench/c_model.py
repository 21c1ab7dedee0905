"""The scalar and the vector model in C (`tools/bench_c`), compiled on demand."""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.batch import Batch
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.transition import SpoolTables
from ehadiag.model.simd.jack import MIDDLE, STAGE_NUMBERS, STAGES

__all__ = ["CLanes", "CModel", "CPeak", "CUnlocated", "NoCompilerError"]

SOURCES = Path(__file__).parents[2] / "bench_c"
OPTIONS = ("-O3", "-march=native", "-shared", "-fPIC")
SINGLE = ("-DREAL=float", "-fsingle-precision-constant")
BRANCHLESS = ("-fno-math-errno", "-fno-trapping-math", "-ffinite-math-only", "-fno-signed-zeros")
"""What lets a compiler turn choices into vector instructions."""
WIDEST = ("-mprefer-vector-width=512",) if platform.machine() in ("x86_64", "AMD64") else ()

PLANT = [PlantConstants._fields.index(name) for name in (
    "GM", "JF", "CF", "KF", "KSF", "XFM", "GQF", "GPF", "AS", "MS", "CS", "XSM", "FSS", "FSS1",
    "PSR", "GP", "GQ", "CLK", "AJ", "MJ", "CJ", "XJM", "FDJ", "FDJ1", "FR", "OXS", "OPD",
)]  # fmt: skip
"""Places of the constants that `plant.h` has."""


WITHOUT_MIDDLE = STAGES.reshape(-1, STAGE_NUMBERS)[:, :MIDDLE].ravel()
"""Places of stages and start, which is all that the C models ask for."""


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
        current: NDArray[np.float64],
    ) -> None:
        n = len(current)
        self.spool, self.pressure, self.position = np.empty(n), np.empty(n), np.empty(n)
        self._function = _build("model.c").eha_respond
        self._function.restype = None
        # Arrays that the pointers below point into.
        self._kept = (
            np.array(constants)[PLANT],
            *(np.ascontiguousarray(part) for part in (tables.moving, tables.stuck, tables.decay)),
            np.ascontiguousarray(current),
        )
        plant, moving, stuck, decay, currents = map(_pointer, self._kept)
        self._arguments = (
            *(plant, moving, stuck, decay),
            *(currents, ctypes.c_long(n), ctypes.c_double(1e-3)),
            *map(_pointer, (self.spool, self.pressure, self.position)),
        )

    def __call__(self) -> None:
        """Run."""
        self._function(*self._arguments)


class CLanes:
    """Costs of candidates by the algorithm of `ehadiag.model.simd.residuals`, one at a time.

    levels: of `SimdModel`; candidates: rows of constants, shape (n, tests, FIELDS); single:
    computes in single precision. Leaves `costs`, shape (n,), and, if wanted, `residuals`, shape
    (n, signals, N), 0 where a sample is missing.

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
        residuals: bool = False,
        single: bool = False,
    ) -> None:
        n = len(candidates)
        self.costs = np.zeros(n)
        kind = np.dtype(np.float32 if single else np.float64)
        shape = (n, *batch.weight.shape)
        self.residuals = np.zeros(shape, kind) if residuals else None
        self._function = _build("lanes.c", *SINGLE * single).eha_lane_costs
        self._function.restype = None
        # Arrays that the pointers below point into.
        self._kept = _of_kind(
            kind,
            *(batch.test, batch.tick, batch.start, batch.origin, *_currents(batch)),
            *(batch.spool, batch.pressure, batch.weight, batch.anchor[:, :3]),
            *(levels, WITHOUT_MIDDLE, candidates[..., PLANT]),
        )
        *inputs, rows = map(_pointer, self._kept)
        wanted = None if self.residuals is None else _pointer(self.residuals)
        self._arguments = (
            *inputs,
            *(ctypes.c_long(len(batch.tick)), _number(kind, cap), ctypes.c_long(n)),
            *(ctypes.c_long(candidates.shape[1]), rows, _pointer(self.costs), wanted),
        )

    def __call__(self) -> None:
        """Evaluate all."""
        self._function(*self._arguments)


class CUnlocated:
    """Costs of a block of candidates with events at the ends of steps, all in vectors.

    candidates: rows of constants, shape (n, tests, FIELDS); they are repeated to fill the block.
    Leaves `costs`, shape (block,).

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
        single: bool = False,
    ) -> None:
        library = _build("unlocated.c", *BRANCHLESS, *WIDEST, *SINGLE * single)
        kind = np.dtype(np.float32 if single else np.float64)
        self.costs = np.zeros(library.eha_block())
        seen = np.isfinite(np.stack([batch.spool, batch.pressure]))
        # Arrays that the pointers below point into.
        self._kept = _of_kind(
            kind,
            *(batch.test, batch.tick, batch.start, _currents(batch)[1]),
            *(np.nan_to_num(batch.spool), np.nan_to_num(batch.pressure)),
            *(np.where(seen, batch.weight, 0.0), levels, WITHOUT_MIDDLE),
            np.resize(candidates[..., PLANT], (len(self.costs), candidates.shape[1], len(PLANT))),
        )
        *inputs, rows = map(_pointer, self._kept)
        self._function = library.eha_unlocated_costs
        self._function.restype = None
        spans = ctypes.c_long(len(batch.tick))
        tests = ctypes.c_long(candidates.shape[1])
        cost = _pointer(self.costs)
        self._arguments = (*inputs, spans, _number(kind, cap), tests, rows, cost)

    def __call__(self) -> None:
        """Evaluate the block."""
        self._function(*self._arguments)


class CPeak:
    """Independent chains of operations in vectors; leaves `operations`, how many a call does.

    kind: "products" (and sums, a pair that fuses being two) or "divisions".

    Raises
    ------
    NoCompilerError: there is no C compiler, or it fails.
    """

    def __init__(self, kind: str, rounds: int) -> None:
        library = _build("peak.c")
        self.width: int = library.eha_width()
        """Numbers in a vector."""
        self.operations = 0.0
        self._function = library[f"eha_{kind}"]
        self._function.restype = ctypes.c_double
        self._rounds = ctypes.c_long(rounds)
        self._out = np.zeros(1)

    def __call__(self) -> None:
        """Run."""
        self._out[0] = 0.0
        self.operations = self._function(self._rounds, _pointer(self._out))


def _currents(batch: Batch) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Current before each span (0 at the beginning of a test), and of the ticks of all, A."""
    before = [
        batch.current[since - 1] if history else 0.0
        for since, history in zip(batch.since, batch.history, strict=True)
    ]
    lengths = np.diff(batch.start)
    spans = [batch.current[a : a + n] for a, n in zip(batch.since, lengths, strict=True)]
    return np.array(before), np.concatenate(spans)


def _of_kind(kind: np.dtype[Any], *arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Whole numbers as they are, the others of that kind."""
    return [np.ascontiguousarray(a, kind if a.dtype.kind == "f" else a.dtype) for a in arrays]


def _number(kind: np.dtype[Any], value: float) -> Any:
    return np.ctypeslib.as_ctypes_type(kind)(value)


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _build(source: str, *options: str) -> ctypes.CDLL:
    compiler = shutil.which("cc")
    if compiler is None:
        raise NoCompilerError("no cc on the path")
    return _compiled(compiler, source, options)


@lru_cache
def _compiled(compiler: str, source: str, options: tuple[str, ...]) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "model.so"
        done = subprocess.run(
            [compiler, *OPTIONS, *options, str(SOURCES / source), "-lm", "-o", str(library)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            first = (done.stderr.strip().splitlines() or ["without a word"])[0]
            raise NoCompilerError(f"cc failed: {first}")
        return ctypes.CDLL(str(library))
