"""What the vector kernel would gain and lose in single precision, measured in C."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.identify.refine.derivatives import KINK, STEP
from ehadiag.identify.search.objective import SEARCH_CAP
from ehadiag.model.parameters import FAULTS
from ehadiag.model.simd.model import SimdModel
from ehadiag_tools.bench.c_model import CLanes, CUnlocated
from ehadiag_tools.bench.figures import Figure, Sizes, cpu_median, each
from ehadiag_tools.bench.problem import all_tests, population

__all__ = ["single_precision"]

SECTION = "lanes"
CANDIDATES, CENTRES = 64, 16
OTHER_WAY = 1.0
"""Distance (LSB) from which an event went the other way: rounding alone makes a thousandth."""


def single_precision(model: SimdModel, in_c: float, took: float, sizes: Sizes) -> list[Figure]:
    """Times against those of scalar C (`in_c`) and of the lanes (`took`), s a candidate; accuracy.

    Raises
    ------
    NoCompilerError: C cannot be compiled.
    """
    batch, levels, ticks = model.batch, model.levels, len(model.batch.current)
    rows = model.unknowns.candidates(population(CANDIDATES))
    single = cpu_median(CLanes(batch, levels, rows, SEARCH_CAP, single=True), sizes.repeats)
    single /= len(rows)
    unlocated = []
    for wanted in (False, True):
        block = CUnlocated(batch, levels, rows, SEARCH_CAP, single=wanted)
        unlocated.append(cpu_median(block, sizes.repeats) / len(block.costs))
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
        _at_best("faster than the lanes", took, best, remark),
        _at_best("faster than scalar C", in_c, best, ""),
        *_accuracy(all_tests(sizes.logs) or [model]),
    ]


def _at_best(than: str, other: float, best: float, remark: str) -> Figure:
    """Ratio of times; `best` is a difference of times, which noise can make no time at all."""
    name = f"float32 lanes at best, {than}"
    if best <= 0.0:
        return Figure(SECTION, name, None, "times", "left out: lost in the noise of its times")
    return Figure(SECTION, name, other / best, "times", remark)


@dataclass(frozen=True, slots=True)
class _Apart:
    """How far single precision is off.

    Attributes
    ----------
    rms: LSB, shape (candidates, 2) of spool and pressure.
    largest: LSB, shape (candidates,).
    slopes: relative error of the derivatives of all centres, severities and signals that have any.
    """

    rms: NDArray[np.float64]
    largest: NDArray[np.float64]
    slopes: NDArray[np.float64]


def _accuracy(models: list[SimdModel]) -> list[Figure]:
    apart = [_apart(model) for model in models]
    rms = np.concatenate([item.rms for item in apart])
    largest = np.concatenate([item.largest for item in apart])
    slopes = np.concatenate([item.slopes for item in apart])
    share = 100.0 * np.mean(largest > OTHER_WAY)
    out = []
    of = f"median of {CANDIDATES} candidates on {len(models)} recordings"
    for name, off in zip(("spool", "pressure"), rms.T, strict=True):
        row, remark = f"float32 against float64, {name} rms", f"{of}; worst {off.max():.2g}"
        out.append(Figure(SECTION, row, float(np.median(off)), "LSB", remark))
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


def _apart(model: SimdModel) -> _Apart:
    points = population(CANDIDATES)
    used = model.batch.weight > 0.0
    double, single = (_residuals(model, points, wanted) for wanted in (False, True))
    off = np.abs(double - single)
    rms = np.sqrt((off**2).sum(axis=2) / used.sum(axis=1))
    slopes = []
    for centre in points[:CENTRES]:
        sides = np.repeat(centre[None, :], 1 + 2 * len(FAULTS), axis=0)
        for j in range(len(FAULTS)):
            sides[1 + 2 * j, j] += STEP
            sides[2 + 2 * j, j] -= STEP
        right, smooth = _slopes(_residuals(model, sides, False), sides)
        wrong, agrees = _slopes(_residuals(model, sides, True), sides)
        for channel, error, either in zip(right, wrong - right, smooth & agrees, strict=True):
            size = np.sqrt(np.mean(channel[either] ** 2))
            if size > 0.0:
                slopes.append(np.sqrt(np.mean(error[either] ** 2)) / size)
    return _Apart(rms, off.max(axis=(1, 2)), np.array(slopes))


def _residuals(model: SimdModel, points: NDArray[np.float64], single: bool) -> NDArray[np.float64]:
    """Residuals in LSB, shape (n, SIGNALS, N)."""
    batch, candidates = model.batch, model.unknowns.candidates(points)
    in_c = CLanes(batch, model.levels, candidates, math.inf, residuals=True, single=single)
    in_c()
    assert in_c.residuals is not None
    noise = np.array([[1.0 / SPOOL.lsb], [1.0 / PRESSURE.lsb]])
    scale = np.divide(
        noise, batch.weight, where=batch.weight > 0.0, out=np.zeros_like(batch.weight)
    )
    return np.asarray(in_c.residuals * scale, dtype=np.float64)


def _slopes(
    residuals: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Derivatives of each severity and signal, one a row, and where there is no event."""
    slopes, smooth = [], []
    for j in range(points.shape[1]):
        high, low = residuals[1 + 2 * j], residuals[2 + 2 * j]
        width = points[1 + 2 * j, j] - points[2 + 2 * j, j]
        slopes.append((high - low) / width)
        smooth.append(np.abs(residuals[0] - 0.5 * (high + low)) < KINK)
    return np.vstack(slopes), np.vstack(smooth)
