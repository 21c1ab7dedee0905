"""The population's kernel: against scalar code and C, over lanes and ticks, on two processors."""

from __future__ import annotations

import math
import os
import time
from functools import partial

import numpy as np

from ehadiag.channels import PRESSURE, SPOOL
from ehadiag.identify.batch import Batch, costs, workspace
from ehadiag.identify.lanes import lane_costs, lane_residuals, lane_work
from ehadiag.identify.objective import SEARCH_CAP
from ehadiag.identify.parallel import ParallelLanes
from ehadiag.model.lanelayout import LANES
from ehadiag_tools.bench_c_model import CLanes, NoCompilerError
from ehadiag_tools.bench_figures import Figure, Sizes, cpu_median
from ehadiag_tools.bench_problem import whole_test

__all__ = ["measure_lanes"]

SECTION = "lanes"
SUBSTEPS = 10
"""Sub-steps of 100 µs in a tick: times are also given for one of these."""
POPULATIONS = (1, LANES // 4, LANES, LANES + 1, 4 * LANES)
SPREAD = (0.0, 1.0)


def measure_lanes(sizes: Sizes, in_c: float | None) -> list[Figure]:
    """Run the section; `in_c`: time of the scalar model in C for the same test, s."""
    batch = whole_test(sizes.logs, 1)
    ticks = len(batch.current)
    out, each = [], 0.0
    for size in POPULATIONS:
        each = _lanes(batch, size, sizes)
        tick = each * 1e9 / ticks
        out.append(
            Figure(
                SECTION,
                f"one evaluation of the whole test, population {size}",
                each * 1e3,
                "ms",
                f"{tick:.1f} ns a tick, {tick / SUBSTEPS:.2f} ns for 100 µs",
            )
        )
    out += _against_c(batch, each, sizes)
    alone = _scalar(batch, sizes)
    out.append(Figure(SECTION, "faster than the scalar kernel", alone / each, "times"))
    if in_c is not None:
        remark = "another algorithm: closed forms, events by halving"
        out.append(
            Figure(SECTION, "faster than the scalar model in C", in_c / each, "times", remark)
        )
    for tests in (2, 4):
        several = _lanes(whole_test(sizes.logs, tests), LANES, sizes)
        name = f"one evaluation of {tests} tests, population {LANES}"
        remark = f"{several * 1e9 / (tests * ticks):.1f} ns a tick, {tests * ticks} ticks"
        out.append(Figure(SECTION, name, several * 1e3, "ms", remark))
    return [*out, _cores(batch, sizes)]


def _against_c(batch: Batch, each: float, sizes: Sizes) -> list[Figure]:
    """Lanes, `each` s an evaluation, against C of the same algorithm, candidate after candidate."""
    name = "the lanes' algorithm in C (cc -O3 -march=native, scalar)"
    rows, work = _population(POPULATIONS[-1]), lane_work(batch)
    try:
        model = CLanes(batch, work.levels, rows, SEARCH_CAP)
        exact = CLanes(batch, work.levels, rows, math.inf, gaps=True)
    except NoCompilerError as error:
        return [Figure(SECTION, name, None, "ms", f"left out: {error}")]
    in_c = cpu_median(model, sizes.repeats) / len(rows)
    exact()
    assert exact.gaps is not None
    gaps = np.empty_like(exact.gaps)
    lane_residuals(batch, rows, work, gaps, np.empty(len(rows), dtype=np.int64))
    used = batch.weight > 0.0
    lsb = batch.weight * np.array([[SPOOL.lsb], [PRESSURE.lsb]])
    apart = (np.abs(gaps - exact.gaps)[:, used] / lsb[used]).max()
    tick = in_c * 1e9 / len(batch.current)
    return [
        Figure(
            SECTION,
            name,
            in_c * 1e3,
            "ms",
            f"{tick:.1f} ns a tick, {tick / SUBSTEPS:.2f} ns for 100 µs",
        ),
        Figure(
            SECTION,
            "faster than the same algorithm in C",
            in_c / each,
            "times",
            f"population {len(rows)}; C leaves out what a candidate at rest does not need",
        ),
        Figure(
            SECTION, "largest gap between both", apart, "LSB", "spool or pressure, all candidates"
        ),
    ]


def _population(size: int) -> np.ndarray:
    rows = np.zeros((size, 5))
    rows[:, :3] = np.random.default_rng(0).uniform(*SPREAD, (size, 3))
    return rows


def _lanes(batch: Batch, size: int, sizes: Sizes) -> float:
    rows, work, out = _population(size), lane_work(batch), np.empty(size)
    call = partial(lane_costs, batch, rows, SEARCH_CAP, work, out)
    return cpu_median(call, sizes.repeats) / size


def _scalar(batch: Batch, sizes: Sizes) -> float:
    rows, out = _population(LANES), np.empty(LANES)
    gaps = np.empty((2, len(batch.current)))
    call = partial(costs, batch, rows, SEARCH_CAP, workspace(batch), gaps, out)
    return cpu_median(call, max(1, sizes.repeats // 3)) / LANES


def _cores(batch: Batch, sizes: Sizes) -> Figure:
    """Wall time of one thread against that of two for the same population."""
    rows = _population(16 * LANES)
    ratios = []
    with ParallelLanes(batch, 1) as one, ParallelLanes(batch, 2) as two:
        for lanes in (one, two):
            lanes.costs(rows, SEARCH_CAP)
        for _ in range(sizes.repeats):
            ratios.append(_wall(one, rows) / _wall(two, rows))
    return Figure(
        SECTION,
        "two threads against one",
        float(np.max(ratios)),
        "times",
        f"wall time, best of {len(ratios)}, median {np.median(ratios):.2f}; load "
        f"{os.getloadavg()[0]:.1f}; needs idle cores",
    )


def _wall(lanes: ParallelLanes, rows: np.ndarray) -> float:
    begin = time.perf_counter()
    lanes.costs(rows, SEARCH_CAP)
    return time.perf_counter() - begin
