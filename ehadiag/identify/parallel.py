"""Evaluates a population on several processors: one thread and one `LaneWork` each."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch
from ehadiag.identify.lanes import LaneWork, lane_costs, lane_residuals, lane_work
from ehadiag.model.lanelayout import LANES

__all__ = ["ParallelLanes"]


class ParallelLanes:
    """Costs and gaps of candidates of one batch, the same digits with any number of threads.

    A context manager: threads end with it.

    Parameters
    ----------
    threads: how many; 1 evaluates in the caller's own.
    """

    def __init__(self, batch: Batch, threads: int) -> None:
        self._batch = batch
        first = lane_work(batch)
        self._works = [first] + [_like(first) for _ in range(threads - 1)]
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def costs(self, candidates: NDArray[np.float64], cap: float) -> NDArray[np.float64]:
        """As `ehadiag.identify.lanes.lane_costs`: shape (n,) of candidates of shape (n, 5)."""
        out = np.empty(len(candidates))

        def share(part: slice, work: LaneWork) -> None:
            lane_costs(self._batch, candidates[part], cap, work, out[part])

        self._share(len(candidates), share)
        return out

    def residuals(
        self, candidates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """As `ehadiag.identify.lanes.lane_residuals`: gaps (n, 2, N), re-anchorings (n,)."""
        out = np.empty((len(candidates), 2, len(self._batch.current)))
        anchored = np.empty(len(candidates), dtype=np.int64)

        def share(part: slice, work: LaneWork) -> None:
            lane_residuals(self._batch, candidates[part], work, out[part], anchored[part])

        self._share(len(candidates), share)
        return out, anchored

    def _share(self, count: int, evaluate: Callable[[slice, LaneWork], None]) -> None:
        """Whole blocks to each thread, the caller's among them."""
        blocks = -(-count // LANES)
        threads = min(len(self._works), blocks)
        edges = [min(count, blocks * i // threads * LANES) for i in range(threads + 1)]
        parts = [slice(a, b) for a, b in pairwise(edges)]
        waiting = []
        if self._pool is not None:
            for part, work in zip(parts[1:], self._works[1:threads], strict=True):
                waiting.append(self._pool.submit(evaluate, part, work))
        if parts:
            evaluate(parts[0], self._works[0])
        for item in waiting:
            item.result()


def _like(work: LaneWork) -> LaneWork:
    """Scratch of another thread, with the same steps of the jack."""
    return work._replace(
        state=work.state.copy(),
        path=work.path.copy(),
        coefficients=work.coefficients.copy(),
        moving=work.moving.copy(),
        stuck=work.stuck.copy(),
        rows=work.rows.copy(),
        sums=work.sums.copy(),
        gaps=work.gaps.copy(),
    )
