"""Calibrates a unit from recordings of it: learns what it is, or says why it cannot."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import msgspec
import numpy as np

from ehadiag.assess.acceptance import (
    objections_to_experiment,
    objections_to_recording,
    objections_to_unit,
    remarks_on_recording,
)
from ehadiag.assess.diagnosis import match_tests
from ehadiag.assess.verdict import Levels
from ehadiag.calibration.models import (
    SENSING,
    SMOOTH,
    Learned,
    Model,
    further_models,
    learn,
    simple_models,
)
from ehadiag.calibration.packing import Lesson, lesson_of, unit_of, values_of
from ehadiag.calibration.result import Calibrated, Severity, Tried
from ehadiag.core.actuator import Actuator, Tolerance
from ehadiag.core.calibration import Source
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment, build_experiment, share_offsets
from ehadiag.identify.nuisance.estimate import Estimated, estimate
from ehadiag.identify.nuisance.explained import is_noise
from ehadiag.identify.nuisance.knowledge import Knowledge, knowledge_of
from ehadiag.identify.nuisance.prior import usual
from ehadiag.identify.refine.first_part import CONSIDERED
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import FAULTS, OFFSETS, Unknowns

__all__ = ["AS_NEW", "LEAST_RECORDINGS", "calibrate", "update"]

AS_NEW = 0.05
"""Severity above which a unit is not as new."""
SURE = 2.0
"""Deviations by which a severity must be beyond it, or stay below twice of it."""
MOST_SEARCHES = 4
"""For what is kept, until two have come to the same place."""
NEARLY_EXPLAINED = 3.0
"""Excess of residuals over noise up to which the search may be to blame, and not the model."""
ALIKE = 30.0
"""Cost by which searches that came to the same place differ."""
LEAST_RECORDINGS = 2
"""One alone has nothing to be checked against."""

Progress = Callable[[str, float], None]
"""Called with the stage and its share done, 0 … 1."""


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
    session = _Session(recordings, plain, tests, default, seed, progress)
    reasons = session.objections()
    if not reasons and len(recordings) < LEAST_RECORDINGS:
        reasons = [
            f"{len(recordings)} recording is not enough: a calibration needs at least "
            f"{LEAST_RECORDINGS}, best of both loops"
        ]
    if reasons:
        return session.refused(reasons)
    tried = session.tried(compare=compare)
    best = min(tried, key=lambda item: item.criterion)
    reasons = session.unexplained(best) or _not_as_new(best.estimated)
    if reasons:
        return session.refused(reasons, best, tried)
    learned = session.learned_as_new(best)
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
    session = _Session(recordings, start, tests, default, seed, progress)
    if start.calibration is None:
        return session.refused([f"actuator {start.name!r} is not calibrated: nothing to update"])
    reasons = session.objections()
    if reasons:
        return session.refused(reasons)
    knowledge = knowledge_of(start)
    experiments = share_offsets(session.build(start))
    found = session.refined(experiments, knowledge)
    model = Model(start.second_stage.kind, start.calibration.plays)
    learned = Learned(model, list(experiments), found, 0.0)
    reasons = session.unexplained(learned) or _not_healthy(found)
    if reasons:
        return session.refused(reasons, learned, [learned])
    lesson = lesson_of(found, _usual_std(learned))
    return session.done(lesson, learned, learned, [learned], sources)


class _Session:
    """One calibration on its way."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        start: Actuator,
        tests: Iterable[StoredTest],
        default: StoredTest | None,
        seed: int,
        progress: Progress | None,
    ) -> None:
        self._begin = time.perf_counter()
        self._recordings = tuple(recordings)
        self._tests = match_tests(recordings, tests, default)
        self._start = start
        self._seed = seed
        self._evaluations = 0
        self.tell = progress or (lambda _stage, _share: None)

    def refined(self, experiments: Sequence[Experiment], knowledge: Knowledge) -> Estimated:
        """Estimate about what is known of a unit, until a search explains the recordings.

        Where none does its effects may have changed since.
        """
        loosened = knowledge.loosened()
        small = dict.fromkeys((item.name for item in FAULTS), 1e-3)
        found: list[Estimated] = []
        for turn in range(MOST_SEARCHES):
            self.tell("learning", turn / MOST_SEARCHES)
            found.append(
                estimate(
                    experiments,
                    (*FAULTS, *OFFSETS, *knowledge.free),
                    known=knowledge.known,
                    joint=(knowledge if turn < MOST_SEARCHES // 2 else loosened).joint,
                    considered=CONSIDERED,
                    hint=None if turn % 2 else small,
                    seed=self._seed + turn,
                )
            )
            self._evaluations += found[-1].evaluations
            if found[-1].explained:
                break
        return min(found, key=lambda item: item.excess)

    def objections(self) -> list[str]:
        """Why the recordings cannot be learned from, each named."""
        out = []
        for recording, test in zip(self._recordings, self._tests, strict=True):
            found = objections_to_recording(recording, test, self._start)
            if not found and test is not None and recording.samples is not None:
                found = objections_to_experiment(self._experiment(recording, test, self._start))
            out += [f"{recording.source}: {text}" for text in found]
        serials = {recording.serial for recording in self._recordings} - {None}
        if len(serials) > 1:
            words = ", ".join(str(serial) for serial in sorted(serials, key=str))
            out.append(f"the recordings are of units with different serial numbers: {words}")
        return [*out, *objections_to_unit(self._recordings, self._start)]

    def build(self, actuator: Actuator) -> list[Experiment]:
        """Experiments of all recordings."""
        return [
            self._experiment(recording, test, actuator)
            for recording, test in zip(self._recordings, self._tests, strict=True)
            if test is not None
        ]

    def _experiment(self, recording: Recording, test: StoredTest, actuator: Actuator) -> Experiment:
        assert recording.samples is not None
        return build_experiment(recording.samples, recording.environment, test, actuator)

    def tried(self, *, compare: bool) -> list[Learned]:
        """Learn with one model after the other until one explains the recordings.

        compare: either second stage with one play and with a smooth hysteresis, in any case.
        """
        models = simple_models(self._start)
        if compare:
            models += [replace(item, plays=SMOOTH) for item in models]
        out: list[Learned] = []
        for model in models:
            found = self._learn(model, nearly_new=True)
            turn = 1
            while turn < MOST_SEARCHES and _may_have_stopped_beside(found, first=not out):
                # The unit may be worn, or the search have stopped beside the optimum.
                other = self._learn(model, nearly_new=turn != 1, turn=turn)
                found = min(found, other, key=lambda item: item.criterion)
                turn += 1
                if found.estimated.excess > NEARLY_EXPLAINED:
                    break
            out.append(found)
            if found.estimated.explained and not compare:
                break
        best = min(out, key=lambda item: item.criterion).model
        for model in further_models(best):
            if any(item.estimated.explained for item in out):
                break
            if all(item.model != model for item in out):
                out.append(self._learn(model, nearly_new=True))
        return out

    def learned_as_new(self, best: Learned) -> Learned:
        """Learn once more, the severities taken for 0 and the frictions as new in their place.

        Residuals like noise are no proof of the best optimum, and what is learned here is believed
        ever after: the best of several searches is taken.
        """
        hint = best.estimated.refined.values
        found = [self._learn(best.model, new=True, hint=hint)]
        for turn in range(1, MOST_SEARCHES):
            around = None if turn % 2 else hint
            found.append(self._learn(best.model, new=True, hint=around, turn=turn))
            found.sort(key=lambda item: item.criterion)
            if found[1].criterion - found[0].criterion < ALIKE:
                break
        return found[0]

    def _learn(
        self,
        model: Model,
        *,
        new: bool = False,
        nearly_new: bool = False,
        hint: Mapping[str, float] | None = None,
        build: Callable[[Actuator], list[Experiment]] | None = None,
        turn: int = 0,
    ) -> Learned:
        found = learn(
            model,
            build or self.build,
            self._start,
            new=new,
            nearly_new=nearly_new,
            hint=hint,
            seed=self._seed + turn,
            tell=lambda share: self.tell(model.words, share),
        )
        self._evaluations += found.estimated.evaluations
        return found

    def unexplained(self, best: Learned) -> list[str]:
        """Why the best model cannot be learned from; empty where it explains the recordings."""
        if best.estimated.explained:
            return []
        reasons = []
        if len(self._recordings) > 1:
            residuals = best.estimated.refined.residuals
            ends = np.cumsum([item.ticks for item in best.experiments])[:-1]
            parts = np.split(residuals, ends, axis=1)
            bad = [
                recording.source
                for recording, part in zip(self._recordings, parts, strict=True)
                if not is_noise(part)
            ]
            reasons.append(f"not explained together: {', '.join(bad or ['none alone'])}")
            reasons += self._each_alone(best)
        return [
            f"no model explains the recordings: the residuals are {best.estimated.excess:.1f} times"
            " the noise: other recordings than of one sound unit as new, another type of unit, or"
            " an effect that no model has",
            *reasons,
        ]

    def _each_alone(self, best: Learned) -> list[str]:
        """Whether the recordings are explained one by one: then they are not of one unit."""
        for recording, test in zip(self._recordings, self._tests, strict=True):
            assert test is not None

            def build(
                actuator: Actuator, recording: Recording = recording, test: StoredTest = test
            ) -> list[Experiment]:
                return [self._experiment(recording, test, actuator)]

            found = self._learn(best.model, build=build)
            if not found.estimated.explained:
                return []
        return ["each recording alone is explained: they are not of one unit in one state"]

    def refused(
        self,
        reasons: Sequence[str],
        best: Learned | None = None,
        tried: Sequence[Learned] = (),
    ) -> Calibrated:
        """Return why there is no calibration."""
        return Calibrated(
            recordings=self._recordings,
            tests=self._tests,
            start=self._start,
            actuator=None,
            reasons=tuple(reasons),
            notes=self._notes(),
            severities=_severities(best.estimated) if best else (),
            values=(),
            tried=_evidence(tried),
            experiments=_with_constants(best) if best else (),
            seed=self._seed,
            evaluations=self._evaluations,
            elapsed=time.perf_counter() - self._begin,
        )

    def done(
        self,
        lesson: Lesson,
        learned: Learned,
        checked: Learned,
        tried: Sequence[Learned],
        sources: Sequence[Source] | None,
    ) -> Calibrated:
        """Return the unit.

        checked: with the severities estimated.
        """
        own = [
            Source(name=recording.source, test=test.name if test else "")
            for recording, test in zip(self._recordings, self._tests, strict=True)
        ]
        of_start = self._start.calibration
        serials = [item.serial for item in self._recordings if item.serial is not None]
        start = learned.model.of(self._start)
        unit = unit_of(
            start,
            lesson,
            learned.estimated,
            plays=learned.model.plays,
            date=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            serial=serials[0] if serials else (of_start.serial if of_start else None),
            sources=[*(of_start.recordings if of_start else ()), *(sources or own)],
            evidence={item.words: item.criterion for item in _evidence(tried)},
        )
        return Calibrated(
            recordings=self._recordings,
            tests=self._tests,
            start=self._start,
            actuator=unit,
            reasons=(),
            notes=self._notes(),
            severities=_severities(checked.estimated),
            values=values_of(self._start, unit, lesson),
            tried=_evidence(tried),
            experiments=_with_constants(learned),
            seed=self._seed,
            evaluations=self._evaluations,
            elapsed=time.perf_counter() - self._begin,
        )

    def _notes(self) -> tuple[str, ...]:
        """What the recordings say of themselves, each once."""
        each = (
            (*recording.quality.notes, *remarks_on_recording(recording, test, self._start))
            for recording, test in zip(self._recordings, self._tests, strict=True)
        )
        return tuple(dict.fromkeys(note for notes in each for note in notes))


def _severities(found: Estimated) -> tuple[Severity, ...]:
    values, names = found.refined.values, [item.name for item in found.refined.parameters]
    std = np.sqrt(np.diag(covariance(found.refined) + found.covariance)).tolist()
    return tuple(
        Severity(item.name, values[item.name], std[names.index(item.name)])
        for item in FAULTS
        if item.name in values
    )


def _may_have_stopped_beside(found: Learned, *, first: bool) -> bool:
    """Whether another search with the same model may explain more."""
    if found.estimated.explained:
        return False
    return first or found.estimated.excess <= NEARLY_EXPLAINED


def _usual_std(learned: Learned) -> dict[str, float]:
    """Deviations of what is known of any unit, by name."""
    known = {**SENSING, **learned.model.known}
    return {
        item.name: known.get(item.name, usual(item)).std
        for item in learned.estimated.refined.parameters
    }


def _not_as_new(found: Estimated) -> list[str]:
    """Why a unit is not as new; empty where it is."""
    out = []
    for item in _severities(found):
        if item.value > AS_NEW:
            out.append(f"not as new: {item.name} {item.value:.3f} ± {item.std:.3f}")
        elif item.value + SURE * item.std > 2.0 * AS_NEW:
            out.append(
                f"the recordings do not show whether the unit is as new: {item.name} "
                f"{item.value:.3f} ± {item.std:.3f}"
            )
    return out


def _not_healthy(found: Estimated) -> list[str]:
    """Why a unit is not healthy; empty where it is."""
    advisory = Levels().advisory
    return [
        f"not healthy: {item.name} {item.value:.3f} ± {item.std:.3f}"
        for item in _severities(found)
        if item.value + SURE * item.std >= advisory
    ]


def _with_constants(learned: Learned) -> tuple[Experiment, ...]:
    """Experiments with the constants that were found, for pictures."""
    refined = learned.estimated.refined
    out = []
    for experiment in learned.estimated.experiments:
        unknowns = Unknowns((), (experiment.constants,), refined.values)
        out.append(replace(experiment, constants=unknowns.constants(np.empty(0))))
    return tuple(out)


def _evidence(tried: Sequence[Learned]) -> tuple[Tried, ...]:
    if not tried:
        return ()
    best = min(item.criterion for item in tried)
    return tuple(
        Tried(item.model.words, item.estimated.excess, item.criterion - best) for item in tried
    )
