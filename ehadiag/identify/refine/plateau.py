"""Minimum of a cost with jumps from stick-slip: the vertex of the smooth bowl beneath them.

A break-away that comes a tick earlier or later makes a step in the cost, and a descent stops at it,
wherever it comes from. Parabolas through many points see past the steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.derivatives import Derivatives, Slope, capped

__all__ = ["Bowl", "centre", "vertex"]

SETTLINGS = 2
REACH = 2.0
"""Deviations to either side over which the bowl is looked at."""
SHARES = np.delete(np.linspace(-REACH, REACH, 9), 4)
"""Points beside the middle of an axis, deviations: with the wide differences two blocks of runs."""
LEAST_TRUSTED = 0.25
"""Share of information in rows whose derivatives hold, below which the cost counts as jagged."""
FINE_SHARES = np.delete(np.linspace(-REACH, REACH, 33), 16)
"""Points beside the middle of the longest axis, deviations: two blocks of runs."""
LEAST_POINTS = 5
LONGEST_AXIS = 0.005
"""Scaled; a coordinate that the test hardly shows is not followed further."""
MIDDLE_WORSE = 1.0
"""Cost by which the middle of a plateau may lie above its best point: further up there is a step
between two basins."""
WORSE = 4.0
"""Cost by which the bowl's vertex may lie above a chance minimum beside it."""
NEAR = 1e-4
"""Scaled coordinates over which derivatives do not change."""
FAR = 1.0
"""Deviations by which a descent may miss the vertex; steps must have held it up if it is more."""
ROUGH = 3.0
"""Distance of the cost from a parabola from which it counts as jagged."""


@dataclass(frozen=True, slots=True, eq=False)
class Bowl:
    """Where the cost's smooth bowl has its vertex.

    x: the vertex, shape (k,).
    smooth: whether the cost is a smooth bowl about it.
    slope: near the vertex, with the rows that can be trusted.
    """

    x: NDArray[np.float64]
    smooth: bool
    slope: Slope


def vertex(model: Derivatives, slope: Slope) -> Bowl:
    """Move to the vertex of the smooth bowl that the cost is, its small jumps apart.

    Parabolas through the cost over some deviations, along the axes of the uncertainty, see past
    its steps.
    """
    smooth = True
    for _ in range(SETTLINGS):
        axes = _axes(model, slope)
        lines = [_line(model, slope.x, axis, SHARES) for axis in axes]
        sides = model.wide_sides(slope.x)
        runs = model.many(np.vstack([sides, *(points for _, points in lines)]))
        trusted = model.trusted(slope, runs[: len(sides)])
        costs = [capped(run) for run in runs[len(sides) :]]
        smooth &= _trusted_share(model, slope, trusted) > LEAST_TRUSTED
        x, far = slope.x.copy(), 0.0
        for axis, (shares, _) in zip(axes, lines, strict=True):
            share, rough = _vertex(
                np.append(shares, 0.0), np.append(costs[: len(shares)], slope.cost)
            )
            costs = costs[len(shares) :]
            smooth &= rough < ROUGH
            x += share * axis
            far = max(far, abs(share))
        if not smooth:
            return Bowl(slope.x, False, trusted)
        x = np.clip(x, model.lower, model.upper)
        if far < FAR and np.abs(x - slope.x)[model.curved].max() < NEAR:
            return Bowl(x, True, trusted)
        moved = model.slopes([x])[0]
        if moved.cost > slope.cost + WORSE:
            return Bowl(slope.x, False, trusted)
        slope = moved
    return Bowl(slope.x, far < FAR, model.trusted(slope))


def centre(model: Derivatives, slope: Slope) -> NDArray[np.float64]:
    """Mean of the likelihood along the longest axis of the uncertainty, steps and all."""
    axes = _axes(model, slope)
    x = slope.x
    if not axes:
        return x
    shares, points = _line(model, x, axes[0], FINE_SHARES)
    values = np.append([capped(run) for run in model.many(points)], slope.cost)
    weight = np.exp(-0.5 * (values - values.min()))
    middle = x + float(np.append(shares, 0.0) @ weight / weight.sum()) * axes[0]
    return middle if capped(model.many(middle[None, :])[0]) < slope.cost + MIDDLE_WORSE else x


def _axes(model: Derivatives, slope: Slope) -> list[NDArray[np.float64]]:
    """Axes of the uncertainty of the coordinates that act through the model, the longest first.

    Coordinates at a bound are left out. Each axis is one deviation long, shape (k,).
    """
    x, curved = slope.x, model.curved
    rows = slope.jacobian[:, slope.used]
    inside = (x > model.lower) & (x < model.upper)
    kept = np.flatnonzero(inside)
    spread = np.linalg.pinv((rows @ rows.T)[np.ix_(kept, kept)], hermitian=True)
    free = np.isin(kept, curved)
    variances, axes = np.linalg.eigh(spread[np.ix_(free, free)])
    out = []
    for variance, axis in zip(variances[::-1], axes.T[::-1], strict=True):
        direction = np.zeros(len(x))
        direction[kept[free]] = axis * min(np.sqrt(max(variance, 0.0)), LONGEST_AXIS)
        out.append(direction)
    return out


def _line(
    model: Derivatives,
    x: NDArray[np.float64],
    axis: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shares of an axis that lead from x to points within the bounds, and these, shape (n, k)."""
    points = x + shares[:, None] * axis
    inside = np.all((points >= model.lower) & (points <= model.upper), axis=1)
    return shares[inside], points[inside]


def _trusted_share(model: Derivatives, slope: Slope, trusted: Slope) -> float:
    """Least share of a constant's information that rows keep which can be trusted.

    Where break-aways make most of it, a narrow basin among many looks smooth and well known.
    """
    most = (slope.jacobian[model.curved][:, slope.used] ** 2).sum(axis=1)
    kept = (slope.jacobian[model.curved][:, trusted.used] ** 2).sum(axis=1)
    return float((kept[most > 0.0] / most[most > 0.0]).min(initial=1.0))


def _vertex(shares: NDArray[np.float64], costs: NDArray[np.float64]) -> tuple[float, float]:
    """Where the parabola through the costs has its minimum, and how far they are from it at most.

    `shares`, `costs`: shape (n,), the last of them where the search stands.
    """
    if len(shares) < LEAST_POINTS:
        return 0.0, 0.0
    fit = np.polyfit(shares, costs, 2)
    rough = float(np.abs(costs - np.polyval(fit, shares)).max())
    bent, slope, _ = fit
    share = shares[np.argmin(costs)] if bent <= 0.0 else -0.5 * slope / bent
    return float(np.clip(share, shares.min(), shares.max())), rough
