"""Searches for a test that shows the severities better, within limits on the actuator's motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.stored_test import StoredTest
from ehadiag.design.play import play
from ehadiag.design.score import POINTS, Score, score, usual_effects
from ehadiag.design.variant import Space, space_of

__all__ = ["Limits", "Proposal", "propose"]

POPULATION = 12
FIRST_SPREAD = 0.3
"""Deviation of the logarithms of the factors with which the search begins."""
FORBIDDEN = 1e3
"""Figure of a test beyond its limits, plus by how much: the search finds the way back."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a test must not exceed.

    Attributes
    ----------
    travel : float
        Of the jack from its middle, m.
    rate : float
        Of the jack, m/s.
    pressure : float
        Differential, Pa.
    duration : float
        s.
    """

    travel: float
    rate: float
    pressure: float
    duration: float

    def excess(self, travel: float, rate: float, pressure: float, duration: float) -> float:
        """By how much the worst is exceeded, as a share; 0 where nothing is."""
        shares = (
            travel / self.travel,
            rate / self.rate,
            pressure / self.pressure,
            duration / self.duration,
        )
        return max(max(shares) - 1.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A test that was found.

    Attributes
    ----------
    test : StoredTest
    score : Score
    scored : int
        Tests that were looked at.
    better : bool
        Whether it is better than the test that the search began with, or that one exceeded limits.
    """

    test: StoredTest
    score: Score
    scored: int
    better: bool


def propose(
    test: StoredTest,
    actuator: Actuator,
    limits: Limits,
    *,
    budget: int = 200,
    seed: int = 0,
    tell: Callable[[float], None] | None = None,
) -> Proposal | None:
    """Search the variants of a test for the lowest figure; None where all exceed the limits.

    An evolution strategy with diagonal adaptation from the best quarter of each generation
    (cross-entropy method, R. Rubinstein, Methodology and Computing in Applied Probability 1, 1999).

    Parameters
    ----------
    test : StoredTest
        Where the search begins.
    actuator : Actuator
        Data of the actuator.
    limits : Limits
        What no test may exceed.
    budget : int
        Tests to look at.
    seed : int
        The same seed gives the same test.
    tell : Callable[[float], None] | None
        Called after each test with the share of the budget that is spent.

    Returns
    -------
    Proposal | None
        None where all tests that were looked at exceed the limits.
    """
    space = space_of(test, actuator.controller.IM)
    rng = np.random.default_rng(seed)
    mean, spread = np.zeros(len(space.lower)), np.full(len(space.lower), FIRST_SPREAD)
    first = _figure(space, mean, actuator, limits)
    best, lowest, scored = mean, first, 1
    while scored + POPULATION <= budget:
        points = np.clip(
            mean + spread * rng.standard_normal((POPULATION, len(mean))), space.lower, space.upper
        )
        points[0] = best
        figures = [lowest]
        for point in points[1:]:
            figures.append(_figure(space, point, actuator, limits))
            scored += 1
            if tell is not None:
                tell(scored / budget)
        order = np.argsort(figures)
        if figures[order[0]] < lowest:
            best, lowest = points[order[0]], figures[order[0]]
        chosen = points[order[: POPULATION // 4]]
        mean = 0.5 * (mean + chosen.mean(axis=0))
        spread = 0.7 * spread + 0.3 * chosen.std(axis=0)
    if lowest >= FORBIDDEN:
        return None
    found = space.variant(best)
    return Proposal(found, score(found, actuator), scored, lowest < first)


def _figure(space: Space, point: NDArray[np.float64], actuator: Actuator, limits: Limits) -> float:
    """Figure of a variant; of one beyond its limits one larger than any."""
    test = space.variant(point)
    # As new the jack goes farthest and fastest: what is too much there is not scored.
    new = play(test, actuator, (0.0,) * len(POINTS[0]), usual_effects())
    excess = limits.excess(new.travel, new.rate, new.pressure, test.duration)
    if excess > 0.0:
        return FORBIDDEN * (1.0 + excess)
    found = score(test, actuator)
    excess = limits.excess(found.travel, found.rate, found.pressure, test.duration)
    return FORBIDDEN * (1.0 + excess) if excess > 0.0 else found.figure
