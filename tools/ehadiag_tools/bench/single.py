"""What the vector kernel would gain and lose in single precision, measured in C."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from ehadiag.identify.refine.residual_model import FAULT_COUNT, KINK, STEP
from numpy.typing import NDArray

from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.identify.search.objective import SEARCH_CAP
from ehadiag.model.scalar.residuals import Batch
from ehadiag.model.simd.residuals import lane_work
from ehadiag_tools.bench.c_model import CLanes, CUnlocated
from ehadiag_tools.bench.figures import Figure, Sizes, cpu_median, each
from ehadiag_tools.bench.problem import all_tests, population

__all__ = ["single_precision"]

SECTION = "lanes"
CANDIDATES, CENTRES = 64, 16
OTHER_WAY = 1.0
"""Gap (LSB) from which an event went the other way: rounding alone makes a thousandth."""


def single_precision(batch: Batch, in_c: float, took: float, sizes: Sizes) -> list[Figure]:
    """Times against those of scalar C (`in_c`) and of the lanes (`took`), s a candidate; accuracy.

    Raises
    ------
    NoCompilerError: C cannot be compiled.
    """
    levels, ticks = lane_work(batch).levels, len(batch.current)
    rows = population(CANDIDATES)
    single = cpu_median(CLanes(batch, levels, rows, SEARCH_CAP, single=True), sizes.repeats)
    single /= len(rows)
    unlocated = []
    for wanted in (False, True):
        model = CUnlocated(batch, levels, rows, SEARCH_CAP, single=wanted)
        unlocated.append(cpu_median(model, sizes.repeats) / len(model.costs))
    best = took - unlocated[0] + unlocated[1]
    rough = "the compiler's vectors; events not located but taken at the ends of steps"
    out = [
        Figure(SECTION, "scalar C, float32", single * 1e3, "ms", each(single, ticks)),
        Figure(SECTION, "float32 in scalar C faster than float64", in_c / single, "times"),
    ]
    for name, spent in zip(("float64", "float32"), unlocated, strict=True):
        remark = f"{each(spent, ticks)}; {rough}"
        out.append(Figure(SECTION, f"vectors alone in C, {name}", spent * 1e3, "ms", remark))
    remark = "the lanes' time, with the vectors of C in float32 for those in float64"
    return [
        *out,
        Figure(
            SECTION, "float32 lanes at best, faster than the lanes", took / best, "times", remark
        ),
        Figure(SECTION, "float32 lanes at best, faster than scalar C", in_c / best, "times"),
        *_accuracy(all_tests(sizes.logs) or [batch]),
    ]


@dataclass(frozen=True, slots=True)
class _Apart:
    """How far single precision is off.

    Attributes
    ----------
    rms: LSB, shape (candidates, 2) of spool and pressure.
    largest: LSB, shape (candidates,).
    slopes: relative error of the derivatives, of all centres, constants and channels that have any.
    """

    rms: NDArray[np.float64]
    largest: NDArray[np.float64]
    slopes: NDArray[np.float64]


def _accuracy(batches: list[Batch]) -> list[Figure]:
    apart = [_apart(batch) for batch in batches]
    rms = np.concatenate([item.rms for item in apart])
    largest = np.concatenate([item.largest for item in apart])
    slopes = np.concatenate([item.slopes for item in apart])
    share = 100.0 * np.mean(largest > OTHER_WAY)
    out = []
    of = f"median of {CANDIDATES} candidates on {len(batches)} recordings"
    for name, gaps in zip(("spool", "pressure"), rms.T, strict=True):
        row, remark = f"float32 against float64, {name} rms", f"{of}; worst {gaps.max():.2g}"
        out.append(Figure(SECTION, row, float(np.median(gaps)), "LSB", remark))
    return [
        *out,
        Figure(
            SECTION,
            "float32: candidates in which an event goes the other way",
            float(share),
            "%",
            f"a sample is off by more than {OTHER_WAY:g} LSB; worst {largest.max():.2g}",
        ),
        Figure(
            SECTION,
            "float32: error of the derivatives",
            100.0 * float(np.median(slopes)),
            "%",
            f"differences of {STEP:g} to both sides, median; 9 in 10 below "
            f"{100.0 * np.quantile(slopes, 0.9):.2g}, worst {100.0 * slopes.max():.2g}",
        ),
    ]


def _apart(batch: Batch) -> _Apart:
    levels, rows = lane_work(batch).levels, population(CANDIDATES)
    used = batch.weight > 0.0
    double, single = (_gaps(batch, levels, rows, wanted) for wanted in (False, True))
    gaps = np.abs(double - single)
    rms = np.sqrt((gaps**2).sum(axis=2) / used.sum(axis=1))
    slopes = []
    for centre in rows[:CENTRES]:
        points = np.repeat(centre[None, :], 1 + 2 * FAULT_COUNT, axis=0)
        for j in range(FAULT_COUNT):
            points[1 + 2 * j, j] += STEP
            points[2 + 2 * j, j] -= STEP
        right, smooth = _slopes(_gaps(batch, levels, points, False), points)
        # Candidates are rounded too; their differences are known.
        wrong, agrees = _slopes(_gaps(batch, levels, points, True), points.astype(np.float32))
        for channel, error, either in zip(right, wrong - right, smooth & agrees, strict=True):
            size = np.sqrt(np.mean(channel[either] ** 2))
            if size > 0.0:
                slopes.append(np.sqrt(np.mean(error[either] ** 2)) / size)
    return _Apart(rms, gaps.max(axis=(1, 2)), np.array(slopes))


def _gaps(
    batch: Batch, levels: NDArray[np.int64], rows: NDArray[np.float64], single: bool
) -> NDArray[np.float64]:
    """Gaps in LSB, shape (n, 2, N)."""
    model = CLanes(batch, levels, rows, math.inf, gaps=True, single=single)
    model()
    assert model.gaps is not None
    noise = np.array([[1.0 / SPOOL.lsb], [1.0 / PRESSURE.lsb]])
    scale = np.divide(
        noise, batch.weight, where=batch.weight > 0.0, out=np.zeros_like(batch.weight)
    )
    return np.asarray(model.gaps * scale, dtype=np.float64)


def _slopes(
    gaps: NDArray[np.float64], points: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Derivatives of each constant and channel, shape (6, N), and where there is no event."""
    slopes, smooth = [], []
    for j in range(FAULT_COUNT):
        high, low = gaps[1 + 2 * j], gaps[2 + 2 * j]
        width = float(points[1 + 2 * j, j]) - float(points[2 + 2 * j, j])
        slopes.append((high - low) / width)
        smooth.append(np.abs(gaps[0] - 0.5 * (high + low)) < KINK)
    return np.vstack(slopes), np.vstack(smooth)
