"""Rivals of the forecast: a library of similar lives, and the age alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ehadiag.prognosis.lives import Life

Array = NDArray[np.float64]
QUANTILES = (0.1, 0.5, 0.9)
LIBRARY_LIVES = 10
"""Number of most similar lives that count."""
MIN_SHARE_OF_LIMIT = 0.85
"""Severity, over the limit, from which a life that was not seen to its end is run on to it."""


def life_end(life: Life, limit: float) -> float | None:
    """Age at a limit, by the last growth where the last diagnosis is near it; else None."""
    if life.value[-1] >= limit:
        return float(np.interp(limit, np.maximum.accumulate(life.value), life.age))
    since = max(len(life.age) - 4, 0)
    rate = (life.value[-1] - life.value[since]) / max(life.age[-1] - life.age[since], 1e-9)
    if life.value[-1] < MIN_SHARE_OF_LIMIT * limit or rate <= 0.0:
        return None
    return float(life.age[-1] + (limit - life.value[-1]) / rate)


def similar_lives(life: Life, fleet: Sequence[Life], limit: float) -> Array | None:
    """Quantiles of what was left of the lives that once looked as this one does now."""
    span = np.linspace(-0.3, 0.0, 8) * life.age[-1]
    own = np.interp(life.age[-1] + span, life.age, life.value)
    found = []
    for other in fleet:
        end = life_end(other, limit)
        if end is None:
            continue
        starts = np.linspace(other.age[0], min(other.age[-1], end), 100)
        curves = np.interp(starts[:, None] + span, other.age, other.value, left=0.0)
        off = np.sqrt(np.mean((curves - own) ** 2, axis=1))
        best = int(np.argmin(off))
        found.append((float(off[best]), end - float(starts[best])))
    if len(found) < 3:
        return None
    off, left = np.array(sorted(found)[:LIBRARY_LIVES]).T
    weights = 1.0 / (off + 0.3 * np.median(off) + 1e-6)
    order = np.argsort(left)
    at = (np.cumsum(weights[order]) - 0.5 * weights[order]) / weights.sum()
    return np.interp(QUANTILES, at, left[order])


def age_alone(life: Life, fleet: Sequence[Life], limit: float) -> Array | None:
    """Quantiles of a Weibull distribution of ages at the limit, given the age that was lived."""
    ends = [life_end(other, limit) for other in fleet]
    known = np.array([end for end in ends if end is not None])
    out = np.array([o.age[-1] for o, end in zip(fleet, ends, strict=True) if end is None])
    if len(known) < 3:
        return None

    def loss(at: Array) -> float:
        shape, scale = np.exp(at)
        dead = np.log(shape / scale) + (shape - 1.0) * np.log(known / scale)
        total = float(np.sum(dead - (known / scale) ** shape) - np.sum((out / scale) ** shape))
        return -total

    shape, scale = np.exp(minimize(loss, (1.0, np.log(known.mean())), method="Nelder-Mead").x)
    lived = (life.age[-1] / scale) ** shape
    ends = scale * (lived - np.log1p(-np.array(QUANTILES))) ** (1.0 / shape)
    return np.asarray(ends - life.age[-1])
