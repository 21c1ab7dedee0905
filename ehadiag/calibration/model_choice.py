"""Chooses the model of a unit from open-loop recordings: simple models first, then further effects.

A simple model that explains the recordings is taken. Otherwise all further effects are estimated
at once, since one left out bends the others. An effect stays if leaving it out costs more than
the Bayesian information criterion takes for one unknown (a Wald test, A. Wald, Trans. AMS 54(3),
1943, with the optimum's covariance). One recording of each open-loop test suffices: there the
spool breaks away seldom, and a search finds the optimum.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.calibration.calibration_session import CalibrationSession, RecordingSelection
from ehadiag.calibration.unit_models import (
    DATUM_PRIOR,
    FURTHER_EFFECTS,
    OIL_EFFECTS,
    PLAYS_OF_SMOOTH_HYSTERESIS,
    SEARCHES,
    SLOW_EFFECTS,
    LearnedModel,
    UnitModel,
    is_explained,
    simple_models,
)
from ehadiag.core.actuator import Actuator
from ehadiag.core.criteria import ESTIMATION, FIT
from ehadiag.identify.estimates import estimate_covariance, is_pressure_misfit, signal_excess_costs
from ehadiag.identify.experiment import lay_out_spans, share_offsets, unknowns_of
from ehadiag.identify.nuisance_estimate import HYSTERESIS_NAME
from ehadiag.identify.ring import SPOOL_PARAMETERS, find_ring, is_same_ring, ring_prior
from ehadiag.model.batch import PRESSURE_ROW, SPOOL_ROW
from ehadiag.model.registry import parameter
from ehadiag.model.residual_models import SimdModel

QUICK_EFFECTS = tuple(name for name in FURTHER_EFFECTS if name not in SLOW_EFFECTS)
SKEW_NAME = "hysteresis_skew"
TRIAL_SIZES_OF_EFFECT = (0.1, 0.3, 1.0, 2.0)
"""Sizes of an effect over its usual one, 1, that are tried."""
MIN_SQUARE_EFFECT_CHANGE = 1e-300


def learn_further_effects(session: CalibrationSession, model: UnitModel) -> LearnedModel:
    """Learn further effects beside those of a model, from open loop.

    model: with a smooth hysteresis. Returns with those that the recordings ask for, or, where that
    explains more, with all.
    """
    best = _learn_effects(session, model, QUICK_EFFECTS, 0)
    if best.estimated.excess <= SEARCHES.max_excess_repeated:
        best = _learn_more_effects(session, best, QUICK_EFFECTS, 1)
    if _promising(best, SLOW_EFFECTS):
        best = _learn_more_effects(session, best, SLOW_EFFECTS, 2)
    return best


def relearn_further_effects(session: CalibrationSession, best: LearnedModel) -> LearnedModel:
    """Learn further effects afresh where much is left after a search for them."""
    if best.estimated.excess > SEARCHES.min_excess_slow:
        best = _learn_more_effects(session, best, QUICK_EFFECTS, 3, afresh=True)
    if best.estimated.excess > SEARCHES.max_excess_repeated:
        best = _learn_more_effects(session, best, QUICK_EFFECTS, 4)
    return best


def ordered_effects(names: Collection[str]) -> tuple[str, ...]:
    """Return effects in the order of `FURTHER_EFFECTS`."""
    return tuple(name for name in FURTHER_EFFECTS if name in names)


def _promising(best: LearnedModel, names: Sequence[str]) -> bool:
    """Whether one of some effects alone could take away much of what is left.

    Their usual sizes are tried beside the optimum, and what changes the residuals as none of the
    estimated parameters does is held against what is left (a score test with finite steps).
    """
    names = [name for name in names if name not in best.model.beside]
    if best.estimated.explained or not names:
        return False
    refined, experiments = best.estimated.refined, best.estimated.experiments
    free = (*refined.parameters, *(parameter(name) for name in names))
    model = SimdModel(lay_out_spans(experiments), unknowns_of(experiments, free))
    points = np.zeros((1 + len(TRIAL_SIZES_OF_EFFECT) * len(names), len(free)))
    points[:, : len(refined.x)] = refined.x * refined.scale
    for k, name in enumerate(names):
        rows = slice(1 + k * len(TRIAL_SIZES_OF_EFFECT), 1 + (k + 1) * len(TRIAL_SIZES_OF_EFFECT))
        points[rows, len(refined.x) + k] = (
            np.array(TRIAL_SIZES_OF_EFFECT) * FURTHER_EFFECTS[name].mean
        )
    runs = model.residuals(points)[0]
    runs = runs.reshape(len(runs), -1)
    weights = 1.0 / np.sqrt(1.0 + (runs[0] / ESTIMATION.cauchy_scale) ** 2)
    known = np.linalg.qr((refined.jacobian.reshape(len(refined.x), -1) * weights).T)[0]
    left = runs[0] * weights
    changes = (runs[1:] - runs[0]) * weights
    left -= known @ (known.T @ left)
    changes -= (changes @ known) @ known.T
    sizes = np.maximum(np.einsum("ij,ij->i", changes, changes), MIN_SQUARE_EFFECT_CHANGE)
    gains = np.minimum(changes @ left, 0.0) ** 2 / sizes
    return bool(gains.max() > SEARCHES.min_effect_gain * (left @ left))


def _learn_more_effects(
    session: CalibrationSession,
    best: LearnedModel,
    more: Sequence[str],
    turn: int,
    *,
    afresh: bool = False,
) -> LearnedModel:
    """Learn more effects beside those that are asked for, where something is left to explain."""
    if best.estimated.explained:
        return best
    names = {*more, *significant_effects(best)}
    begin = None if afresh else best.estimated.refined.values
    found = _learn_effects(session, best.model, names, turn, begin)
    return min(best, found, key=_rank)


def _learn_effects(
    session: CalibrationSession,
    model: UnitModel,
    names: Collection[str],
    turn: int,
    begin: Mapping[str, float] | None = None,
) -> LearnedModel:
    """Learn some effects, and then those of them that are asked for, if need be."""
    found = _learn_from(session, model, ordered_effects(names), begin, turn)
    if found.estimated.excess > SEARCHES.min_excess_slow or not set(SLOW_EFFECTS).intersection(
        names
    ):
        values = found.estimated.refined.values
        fewer = _learn_from(session, model, significant_effects(found), values, turn)
        found = min(found, fewer, key=_rank)
    return found


def _learn_from(
    session: CalibrationSession,
    model: UnitModel,
    names: tuple[str, ...],
    begin: Mapping[str, float] | None,
    turn: int,
) -> LearnedModel:
    """Learn with these further effects, beginning about these values by name."""
    usual = {name: FURTHER_EFFECTS[name].mean for name in SLOW_EFFECTS}
    return session.learn(
        replace(model, beside=names),
        nearly_new=True,
        hint={**usual, **begin} if begin else None,
        budget=SEARCHES.max_runs_one_start,
        part=RecordingSelection.OPEN_LOOP,
        turn=turn,
    )


def _rank(found: LearnedModel) -> tuple[bool, float]:
    return not found.estimated.explained, found.criterion


def significant_effects(found: LearnedModel) -> tuple[str, ...]:
    """Effects of the model that the recordings ask for."""
    refined = found.estimated.refined
    return select_significant(
        found.model.beside,
        [item.name for item in refined.parameters],
        refined.x * refined.scale,
        estimate_covariance(refined),
        math.log(max(int((refined.residuals != 0.0).sum()), 2)),
    )


def select_significant(
    beside: Sequence[str],
    names: Sequence[str],
    values: NDArray[np.float64],
    spread: NDArray[np.float64],
    worth: float,
) -> tuple[str, ...]:
    """Effects that leaving out would cost more than one unknown is worth.

    Taken out one after the other, the least asked for first, the rest adjusted each time.

    beside: effects that may be left out; names: all that was estimated; values: their estimates,
    shape (k,); spread: their covariance, shape (k, k); worth: cost that one unknown must save.
    """
    left = list(beside)
    while left:
        places = [names.index(name) for name in left]
        squares = values[places] ** 2 / np.maximum(
            np.diag(spread)[places], MIN_SQUARE_EFFECT_CHANGE
        )
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


def choose_model(
    session: CalibrationSession, start: Actuator, *, compare: bool
) -> list[LearnedModel]:
    """Learn with one model after the other until one explains the recordings; all that were tried.

    The other second stage is tried where the spool is explained and the pressure is not: the spool
    leaves as much with either.

    compare: try either second stage with one play and with a smooth hysteresis, in any case.
    """
    out: list[LearnedModel] = []
    simple = simple_models(start)
    if start.second_stage.kind == "orifice" and not compare:
        # A maker that states orifices states a real valve: its chambers' volumes change.
        out = _learn_chambers(session, simple[0])
        if is_explained(out[-1]):
            return out
    for plays in (1, PLAYS_OF_SMOOTH_HYSTERESIS):
        for model in simple:
            if model != simple[0] and not compare and not _leaves_pressure_unexplained(out[-1]):
                break
            out.append(_learn_simple_model(session, replace(model, plays=plays), out))
            if out[-1].estimated.explained and not compare:
                return out
    if any(item.estimated.explained for item in out):
        return out
    return [*out, *(_with_one_play(session, item) for item in _rich_models(session, simple))]


def _learn_chambers(session: CalibrationSession, first: UnitModel) -> list[LearnedModel]:
    """Learn with orifices, and where that does not suffice with chambers by position.

    The phase of the ring decides into which of many valleys a search goes: the first search shows
    what moves the spool, a scan the stiffness of the oil.
    """
    open_loop = RecordingSelection.OPEN_LOOP
    plain = session.learn(
        first, nearly_new=True, brief=True, budget=SEARCHES.max_runs_one_start, part=open_loop
    )
    if plain.estimated.explained:
        return [plain]
    out = [plain]
    moved, better = replace(first, by_position=True), False
    # The plain search may have bent what moves the spool: the scan is repeated, and the search
    # where it says another stiffness. Chambers that do not move have had no scan yet.
    models = [moved, moved, moved, first]
    while models:
        model, *models = models
        values = out[-1].estimated.refined.values
        experiments = share_offsets(session.build(model.of(session.start), open_loop))
        ring = find_ring(experiments, values)
        if len(out) == 2 and is_same_ring(ring, session.ring):
            if better:
                break
            model, models = first, []
        session.ring = ring or session.ring
        hint = {name: values[name] for name in SPOOL_PARAMETERS if name in values}
        joint = None
        if session.ring is not None:
            hint["bulk_modulus"] = session.ring.stiffness
            joint = ring_prior(session.ring, OIL_EFFECTS["bulk_modulus"], DATUM_PRIOR)
        found = session.learn(
            model,
            nearly_new=True,
            hint=hint,
            joint=joint,
            budget=SEARCHES.max_runs_one_start,
            part=open_loop,
            turn=len(out) - 1,
        )
        out.append(found)
        better = found.estimated.excess < SEARCHES.max_excess_share_moved * plain.estimated.excess
        if found.estimated.explained or (len(out) > 2 and better):
            break
        if len(out) > 2 and _leaves_as_much(found, out[-2]):
            models = models[-1:]
    return sorted(out, key=lambda item: item.criterion, reverse=True)


def _leaves_as_much(found: LearnedModel, before: LearnedModel) -> bool:
    """Whether a search leaves as much as the one before with the same model."""
    least = before.estimated.excess / SEARCHES.max_same_excess_ratio
    return found.model == before.model and found.estimated.excess > least


def _rich_models(session: CalibrationSession, simple: Sequence[UnitModel]) -> list[LearnedModel]:
    """Learn further effects with one second stage after the other, until one leaves little.

    Where the spool is explained and the pressure is far from it the other one comes first, before
    the effects are looked for again.
    """
    out: list[LearnedModel] = []
    for model in simple:
        found = learn_further_effects(session, replace(model, plays=PLAYS_OF_SMOOTH_HYSTERESIS))
        if not _is_of_the_pressure(found):
            found = relearn_further_effects(session, found)
        out.append(found)
        if found.estimated.excess <= SEARCHES.max_excess_repeated:
            return out
    best = min(out, key=lambda item: item.criterion)
    if not _is_of_the_pressure(best):
        return out
    again = relearn_further_effects(session, best)
    return out if again is best else [*out, again]


def _with_one_play(session: CalibrationSession, found: LearnedModel) -> LearnedModel:
    """Learn with one play where a smooth hysteresis leans to its widest plays, if it costs no more.

    Such a hysteresis is nearly one play of its mean width, but for small changes of the current, by
    which a diagnosis would tell friction from it.
    """
    values = found.estimated.refined.values
    skew, count = values.get(SKEW_NAME, 0.0), found.model.plays
    if skew > SEARCHES.max_skew_of_one_play:
        return found
    places = (np.arange(count) + 0.5) / count
    mean_place = float(np.average(places, weights=np.exp(-skew * places)))
    begin = {**values, HYSTERESIS_NAME: 2.0 * mean_place * values[HYSTERESIS_NAME]}
    # The skew may stand for other effects, as the gain of a sensor.
    others = {*QUICK_EFFECTS, *significant_effects(found)} - {SKEW_NAME}
    one_play = _learn_effects(session, replace(found.model, plays=1), others, 0, begin)
    if found.estimated.explained and not one_play.estimated.explained:
        return found
    more = one_play.criterion - found.criterion
    return one_play if more < SEARCHES.max_same_cost_difference else found


def _is_of_the_pressure(found: LearnedModel) -> bool:
    return is_pressure_misfit(found.estimated.refined.residuals)


def _leaves_pressure_unexplained(found: LearnedModel) -> bool:
    """Whether the spool is explained, more or less, and the pressure is not."""
    excesses = signal_excess_costs(found.estimated.refined.residuals)
    return (
        excesses[SPOOL_ROW] <= SEARCHES.max_spool_excess_other_stage
        and excesses[PRESSURE_ROW] > FIT.max_explained_excess
    )


def _learn_simple_model(
    session: CalibrationSession, model: UnitModel, before: Sequence[LearnedModel]
) -> LearnedModel:
    """Learn with a model without further effects, a smooth hysteresis from where one play ended."""
    if model.plays == 1:
        return _learn_one_play(session, model, first=not before)
    alike = [item for item in before if item.model.second_stage == model.second_stage]
    hint = (alike or before)[-1].estimated.refined.values
    return session.learn(
        model,
        nearly_new=True,
        hint=hint,
        budget=SEARCHES.max_runs_one_start,
        part=RecordingSelection.OPEN_LOOP,
    )


def _learn_one_play(session: CalibrationSession, model: UnitModel, *, first: bool) -> LearnedModel:
    """Learn with one play, again where the search may have stopped beside the optimum."""
    found = session.learn(model, nearly_new=True, brief=True, part=RecordingSelection.OPEN_LOOP)
    turn = 1
    while turn < SEARCHES.searches_per_model and _may_be_local_optimum(found, first=first):
        # The unit may be worn, too.
        other = session.learn(
            model, nearly_new=turn != 1, brief=True, part=RecordingSelection.OPEN_LOOP, turn=turn
        )
        found = min(found, other, key=lambda item: item.criterion)
        turn += 1
        if found.estimated.excess > SEARCHES.max_excess_repeated or found.estimated.explained:
            break
    return found


def _may_be_local_optimum(found: LearnedModel, *, first: bool) -> bool:
    """Whether another search with the same model may explain more."""
    if found.estimated.explained:
        return False
    return first or found.estimated.excess <= SEARCHES.max_excess_repeated
