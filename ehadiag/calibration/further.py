"""Learns what a unit has beyond its data and the basic effects, where the recordings ask for it.

Effects are freed at once, since one left out bends the others; but friction that falls with the
velocity, which passes for hysteresis and takes a run of the model several times as long, only where
the others leave something. After each search what the recordings do not ask for is taken out again:
an effect stays if leaving it out would cost more than the Bayesian information criterion takes for
one more unknown (a Wald test, A. Wald, Trans. AMS 54(3), 1943, of the optimum's own covariance). A
search with those that stay, which begins there, is quick, and often finds the way on where the one
with all of them crept along a valley.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.calibration.judging import MOST_LEFT
from ehadiag.calibration.models import EFFECTS, ONE_START, SLOW, Learned
from ehadiag.calibration.session import Session
from ehadiag.identify.uncertainty import covariance

__all__ = ["asked_for", "asked_for_by", "with_further_effects"]

QUICK = tuple(name for name in EFFECTS if name not in SLOW)
LITTLE = 1.5
"""Residuals over noise up to which no slow search is made for a little more."""
TINY = 1e-300


def with_further_effects(session: Session, smooth: Learned) -> Learned:
    """Learn further effects, beginning where a smooth hysteresis alone explains most.

    Parameters
    ----------
    session : Session
        The recordings.
    smooth : Learned
        With a smooth hysteresis.

    Returns
    -------
    Learned
        With those that the recordings ask for, or, where that explains more, with all.
    """
    best = _round(session, smooth, QUICK, 0)
    if best.estimated.excess <= MOST_LEFT:
        best = _round(session, best, QUICK, 1)
    best = _round(session, best, SLOW, 2)
    if best.estimated.excess > LITTLE:
        best = _round(session, best, QUICK, 3)
    return best


def _round(session: Session, best: Learned, more: Sequence[str], turn: int) -> Learned:
    """Learn more effects beside those that are asked for, and then those that are, if need be."""
    if best.estimated.explained:
        return best
    names = {*more, *asked_for_by(best)}
    found = _beginning_at(session, best, tuple(name for name in EFFECTS if name in names), turn)
    if found.estimated.excess > LITTLE or not names.intersection(SLOW):
        fewer = _beginning_at(session, found, asked_for_by(found), turn)
        found = min(found, fewer, key=_worse)
    return min(best, found, key=_worse)


def _beginning_at(session: Session, found: Learned, names: tuple[str, ...], turn: int) -> Learned:
    """Learn with these further effects, beginning where another search ended."""
    return session.learn(
        replace(found.model, beside=names),
        nearly_new=True,
        hint=found.estimated.refined.values,
        budget=ONE_START,
        some=True,
        turn=turn,
    )


def _worse(found: Learned) -> tuple[bool, float]:
    return not found.estimated.explained, found.criterion


def asked_for_by(found: Learned) -> tuple[str, ...]:
    """Effects of the model that the recordings ask for."""
    refined = found.estimated.refined
    return asked_for(
        found.model.beside,
        [item.name for item in refined.parameters],
        refined.x * refined.scale,
        covariance(refined),
        math.log(max(int((refined.residuals != 0.0).sum()), 2)),
    )


def asked_for(
    beside: Sequence[str],
    names: Sequence[str],
    values: NDArray[np.float64],
    spread: NDArray[np.float64],
    worth: float,
) -> tuple[str, ...]:
    """Effects that leaving out would cost more than one unknown is worth.

    Taken out one after the other, the least asked for first, the rest adjusted each time.

    Parameters
    ----------
    beside : Sequence[str]
        Effects that may be left out.
    names : Sequence[str]
        All that was estimated.
    values : NDArray[np.float64]
        Their estimates, shape (k,).
    spread : NDArray[np.float64]
        Their covariance, shape (k, k).
    worth : float
        Cost that one unknown must save.

    Returns
    -------
    tuple[str, ...]
        In the order given.
    """
    left = list(beside)
    while left:
        places = [names.index(name) for name in left]
        squares = values[places] ** 2 / np.maximum(np.diag(spread)[places], TINY)
        least = int(np.argmin(squares))
        if squares[least] >= worth:
            break
        k = places[least]
        # The others where this one is 0, and what is then known of them.
        gain = spread[:, k] / spread[k, k]
        values = values - gain * values[k]
        spread = spread - np.outer(gain, spread[k])
        left.pop(least)
    return tuple(left)
