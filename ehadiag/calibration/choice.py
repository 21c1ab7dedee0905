"""Chooses the model that a unit is learned by: simple ones first, then all effects, then fewer.

A simple model that leaves nothing is taken. Else all that a unit may have besides is freed at
once, since one effect left out bends the others, and what the recordings do not ask for is taken
out again: an effect stays if leaving it out would cost more than the Bayesian information
criterion takes for one more unknown (a Wald test, A. Wald, Trans. AMS 54(3), 1943, of the
optimum's own covariance). One recording of each test suffices to choose; all are learned from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.calibration.judging import MOST_LEFT, is_explained
from ehadiag.calibration.models import EFFECTS, SMOOTH, Learned, Model, simple_models
from ehadiag.calibration.session import Session
from ehadiag.core.actuator import Actuator
from ehadiag.identify.uncertainty import covariance

__all__ = ["asked_for", "choose", "learned_as_new"]

MOST_SEARCHES = 4
"""With one model, until two have come to the same place."""
ALIKE = 30.0
"""Cost by which searches that came to the same place differ."""
ONE_START = 1
"""Budget of a search that ends after its first start."""
TINY = 1e-300


def choose(session: Session, start: Actuator, *, compare: bool) -> list[Learned]:
    """Learn with one model after the other until one explains the recordings; all that were tried.

    Parameters
    ----------
    session : Session
        The recordings.
    start : Actuator
        Data of the unit's type.
    compare : bool
        Try either second stage with one play and with a smooth hysteresis, in any case.

    Returns
    -------
    list[Learned]
        In the order in which they were tried.
    """
    models = simple_models(start)
    if compare:
        models += [replace(item, plays=SMOOTH) for item in models]
    out: list[Learned] = []
    for model in models:
        out.append(_searched(session, model, first=not out))
        if out[-1].estimated.explained and not compare:
            return out
    if any(item.estimated.explained for item in out):
        return out
    smooth = [_smooth(session, out, simple) for simple in simple_models(start)]
    if not compare:
        out += smooth
    if any(item.estimated.explained for item in smooth):
        return out
    for item in smooth:  # what they leave does not tell the second stage
        out.append(_rich(session, item))
        if is_explained(out[-1]):
            break
    return out


def _smooth(session: Session, tried: Sequence[Learned], simple: Model) -> Learned:
    """Learn a smooth hysteresis with one class of second stage, if that has not been tried."""
    model = replace(simple, plays=SMOOTH)
    for item in tried:
        if item.model == model:
            return item
    one_play = next(item for item in tried if item.model == simple)
    hint = one_play.estimated.refined.values
    return session.learn(model, nearly_new=True, hint=hint, budget=ONE_START, some=True)


def _rich(session: Session, smooth: Learned) -> Learned:
    """Learn all effects, beginning where the hysteresis alone explains most.

    From the usual sizes of all of them friction that falls with speed stands in for hysteresis.
    """
    model = replace(smooth.model, beside=tuple(EFFECTS))
    hint = smooth.estimated.refined.values
    return session.learn(model, nearly_new=True, hint=hint, budget=ONE_START, some=True)


def learned_as_new(session: Session, best: Learned) -> Learned:
    """Learn once more, the severities taken for 0 and the frictions as new in their place.

    Effects that the recordings do not ask for are left out. Residuals like noise are no proof of
    the best optimum, and what is learned here is believed ever after: with a simple model the best
    of several searches is taken. With many effects each search begins where the first one ended.

    Parameters
    ----------
    session : Session
        The recordings.
    best : Learned
        With the severities estimated.

    Returns
    -------
    Learned
        With the frictions.
    """
    hint = best.estimated.refined.values
    model = replace(best.model, beside=_asked_for(best)) if best.model.rich else best.model
    found = [session.learn(model, new=True, hint=hint, budget=ONE_START)]
    for turn in range(1, MOST_SEARCHES):
        if best.model.rich and found[0].estimated.excess <= MOST_LEFT:
            break
        around = None if turn % 2 and not best.model.rich else hint
        found.append(session.learn(model, new=True, hint=around, budget=ONE_START, turn=turn))
        found.sort(key=lambda item: item.criterion)
        if found[1].criterion - found[0].criterion < ALIKE:
            break
    return found[0]


def _searched(session: Session, model: Model, *, first: bool) -> Learned:
    """Learn with a simple model, again where the search may have stopped beside the optimum."""
    found = session.learn(model, nearly_new=True, brief=True, some=True)
    turn = 1
    while turn < MOST_SEARCHES and _may_have_stopped_beside(found, first=first):
        # The unit may be worn, too.
        other = session.learn(model, nearly_new=turn != 1, brief=True, some=True, turn=turn)
        found = min(found, other, key=lambda item: item.criterion)
        turn += 1
        if found.estimated.excess > MOST_LEFT:
            break
    return found


def _may_have_stopped_beside(found: Learned, *, first: bool) -> bool:
    """Whether another search with the same model may explain more."""
    if found.estimated.explained:
        return False
    return first or found.estimated.excess <= MOST_LEFT


def _asked_for(found: Learned) -> tuple[str, ...]:
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
