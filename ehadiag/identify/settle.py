"""The bottom of a cost that has steps: past what break-aways make of it.

A break-away that comes a tick earlier or later makes a step in the cost, on which a descent stops
wherever it comes from.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.gapmodel import FAULT_COUNT, GapModel, Slope

__all__ = ["centre", "settle"]

SETTLINGS = 2
REACH = 2.0
"""Deviations to either side over which the bowl is looked at."""
POINTS = 11
FINE_POINTS = 33
LEAST_POINTS = 5
LONGEST_AXIS = 0.005
"""Fault constants; a constant that the test hardly shows is not followed further."""
WORSE = 4.0
"""Cost by which the bowl's vertex may lie above a chance minimum beside it."""
ROUGH = 3.0
"""Distance of the cost from a parabola from which it counts as jagged."""


def settle(model: GapModel, slope: Slope) -> tuple[NDArray[np.float64], bool]:
    """Move to the vertex of the smooth bowl that the cost is, its small jumps apart.

    Parabolas through the cost over some deviations, along the axes of the uncertainty, see past
    its steps. Returns the vertex, shape (5,), and whether the cost is a smooth bowl about it.
    """
    x, cost = slope.x, slope.cost
    axes = _axes(slope)
    smooth_bowl = True
    for _ in range(SETTLINGS):
        moved, rough = _vertex(model, x, cost, axes)
        smooth_bowl &= rough < ROUGH
        if smooth_bowl:
            return moved, True
        slope = model.slopes([moved])[0]
        if slope.cost > cost + WORSE:
            break
        x, cost, axes = moved, slope.cost, _axes(slope)
    return x, smooth_bowl


def centre(model: GapModel, slope: Slope) -> NDArray[np.float64]:
    """Mean of the likelihood along the longest axis of the uncertainty, steps and all."""
    axes = _axes(slope)
    x = slope.x
    if not axes:
        return x
    shares = np.linspace(-REACH, REACH, FINE_POINTS)
    points = x + shares[:, None] * axes[0]
    inside = _inside(points)
    values = model.costs(points[inside])
    weight = np.exp(-0.5 * (values - values.min()))
    middle = x + float(shares[inside] @ weight / weight.sum()) * axes[0]
    return middle if float(model.costs(middle[None, :])[0]) < slope.cost + WORSE else x


def _inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Points whose fault constants are 0 … 1."""
    faults = points[:, :FAULT_COUNT]
    return np.asarray(np.all((faults >= 0.0) & (faults <= 1.0), axis=1))


def _axes(slope: Slope) -> list[NDArray[np.float64]]:
    """Axes of the uncertainty of the constants inside their bounds, the longest first.

    Each is one deviation long, shape (5,).
    """
    x = slope.x
    rows = slope.jacobian[:, slope.used]
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
    model: GapModel, x: NDArray[np.float64], cost: float, axes: list[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], float]:
    """Minimum of the parabolas through the cost along all axes, which are conjugate.

    Returns that point, and how far the cost is from a parabola at most.
    """
    shares = np.linspace(-REACH, REACH, POINTS)
    aside = shares[shares != 0.0]
    lines = [x + aside[:, None] * axis for axis in axes]
    kept = [_inside(points) for points in lines]
    wanted = [points[inside] for points, inside in zip(lines, kept, strict=True)]
    if not wanted:
        return x, 0.0
    values = np.split(model.costs(np.vstack(wanted)), np.cumsum([len(w) for w in wanted])[:-1])
    out, roughest = x.copy(), 0.0
    for axis, inside, measured in zip(axes, kept, values, strict=True):
        if len(measured) + 1 < LEAST_POINTS:
            continue
        at = np.append(aside[inside], 0.0)
        costs = np.append(measured, cost)
        fit = np.polyfit(at, costs, 2)
        roughest = max(roughest, float(np.abs(costs - np.polyval(fit, at)).max()))
        bent, slope, _ = fit
        share = at[np.argmin(costs)] if bent <= 0.0 else -0.5 * slope / bent
        out += float(np.clip(share, at.min(), at.max())) * axis
    out[:FAULT_COUNT] = np.clip(out[:FAULT_COUNT], 0.0, 1.0)
    return out, roughest
