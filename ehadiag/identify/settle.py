"""The bottom of a cost that has steps: past what break-aways make of it.

A break-away that comes a tick earlier or later makes a step in the cost, on which a descent stops
wherever it comes from.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.gapmodel import CAP, FAULT_COUNT, GapModel, capped

__all__ = ["centre", "settle"]

SETTLINGS = 2
REACH = 2.0
"""Deviations to either side over which the bowl is looked at."""
POINTS = 9
FINE_POINTS = 33
LEAST_POINTS = 5
LONGEST_AXIS = 0.005
"""Fault constants; a constant that the test hardly shows is not followed further."""
WORSE = 4.0
"""Cost by which the bowl's vertex may lie above a chance minimum beside it."""
ROUGH = 3.0
"""Distance of the cost from a parabola from which it counts as jagged."""


def settle(
    model: GapModel, x: NDArray[np.float64], gaps: NDArray[np.float64], cost: float
) -> tuple[NDArray[np.float64], bool]:
    """Move to the vertex of the smooth bowl that the cost is, its small jumps apart.

    Parabolas through the cost over some deviations, along the axes of the uncertainty, see past
    its steps. `x` are fault constants and offsets in units of noise, shape (5,), `gaps` and `cost`
    those at x. Returns the vertex, and whether the cost is a smooth bowl about it.
    """
    smooth_bowl = True
    for _ in range(SETTLINGS):
        best = x.copy()
        for direction in _axes(model, x, gaps):
            best, rough = _vertex(model, best, direction)
            smooth_bowl &= rough < ROUGH
        moved_gaps = model.gaps(best)
        moved_cost = capped(moved_gaps)
        if moved_cost > cost + WORSE:
            break
        x, gaps, cost = best, moved_gaps, moved_cost
    return x, smooth_bowl


def centre(model: GapModel, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the likelihood along the longest axis of the uncertainty, steps and all."""
    gaps = model.gaps(x)
    cost = capped(gaps)
    axes = _axes(model, x, gaps)
    if not axes:
        return x
    shares = np.linspace(-REACH, REACH, FINE_POINTS)
    points = x + shares[:, None] * axes[0]
    inside = np.all((points[:, :FAULT_COUNT] >= 0.0) & (points[:, :FAULT_COUNT] <= 1.0), axis=1)
    values = np.array([capped(model.gaps(point)) for point in points[inside]])
    weight = np.exp(-0.5 * (values - values.min()))
    middle = x + float(shares[inside] @ weight / weight.sum()) * axes[0]
    return middle if capped(model.gaps(middle)) < cost + WORSE else x


def _axes(
    model: GapModel, x: NDArray[np.float64], gaps: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Axes of the uncertainty of the constants inside their bounds, the longest first.

    Each is one deviation long, shape (5,).
    """
    jacobian, smooth = model.jacobian(x, gaps)
    rows = jacobian[:, smooth & (gaps**2 < CAP)]
    free = (x[:FAULT_COUNT] > 0.0) & (x[:FAULT_COUNT] < 1.0)
    kept = np.concatenate([free, np.ones(len(x) - FAULT_COUNT, dtype=np.bool_)])
    spread = np.linalg.pinv((rows @ rows.T)[np.ix_(kept, kept)], hermitian=True)
    count = int(free.sum())
    variances, axes = np.linalg.eigh(spread[:count, :count])
    out = []
    for variance, axis in zip(variances[::-1], axes.T[::-1], strict=True):
        direction = np.zeros(len(x))
        direction[:FAULT_COUNT][free] = axis * min(np.sqrt(max(variance, 0.0)), LONGEST_AXIS)
        out.append(direction)
    return out


def _vertex(
    model: GapModel, x: NDArray[np.float64], direction: NDArray[np.float64]
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
    values = np.array([capped(model.gaps(point)) for point in points[inside]])
    fit = np.polyfit(shares, values, 2)
    rough = float(np.abs(values - np.polyval(fit, shares)).max())
    bent, slope, _ = fit
    share = shares[np.argmin(values)] if bent <= 0.0 else -0.5 * slope / bent
    return x + float(np.clip(share, shares[0], shares[-1])) * direction, rough
