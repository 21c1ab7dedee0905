"""Calibrates a unit from recordings of it: learns what it is, or says why it cannot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from ehadiag.calibration.as_new import learned_as_new
from ehadiag.calibration.choice import choose
from ehadiag.calibration.judging import AS_NEW, is_explained, not_as_new, not_healthy, unexplained
from ehadiag.calibration.models import EFFECTS, Learned, Model
from ehadiag.calibration.packing import lesson_of
from ehadiag.calibration.result import Calibrated
from ehadiag.calibration.session import Progress, Session
from ehadiag.core.actuator import Actuator, Tolerance
from ehadiag.core.calibration import Calibration, Source
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment, share_offsets
from ehadiag.identify.nuisance.estimate import Estimated, estimate
from ehadiag.identify.nuisance.knowledge import Knowledge, knowledge_of
from ehadiag.identify.nuisance.prior import usual
from ehadiag.identify.refine.first_part import CONSIDERED
from ehadiag.model.parameters import FAULTS, OFFSETS

__all__ = ["AS_NEW", "LEAST_RECORDINGS", "calibrate", "update"]

LEAST_RECORDINGS = 2
"""One alone has nothing to be checked against."""
MOST_SEARCHES = 4
"""Of an update, until one explains the recordings."""


def calibrate(
    recordings: Sequence[Recording],
    start: Actuator,
    tests: Iterable[StoredTest],
    *,
    default: StoredTest | None = None,
    sources: Sequence[Source] | None = None,
    compare: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibrated:
    """Learn a unit from recordings of it as new.

    Data and effects are looked for within their usual sizes (PHY-28 to 37), whatever the start file
    says of tolerances.

    Parameters
    ----------
    recordings : Sequence[Recording]
        Of one unit, as new: at least `LEAST_RECORDINGS`.
    start : Actuator
        Data of the unit's type.
    tests : Iterable[StoredTest]
        Tests that a recording may be of.
    default : StoredTest | None
        Test of recordings whose bus does not carry a number.
    sources : Sequence[Source] | None
        What the file says of each recording; its name and test unless given.
    compare : bool
        Try both second stages, each with one play and with a smooth hysteresis, also where the
        first explains the recordings.
    seed : int
        The same seed gives the same answer.
    progress : Progress | None
        Called with stage and share done.

    Returns
    -------
    Calibrated
        With `reasons` and no actuator where it is refused.
    """
    plain = msgspec.structs.replace(start, tolerance=Tolerance(), calibration=None)
    session = Session(recordings, plain, tests, default, seed, progress)
    reasons = session.objections()
    if not reasons and len(recordings) < LEAST_RECORDINGS:
        reasons = [
            f"{len(recordings)} recording is not enough: a calibration needs at least "
            f"{LEAST_RECORDINGS}, best of both loops"
        ]
    if reasons:
        return session.refused(reasons)
    tried = choose(session, plain, compare=compare)
    best = min(tried, key=lambda item: (not is_explained(item), item.criterion))
    if not is_explained(best):
        return session.refused(unexplained(best), best, tried)
    reasons = not_as_new(best.estimated)
    if reasons:
        return session.refused(reasons, best, tried)
    learned = learned_as_new(session, best)
    if not is_explained(learned):
        return session.refused(unexplained(learned, recordings), best, tried)
    lesson = lesson_of(learned.estimated, _usual_std(learned))
    return session.done(lesson, learned, best, tried, sources)


def update(
    recordings: Sequence[Recording],
    start: Actuator,
    tests: Iterable[StoredTest],
    *,
    default: StoredTest | None = None,
    sources: Sequence[Source] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibrated:
    """Refine a calibration by later recordings of the same unit, still healthy.

    What the calibration says is what is known beforehand. The severities are estimated beside it,
    so the unit need not be as new.

    Parameters
    ----------
    recordings : Sequence[Recording]
        Of one unit at one time; one suffices.
    start : Actuator
        The calibrated unit.
    tests : Iterable[StoredTest]
        See `calibrate`.
    default : StoredTest | None
        See `calibrate`.
    sources : Sequence[Source] | None
        See `calibrate`.
    seed : int
        See `calibrate`.
    progress : Progress | None
        See `calibrate`.

    Returns
    -------
    Calibrated
        With `reasons` and no actuator where it is refused.
    """
    session = Session(recordings, start, tests, default, seed, progress)
    if start.calibration is None:
        return session.refused([f"actuator {start.name!r} is not calibrated: nothing to update"])
    reasons = [*session.objections(), *_known_already(start.calibration, sources or ())]
    if reasons:
        return session.refused(reasons)
    knowledge = knowledge_of(start)
    experiments = share_offsets(session.build(start))
    found = _refined(session, experiments, knowledge)
    model = Model(start.second_stage.kind, start.calibration.plays)
    learned = Learned(model, list(experiments), found, 0.0)
    if not found.explained:
        return session.refused(unexplained(learned, session.recordings), learned, [learned])
    reasons = not_healthy(found)
    if reasons:
        return session.refused(reasons, learned, [learned])
    lesson = lesson_of(found, _usual_std(learned))
    return session.done(lesson, learned, learned, [learned], sources)


def _known_already(calibration: Calibration, sources: Sequence[Source]) -> list[str]:
    """Say which recordings the calibration was learned from: they would count twice."""
    known = {item.sha256: item.name for item in calibration.recordings if item.sha256}
    return [
        f"{item.name} is {known[item.sha256]}, which the calibration was learned from already"
        for item in sources
        if item.sha256 in known
    ]


def _refined(
    session: Session, experiments: Sequence[Experiment], knowledge: Knowledge
) -> Estimated:
    """Estimate about what is known of a unit, until a search explains the recordings.

    Where none does its effects may have changed since.
    """
    loosened = knowledge.loosened()
    small = dict.fromkeys((item.name for item in FAULTS), 1e-3)
    found: list[Estimated] = []
    for turn in range(MOST_SEARCHES):
        session.tell("learning", turn / MOST_SEARCHES)
        found.append(
            estimate(
                experiments,
                (*FAULTS, *OFFSETS, *knowledge.free),
                known=knowledge.known,
                joint=(knowledge if turn < MOST_SEARCHES // 2 else loosened).joint,
                considered=CONSIDERED,
                hint=None if turn % 2 else small,
                seed=session.seed + turn,
                explains=knowledge.explains,
            )
        )
        session.evaluations += found[-1].evaluations
        if found[-1].explained:
            break
    return min(found, key=lambda item: item.excess)


def _usual_std(learned: Learned) -> dict[str, float]:
    """Deviations of what is known of any unit, by name."""
    known = {**EFFECTS, **learned.model.known}
    return {
        item.name: known.get(item.name, usual(item)).std
        for item in learned.estimated.refined.parameters
    }
