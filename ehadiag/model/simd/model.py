"""The vector kernels as a model that explains recordings, on the processors that there are."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.vector import WIDTH
from ehadiag.model.batch import Batch
from ehadiag.model.parameters import Unknowns
from ehadiag.model.simd.layout import LANES
from ehadiag.model.simd.residuals import (
    Scratch,
    block_costs,
    block_residuals,
    levels_for,
    scratch_beside,
    scratch_for,
)

__all__ = ["SimdModel", "processors"]


def processors() -> int:
    """Processors that this process may use; at most `EHADIAG_THREADS`, where that is set."""
    told = os.environ.get("EHADIAG_THREADS", "")
    if told.isascii() and told.isdigit() and int(told) > 0:
        return min(_there(), int(told))
    return _there()


def _there() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class SimdModel:
    """A `ehadiag.model.interface.ResidualModel` of vector kernels.

    Residuals of more than one block are computed on several processors, with the same digits on
    any number of them; costs on one.

    Parameters
    ----------
    threads : int, optional
        At most so many; as many as there are processors unless given.
    levels : shape (N,), optional
        `levels` of a model of the same spans, else they are found anew.
    """

    def __init__(
        self,
        batch: Batch,
        unknowns: Unknowns,
        *,
        threads: int | None = None,
        levels: NDArray[np.int64] | None = None,
    ) -> None:
        self.batch = batch
        self.unknowns = unknowns
        self.evaluations = 0
        self._threads = processors() if threads is None else threads
        if levels is None:
            levels = levels_for(batch, unknowns.candidates(_scattered(unknowns)))
        self.levels: NDArray[np.int64] = levels
        """How the jack's ticks are cut; to find that takes half as long as to run a block."""
        self._work = scratch_for(levels)

    def residuals(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """See the protocol."""
        count = len(points)
        candidates = self.unknowns.candidates(points)
        out = np.empty((count, *self.batch.weight.shape))
        anchored = np.empty(count, dtype=np.int64)
        blocks = -(-count // LANES)
        threads = max(1, min(self._threads, blocks))
        edges = [min(count, blocks * i // threads * LANES) for i in range(threads)] + [count]
        first, *others = [slice(a, b) for a, b in pairwise(edges)]

        def evaluate(part: slice, scratch: Scratch) -> None:
            block_residuals(self.batch, candidates[part], scratch, out[part], anchored[part])

        if others:
            with ThreadPoolExecutor(len(others)) as pool:
                waiting = [
                    pool.submit(evaluate, part, scratch_beside(self._work)) for part in others
                ]
                evaluate(first, self._work)
                for item in waiting:
                    item.result()
        else:
            evaluate(first, self._work)
        self.evaluations += count
        return out, anchored

    def costs(self, points: NDArray[np.float64], cap: float) -> NDArray[np.float64]:
        """See the protocol."""
        out = np.empty(len(points))
        block_costs(self.batch, self.unknowns.candidates(points), cap, self._work, out)
        self.evaluations += len(points)
        return out


def _scattered(unknowns: Unknowns) -> NDArray[np.float64]:
    """Points all over the space, shape (n, k): a lattice; 0 where a bound is infinite."""
    lower, upper = unknowns.lower, unknowns.upper
    bounded = np.isfinite(lower) & np.isfinite(upper)
    count = WIDTH if len(lower) <= WIDTH else LANES
    shares = np.linspace(0.0, 1.0, count)[:, None] * STEPS ** np.arange(len(lower)) % WRAP
    width = np.where(bounded, upper - lower, 0.0)
    return np.where(bounded, lower, 0.0) + shares * width


STEPS, WRAP = 7.0, 1.0 + 1e-9
"""Of the lattice: ratio of the shares of neighbouring coordinates; the upper bound is kept."""
