"""Deterministic refinement: robust least squares on all of the test, and what it leaves.

Damped Gauss-Newton on the weighted gaps of spool and pressure, the model re-anchored on the
measured spool. Gaps beyond three times the noise are left out of a step (their square is capped),
and so are rows whose two-sided differences disagree: there a break-away goes one way on one side
and the other way on the other. Constant offsets of both sensors are estimated beside the faults;
being constant they are told apart from the faults, which act alike in both directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.batch import Batch, Workspace, residuals, spool_rates, workspace

__all__ = ["CAP", "Refinement", "describe", "median_offsets", "refine"]

CAP = 9.0
STEP = 5e-5
"""Half-width of the differences, fault constants."""
WIDE_STEP = 2e-4
AGREEMENT = 0.2
"""Share by which derivatives over two widths may differ (beside the typical derivative)."""
KINK = 0.3
"""Two-sided differences that disagree by more (in units of noise) mark a break-away."""
SETTLINGS = 2
REACH = 2.0
"""Deviations to either side over which the bowl is looked at."""
POINTS = 9
LEAST_POINTS = 5
LONGEST_AXIS = 0.005
"""Fault constants; a constant that the test hardly shows is not followed further."""
WORSE = 4.0
"""Cost by which the bowl's vertex may lie above a chance minimum beside it."""
ROUGH = 3.0
"""Distance of the cost from a parabola from which it counts as jagged."""
ITERATIONS = 20
CONVERGED = 1e-6
FAULT_COUNT = 3


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Optimum of the robust least squares.

    Attributes
    ----------
    values: Kintas, FSS, FDJ, shape (3,).
    offsets: spool (m) and pressure (Pa), shape (2,).
    cost: capped sum of squares there.
    gaps: weighted gaps there, shape (2, N), 0 where no sample.
    jacobian: derivative of the gaps by the fault constants and, scaled by the noise, by the
        offsets; 0 in rows left out; shape (5, 2, N).
    spool_rate: velocity of the modelled spool at the end of each tick, weighted like its gap, 1/s,
        shape (N,).
    used: rows that took part, shape (2, N).
    weighted: rows that have a sample, shape (2, N).
    evaluations: runs of the model.
    converged: whether the last step was below 1e-6.
    jagged: break-aways make steps in the cost about the optimum: a descent may stop beside it.
    anchored: how often the model was re-anchored at the optimum.
    """

    values: NDArray[np.float64]
    offsets: NDArray[np.float64]
    cost: float
    gaps: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    spool_rate: NDArray[np.float64]
    used: NDArray[np.bool_]
    weighted: NDArray[np.bool_]
    evaluations: int
    converged: bool
    jagged: bool
    anchored: int


class _Model:
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


def refine(
    batch: Batch,
    start: NDArray[np.float64],
    offsets: NDArray[np.float64],
    noise: tuple[float, float],
) -> Refinement:
    """Minimise the capped sum of squares.

    Parameters
    ----------
    start: fault constants, shape (3,).
    offsets: of spool (m) and pressure (Pa) at the start, shape (2,).
    noise: that of spool (m) and pressure (Pa), the unit in which offsets are sought.
    """
    model = _Model(batch, noise)
    x = np.concatenate([np.clip(start, 0.0, 1.0), offsets / np.array(noise)])
    gaps = model.gaps(x)
    cost = _capped(gaps)
    damping = 1e-5
    converged = False
    for _ in range(ITERATIONS):
        jacobian, smooth = model.jacobian(x, gaps)
        used = smooth & (gaps**2 < CAP)
        rows = jacobian[:, used]
        normal, gradient = rows @ rows.T, rows @ gaps[used]
        free = ~((x == 0.0) & (gradient > 0.0) | (x == 1.0) & (gradient < 0.0))
        free[FAULT_COUNT:] = True
        moved = False
        for _ in range(8):
            step = np.zeros(len(x))
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
            step[free] = -np.linalg.solve(damped[np.ix_(free, free)], gradient[free])
            trial = x + step
            trial[:FAULT_COUNT] = np.clip(trial[:FAULT_COUNT], 0.0, 1.0)
            trial_gaps = model.gaps(trial)
            trial_cost = _capped(trial_gaps)
            if trial_cost <= cost:
                moved = True
                break
            damping = max(damping * 10.0, 1e-6)
        if not moved:
            # No step improves: the optimum, to within the jumps that break-aways make.
            converged = bool(np.abs(step[:FAULT_COUNT]).max() < STEP)
            break
        size = float(np.abs(trial - x)[:FAULT_COUNT].max())
        x, gaps, cost = trial, trial_gaps, trial_cost
        damping = max(damping / 10.0, 1e-9)
        if size < CONVERGED:
            converged = True
            break
    x, smooth_bowl = _settle(model, x, gaps, cost)
    return _described(model, x, converged=converged, jagged=not smooth_bowl)


def describe(
    batch: Batch,
    values: NDArray[np.float64],
    offsets: NDArray[np.float64],
    noise: tuple[float, float],
) -> Refinement:
    """What `refine` returns, for a point that something else has found."""
    model = _Model(batch, noise)
    x = np.concatenate([values, offsets / np.array(noise)])
    return _described(model, x, converged=True, jagged=True)


def _described(
    model: _Model, x: NDArray[np.float64], *, converged: bool, jagged: bool
) -> Refinement:
    gaps = model.gaps(x)
    anchored = model.anchored
    weighted = model.batch.weight > 0.0
    jacobian, steady = _trusted_jacobian(model, x, gaps)
    used = steady & (gaps**2 < CAP) & weighted
    jacobian[:, ~used] = 0.0
    return Refinement(
        values=x[:FAULT_COUNT],
        offsets=x[FAULT_COUNT:] * model.scale[FAULT_COUNT:],
        cost=_capped(gaps),
        gaps=gaps,
        jacobian=jacobian,
        spool_rate=model.spool_rate(x),
        used=used,
        weighted=weighted,
        evaluations=model.evaluations,
        converged=converged,
        jagged=jagged,
        anchored=anchored,
    )


def _trusted_jacobian(
    model: _Model, x: NDArray[np.float64], gaps: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Derivatives, shape (5, 2, N), and the rows where two widths of difference agree on them.

    Where a break-away falls into a difference its jump looks like information that is not there.
    """
    jacobian, smooth = model.jacobian(x, gaps)
    wide, wide_smooth = model.jacobian(x, gaps, WIDE_STEP)
    typical = np.sqrt(np.mean(wide**2, axis=(1, 2), keepdims=True))
    allowed = AGREEMENT * np.maximum(np.abs(jacobian), np.abs(wide)) + typical
    agree = np.all(np.abs(jacobian - wide) <= allowed, axis=0)
    return jacobian, smooth & wide_smooth & agree


