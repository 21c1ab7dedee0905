"""From recordings to a verdict: the one path that every command and script takes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ehadiag.assess.acceptance import (
    objection_to_current,
    objections_to_estimate,
    objections_to_experiment,
    objections_to_recording,
    objections_to_unit,
    out_of_range,
    remarks_on_recording,
    repetitions,
)
from ehadiag.assess.culprit import Culprit, culprit_of
from ehadiag.assess.delays import in_time
from ehadiag.assess.lost_ticks import UNEASY, can_be_told, told_by_response, widened
from ehadiag.assess.modelled import response_of
from ehadiag.assess.other_faults import (
    OtherFault,
    degraded_by,
    notes_on_other_faults,
    other_faults,
)
from ehadiag.assess.plausible import objections_to_actuator
from ehadiag.assess.position import (
    PositionFit,
    most_gain_error,
    objections_to_position,
    position_fit,
)
from ehadiag.assess.supply import objections_to_supply
from ehadiag.assess.travel import objections_to_travel
from ehadiag.assess.unobservable import (
    lost_order,
    lost_positions,
    observable,
    what_is_left,
)
from ehadiag.assess.verdict import Levels, Verdict, judge
from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Recording
from ehadiag.core.shown_in import told
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment, build_experiment, noise_is_judged_early
from ehadiag.identify.nuisance.knowledge import OF_THE_DAY, PASS_FOR_FAULTS, knowledge_of
from ehadiag.identify.result import Identification
from ehadiag.identify.search.solvers import CompactGa, Solver
from ehadiag.identify.search.stages import STAGES, Progress, first_ends_at, stage_ends_at
from ehadiag.identify.session import Nuisances, Session, SoFar
from ehadiag.model.parameters import parameter
from ehadiag.model.scalar.response import Response

__all__ = ["Diagnosis", "DiagnosisSession", "diagnose", "match_tests", "not_tested"]

CHANGED = 6.0
"""Deviations of a calibration beyond which an effect has changed since."""
LEAST_CHANGE = 0.1
"""Of an effect, in units of its scale."""
LEAST_SHARE = 0.75
"""Share of samples without which nothing is worked out of a running test."""


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """Verdict on one actuator, and all that led to it."""

    recordings: tuple[Recording, ...]
    tests: tuple[StoredTest | None, ...]
    actuator: Actuator
    verdict: Verdict
    reasons: tuple[str, ...]
    identification: Identification | None
    """None where the recording could not be identified from."""
    experiments: tuple[Experiment, ...]
    """What was identified from; empty without identification."""
    positions: tuple[PositionFit | None, ...]
    """Of each experiment the check of its position sensor; None where there are too few samples."""
    other: tuple[OtherFault, ...]
    """Effects of the unit that were estimated and have a limit of their own."""
    culprit: Culprit | None
    """What may keep the model from explaining the recordings; None where it explains them."""
    notes: tuple[str, ...]
    """What the recordings say of themselves, what was assumed, what is missing."""
    elapsed: float
    """s from samples to verdict."""


Estimated = tuple[list[Experiment], Identification, tuple[str, ...], tuple[str, ...]]
"""Experiments, what they say, notes on what was put right, and why it cannot carry a verdict."""


class DiagnosisSession:
    """A diagnosis that is fed a recording as it grows, and is asked to finish.

    A finished recording is the same path, fed once: `diagnose`. What was worked out of a test's
    beginning is used where the finished recording has the same samples to the last bit, so that the
    answer is that of the recording alone, only sooner. One thread at a time.

    Parameters
    ----------
    actuator : Actuator
    tests : Iterable[StoredTest]
        The tests that a recording may be of, told apart by number.
    default : StoredTest | None
        Test of recordings whose bus does not carry a number.
    levels : Levels | None
        Advisory level and limit.
    solver : Solver | None
        Global search; the compact genetic algorithm unless given.
    seed : int
        The same seed gives the same answer on the same machine.
    nuisances : Nuisances
        Which effects of the installation are estimated beside the faults.
    """

    def __init__(
        self,
        actuator: Actuator,
        tests: Iterable[StoredTest],
        *,
        default: StoredTest | None = None,
        levels: Levels | None = None,
        solver: Solver | None = None,
        seed: int = 0,
        nuisances: Nuisances = Nuisances.AUTO,
    ) -> None:
        self._actuator = actuator
        self._tests = tuple(tests)
        self._default = default
        self._levels = levels or Levels()
        self._session = Session(solver, seed, nuisances, knowledge_of(actuator))

    @property
    def reused(self) -> int:
        """Stages that did not have to run again when the diagnosis was finished."""
        return self._session.reused

    @property
    def so_far(self) -> SoFar | None:
        """Severities as the running test shows them; another thread may look."""
        return self._session.so_far

    def due_s(self, test: StoredTest) -> tuple[float, ...]:
        """Instants of a running test (s) from which there is something more to work out.

        None for a solver that holds the interpreter, nor for a test without a quiet first part.
        """
        if not isinstance(self._session.solver, CompactGa) or not noise_is_judged_early(test):
            return ()
        ends = {first_ends_at(test), *(stage_ends_at(test, i) for i in range(len(STAGES)))}
        return tuple(sorted(end for end in ends if end < test.duration))

    def feed(self, recording: Recording) -> None:
        """Work out all that the samples so far allow; nothing of what cannot carry a verdict."""
        samples, test = recording.samples, _match(recording, self._tests, self._default)
        if samples is None or samples.ticks == 0 or test is None or not self.due_s(test):
            return
        if out_of_range(recording.environment, samples, self._actuator):
            return
        if objections_to_actuator(self._actuator):
            return
        experiment = build_experiment(samples, recording.environment, test, self._actuator)
        for values in (experiment.spool, experiment.pressure):
            if np.isfinite(values).mean() < LEAST_SHARE:
                return
        self._session.feed([experiment])

    def finish(
        self, recordings: Sequence[Recording], progress: Progress | None = None
    ) -> Diagnosis:
        """Diagnose one actuator from one complete recording, or from several together."""
        begin = time.perf_counter()
        matched = match_tests(recordings, self._tests, self._default)
        experiments, reasons = self._experiments(recordings, matched)
        orders = tuple(dict.fromkeys(filter(None, map(lost_order, recordings))))
        known = (*map(lost_positions, experiments), *orders)
        hidden = tuple(dict.fromkeys(reason for reason in reasons if reason in known))
        closed = any(item.test.closed_loop for item in experiments)
        lost = bool(hidden) and set(reasons) <= set(hidden) and observable(experiments)
        identification: Identification | None = None
        positions: tuple[PositionFit | None, ...] = ()
        others: tuple[OtherFault, ...] = ()
        culprit: Culprit | None = None
        late: tuple[str, ...] = ()
        verdict, why = Verdict.NOT_TESTED, tuple(reasons)
        told = self._told(recordings, experiments, progress) if lost and not orders else None
        if lost and told is None:
            found = self._session.finish(experiments, progress)
            identification, words = what_is_left(found, closed=closed)
            why = tuple(f"{reason}: {words}" for reason in hidden)
        if told is not None or not reasons:
            experiments, identification, late, why = told or self._estimated(
                recordings, experiments, progress, ordered=not orders
            )
            modelled = [response_of(item, identification) for item in experiments]
            positions = tuple(map(position_fit, experiments, modelled))
            others = other_faults(identification, self._actuator)
            if why and orders:
                identification, words = what_is_left(identification, closed=closed)
                why = tuple(f"{reason}: {words}" for reason in orders)
            elif why:
                culprit = culprit_of(experiments, identification, recordings[0].environment)
            else:
                why = (
                    *_of_supplies(experiments, modelled, identification),
                    *_of_positions(positions, most_gain_error(self._actuator)),
                )
            if not why:
                verdict, why = degraded_by(others, *judge(identification, self._levels))
        return Diagnosis(
            recordings=tuple(recordings),
            tests=matched,
            actuator=self._actuator,
            verdict=verdict,
            reasons=why,
            identification=identification,
            experiments=tuple(experiments) if identification else (),
            positions=positions,
            other=others,
            culprit=culprit,
            notes=(
                *_notes(recordings, matched, self._actuator),
                *_freed(identification, self._actuator),
                *late,
                *_unchecked(positions),
                *notes_on_other_faults(others),
            ),
            elapsed=time.perf_counter() - begin,
        )

    def _estimated(
        self,
        recordings: Sequence[Recording],
        experiments: list[Experiment],
        progress: Progress | None,
        *,
        ordered: bool,
    ) -> Estimated:
        """Identify; where that does not explain the recordings, by what the response tells."""
        found = self._session.finish(experiments, progress)
        late: tuple[str, ...] = ()
        by_time = any(item.by_time for item in recordings)
        if by_time:
            experiments, found, late = in_time(
                experiments, found, lambda item: self._session.finish(item, progress)
            )
        why = tuple(objections_to_estimate(found, self._actuator.calibration))
        if why and ordered and not late:
            told = self._told(recordings, experiments, progress)
            if told is not None:
                return told
        if by_time and found.fit.outliers > UNEASY and can_be_told(recordings, experiments):
            found = widened(found)
        return experiments, found, late, why

    def _told(
        self,
        recordings: Sequence[Recording],
        experiments: Sequence[Experiment],
        progress: Progress | None,
    ) -> Estimated | None:
        """Identify with lost positions as the response tells them; None where that explains
        nothing."""
        if not can_be_told(recordings, experiments):
            return None
        told = told_by_response(
            recordings,
            experiments,
            self._actuator,
            lambda item: self._session.finish(item, progress),
        )
        if told is None or objections_to_estimate(told[1], self._actuator.calibration):
            return None
        now, found, note = told
        return now, widened(found), (note,), ()

    def _experiments(
        self, recordings: Sequence[Recording], matched: Sequence[StoredTest | None]
    ) -> tuple[list[Experiment], list[str]]:
        """What is identified from, and why that cannot be."""
        reasons, experiments = objections_to_actuator(self._actuator), []
        for recording, test in zip(recordings, matched, strict=True):
            objections = objections_to_recording(recording, test, self._actuator)
            if not objections and test is not None and recording.samples is not None:
                experiment = build_experiment(
                    recording.samples, recording.environment, test, self._actuator
                )
                objections = objections_to_experiment(experiment)
                if objections == [objection_to_current(experiment)] and lost_order(recording):
                    objections = [lost_order(recording)]
                if test.closed_loop and not objections:
                    # The control law works on the position: a search would take long.
                    objections = objections_to_travel(recording.samples, self._actuator)
                experiments.append(experiment)
            reasons += objections
        if len({recording.serial for recording in recordings} - {None}) > 1:
            reasons.append("the recordings are of actuators with different serial numbers")
        else:
            reasons += repetitions(recordings)
        reasons += objections_to_unit(recordings, self._actuator)
        return experiments, reasons


def diagnose(
    recordings: Sequence[Recording],
    actuator: Actuator,
    tests: Iterable[StoredTest],
    *,
    default: StoredTest | None = None,
    levels: Levels | None = None,
    solver: Solver | None = None,
    seed: int = 0,
    nuisances: Nuisances = Nuisances.AUTO,
    progress: Progress | None = None,
) -> Diagnosis:
    """Diagnose one actuator from complete recordings: see `DiagnosisSession`."""
    session = DiagnosisSession(
        actuator,
        tests,
        default=default,
        levels=levels,
        solver=solver,
        seed=seed,
        nuisances=nuisances,
    )
    return session.finish(recordings, progress)


def not_tested(
    recordings: Sequence[Recording],
    tests: Sequence[StoredTest | None],
    actuator: Actuator,
    reasons: Sequence[str],
    elapsed: float = 0.0,
) -> Diagnosis:
    """Return the verdict NOT TESTED for a test that did not come about, or was not judged.

    tests: of each recording.
    """
    return Diagnosis(
        recordings=tuple(recordings),
        tests=tuple(tests),
        actuator=actuator,
        verdict=Verdict.NOT_TESTED,
        reasons=tuple(reasons),
        identification=None,
        experiments=(),
        positions=(),
        other=(),
        culprit=None,
        notes=_notes(recordings, tests, actuator),
        elapsed=elapsed,
    )


def match_tests(
    recordings: Sequence[Recording], tests: Iterable[StoredTest], default: StoredTest | None = None
) -> tuple[StoredTest | None, ...]:
    """Find the test that each recording is of; None where it is none of `tests`."""
    known = tuple(tests)
    return tuple(_match(recording, known, default) for recording in recordings)


def _match(
    recording: Recording, tests: Sequence[StoredTest], default: StoredTest | None
) -> StoredTest | None:
    """Find the test that a recording is of."""
    if recording.test_id is None:
        return default
    return next((test for test in tests if test.id == recording.test_id), None)


def _notes(
    recordings: Sequence[Recording], tests: Sequence[StoredTest | None], actuator: Actuator
) -> tuple[str, ...]:
    """Notes on all recordings, each once."""
    each = (
        (*recording.quality.notes, *remarks_on_recording(recording, test, actuator))
        for recording, test in zip(recordings, tests, strict=True)
    )
    return tuple(dict.fromkeys(note for notes in each for note in notes))


def _of_supplies(
    experiments: Sequence[Experiment],
    modelled: Sequence[Response],
    identification: Identification,
) -> list[str]:
    """Why the supply pressure cannot be what its probe says, each reason once."""
    # What the sensor read at rest has been taken off those that rested.
    offset = identification.fit.pressure_offset
    found = (
        objections_to_supply(experiment, response, offset - experiment.pressure_offset)
        for experiment, response in zip(experiments, modelled, strict=True)
    )
    return list(dict.fromkeys(why for reasons in found for why in reasons))


def _of_positions(positions: Sequence[PositionFit | None], most: float) -> list[str]:
    """Why the position sensor cannot be believed, each reason once."""
    found = (objections_to_position(fit, most) for fit in positions if fit)
    return list(dict.fromkeys(why for reasons in found for why in reasons))


def _unchecked(positions: Sequence[PositionFit | None]) -> tuple[str, ...]:
    """Whether the position sensor went unchecked."""
    if None not in positions:
        return ()
    return ("too few samples of the jack position: its sensor is not checked",)


def _freed(identification: Identification | None, actuator: Actuator) -> tuple[str, ...]:
    """What was estimated beside the faults, if anything, and what is known of it."""
    if identification is None or not identification.freed:
        return ()
    out = []
    calibration = actuator.calibration
    learned = calibration.parameters if calibration else ()
    stds = dict(zip(learned, calibration.std, strict=True)) if calibration else {}
    if calibration is not None:
        out.append(
            f"actuator calibrated on {calibration.date} from {len(calibration.recordings)} "
            "recordings: its data and effects are refined within what is known of them"
        )
        out += [
            f"{parameter(name).short} has changed since: {told(value, parameter(name).unit)} then, "
            f"{told(identification.nuisances[name].value, parameter(name).unit)} now"
            for name, value in calibration.effects.items()
            if name in identification.nuisances
            and abs(identification.nuisances[name].value - value)
            > max(CHANGED * stds[name], LEAST_CHANGE * parameter(name).scale)
        ]
    learned = (*learned, *OF_THE_DAY)
    words = [parameter(name).short for name in identification.freed if name not in learned]
    if words:
        out.append(f"estimated beside the faults: {', '.join(words)}")
    aliases = [name for name in PASS_FOR_FAULTS if actuator.tolerance.of(name) > 0.0]
    if aliases and calibration is None:
        out.append(
            f"held, with the tolerance in the intervals: {', '.join(aliases)}, which no recording "
            "tells from a fault"
        )
    return tuple(out)
