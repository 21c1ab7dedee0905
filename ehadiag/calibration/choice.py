"""Chooses the model that a unit is learned by, in open loop: simple ones first, then all effects.

A simple model that leaves nothing is taken. Else what a unit may have besides is freed, and what
the recordings do not ask for is taken out again (`ehadiag.calibration.effects`). One recording of
each open-loop test suffices to choose: there the spool breaks away seldom, so that a search comes
to the optimum and what it leaves is of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ehadiag.calibration.effects import looked_for_again, with_further_effects
from ehadiag.calibration.judging import WORTH_ANOTHER
from ehadiag.calibration.models import ONE_START, SMOOTH, Learned, Model, simple_models
from ehadiag.calibration.session import Part, Session
from ehadiag.core.actuator import Actuator
from ehadiag.identify.nuisance.explained import (
    SPOOL_EXPLAINED,
    excess_of_signals,
    is_of_the_pressure,
)
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW

__all__ = ["choose"]

SPOOL_AT_MOST = 1.5
"""Spool's residuals over noise up to which the other second stage may explain the pressure."""
MOST_SEARCHES = 3
"""With one model, until two have come to the same place."""


def choose(session: Session, start: Actuator, *, compare: bool) -> list[Learned]:
    """Learn with one model after the other until one explains the recordings; all that were tried.

    The other second stage is tried where the spool is explained and the pressure is not: the spool
    leaves as much with either.

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
    out: list[Learned] = []
    simple = simple_models(start)
    for plays in (1, SMOOTH):
        for model in simple:
            if model != simple[0] and not compare and not _misses_the_pressure(out[-1]):
                break
            out.append(_simply(session, replace(model, plays=plays), out))
            if out[-1].estimated.explained and not compare:
                return out
    if any(item.estimated.explained for item in out):
        return out
    return [*out, *_with_further_effects(session, simple)]


def _with_further_effects(session: Session, simple: Sequence[Model]) -> list[Learned]:
    """Learn further effects with one second stage after the other, until one leaves little.

    Where the spool is explained and the pressure is far from it the other one comes first, before
    the effects are looked for again.
    """
    out: list[Learned] = []
    for model in simple:
        found = with_further_effects(session, replace(model, plays=SMOOTH))
        if not _is_of_the_pressure(found):
            found = looked_for_again(session, found)
        out.append(found)
        if found.estimated.excess <= WORTH_ANOTHER:
            return out
    best = min(out, key=lambda item: item.criterion)
    if not _is_of_the_pressure(best):
        return out
    again = looked_for_again(session, best)
    return out if again is best else [*out, again]


def _is_of_the_pressure(found: Learned) -> bool:
    return is_of_the_pressure(found.estimated.refined.residuals)


def _misses_the_pressure(found: Learned) -> bool:
    """Whether the spool is explained, more or less, and the pressure is not."""
    excesses = excess_of_signals(found.estimated.refined.residuals)
    return excesses[SPOOL_ROW] <= SPOOL_AT_MOST and excesses[PRESSURE_ROW] > SPOOL_EXPLAINED


def _simply(session: Session, model: Model, before: Sequence[Learned]) -> Learned:
    """Learn with a model without further effects, a smooth hysteresis from where one play ended."""
    if model.plays == 1:
        return _searched(session, model, first=not before)
    alike = [item for item in before if item.model.second_stage == model.second_stage]
    hint = (alike or before)[-1].estimated.refined.values
    return session.learn(model, nearly_new=True, hint=hint, budget=ONE_START, part=Part.OPEN_LOOP)


def _searched(session: Session, model: Model, *, first: bool) -> Learned:
    """Learn with one play, again where the search may have stopped beside the optimum."""
    found = session.learn(model, nearly_new=True, brief=True, part=Part.OPEN_LOOP)
    turn = 1
    while turn < MOST_SEARCHES and _may_have_stopped_beside(found, first=first):
        # The unit may be worn, too.
        other = session.learn(
            model, nearly_new=turn != 1, brief=True, part=Part.OPEN_LOOP, turn=turn
        )
        found = min(found, other, key=lambda item: item.criterion)
        turn += 1
        if found.estimated.excess > WORTH_ANOTHER or found.estimated.explained:
            break
    return found


def _may_have_stopped_beside(found: Learned, *, first: bool) -> bool:
    """Whether another search with the same model may explain more."""
    if found.estimated.explained:
        return False
    return first or found.estimated.excess <= WORTH_ANOTHER
