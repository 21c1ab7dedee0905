"""Gaps of a candidate, their derivatives and their capped sum of squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch, Workspace, residuals, spool_rates, workspace

__all__ = ["CAP", "FAULT_COUNT", "STEP", "GapModel", "capped"]

CAP = 9.0
"""Largest square of one weighted gap that counts."""
FAULT_COUNT = 3
STEP = 5e-5
"""Half-width of the differences, fault constants."""
WIDE_STEP = 2e-4
AGREEMENT = 0.2
"""Share by which derivatives over two widths may differ (beside the typical derivative)."""
KINK = 0.3
"""Two-sided differences that disagree by more (in units of noise) mark a break-away."""


class GapModel:
    """Gaps of a candidate; counts evaluations."""

    def __init__(self, batch: Batch, noise: tuple[float, float]) -> None:
        self.batch = batch
        self.work: Workspace = workspace(batch)
        self.evaluations = 0
        self.anchored = 0
        self.scale = np.array([1.0, 1.0, 1.0, *noise])

    def gaps(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted gaps at x (fault constants, offsets in units of noise), shape (2, N)."""
        out = np.empty((2, len(self.batch.current)))
        self.anchored = residuals(self.batch, x * self.scale, self.work, out)
        self.evaluations += 1
        return out

    def spool_rate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted velocity of the spool at the end of each tick, 1/s, shape (N,)."""
        out = np.empty(len(self.batch.current))
        spool_rates(self.batch, x * self.scale, self.work, out)
        return out * self.batch.weight[0]

    def jacobian(
        self, x: NDArray[np.float64], gaps: NDArray[np.float64], width: float = STEP
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Derivatives, shape (5, 2, N), and the rows whose derivatives hold, shape (2, N)."""
        out = np.zeros((len(x), *gaps.shape))
        smooth = np.ones(gaps.shape, dtype=np.bool_)
        for j in range(FAULT_COUNT):
            above, below = x.copy(), x.copy()
            above[j] = x[j] + width if x[j] + width <= 1.0 else x[j] - 2.0 * width
            below[j] = x[j] - width if x[j] - width >= 0.0 else x[j] + 2.0 * width
            high, low = self.gaps(above), self.gaps(below)
            out[j] = (high - low) / (above[j] - below[j])
            straight = low + out[j] * (x[j] - below[j])
            smooth &= np.abs(gaps - straight) < KINK
        out[3, 0] = -self.batch.weight[0] * self.scale[3]
        out[4, 1] = -self.batch.weight[1] * self.scale[4]
        return out, smooth

    def trusted_jacobian(
        self, x: NDArray[np.float64], gaps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Derivatives, shape (5, 2, N), and the rows where two widths of difference agree on them.

        A break-away inside a difference makes a jump that looks like information but is none.
        """
        jacobian, smooth = self.jacobian(x, gaps)
        wide, wide_smooth = self.jacobian(x, gaps, WIDE_STEP)
        typical = np.sqrt(np.mean(wide**2, axis=(1, 2), keepdims=True))
        allowed = AGREEMENT * np.maximum(np.abs(jacobian), np.abs(wide)) + typical
        agree = np.all(np.abs(jacobian - wide) <= allowed, axis=0)
        return jacobian, smooth & wide_smooth & agree


def capped(gaps: NDArray[np.float64]) -> float:
    """Sum of squares of weighted gaps, each at most `CAP`."""
    return float(np.minimum(gaps**2, CAP).sum())
