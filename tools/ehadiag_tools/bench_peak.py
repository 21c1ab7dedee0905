"""How much of what one core can do the lanes' kernel does."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch
from ehadiag.identify.lanes import LaneWork, lane_costs, lane_work
from ehadiag.identify.objective import SEARCH_CAP
from ehadiag.model.lanelayout import LANES
from ehadiag_tools.bench_c_model import CPeak
from ehadiag_tools.bench_figures import Figure, Sizes, cpu_median, each
from ehadiag_tools.bench_operations import Job, count_operations
from ehadiag_tools.bench_problem import population

__all__ = ["against_peak", "beginning"]

SECTION = "lanes"
ROUNDS = 300_000
"""Of the chains: some 10 ms."""
COUNTED = 20
"""Ticks in which operations are counted, for each tick that a slow oracle takes."""


def against_peak(batch: Batch, took: float, sizes: Sizes) -> list[Figure]:
    """Operations of the lanes, `took` s a candidate, against the vector peak in the same run.

    Raises
    ------
    NoCompilerError: the peak cannot be measured.
    """
    peak, width = _rate("products", sizes)
    divided, _ = _rate("divisions", sizes)
    work, rows, ticks = lane_work(batch), population(LANES), len(batch.current)
    # At rest there are no events; the steps are those of the test.
    still = batch._replace(current=np.zeros(ticks))
    call = partial(lane_costs, still, rows, SEARCH_CAP, work, np.empty(LANES))
    resting = cpu_median(call, sizes.repeats) / LANES
    total, vector, divisions, choices = _operations(batch, work, rows, sizes)
    rate, vector_rate = total * ticks / took, vector * ticks / resting
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
            f"{vector:.0f} of all lanes together, {total - vector:.0f} of lanes that go alone; "
            "no more than half of the peak where product and sum do not fuse",
        ),
        (
            "share of the vector peak",
            100.0 * rate / peak,
            "%",
            f"{rate * 1e-9:.1f} GFLOP/s; a division counts as one operation, a choice as none",
        ),
        ("lanes together", resting * 1e3, "ms", f"{each(resting, ticks)}; a test without events"),
        (
            "share of the vector peak, lanes together",
            100.0 * vector_rate / peak,
            "%",
            f"{vector_rate * 1e-9:.1f} GFLOP/s; beside them {choices:.0f} comparisons and choices, "
            f"as dear as a sum each, and {divisions:.1f} divisions, at the least "
            f"{divisions / divided * 1e9:.1f} ns a tick",
        ),
        (
            "share of time for lanes that go alone",
            100.0 * (1.0 - resting / took),
            "%",
            f"for {100.0 * (1.0 - vector / total):.0f} % of the operations: each waits for the "
            "one before, behind branches",
        ),
    ]
    return [Figure(SECTION, *row) for row in figures]


def _operations(
    batch: Batch, work: LaneWork, rows: NDArray[np.float64], sizes: Sizes
) -> tuple[float, float, float, float]:
    """Of a candidate in a tick: all; of all lanes together all, divisions, and choices."""
    counted = min(len(batch.current), COUNTED * sizes.ticks)
    levels = work.levels[:counted]
    still = batch._replace(current=np.zeros(len(batch.current)))
    jobs: list[Job] = [(beginning(batch, counted), work._replace(levels=levels), rows)]
    # With these the work of a tick, of a further step of the jack and of no tick come apart.
    for ticks, level in ((10, 0), (20, 0), (20, 1)):
        steps = np.full(ticks, level, dtype=np.int64)
        jobs.append((beginning(still, ticks), work._replace(levels=steps), rows))
    found = count_operations(jobs)
    few, more, finer = (
        np.array([item.vector, item.divisions, item.choices]) / LANES for item in found[1:]
    )
    tick, step = (more - few) / 10.0, (finer - more) / 20.0
    vector, divisions, choices = tick + step * (np.mean(2.0**levels) - 1.0)
    total = (found[0].vector + found[0].scalar) / (counted * LANES)
    return total, float(vector), float(divisions), float(choices)


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
        weight=np.ascontiguousarray(batch.weight[:, :ticks]),
    )
