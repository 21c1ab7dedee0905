"""A model made linear over the spread of what is believed, by regression on runs.

A derivative at a point sees no break-away that comes a tick earlier or later; the regression over
points as far apart as the parameters are uncertain sees their mean effect, and what it leaves over
tells how far each sample can be trusted (statistical linear regression: Lefebvre, Bruyninckx,
De Schutter, IEEE Trans. Automatic Control 47(8), 2002).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.derivatives import Derivatives

__all__ = ["Belief", "Cross", "Linearised", "crossed", "linearised", "pseudo_inverse"]

BLOCK = 16
"""Runs come in blocks of that size."""
REACH = np.sqrt(3.0)
"""Deviations of a belief from its mean to the points on a coordinate."""
LEAST_SINGULAR = 1e-6
"""Singular value, over the largest, below which a direction is not seen."""
ONE_SIDED = 0.25
"""Share of that distance to a bound from which the points lie on its other side."""


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Where the parameters are believed to be.

    Attributes
    ----------
    x : shape (k,)
        Mean, in units of the model's scales.
    root : shape (c, c)
        Root of the covariance of the coordinates that act through the model: root rootᵀ.
    """

    x: NDArray[np.float64]
    root: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Residuals as a linear function about a point.

    Attributes
    ----------
    x : shape (k,)
        Mean of the points that were run.
    residuals : shape (signals, N)
        Their mean.
    jacobian : shape (k, signals, N)
    scatter : shape (signals, N)
        Variance about the linear function.
    at : shape (k,)
        Mean of the belief itself.
    middle : shape (signals, N)
        Residuals there.
    """

    x: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    scatter: NDArray[np.float64]
    at: NDArray[np.float64]
    middle: NDArray[np.float64]


def linearised(model: Derivatives, belief: Belief, rng: np.random.Generator) -> Linearised:
    """Regress the residuals on points drawn about a belief.

    The points are the mean and as many as nearly fill whole blocks of runs, in pairs that mirror
    each other, along random orthogonal directions: their mean and covariance are nearly the
    belief's own.
    """
    curved, count = model.curved, len(model.curved)
    pairs = BLOCK // 2 * -(-(count + 1) // (BLOCK // 2)) - 1
    shares = _directions(rng, count, pairs)
    points = np.repeat(belief.x[None, :], 1 + 2 * pairs, axis=0)
    points[1:, curved] += np.vstack([shares, -shares]) @ belief.root.T
    points[:, curved] = _mirrored(points[:, curved], model.lower[curved], model.upper[curved])
    x = points.mean(axis=0)
    runs = model.many(points)
    shape, flat = runs.shape[1:], runs.reshape(len(runs), -1)
    # Offsets in units of the spread, so that the regression is well conditioned.
    inverse = np.linalg.inv(belief.root)
    offsets = (points - x)[:, curved] @ inverse.T
    basis, triangle = np.linalg.qr(np.column_stack([np.ones(len(points)), offsets]))
    along = basis.T @ flat
    left = np.einsum("ij,ij->j", flat, flat) - np.einsum("ij,ij->j", along, along)
    scatter = np.maximum(left, 0.0) / max(len(points) - 1 - count, 1)
    slopes = inverse.T @ pseudo_inverse(triangle[1:, 1:])
    jacobian = model.additive_slopes()
    jacobian[curved] = (slopes @ along[1:]).reshape(count, *shape)
    mean = (along[0] * basis[0, 0]).reshape(shape)
    return Linearised(x, mean, jacobian, scatter.reshape(shape), points[0], runs[0])


def pseudo_inverse(square: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pseudo-inverse of a square matrix.

    Random rotations give many equal singular values, with which the library's decomposition (divide
    and conquer) does not converge once in some thousand searches; that of the normal equations
    does.
    """
    try:
        return np.asarray(np.linalg.pinv(square, rcond=LEAST_SINGULAR))
    except np.linalg.LinAlgError:
        normal = square.T @ square
        return np.asarray(np.linalg.pinv(normal, LEAST_SINGULAR**2, hermitian=True) @ square.T)


