"""Finds which further effects a unit has, beyond its data and the basic ones, and learns them.

Effects are freed at once, since one left out bends the others; but friction that falls with the
velocity, which passes for hysteresis and takes a run of the model several times as long, only where
the others leave something. After each search what the recordings do not ask for is taken out again:
an effect stays if leaving it out would cost more than the Bayesian information criterion takes for
one more unknown (a Wald test, A. Wald, Trans. AMS 54(3), 1943, of the optimum's own covariance). A
search with those that stay, which begins there, is quick, and often finds the way on where the one
with all of them crept along a valley. Other searches begin afresh: beside the optimum of a model
without the effects they mostly stay.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.calibration.judging import WORTH_ANOTHER
from ehadiag.calibration.models import EFFECTS, ONE_START, SLOW, Learned, Model
from ehadiag.calibration.session import Part, Session
from ehadiag.identify.refine.posterior import TAIL
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import parameter
from ehadiag.model.simd.model import SimdModel

__all__ = [
    "QUICK",
    "asked_for",
    "asked_for_by",
    "in_order",
    "looked_for_again",
    "with_further_effects",
]

QUICK = tuple(name for name in EFFECTS if name not in SLOW)
LITTLE = 1.5
"""Residuals over noise up to which no slow search is made for a little more."""
SIZES = (0.1, 0.3, 1.0, 2.0)
"""Of an effect, over its usual one, that are tried."""
MUCH = 0.03
"""Share of what is left that an effect must take away."""
TINY = 1e-300


def with_further_effects(session: Session, model: Model) -> Learned:
    """Learn further effects beside those of a model, from open loop.

    Parameters
    ----------
    session : Session
        The recordings.
    model : Model
        With a smooth hysteresis.

    Returns
    -------
    Learned
        With those that the recordings ask for, or, where that explains more, with all.
    """
    best = _freed(session, model, QUICK, 0)
    if best.estimated.excess <= WORTH_ANOTHER:
        best = _round(session, best, QUICK, 1)
    if _promising(best, SLOW):
        best = _round(session, best, SLOW, 2)
    return best


def looked_for_again(session: Session, best: Learned) -> Learned:
    """Learn further effects afresh where much is left after a search for them."""
    if best.estimated.excess > LITTLE:
        best = _round(session, best, QUICK, 3, afresh=True)
    if best.estimated.excess > WORTH_ANOTHER:
        best = _round(session, best, QUICK, 4)
    return best


def in_order(names: Collection[str]) -> tuple[str, ...]:
    """Return effects in the order of `EFFECTS`."""
    return tuple(name for name in EFFECTS if name in names)


def _promising(best: Learned, names: Sequence[str]) -> bool:
    """Whether one of some effects alone could take away much of what is left.

    Their usual sizes are tried beside the optimum, and what changes the residuals as none of the
    estimated parameters does is held against what is left (a score test with finite steps).
    """
    names = [name for name in names if name not in best.model.beside]
    if best.estimated.explained or not names:
        return False
    refined, experiments = best.estimated.refined, best.estimated.experiments
    free = (*refined.parameters, *(parameter(name) for name in names))
    model = SimdModel(lay_out(experiments), unknowns_of(experiments, free))
    points = np.zeros((1 + len(SIZES) * len(names), len(free)))
    points[:, : len(refined.x)] = refined.x * refined.scale
    for k, name in enumerate(names):
        rows = slice(1 + k * len(SIZES), 1 + (k + 1) * len(SIZES))
        points[rows, len(refined.x) + k] = np.array(SIZES) * EFFECTS[name].mean
    runs = model.residuals(points)[0]
    runs = runs.reshape(len(runs), -1)
    weights = 1.0 / np.sqrt(1.0 + (runs[0] / TAIL) ** 2)
    known = np.linalg.qr((refined.jacobian.reshape(len(refined.x), -1) * weights).T)[0]
    left = runs[0] * weights
    changes = (runs[1:] - runs[0]) * weights
    left -= known @ (known.T @ left)
    changes -= (changes @ known) @ known.T
    sizes = np.maximum(np.einsum("ij,ij->i", changes, changes), TINY)
    gains = np.minimum(changes @ left, 0.0) ** 2 / sizes
    return bool(gains.max() > MUCH * (left @ left))


def _round(
    session: Session, best: Learned, more: Sequence[str], turn: int, *, afresh: bool = False
) -> Learned:
    """Learn more effects beside those that are asked for, where something is left to explain."""
    if best.estimated.explained:
        return best
    names = {*more, *asked_for_by(best)}
    found = _freed(session, best.model, names, turn, None if afresh else best)
    return min(best, found, key=_worse)


def _freed(
    session: Session,
    model: Model,
    names: Collection[str],
    turn: int,
    begin: Learned | None = None,
) -> Learned:
    """Learn some effects, and then those of them that are asked for, if need be."""
    found = _search(session, model, in_order(names), begin, turn)
    if found.estimated.excess > LITTLE or not set(SLOW).intersection(names):
        fewer = _search(session, model, asked_for_by(found), found, turn)
        found = min(found, fewer, key=_worse)
    return found


def _search(
    session: Session, model: Model, names: tuple[str, ...], begin: Learned | None, turn: int
) -> Learned:
    """Learn with these further effects, beginning where another search ended."""
    usual = {name: EFFECTS[name].mean for name in SLOW}
    return session.learn(
        replace(model, beside=names),
        nearly_new=True,
        hint={**usual, **begin.estimated.refined.values} if begin else None,
        budget=ONE_START,
        part=Part.OPEN_LOOP,
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
