"""How much of what one core can do the lanes' kernel does."""

from __future__ import annotations

from functools import partial

import numpy as np

from ehadiag.identify.batch import Batch
from ehadiag.identify.lanes import lane_costs, lane_work
from ehadiag.identify.objective import SEARCH_CAP
from ehadiag.model.lanelayout import LANES
from ehadiag_tools.bench_c_model import CPeak
from ehadiag_tools.bench_figures import Figure, Sizes, cpu_median, each
from ehadiag_tools.bench_operations import count_operations
from ehadiag_tools.bench_problem import population

__all__ = ["against_peak", "beginning"]

SECTION = "lanes"
ROUNDS = 300_000
"""Of the chains: some 10 ms."""
COUNTED = 20
"""Ticks in which operations are counted, for each tick of a slow oracle."""


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
    vectors = cpu_median(call, sizes.repeats) / LANES
    counted = min(ticks, COUNTED * sizes.ticks)
    found = count_operations(
        beginning(batch, counted), work._replace(levels=work.levels[:counted]), rows
    )
    per = 1.0 / (counted * LANES)
    vector, alone, divisions = found.vector * per, found.scalar * per, found.divisions * per
    rate, vector_rate = (vector + alone) * ticks / took, vector * ticks / vectors
    rows_of = [
        (
            "vector peak of one core, float64",
            peak * 1e-9,
            "GFLOP/s",
            f"C, independent chains of fused products and sums, {width} in a vector",
        ),
        (
            "operations of a candidate in a tick",
            vector + alone,
            "",
            f"{vector:.0f} in vectors, {alone:.0f} of lanes that go alone; no more than half of "
            "the peak where product and sum do not fuse",
        ),
        (
            "share of the vector peak",
            100.0 * rate / peak,
            "%",
            f"{rate * 1e-9:.1f} GFLOP/s; a division counts as one operation, a choice as none",
        ),
        ("vectors alone", vectors * 1e3, "ms", f"{each(vectors, ticks)}; a test without events"),
        (
            "share of the vector peak, vectors alone",
            100.0 * vector_rate / peak,
            "%",
            f"{vector_rate * 1e-9:.1f} GFLOP/s; beside them {found.choices * per:.0f} comparisons "
            f"and choices, as dear as a sum each, and {divisions:.1f} divisions, at the least "
            f"{divisions / divided * 1e9:.1f} ns a tick",
        ),
        (
            "share of time for events",
            100.0 * (1.0 - vectors / took),
            "%",
            f"for {100.0 * alone / (vector + alone):.0f} % of the operations: one by one, behind "
            "branches",
        ),
    ]
    return [Figure(SECTION, *row) for row in rows_of]


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