def crossed(model: Derivatives, belief: Belief) -> Linearised:
    """Fit a line to the residuals along each coordinate through the mean of a belief.

    For few unknowns, which are told apart: a middle and two points on each coordinate. What a
    coordinate does not move at all has exactly no slope by it, which a regression on all points at
    once does not give. At a bound both points are on the same side.
    """
    cross = Cross.about(model, belief)
    return cross.lines(model, model.many(cross.points))


@dataclass(frozen=True, slots=True, eq=False)
class Cross:
    """Points of `crossed`: the mean of a belief, and two on each coordinate through it.

    Attributes
    ----------
    points : shape (1 + 2 c, k)
    offsets : shape (c, 3)
        Where on its coordinate the mean and its two points stand, from the mean.
    """

    points: NDArray[np.float64]
    offsets: NDArray[np.float64]

    @classmethod
    def about(cls, model: Derivatives, belief: Belief) -> Cross:
        """Lay the points, within the bounds of the model."""
        curved, count = model.curved, len(model.curved)
        reach = REACH * np.sqrt((belief.root**2).sum(axis=1))
        points = np.repeat(belief.x[None, :], 1 + 2 * count, axis=0)
        offsets = np.zeros((count, 3))
        for k, j in enumerate(curved):
            there, width = belief.x[j], reach[k]
            above, below = min(width, model.upper[j] - there), min(width, there - model.lower[j])
            if below < ONE_SIDED * width:
                below = -0.5 * above
            elif above < ONE_SIDED * width:
                above = -0.5 * below
            points[1 + 2 * k, j], points[2 + 2 * k, j] = there + above, there - below
            offsets[k, 1:] = above, -below
        return cls(points, offsets)

    def lines(self, model: Derivatives, runs: NDArray[np.float64]) -> Linearised:
        """Fit a line along each coordinate to residuals at the points."""
        count = len(model.curved)
        shape, flat = runs.shape[1:], runs.reshape(len(runs), -1)
        # By differences from the middle: what slopes, and, at unit length, what a line through the
        # three runs of a coordinate does not explain.
        shares = np.zeros((2 * count, len(runs) - 1))
        for k, offsets in enumerate(self.offsets):
            mine = slice(2 * k, 2 * k + 2)
            along = offsets - offsets.mean()
            across = np.array([along[1] - along[2], along[2] - along[0], along[0] - along[1]])
            shares[k, mine] = (along / (along @ along))[1:]
            shares[count + k, mine] = (across / np.sqrt(across @ across))[1:]
        differences = flat[1:] - flat[0]
        out = shares @ differences
        jacobian = model.additive_slopes()
        jacobian[model.curved] = out[:count].reshape(count, *shape)
        left = out[count:]
        scatter = np.einsum("ij,ij->j", left, left).reshape(shape) / count
        mean = (flat[0] + differences.sum(axis=0) / len(runs)).reshape(shape)
        middle = self.points.mean(axis=0)
        return Linearised(middle, mean, jacobian, scatter, self.points[0], runs[0])


def _directions(rng: np.random.Generator, count: int, pairs: int) -> NDArray[np.float64]:
    """Rows of random rotations, each as long as a standard normal vector, shape (pairs, count)."""
    turns = [
        np.linalg.qr(rng.standard_normal((count, count)))[0] for _ in range(-(-pairs // count))
    ]
    return np.asarray(np.vstack(turns)[:pairs] * np.sqrt(count))


def _mirrored(
    points: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points beyond a bound as far inside of it."""
    points = np.where(points < lower, 2.0 * lower - points, points)
    points = np.where(points > upper, 2.0 * upper - points, points)
    return np.clip(points, lower, upper)
