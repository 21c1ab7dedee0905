"""What is believed of a severity's law of wear: from the fleet's lives, then its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ehadiag.prognosis.lives import Increments
from ehadiag.prognosis.wear import Law, Process

__all__ = ["Belief", "Posterior", "learnt", "posterior", "starting_belief"]

TYPICAL = Law(power=1.0, rate=0.3, variety=0.3, spread=0.15, feedback=1.0)
DOUBT = (0.35, 1.5, 0.5, 1.2, 1.5)
"""Standard deviations of the logarithms of `TYPICAL`: nobody has told anything yet."""
STEP = 1e-3
"""Of the second differences, in the logarithms."""
WIDER = 1.2
"""Proposals are so much wider than the curvature at the top says."""
FREEDOM = 5
"""Degrees of freedom of the proposals, a t density."""


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Normal density of the logarithms of a law."""

    mean: NDArray[np.float64]
    """Shape (5,), in the order of `Law`."""
    covariance: NDArray[np.float64]
    """Shape (5, 5)."""
    scale: float
    """Age at which the clock stands at 1."""
    evidence: float = 0.0
    """Log density of all that it was learnt from."""


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Draws of laws with their weights, and how well the process explains what was seen."""

    laws: tuple[Law, ...]
    weights: NDArray[np.float64]
    """Sum 1, shape (laws,)."""
    evidence: float
    """Log density of the increments, laws integrated out."""
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]


def starting_belief(scale: float) -> Belief:
    """Return what is believed without a fleet: within a factor of some, of all wear.

    Parameters
    ----------
    scale : float
        Age at which the clock stands at 1, hours or cycles.

    Returns
    -------
    Belief
        The same for each process.
    """
    return Belief(np.log(np.array(TYPICAL)), np.diag(np.array(DOUBT) ** 2), scale)


def learnt(process: Process, fleet: Increments, belief: Belief, seed: int) -> Belief:
    """Return what is believed after having seen other units' lives.

    Parameters
    ----------
    process : Process
        Of wear.
    fleet : Increments
        Of the other units' lives.
    belief : Belief
        Before.
    seed : int
        Of the draws.

    Returns
    -------
    Belief
        After; the same where there are no lives.
    """
    if not len(fleet):
        return belief
    found = posterior(process, fleet, belief, 400, np.random.default_rng(seed))
    return Belief(found.mean, found.covariance, belief.scale, belief.evidence + found.evidence)


def posterior(
    process: Process, seen: Increments, belief: Belief, draws: int, rng: np.random.Generator
) -> Posterior:
    """Draw laws given increments: importance sampling about the most probable one.

    Parameters
    ----------
    process : Process
        Of wear.
    seen : Increments
        What the laws have to explain.
    belief : Belief
        Before.
    draws : int
        How many.
    rng : np.random.Generator
        Of the draws.

    Returns
    -------
    Posterior
        The draws; evidence minus infinity where the process cannot have made the increments.
    """
    precision = np.asarray(np.linalg.inv(belief.covariance), dtype=np.float64)
    (_, volume) = np.linalg.slogdet(2.0 * np.pi * belief.covariance)

    def height(at: NDArray[np.float64]) -> float:
        law = Law(*np.exp(np.clip(at, -25.0, 25.0)).tolist())
        off = at - belief.mean
        prior = -0.5 * (float(off @ precision @ off) + volume)
        with np.errstate(all="ignore"):
            value = prior + process.log_likelihood(seen, law, belief.scale)
        return value if math.isfinite(value) else -1e12

    if not math.isfinite(process.log_likelihood(seen, Law(*np.exp(belief.mean)), belief.scale)):
        laws = tuple(Law(*np.exp(belief.mean).tolist()) for _ in range(draws))
        even = np.full(draws, 1.0 / draws)
        return Posterior(laws, even, -math.inf, belief.mean, belief.covariance)
    top = minimize(lambda at: -height(at), belief.mean, method="BFGS", options={"gtol": 1e-3}).x
    shape = WIDER**2 * _curvature(height, top, precision)
    root = np.linalg.cholesky(shape)
    normal = rng.standard_normal((draws, len(top)))
    stretch = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, draws))
    points = top + (normal @ root.T) * stretch[:, None]
    z = np.sum(normal**2, axis=1) * stretch**2
    k = len(top)
    proposed = (
        math.lgamma(0.5 * (FREEDOM + k)) - math.lgamma(0.5 * FREEDOM)
        - 0.5 * k * math.log(FREEDOM * math.pi) - float(np.log(np.diag(root)).sum())
        - 0.5 * (FREEDOM + k) * np.log1p(z / FREEDOM)
    )  # fmt: skip
    logs = np.array([height(point) for point in points]) - proposed
    highest = float(logs.max())
    weights = np.exp(logs - highest)
    evidence = highest + math.log(float(weights.mean()))
    weights /= weights.sum()
    mean = weights @ points
    off = points - mean
    covariance = (weights[:, None] * off).T @ off + 1e-8 * np.eye(k)
    laws = tuple(Law(*row) for row in np.exp(np.clip(points, -25.0, 25.0)).tolist())
    return Posterior(laws, weights, evidence, mean, covariance)


def _curvature(
    height: Callable[[NDArray[np.float64]], float],
    top: NDArray[np.float64],
    precision: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Covariance that the curvature at the top says, never wider than the prior's."""
    k = len(top)
    h = STEP * 10.0
    hessian = np.zeros((k, k))
    steps = np.eye(k) * h
    for i in range(k):
        for j in range(i, k):
            value = (
                height(top + steps[i] + steps[j]) - height(top + steps[i] - steps[j])
                - height(top - steps[i] + steps[j]) + height(top - steps[i] - steps[j])
            ) / (4.0 * h * h)  # fmt: skip
            hessian[i, j] = hessian[j, i] = -value
    # The prior's share of the curvature is certain; the data's may be no curvature at all.
    own, axes = np.linalg.eigh(hessian - precision)
    full = precision + axes @ np.diag(np.maximum(own, 0.0)) @ axes.T
    return np.asarray(np.linalg.inv(full))
