"""Search from several starts, until a recording is explained.

A search may settle beside the optimum; its residuals show it. From such a place a fresh look over a
tenth of the first spread mostly finds the way on, else a start of its own does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.nuisance.explained import excess, misses_only_pressure, outliers_of
from ehadiag.identify.refine.derivatives import Derivatives
from ehadiag.identify.refine.linearisation import BLOCK, Belief, linearised
from ehadiag.identify.refine.posterior import MANY, PATIENT, robust_cost, sharpen

__all__ = ["Found", "Place", "search"]

SAME = 10.0
"""Objective up to which two ends are of the same place (a parameter one deviation off costs 1)."""
FEW_OUTLIERS = (0.005, 0.1)
"""Shares of residuals beyond three deviations between which three ends must be of the same place,
two otherwise: twice two searches of sound units ended at one wrong place, with 0.01 and 0.04.
What is broken leaves 0.16 and more, mostly; spikes leave less."""
NO_LESS = 0.98
"""Share of the excess with fewer unknowns that is as much."""
AGAIN = 0.1
"""Spread of a further look about the best so far, in spreads of the first."""
ALIAS_SPAN = 1.25
"""Half-width over which a parameter is moved against what it passes for, in units of its scale."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where one start ended.

    Attributes
    ----------
    x : shape (k,)
    cost : float
    """

    x: NDArray[np.float64]
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The best place that a search has come to.

    Attributes
    ----------
    belief : Belief
    residuals : shape (signals, N)
        Weighted, at its mean.
    cost : float
        Robust, see `robust_cost`.
    explained : bool
    places : tuple of Place
        Where all starts ended.
    confirmed : bool
        Whether only the pressure is not explained there, and another search ended there, too.
    """

    belief: Belief
    residuals: NDArray[np.float64]
    cost: float
    explained: bool
    places: tuple[Place, ...]
    confirmed: bool = False

    @property
    def starts(self) -> int:
        """How many it took."""
        return len(self.places)


def search(
    model: Derivatives,
    known: Belief,
    information: NDArray[np.float64],
    origins: Sequence[Belief],
    explains: Callable[[NDArray[np.float64]], bool],
    *,
    again: NDArray[np.float64] | None = None,
    calmly: bool = False,
    alias: str = "",
    budget: int = 1600,
    seed: int = 0,
    tell: Callable[[float], None] | None = None,
    hopeless: Callable[[NDArray[np.float64], int], bool] | None = None,
    patient: bool = False,
    confirms: bool = False,
    before: float = np.inf,
) -> Found:
    """Search until the residuals are explained, or the budget is spent.

    Parameters
    ----------
    known : Belief
        Before the recordings.
    information : shape (k, k)
        See `sharpen`.
    origins : sequence of Belief
        Where every other start begins, in turn; those between begin beside the best so far.
    explains : callable
        Of residuals, shape (signals, N): whether there is nothing better to look for
        (a search that has not come to rest goes on all the same).
    again : shape (c, c), optional
        Root of the covariance over which a further start looks about the best place; default
        a tenth of the first.
    calmly : bool
        Whether such a start takes its time.
    alias : str
        Name of a parameter that passes for a sensor's constant error.
    budget : int
        Runs of the model after which no further start is made.
    tell : callable, optional
        Called before each round and after each start with the share of the budget that is spent;
        what it raises ends the search.
    hopeless : callable, optional
        Of the best residuals and the number of starts: whether further ones will not help.
    patient : bool
        Whether all starts but the first take their time, each from the last origin, until enough
        have come to the same place; else every other one begins beside the best so far.
    confirms : bool
        Whether a place that only misses the pressure ends the search, too, if it is found again or
        leaves as much as `before`.
    before : float
        Excess that another search left with fewer unknowns.
    """
    until = model.evaluations + budget
    again = AGAIN * known.root if again is None else again

    def between() -> None:
        if tell is not None:
            tell(min(1.0 - (until - model.evaluations) / max(budget, 1), 1.0))

    best: Found | None = None
    confirmed = False
    places: list[Place] = []
    while best is None or (not best.explained and model.evaluations < until):
        turn, beside = divmod(len(places), 2)
        takes_time = best is not None and (patient or (beside and calmly))
        pace = PATIENT if takes_time else MANY
        if patient:
            begin = origins[0 if best is None else -1]
        elif best is None or not beside:
            begin = origins[turn % len(origins)]
        else:
            begin = Belief(_past_alias(model, best, alias), again)
        rng = np.random.default_rng([seed, len(places)])
        linearise = partial(linearised, rng=rng)
        sharpened = sharpen(model, known, begin, information, linearise, pace, between)
        belief, settled = sharpened.belief, sharpened.settled
        residuals = model.many(belief.x[None, :])[0]
        cost = float(robust_cost(residuals))
        places.append(Place(belief.x, cost))
        if best is None or cost < best.cost:
            best = Found(belief, residuals, cost, settled and explains(residuals), ())
        confirmed = confirms and _is_confirmed(best, places, before)
        if confirmed or (hopeless is not None and hopeless(best.residuals, len(places))):
            break
        if patient and _met(best, places):
            break
        between()
    return replace(best, places=tuple(places), confirmed=confirmed)


def _is_confirmed(best: Found, places: Sequence[Place], before: float) -> bool:
    """Whether further starts would end there, too: another one did, or the search with fewer
    unknowns, which the others have nothing to add to."""
    if best.explained or not misses_only_pressure(best.residuals):
        return False
    return _met(best, places) or excess(best.residuals) >= NO_LESS * before


def _met(best: Found, places: Sequence[Place]) -> bool:
    """Whether enough starts came to the best place."""
    unit = max(best.cost / max(int(np.count_nonzero(best.residuals)), 1), 1.0)
    least, most = FEW_OUTLIERS
    enough = 3 if least <= outliers_of(best.residuals) <= most else 2
    return sum(place.cost - best.cost <= SAME * unit for place in places) >= enough


def _past_alias(model: Derivatives, best: Found, alias: str) -> NDArray[np.float64]:
    """Best point along the line on which a parameter and a sensor's constant error trade."""
    names = [item.name for item in model.estimated]
    x = best.belief.x
    if alias not in names:
        return x
    j = names.index(alias)
    shifts = ALIAS_SPAN * (np.arange(BLOCK) - 0.5 * BLOCK + 1.0) / (0.5 * BLOCK)
    points = np.repeat(x[None, :], BLOCK, axis=0)
    points[:, j] = np.clip(x[j] + shifts, model.lower[j], model.upper[j])
    # Medians do not see the samples that a wrong pair spoils.
    slopes, runs = model.additive_slopes(), model.many(points)
    for k, item in enumerate(model.estimated):
        if item.adds_to is not None and item.adds_to < slopes.shape[1]:
            slope, run = slopes[k, item.adds_to], runs[:, item.adds_to]
            used = slope != 0.0
            points[:, k] -= np.median(run[:, used] / slope[used], axis=1)
    return points[int(np.argmin(robust_cost(model.many(points))))]
