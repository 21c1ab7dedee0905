"""Calibrates a unit from recordings: its actuator data, or why they cannot be learned."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from ehadiag.calibration.calibration_session import (
    CalibrationProgress,
    CalibrationSession,
    RecordingSelection,
    learned_parameters,
)
from ehadiag.calibration.model_choice import (
    QUICK_EFFECTS,
    choose_model,
    ordered_effects,
    significant_effects,
)
from ehadiag.calibration.unit_models import (
    CRITERIA,
    DATUM_PRIOR,
    FURTHER_EFFECTS,
    OIL_EFFECTS,
    SEARCHES,
    SLOW_EFFECTS,
    Calibrated,
    LearnedModel,
    UnitModel,
    is_explained,
    objections_to_as_new,
    objections_to_healthy,
    objections_to_model,
)
from ehadiag.core.actuator import Actuator, Calibration, CalibrationSource, Tolerance
from ehadiag.identify.experiment import Experiment, share_offsets
from ehadiag.identify.nuisance_estimate import HYSTERESIS_NAME, NuisanceEstimate, estimate_nuisances
from ehadiag.identify.nuisance_search import NuisanceSearchSettings
from ehadiag.identify.partial_refinement import considered_instants
from ehadiag.identify.prior import UnitPrior, data_errors_of_severities, unit_prior, usual_prior
from ehadiag.identify.ring import Ring, ring_prior
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS
from firmware_iface.recording import Recording
from firmware_iface.stored_test import StoredTest


def learn_as_new(session: CalibrationSession, best: LearnedModel) -> LearnedModel:
    """Learn from all recordings, the severities taken for 0 and the frictions as new instead.

    Residuals like noise are no proof of the best optimum, and what is learned here is believed ever
    after: the best of several searches is taken. Where the model leaves something in open loop the
    further effects that this does not ask for are freed once more, since closed loop may: but not
    where it is so rough that it would ask for any, unless all is unexplained without.

    best: from open loop, with the severities estimated.
    """
    values = best.estimated.refined.values
    if best.model.by_position:
        return _learn_chambers_as_new(session, best)
    hint = {**values, **data_errors_of_severities(session.start, values)}
    if best.model.rich and not (
        best.estimated.explained or values[HYSTERESIS_NAME] < SEARCHES.min_hysteresis_effects
    ):
        return _with_effects(session, best, hint)
    model = replace(best.model, beside=significant_effects(best)) if best.model.rich else best.model
    budget = SEARCHES.max_runs_two_starts
    found = [session.learn(model, new=True, hint=hint, hint_of_open=True, budget=budget)]
    for turn in range(1, SEARCHES.searches_as_new):
        if _is_same_optimum(best, found[0]) or (model.rich and found[0].estimated.explained):
            break
        around = None if turn % 2 else found[0].estimated.refined.values
        found.append(session.learn(model, new=True, hint=around, budget=budget, turn=turn))
        found.sort(key=lambda item: item.criterion)
        if found[1].criterion - found[0].criterion < SEARCHES.max_same_cost_difference:
            break
    if model.rich and not is_explained(found[0]):
        found.append(_with_effects(session, best, hint))
    return min(found, key=lambda item: item.criterion)


def _learn_chambers_as_new(session: CalibrationSession, best: LearnedModel) -> LearnedModel:
    """Learn from all recordings, where open loop has shown the phase of the ring.

    Closed loop begins in the valley of open loop: with other values each break-away of its jack
    comes at another phase.
    """
    values = best.estimated.refined.values
    hint = {**values, **data_errors_of_severities(session.start, values)}
    stiffness = (1.0 + values["bulk_modulus"]) / (1.0 + values["datum_volume_of_one_chamber"])
    ring = Ring(stiffness / (1.0 + values["datum_MJ"]) - 1.0, 0.0)
    joint = ring_prior(ring, OIL_EFFECTS["bulk_modulus"], DATUM_PRIOR)
    found: list[LearnedModel] = []
    for turn in range(SEARCHES.searches_of_chambers):
        found.append(
            session.learn(
                best.model, new=True, hint=hint, hint_of_open=True, joint=joint,
                budget=SEARCHES.max_runs_one_start, turn=turn,
            )
        )  # fmt: skip
        # Another search cannot explain more than open loop, which is where the optimum is found.
        most = SEARCHES.max_same_excess_ratio * best.estimated.excess
        if found[-1].estimated.explained or found[-1].estimated.excess <= most:
            break
    return min(found, key=lambda item: item.criterion)


def _with_effects(
    session: CalibrationSession, best: LearnedModel, hint: Mapping[str, float]
) -> LearnedModel:
    """Learn from all recordings with the further effects that these ask for."""
    names = set(significant_effects(best))
    if not names.intersection(SLOW_EFFECTS):
        names.update(QUICK_EFFECTS)
    model = replace(best.model, beside=ordered_effects(names))
    whole = session.learn(
        model,
        new=True,
        hint=hint,
        hint_of_open=True,
        budget=SEARCHES.max_runs_one_start,
        part=RecordingSelection.EACH_TEST,
    )
    fewer = replace(model, beside=significant_effects(whole))
    of_all = [whole] if len(whole.experiments) == len(session.recordings) else []
    if fewer == model and of_all:
        return whole
    enough = 1 if names.intersection(SLOW_EFFECTS) else 2
    found: list[LearnedModel] = []
    while len(found) < SEARCHES.searches_as_new:
        afresh = bool(len(found) % 2)
        around = hint if afresh else min([whole, *found], key=_excess_of).estimated.refined.values
        found.append(
            session.learn(
                fewer,
                new=True,
                hint=around,
                hint_of_open=afresh,
                budget=SEARCHES.max_runs_one_start,
                turn=len(found),
            )
        )
        nearest = min(found, key=_excess_of)
        before, fewer = fewer, replace(fewer, beside=significant_effects(found[-1]))
        done = nearest.estimated.explained or len(found) >= enough
        if fewer == before and done and _is_good_enough(nearest, whole):
            break
    return min([*found, *of_all], key=lambda item: item.criterion)


def _excess_of(found: LearnedModel) -> float:
    """What a search leaves, over noise."""
    return found.estimated.excess


def _is_same_optimum(best: LearnedModel, found: LearnedModel) -> bool:
    """Whether a search came to the place of another one with the same recordings."""
    same = len(best.experiments) == len(found.experiments)
    return same and found.criterion - best.criterion < SEARCHES.max_same_cost_difference


def _is_good_enough(found: LearnedModel, best: LearnedModel) -> bool:
    """Whether what a search leaves is explained, or about as little as another one left."""
    if found.estimated.explained:
        return True
    return found.estimated.excess <= min(
        SEARCHES.max_excess_repeated, SEARCHES.max_same_excess_ratio * best.estimated.excess
    )


def calibrate(
    recordings: Sequence[Recording],
    start: Actuator,
    tests: Iterable[StoredTest],
    *,
    default: StoredTest | None = None,
    sources: Sequence[CalibrationSource] | None = None,
    compare: bool = False,
    seed: int = 0,
    progress: CalibrationProgress | None = None,
) -> Calibrated:
    """Learn a unit from recordings of it as new.

    Data and effects are looked for within their usual sizes (PHY-28 to 37), whatever the start file
    says of tolerances.

    recordings: of one unit, as new: at least two; start: data of the unit's type; default: test of
    recordings whose bus does not carry a number; sources: what the file says of each recording; its
    name and test unless given; compare: try both second stages, each with one play and with a
    smooth hysteresis, also where the first explains the recordings; progress: called with stage and
    share done. Returns with `reasons` and no actuator where it is refused.
    """
    plain = msgspec.structs.replace(start, tolerance=Tolerance(), calibration=None)
    session = CalibrationSession(recordings, plain, tests, default, seed, progress)
    reasons = session.objections()
    if not reasons and len(recordings) < CRITERIA.min_recordings:
        reasons = [
            f"{len(recordings)} recording is not enough: a calibration needs at least "
            f"{CRITERIA.min_recordings}, best of both loops"
        ]
    if reasons:
        return session.refused(reasons)
    tried = choose_model(session, plain, compare=compare)
    best = min(tried, key=lambda item: (not is_explained(item), item.criterion))
    if not is_explained(best):
        return session.refused(objections_to_model(best), best, tried)
    reasons = objections_to_as_new(best.estimated)
    if reasons:
        return session.refused(reasons, best, tried)
    learned = learn_as_new(session, best)
    if not is_explained(learned):
        return session.refused(objections_to_model(learned, recordings), best, tried)
    lesson = learned_parameters(learned.estimated, _prior_stds(learned))
    return session.done(lesson, learned, best, tried, sources)


def update_calibration(
    recordings: Sequence[Recording],
    start: Actuator,
    tests: Iterable[StoredTest],
    *,
    default: StoredTest | None = None,
    sources: Sequence[CalibrationSource] | None = None,
    seed: int = 0,
    progress: CalibrationProgress | None = None,
) -> Calibrated:
    """Refine a calibration by later recordings of the same unit, still healthy.

    The calibration is the prior. The severities are estimated too, so the unit need not be as new.
    One recording suffices; the parameters are those of `calibrate`, the start the calibrated unit.
    """
    session = CalibrationSession(recordings, start, tests, default, seed, progress)
    if start.calibration is None:
        return session.refused([f"actuator {start.name!r} is not calibrated: nothing to update"])
    reasons = [
        *session.objections(),
        *_objections_to_repeated_sources(start.calibration, sources or ()),
    ]
    if reasons:
        return session.refused(reasons)
    knowledge = unit_prior(start)
    experiments = share_offsets(session.build(start))
    found = _refine_estimate(session, experiments, knowledge)
    model = UnitModel(start.second_stage.kind, start.calibration.plays)
    learned = LearnedModel(model, list(experiments), found, 0.0)
    if not found.explained:
        return session.refused(objections_to_model(learned, session.recordings), learned, [learned])
    reasons = objections_to_healthy(found)
    if reasons:
        return session.refused(reasons, learned, [learned])
    lesson = learned_parameters(found, _prior_stds(learned))
    return session.done(lesson, learned, learned, [learned], sources)


def _objections_to_repeated_sources(
    calibration: Calibration, sources: Sequence[CalibrationSource]
) -> list[str]:
    """Say which recordings the calibration was learned from: they would count twice."""
    known = {item.sha256: item.name for item in calibration.recordings if item.sha256}
    return [
        f"{item.name} is {known[item.sha256]}, which the calibration was learned from already"
        for item in sources
        if item.sha256 in known
    ]


def _refine_estimate(
    session: CalibrationSession, experiments: Sequence[Experiment], knowledge: UnitPrior
) -> NuisanceEstimate:
    """Estimate about what is known of a unit, until a search explains the recordings.

    Where none does its effects may have changed since.
    """
    loosened = knowledge.loosened()
    small = dict.fromkeys((item.name for item in FAULTS), 1e-3)
    free = (*FAULTS, *SENSOR_OFFSETS, *knowledge.free)
    found: list[NuisanceEstimate] = []
    for turn in range(SEARCHES.searches_of_update):
        session.tell("learning", turn / SEARCHES.searches_of_update)
        found.append(
            estimate_nuisances(
                experiments,
                NuisanceSearchSettings(
                    free,
                    priors=knowledge.priors,
                    joint=(
                        knowledge if turn < SEARCHES.searches_of_update // 2 else loosened
                    ).joint,
                    hint=None if turn % 2 else small,
                    seed=session.seed + turn,
                    explains=knowledge.explains,
                ),
                considered_instants(free),
            )
        )
        session.evaluations += found[-1].evaluations
        if found[-1].explained:
            break
    return min(found, key=lambda item: item.excess)


def _prior_stds(learned: LearnedModel) -> dict[str, float]:
    """Deviations of what is known of any unit, by name."""
    known = {**FURTHER_EFFECTS, **learned.model.known}
    return {
        item.name: known.get(item.name, usual_prior(item)).std
        for item in learned.estimated.refined.parameters
    }
