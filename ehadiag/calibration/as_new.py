"""Learns a unit from all recordings of it as new, with the model that was chosen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ehadiag.calibration.effects import QUICK, asked_for_by, in_order
from ehadiag.calibration.judging import WORTH_ANOTHER, is_explained
from ehadiag.calibration.models import ONE_START, SLOW, TWO_STARTS, Learned
from ehadiag.calibration.session import Part, Session
from ehadiag.identify.nuisance.estimate import HYSTERESIS
from ehadiag.identify.nuisance.knowledge import data_that_pass_for

__all__ = ["learned_as_new"]

MOST_SEARCHES = 3
"""Of all recordings, until two have come to the same place."""
AS_MUCH = 1.1
"""Ratio of what two searches leave, over noise, up to which neither stopped beside the optimum."""
ALIKE = 30.0
"""Cost by which searches that came to the same place differ."""
ROUGH = 3e-3
"""Hysteresis, full width, below which effects that closed loop asks for are break-aways."""


def learned_as_new(session: Session, best: Learned) -> Learned:
    """Learn from all recordings, the severities taken for 0 and the frictions as new instead.

    Residuals like noise are no proof of the best optimum, and what is learned here is believed ever
    after: the best of several searches is taken. Where the model leaves something in open loop the
    further effects that this does not ask for are freed once more, since closed loop may: but not
    where it is so rough that it would ask for any, unless all is unexplained without.

    Parameters
    ----------
    session : Session
        The recordings.
    best : Learned
        From open loop, with the severities estimated.

    Returns
    -------
    Learned
        With the frictions.
    """
    values = best.estimated.refined.values
    hint = {**values, **data_that_pass_for(session.start, values)}
    if best.model.rich and not (best.estimated.explained or values[HYSTERESIS] < ROUGH):
        return _with_effects(session, best, hint)
    model = replace(best.model, beside=asked_for_by(best)) if best.model.rich else best.model
    found = [session.learn(model, new=True, hint=hint, hint_of_open=True, budget=TWO_STARTS)]
    for turn in range(1, MOST_SEARCHES):
        if _came_to(best, found[0]) or (model.rich and found[0].estimated.explained):
            break
        around = None if turn % 2 else found[0].estimated.refined.values
        found.append(session.learn(model, new=True, hint=around, budget=TWO_STARTS, turn=turn))
        found.sort(key=lambda item: item.criterion)
        if found[1].criterion - found[0].criterion < ALIKE:
            break
    if model.rich and not is_explained(found[0]):
        found.append(_with_effects(session, best, hint))
    return min(found, key=lambda item: item.criterion)


def _with_effects(session: Session, best: Learned, hint: Mapping[str, float]) -> Learned:
    """Learn from all recordings with the further effects that these ask for."""
    names = set(asked_for_by(best))
    if not names.intersection(SLOW):
        names.update(QUICK)
    model = replace(best.model, beside=in_order(names))
    whole = session.learn(
        model, new=True, hint=hint, hint_of_open=True, budget=ONE_START, part=Part.EACH_TEST
    )
    fewer = replace(model, beside=asked_for_by(whole))
    of_all = [whole] if len(whole.experiments) == len(session.recordings) else []
    if fewer == model and of_all:
        return whole
    enough = 1 if names.intersection(SLOW) else 2
    found: list[Learned] = []
    while len(found) < MOST_SEARCHES:
        afresh = bool(len(found) % 2)
        around = hint if afresh else min([whole, *found], key=_left).estimated.refined.values
        found.append(
            session.learn(
                fewer,
                new=True,
                hint=around,
                hint_of_open=afresh,
                budget=ONE_START,
                turn=len(found),
            )
        )
        nearest = min(found, key=_left)
        before, fewer = fewer, replace(fewer, beside=asked_for_by(found[-1]))
        done = nearest.estimated.explained or len(found) >= enough
        if fewer == before and done and _as_good(nearest, whole):
            break
    return min([*found, *of_all], key=lambda item: item.criterion)


def _left(found: Learned) -> float:
    """What a search leaves, over noise."""
    return found.estimated.excess


def _came_to(best: Learned, found: Learned) -> bool:
    """Whether a search came to the place of another one with the same recordings."""
    same = len(best.experiments) == len(found.experiments)
    return same and found.criterion - best.criterion < ALIKE


def _as_good(found: Learned, best: Learned) -> bool:
    """Whether what a search leaves is explained, or about as little as another one left."""
    if found.estimated.explained:
        return True
    return found.estimated.excess <= min(WORTH_ANOTHER, AS_MUCH * best.estimated.excess)
