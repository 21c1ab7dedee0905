"""Chooses the model that a unit is learned by: simple ones first, then all effects, then fewer.

A simple model that leaves nothing is taken. Else what a unit may have besides is freed, and what
the recordings do not ask for is taken out again (`ehadiag.calibration.effects`). One recording of
each test suffices to choose; all are learned from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ehadiag.calibration.effects import asked_for_by, with_further_effects
from ehadiag.calibration.judging import WORTH_ANOTHER
from ehadiag.calibration.models import ONE_START, SMOOTH, TWO_STARTS, Learned, Model, simple_models
from ehadiag.calibration.session import Session
from ehadiag.core.actuator import Actuator
from ehadiag.identify.nuisance.explained import is_noise
from ehadiag.identify.nuisance.knowledge import data_that_pass_for
from ehadiag.identify.spans import by_experiment

__all__ = ["choose", "learned_as_new"]

MOST_SEARCHES = 3
"""With one model, until two have come to the same place."""
AS_MUCH = 1.1
"""Ratio of what two searches leave, over noise, up to which neither stopped beside the optimum."""
ALIKE = 30.0
"""Cost by which searches that came to the same place differ."""


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
        if _has_all_effects(out[-1]) and not compare:
            return out
    if any(_has_all_effects(item) for item in out):
        return out
    smooth = [_smooth(session, out, simple) for simple in simple_models(start)]
    if not compare:
        out += smooth
    if any(item.estimated.explained for item in smooth):
        return out
    for item in smooth:  # what they leave does not tell the second stage
        out.append(with_further_effects(session, item))
        if out[-1].estimated.excess <= WORTH_ANOTHER:
            break
    return out


def _has_all_effects(found: Learned) -> bool:
    """Whether all is explained, or all of open loop: no effect is missing.

    In closed loop the spool breaks away so often that a search may end with some of it at wrong
    ticks.
    """
    if found.estimated.explained:
        return True
    parts = by_experiment(found.experiments, found.estimated.refined.residuals)
    first = [
        is_noise(part)
        for item, part in zip(found.experiments, parts, strict=True)
        if not item.test.closed_loop
    ]
    return bool(first) and all(first)


def _smooth(session: Session, tried: Sequence[Learned], simple: Model) -> Learned:
    """Learn a smooth hysteresis with one class of second stage, if that has not been tried."""
    model = replace(simple, plays=SMOOTH)
    for item in tried:
        if item.model == model:
            return item
    one_play = next(item for item in tried if item.model == simple)
    hint = one_play.estimated.refined.values
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
    values = best.estimated.refined.values
    hint = {**values, **data_that_pass_for(session.start, values)}
    model = replace(best.model, beside=asked_for_by(best)) if best.model.rich else best.model
    budget = ONE_START if model.rich else TWO_STARTS
    found = [session.learn(model, new=True, hint=hint, budget=budget)]
    for turn in range(1, MOST_SEARCHES):
        if _came_to(best, found[0]) or (best.model.rich and _as_good(found[0], best)):
            break
        around = None if turn % 2 and not best.model.rich else hint
        found.append(session.learn(model, new=True, hint=around, budget=budget, turn=turn))
        found.sort(key=lambda item: item.criterion)
        if found[1].criterion - found[0].criterion < ALIKE:
            break
    return found[0]


def _came_to(best: Learned, found: Learned) -> bool:
    """Whether a search came to the place of another one with the same recordings."""
    same = len(best.experiments) == len(found.experiments)
    return same and found.criterion - best.criterion < ALIKE


def _as_good(found: Learned, best: Learned) -> bool:
    """Whether what a search leaves is explained, or about as little as another one left."""
    if found.estimated.explained:
        return True
    return found.estimated.excess <= min(WORTH_ANOTHER, AS_MUCH * best.estimated.excess)


def _searched(session: Session, model: Model, *, first: bool) -> Learned:
    """Learn with a simple model, again where the search may have stopped beside the optimum."""
    found = session.learn(model, nearly_new=True, brief=True, some=True)
    turn = 1
    while turn < MOST_SEARCHES and _may_have_stopped_beside(found, first=first):
        # The unit may be worn, too.
        other = session.learn(model, nearly_new=turn != 1, brief=True, some=True, turn=turn)
        found = min(found, other, key=lambda item: item.criterion)
        turn += 1
        if found.estimated.excess > WORTH_ANOTHER or _has_all_effects(found):
            break
    return found


def _may_have_stopped_beside(found: Learned, *, first: bool) -> bool:
    """Whether another search with the same model may explain more."""
    if found.estimated.explained:
        return False
    return first or found.estimated.excess <= WORTH_ANOTHER
