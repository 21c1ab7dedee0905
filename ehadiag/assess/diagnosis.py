"""From recordings to a verdict: the one path that every command and script takes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ehadiag.assess.acceptance import (
    objections_to_estimate,
    objections_to_experiment,
    objections_to_recording,
    remarks_on_recording,
)
from ehadiag.assess.verdict import Levels, Verdict, judge
from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.pipeline import identify
from ehadiag.identify.result import Identification
from ehadiag.identify.search.solvers import Solver
from ehadiag.identify.search.stages import Memory, Progress

__all__ = ["Diagnosis", "diagnose", "match_tests", "not_tested"]


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
    notes: tuple[str, ...]
    """What the recordings say of themselves, what was assumed, what is missing."""
    elapsed: float
    """s from samples to verdict."""


def diagnose(
    recordings: Sequence[Recording],
    actuator: Actuator,
    tests: Iterable[StoredTest],
    *,
    default: StoredTest | None = None,
    levels: Levels | None = None,
    solver: Solver | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    memory: Memory | None = None,
) -> Diagnosis:
    """Diagnose one actuator from one recording, or from several together.

    Parameters
    ----------
    tests: the tests that a recording may be of, told apart by number.
    default: test of recordings whose bus does not carry a number.
    memory: what was worked out ahead (see `ehadiag.assess.online`); it does not change the
        answer.
    """
    begin = time.perf_counter()
    matched = match_tests(recordings, tests, default)

    def result(
        verdict: Verdict,
        reasons: Sequence[str],
        identification: Identification | None = None,
        experiments: tuple[Experiment, ...] = (),
    ) -> Diagnosis:
        return Diagnosis(
            recordings=tuple(recordings),
            tests=matched,
            actuator=actuator,
            verdict=verdict,
            reasons=tuple(reasons),
            identification=identification,
            experiments=experiments,
            notes=_notes(recordings, matched, actuator),
            elapsed=time.perf_counter() - begin,
        )

    reasons, experiments = [], []
    for recording, test in zip(recordings, matched, strict=True):
        objections = objections_to_recording(recording, test, actuator)
        if not objections and test is not None and recording.samples is not None:
            experiment = build_experiment(recording.samples, recording.environment, test, actuator)
            objections = objections_to_experiment(experiment)
            experiments.append(experiment)
        reasons += objections
    if len({recording.serial for recording in recordings} - {None}) > 1:
        reasons.append("the recordings are of actuators with different serial numbers")
    if reasons:
        return result(Verdict.NOT_TESTED, reasons)
    identification = identify(
        experiments, solver=solver, seed=seed, progress=progress, memory=memory
    )
    doubts = objections_to_estimate(identification)
    if doubts:
        return result(Verdict.NOT_TESTED, doubts, identification, tuple(experiments))
    verdict, why = judge(identification, levels or Levels())
    return result(verdict, why, identification, tuple(experiments))


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
        notes=_notes(recordings, tests, actuator),
        elapsed=elapsed,
    )


def match_tests(
    recordings: Sequence[Recording], tests: Iterable[StoredTest], default: StoredTest | None = None
) -> tuple[StoredTest | None, ...]:
    """Find the test that each recording is of; None where it is none of `tests`."""
    known = tuple(tests)
    return tuple(_match(recording, known, default) for recording in recordings)


def _notes(
    recordings: Sequence[Recording], tests: Sequence[StoredTest | None], actuator: Actuator
) -> tuple[str, ...]:
    """Notes on all recordings, each once."""
    each = (
        (*recording.quality.notes, *remarks_on_recording(recording, test, actuator))
        for recording, test in zip(recordings, tests, strict=True)
    )
    return tuple(dict.fromkeys(note for notes in each for note in notes))


def _match(
    recording: Recording, tests: Sequence[StoredTest], default: StoredTest | None
) -> StoredTest | None:
    """Find the test that a recording is of."""
    if recording.test_id is None:
        return default
    return next((test for test in tests if test.id == recording.test_id), None)
