"""Many candidates on the processors that there are: whole blocks to each."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.scalar.residuals import Batch
from ehadiag.model.simd.layout import LANES
from ehadiag.model.simd.residuals import LaneWork, lane_residuals, work_beside

__all__ = ["processors", "residuals_on_cores"]


def processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def residuals_on_cores(
    batch: Batch,
    candidates: NDArray[np.float64],
    work: LaneWork,
    out: NDArray[np.float64],
    anchored: NDArray[np.int64],
    cores: int | None = None,
) -> None:
    """As `lane_residuals`, with the same digits on any number of cores.

    cores: how many; as `processors` says if not given.
    """
    count = len(candidates)
    blocks = -(-count // LANES)
    threads = max(1, min(processors() if cores is None else cores, blocks))
    edges = [min(count, blocks * i // threads * LANES) for i in range(threads)] + [count]
    first, *others = [slice(a, b) for a, b in pairwise(edges)]

    def evaluate(part: slice, scratch: LaneWork) -> None:
        lane_residuals(batch, candidates[part], scratch, out[part], anchored[part])

    if not others:
        evaluate(first, work)
        return
    with ThreadPoolExecutor(len(others)) as pool:
        waiting = [pool.submit(evaluate, part, work_beside(work)) for part in others]
        evaluate(first, work)
        for item in waiting:
            item.result()
