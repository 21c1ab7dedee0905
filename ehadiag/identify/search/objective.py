"""The objective that every solver minimises: capped squares of weighted gaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.scalar.residuals import Batch
from ehadiag.model.simd.residuals import lane_costs, lane_work

__all__ = ["SEARCH_CAP", "Objective"]

SEARCH_CAP = 25.0
"""Largest square of one weighted gap: a break-away that went the other way costs no more."""


class Objective:
    """Callable on a population; counts its evaluations.

    Candidates are rows (Kintas, FSS, FDJ), each 0 … 1; offsets of the sensors are held.
    """

    def __init__(
        self,
        batch: Batch,
        offsets: NDArray[np.float64] | None = None,
        cap: float = SEARCH_CAP,
    ) -> None:
        self.batch = batch
        self.cap = cap
        self.offsets = np.zeros(2) if offsets is None else offsets
        self.evaluations = 0
        self.work = lane_work(batch)

    def __call__(self, population: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of each row, shape (n,) for a population of shape (n, 3)."""
        rows = np.atleast_2d(np.asarray(population, dtype=np.float64))
        candidates = np.empty((len(rows), 5))
        candidates[:, :3] = rows
        candidates[:, 3:] = self.offsets
        out = np.empty(len(rows))
        lane_costs(self.batch, candidates, self.cap, self.work, out)
        self.evaluations += len(rows)
        return out
