"""Gaps of candidates, their derivatives and their capped sum of squares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.scalar.residuals import Batch, Workspace, residuals, spool_rates, workspace
from ehadiag.model.simd.residuals import LaneWork, lane_work
from ehadiag.model.simd.threads import residuals_on_cores

__all__ = ["CAP", "FAULT_COUNT", "STEP", "GapModel", "Slope", "capped", "wide_sides"]

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


@dataclass(frozen=True, slots=True, eq=False)
class Slope:
    """Gaps at a point and how they change about it.

    Attributes
    ----------
    x: fault constants, and offsets in units of noise, shape (5,).
    gaps: weighted gaps there, shape (2, N).
    cost: their capped sum of squares.
    jacobian: derivatives of the gaps, shape (5, 2, N).
    smooth: rows whose derivatives hold, shape (2, N).
    """

    x: NDArray[np.float64]
    gaps: NDArray[np.float64]
    cost: float
    jacobian: NDArray[np.float64]
    smooth: NDArray[np.bool_]

    @property
    def used(self) -> NDArray[np.bool_]:
        """Rows that a step goes by, shape (2, N)."""
        return self.smooth & (self.gaps**2 < CAP)


class GapModel:
    """Gaps of candidates; counts evaluations."""

    def __init__(self, batch: Batch, noise: tuple[float, float]) -> None:
        self.batch = batch
        self.work: LaneWork = lane_work(batch)
        self.single: Workspace = workspace(batch)
        self.evaluations = 0
        self.scale = np.array([1.0, 1.0, 1.0, *noise])

    def many(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted gaps of points, shape (n, 2, N) for points of shape (n, 5)."""
        out = np.empty((len(points), 2, len(self.batch.current)))
        anchored = np.empty(len(points), dtype=np.int64)
        residuals_on_cores(self.batch, points * self.scale, self.work, out, anchored)
        self.evaluations += len(points)
        return out

    def one(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Weighted gaps at x, shape (2, N), and how often the model was re-anchored."""
        out = np.empty((2, len(self.batch.current)))
        anchored = residuals(self.batch, x * self.scale, self.single, out)
        self.evaluations += 1
        return out, anchored

    def spool_rate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weighted velocity of the spool at the end of each tick, 1/s, shape (N,)."""
        out = np.empty(len(self.batch.current))
        spool_rates(self.batch, x * self.scale, self.single, out)
        return out * self.batch.weight[0]

    def slopes(self, centres: list[NDArray[np.float64]]) -> list[Slope]:
        """Gaps and derivatives at several points, all runs of the model together."""
        sides = [_sides(x, STEP) for x in centres]
        points = np.vstack(
            [np.vstack([x[None, :], at]) for x, at in zip(centres, sides, strict=True)]
        )
        runs = self.many(points).reshape(len(centres), 1 + 2 * FAULT_COUNT, 2, -1)
        out = []
        for x, at, gaps in zip(centres, sides, runs, strict=True):
            jacobian, smooth = self._differences(x, gaps[0], at, gaps[1:])
            out.append(Slope(x, gaps[0], capped(gaps[0]), jacobian, smooth))
        return out

    def trusted_slope(self, x: NDArray[np.float64]) -> Slope:
        """Gaps and derivatives at a point, rows left out as by `trusted`; in one block of runs."""
        at = _sides(x, STEP)
        runs = self.many(np.vstack([x[None, :], at, wide_sides(x)]))
        jacobian, smooth = self._differences(x, runs[0], at, runs[1 : 1 + len(at)])
        slope = Slope(x, runs[0], capped(runs[0]), jacobian, smooth)
        return self.trusted(slope, runs[1 + len(at) :])

    def trusted(self, slope: Slope, runs: NDArray[np.float64] | None = None) -> Slope:
        """Leave rows out where derivatives over a wider difference disagree.

        A break-away inside a difference makes a jump that looks like information but is none.
        `runs`: gaps at `wide_sides` of the slope's point, shape (6, 2, N), if they are known.
        """
        sides = wide_sides(slope.x)
        if runs is None:
            runs = self.many(sides)
        wide, wide_smooth = self._differences(slope.x, slope.gaps, sides, runs)
        typical = np.sqrt(np.mean(wide**2, axis=(1, 2), keepdims=True))
        allowed = AGREEMENT * np.maximum(np.abs(slope.jacobian), np.abs(wide)) + typical
        agree = np.all(np.abs(slope.jacobian - wide) <= allowed, axis=0)
        return replace(slope, smooth=slope.smooth & wide_smooth & agree)

    def _differences(
        self,
        x: NDArray[np.float64],
        gaps: NDArray[np.float64],
        sides: NDArray[np.float64],
        runs: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Derivatives from runs on both sides, and the rows where these agree with the middle."""
        out = np.zeros((len(x), *gaps.shape))
        smooth = np.ones(gaps.shape, dtype=np.bool_)
        for j in range(FAULT_COUNT):
            above, below = sides[2 * j, j], sides[2 * j + 1, j]
            high, low = runs[2 * j], runs[2 * j + 1]
            out[j] = (high - low) / (above - below)
            straight = low + out[j] * (x[j] - below)
            smooth &= np.abs(gaps - straight) < KINK
        out[3, 0] = -self.batch.weight[0] * self.scale[3]
        out[4, 1] = -self.batch.weight[1] * self.scale[4]
        return out, smooth


def wide_sides(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points about x for derivatives over a wider difference, shape (6, 5)."""
    return _sides(x, WIDE_STEP)


def _sides(x: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Points above and below x in each fault constant, within 0 … 1, shape (6, 5)."""
    out = np.repeat(x[None, :], 2 * FAULT_COUNT, axis=0)
    for j in range(FAULT_COUNT):
        out[2 * j, j] = x[j] + width if x[j] + width <= 1.0 else x[j] - 2.0 * width
        out[2 * j + 1, j] = x[j] - width if x[j] - width >= 0.0 else x[j] + 2.0 * width
    return out


def capped(gaps: NDArray[np.float64]) -> float:
    """Sum of squares of weighted gaps, each at most `CAP`."""
    return float(np.minimum(gaps**2, CAP).sum())
