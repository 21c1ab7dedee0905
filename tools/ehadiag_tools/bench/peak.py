"""Share of one core's peak throughput that the vector kernel reaches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.search.objective import SEARCH_CAP
from ehadiag.model.batch import Batch
from ehadiag.model.simd.layout import LANES
from ehadiag.model.simd.model import SimdModel
from ehadiag_tools.bench.c_model import CPeak
from ehadiag_tools.bench.figures import Figure, Sizes, cpu_median, each
from ehadiag_tools.bench.operations import Job, count_operations
from ehadiag_tools.bench.problem import population

__all__ = ["against_peak", "beginning"]

SECTION = "lanes"
ROUNDS = 300_000
"""Of the chains: some 10 ms."""
SLOW = 2e-3
"""Largest current (A) of a test with next to no events: the jack keeps off its stops."""
COUNTED = 20
"""Ticks in which operations are counted, for each tick that a slow oracle takes."""


def against_peak(model: SimdModel, took: float, sizes: Sizes) -> list[Figure]:
    """Operations of the lanes, `took` s a candidate, against the vector peak in the same run.

    Raises
    ------
    NoCompilerError: the peak cannot be measured.
    """
    peak, width = _rate("products", sizes)
    divided, _ = _rate("divisions", sizes)
    batch, levels, points = model.batch, model.levels, population(LANES)
    ticks, candidates = len(batch.current), model.unknowns.candidates(points)
    slow = batch._replace(current=_triangle(ticks))
    calm = SimdModel(slow, model.unknowns, levels=levels)
    together = cpu_median(lambda: calm.costs(points, SEARCH_CAP), sizes.repeats) / LANES
    counted = min(ticks, COUNTED * sizes.ticks)
    quarter = -(-counted // 4)
    jobs: list[Job] = [
        (beginning(batch, counted), levels[:counted], candidates),
        # Steps of the jack as in the whole test, on average.
        (beginning(slow, quarter), levels[:counted:4].copy(), candidates),
    ]
    whole, part = count_operations(jobs)
    total, per = whole.arithmetic / (counted * LANES), 1.0 / (quarter * LANES)
    rate, slow_rate = total * ticks / took, part.arithmetic * per * ticks / together
    figures = [
        (
            "vector peak of one core, float64",
            peak * 1e-9,
            "GFLOP/s",
            f"C, independent chains of fused products and sums, {width} in a vector",
        ),
        (
            "operations of a candidate in a tick",
            total,
            "",
            f"{whole.vector / (counted * LANES):.0f} of them in vectors; no more than half of the "
            "peak where product and sum do not fuse",
        ),
        (
            "share of the vector peak",
            100.0 * rate / peak,
            "%",
            f"{rate * 1e-9:.1f} GFLOP/s; a division counts as one operation, a choice as none",
        ),
        (
            "one evaluation of a slow triangle of the same length",
            together * 1e3,
            "ms",
            f"{each(together, ticks)}; next to no events, the same steps",
        ),
        (
            "share of the vector peak, slow triangle",
            100.0 * slow_rate / peak,
            "%",
            f"{slow_rate * 1e-9:.1f} GFLOP/s; beside {part.arithmetic * per:.0f} operations in a "
            f"tick {part.choices * per:.0f} comparisons and choices, as dear as a sum each; "
            f"{part.divisions * per:.1f} are divisions, at the least "
            f"{part.divisions * per / divided * 1e9:.1f} ns",
        ),
        (
            "share of the test's time for events",
            100.0 * (1.0 - together / took),
            "%",
            "against the slow triangle; below zero: lost in the noise of both times",
        ),
    ]
    return [Figure(SECTION, *row) for row in figures]


def _triangle(ticks: int) -> NDArray[np.float64]:
    """Current that moves spool and jack all the time, to and fro once, A."""
    turns = np.arange(ticks) / ticks
    return np.asarray(SLOW * 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * turns)))


def _rate(kind: str, sizes: Sizes) -> tuple[float, int]:
    """Operations a second at the most, and how many are in a vector."""
    chains = CPeak(kind, ROUNDS)
    spent = cpu_median(chains, sizes.repeats)
    return chains.operations / spent, chains.width


def beginning(batch: Batch, ticks: int) -> Batch:
    """Cut a batch of one span to its first ticks."""
    return batch._replace(
        start=np.array([0, ticks]),
        current=batch.current[:ticks],
        spool=batch.spool[:ticks],
        pressure=batch.pressure[:ticks],
        position=batch.position[:ticks],
        weight=np.ascontiguousarray(batch.weight[:, :ticks]),
    )
