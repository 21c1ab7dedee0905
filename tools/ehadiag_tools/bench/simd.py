"""Benchmark of the vector kernel: against scalar code and C, by population, on two processors."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.search.objective import SEARCH_CAP
from ehadiag.model.interface import ResidualModel
from ehadiag.model.scalar.residuals import ScalarModel
from ehadiag.model.simd.layout import LANES
from ehadiag.model.simd.model import SimdModel
from ehadiag_tools.bench.c_model import CLanes, CModel, NoCompilerError
from ehadiag_tools.bench.figures import Figure, Sizes, cpu_median, each
from ehadiag_tools.bench.kernel import CompiledModel
from ehadiag_tools.bench.peak import against_peak
from ehadiag_tools.bench.problem import population, whole_test
from ehadiag_tools.bench.single import single_precision

__all__ = ["measure"]

SECTION = "lanes"
POPULATIONS = (1, LANES // 4, LANES, LANES + 1, 4 * LANES)


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    model = whole_test(sizes.logs, 1)
    ticks = len(model.batch.current)
    out, took = [], 0.0
    for size in POPULATIONS:
        took = _lanes(model, size, sizes)
        name = f"one evaluation of the whole test, population {size}"
        out.append(Figure(SECTION, name, took * 1e3, "ms", each(took, ticks)))
    for tests in (2, 4):
        several = _lanes(whole_test(sizes.logs, tests), LANES, sizes)
        name = f"one evaluation of {tests} tests, population {LANES}"
        out.append(Figure(SECTION, name, several * 1e3, "ms", each(several, tests * ticks)))
    alone = _scalar(model, sizes)
    out.append(Figure(SECTION, "faster than the scalar kernel", alone / took, "times"))
    out.append(_cores(model, sizes))
    try:
        in_c = _in_c(model, sizes)
        return [
            *out,
            *_against_c(model, in_c, took, sizes),
            *against_peak(model, took, sizes),
            *single_precision(model, in_c, took, sizes),
        ]
    except NoCompilerError as error:
        return [*out, Figure(SECTION, "what is compared with C", None, "", f"left out: {error}")]


def _in_c(model: SimdModel, sizes: Sizes) -> float:
    """Time of one candidate by the lanes' steps in scalar C, s."""
    rows = model.unknowns.candidates(population(POPULATIONS[-1]))
    return cpu_median(CLanes(model.batch, model.levels, rows, SEARCH_CAP), sizes.repeats) / len(
        rows
    )


def _against_c(lanes: SimdModel, in_c: float, took: float, sizes: Sizes) -> list[Figure]:
    """Lanes, `took` s a candidate, against C of the same steps and the scalar model's."""
    batch, rows = lanes.batch, population(POPULATIONS[-1])
    candidates = lanes.unknowns.candidates(rows)
    model = CLanes(batch, lanes.levels, candidates, math.inf, residuals=True)
    model()
    assert model.residuals is not None
    used = batch.weight > 0.0
    lsb = batch.weight * np.array([[SPOOL.lsb], [PRESSURE.lsb]])
    apart = (np.abs(lanes.residuals(rows)[0] - model.residuals)[:, used] / lsb[used]).max()
    name = "the lanes' steps in scalar C (cc -O3 -march=native)"
    remark = (
        f"population {len(rows)}; C finds events by regula falsi and leaves out what a candidate at"
        " rest does not need"
    )
    other = "the same laws; events by halving, the jack by as many steps as the path asks for"
    alone = _scalar_in_c(sizes)
    return [
        Figure(SECTION, name, in_c * 1e3, "ms", each(in_c, len(batch.current))),
        Figure(SECTION, "faster than the lanes' steps in scalar C", in_c / took, "times", remark),
        Figure(
            SECTION, "farthest apart of both", apart, "LSB", "spool or pressure, all candidates"
        ),
        Figure(SECTION, "faster than the scalar model in C", alone / took, "times", other),
    ]


def _scalar_in_c(sizes: Sizes) -> float:
    current = resolve_test("open").command()
    model = CompiledModel(current)
    return cpu_median(CModel(model.constants, model.tables, current), sizes.repeats)


def _lanes(model: SimdModel, size: int, sizes: Sizes) -> float:
    return cpu_median(_evaluation(model, size), sizes.repeats) / size


def _evaluation(model: ResidualModel, size: int) -> Callable[[], object]:
    return partial(model.costs, population(size), SEARCH_CAP)


def _scalar(model: SimdModel, sizes: Sizes) -> float:
    call = _evaluation(ScalarModel(model.batch, model.unknowns), LANES)
    return cpu_median(call, max(1, sizes.repeats // 3)) / LANES


def _cores(model: SimdModel, sizes: Sizes) -> Figure:
    """Wall time of one thread's work against that of two threads' twice the work."""
    models = [SimdModel(model.batch, model.unknowns, levels=model.levels) for _ in range(2)]
    works = [_evaluation(item, 8 * LANES) for item in models]
    pairs = np.array([(_wall(works[:1]), _wall(works)) for _ in range(sizes.repeats)])
    alone, both = pairs.min(axis=0)
    middle = np.median(2.0 * pairs[:, 0] / pairs[:, 1])
    return Figure(
        SECTION,
        "two threads against one",
        2.0 * float(alone / both),
        "times",
        f"wall time, least of {len(pairs)}; median ratio {middle:.2f}; load "
        f"{os.getloadavg()[0]:.1f}; needs idle cores",
    )


def _wall(works: list[Callable[[], object]]) -> float:
    threads = [threading.Thread(target=work) for work in works]
    begin = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return time.perf_counter() - begin