def _settle(
    model: _Model, x: NDArray[np.float64], gaps: NDArray[np.float64], cost: float
) -> tuple[NDArray[np.float64], bool]:
    """Move to the vertex of the smooth bowl that the cost is, its small jumps apart.

    Break-aways that come a tick earlier or later make steps in the cost, on which a descent stops
    wherever it comes from. Parabolas through the cost over some deviations, along the axes of the
    uncertainty, see past them. Returns the vertex, and whether the cost is a smooth bowl about it.
    """
    smooth_bowl = True
    for _ in range(SETTLINGS):
        jacobian, smooth = model.jacobian(x, gaps)
        used = smooth & (gaps**2 < CAP)
        rows = jacobian[:, used]
        free = (x[:FAULT_COUNT] > 0.0) & (x[:FAULT_COUNT] < 1.0)
        kept = np.concatenate([free, np.ones(len(x) - FAULT_COUNT, dtype=np.bool_)])
        spread = np.linalg.pinv((rows @ rows.T)[np.ix_(kept, kept)], hermitian=True)
        count = int(free.sum())
        if count == 0:
            break
        variances, axes = np.linalg.eigh(spread[:count, :count])
        best = x.copy()
        for variance, axis in zip(variances[::-1], axes.T[::-1], strict=True):
            length = min(float(np.sqrt(max(variance, 0.0))), LONGEST_AXIS)
            direction = np.zeros(len(x))
            direction[:FAULT_COUNT][free] = axis * length
            best, rough = _vertex(model, best, direction)
            smooth_bowl &= rough < ROUGH
        moved_gaps = model.gaps(best)
        moved_cost = _capped(moved_gaps)
        if moved_cost > cost + WORSE:
            break
        x, gaps, cost = best, moved_gaps, moved_cost
    return x, smooth_bowl


def _vertex(
    model: _Model, x: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Minimum of the parabola through the cost at points along a direction.

    Returns that point, and how far the cost is from the parabola at most.
    """
    shares = np.linspace(-REACH, REACH, POINTS)
    points = x + shares[:, None] * direction
    inside = np.all((points[:, :FAULT_COUNT] >= 0.0) & (points[:, :FAULT_COUNT] <= 1.0), axis=1)
    if inside.sum() < LEAST_POINTS:
        return x, 0.0
    shares = shares[inside]
    values = np.array([_capped(model.gaps(point)) for point in points[inside]])
    fit = np.polyfit(shares, values, 2)
    rough = float(np.abs(values - np.polyval(fit, shares)).max())
    bent, slope, _ = fit
    share = shares[np.argmin(values)] if bent <= 0.0 else -0.5 * slope / bent
    return x + float(np.clip(share, shares[0], shares[-1])) * direction, rough


def median_offsets(batch: Batch, faults: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median gap of spool (m) and pressure (Pa), shape (2,), at fault constants of shape (3,).

    For a batch that runs free: re-anchoring would take most of an offset away.
    """
    gaps = np.empty((2, len(batch.current)))
    residuals(batch, np.concatenate([faults, [0.0, 0.0]]), workspace(batch), gaps)
    out = np.zeros(2)
    for channel in range(2):
        weight = batch.weight[channel]
        used = weight > 0.0
        if used.any():
            out[channel] = float(np.median(gaps[channel, used] / weight[used]))
    return out


def _capped(gaps: NDArray[np.float64]) -> float:
    return float(np.minimum(gaps**2, CAP).sum())
