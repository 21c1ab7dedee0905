"""Recordings of one unit on their way to a calibration: read, checked, learned from, reported."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from enum import Enum
from functools import partial

import numpy as np

from ehadiag.assess.acceptance import (
    objections_to_experiment,
    objections_to_recording,
    objections_to_unit,
    remarks_on_recording,
    repetitions,
)
from ehadiag.assess.diagnosis import match_tests
from ehadiag.calibration.judging import severities_of
from ehadiag.calibration.models import BUDGET, Learned, Model, learn
from ehadiag.calibration.packing import Lesson, unit_of, values_of
from ehadiag.calibration.result import Calibrated, Tried
from ehadiag.core.actuator import Actuator
from ehadiag.core.calibration import Source
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.model.parameters import Unknowns

__all__ = ["Part", "Progress", "Session"]

Progress = Callable[[str, float], None]
"""Called with the stage and its share done, 0 … 1."""


class Part(Enum):
    """Which of the recordings are learned from."""

    ALL = "all"
    EACH_TEST = "the first of each test"
    OPEN_LOOP = "the first of each open-loop test, or of each test if none is"


class Session:
    """Recordings, the tests that they are of, and the unit's data to begin with."""

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
        self.recordings = tuple(recordings)
        self._tests = match_tests(recordings, tests, default)
        self.start = start
        self.seed = seed
        self.evaluations = 0
        self.tell = progress or (lambda _stage, _share: None)

    def objections(self) -> list[str]:
        """Why the recordings cannot be learned from, each named."""
        out = []
        for recording, test in zip(self.recordings, self._tests, strict=True):
            found = objections_to_recording(recording, test, self.start)
            if not found and test is not None and recording.samples is not None:
                found = objections_to_experiment(self._experiment(recording, test, self.start))
            out += [f"{recording.source}: {text}" for text in found]
        serials = {recording.serial for recording in self.recordings} - {None}
        if len(serials) > 1:
            words = ", ".join(str(serial) for serial in sorted(serials, key=str))
            out.append(f"the recordings are of units with different serial numbers: {words}")
        return [
            *out,
            *repetitions(self.recordings),
            *objections_to_unit(self.recordings, self.start),
        ]

    def build(self, actuator: Actuator, part: Part = Part.ALL) -> list[Experiment]:
        """Experiments of a part of the recordings."""
        return [
            self._experiment(self.recordings[index], self._tests[index], actuator)
            for index in self._indices(part)
        ]

    def _indices(self, part: Part) -> list[int]:
        known = [(index, test) for index, test in enumerate(self._tests) if test is not None]
        if part is Part.ALL:
            return [index for index, _ in known]
        if part is Part.OPEN_LOOP:
            known = [item for item in known if not item[1].closed_loop] or known
        return sorted({test.name: index for index, test in reversed(known)}.values())

    def _experiment(
        self, recording: Recording, test: StoredTest | None, actuator: Actuator
    ) -> Experiment:
        assert recording.samples is not None
        assert test is not None
        return build_experiment(recording.samples, recording.environment, test, actuator)

    def learn(
        self,
        model: Model,
        *,
        new: bool = False,
        nearly_new: bool = False,
        hint: Mapping[str, float] | None = None,
        hint_of_open: bool = False,
        budget: int = BUDGET,
        brief: bool = False,
        part: Part = Part.ALL,
        turn: int = 0,
    ) -> Learned:
        """Learn with a model; see `ehadiag.calibration.models.learn`.

        part: of the recordings; turn: of several searches with it.
        """
        found = learn(
            model,
            partial(self.build, part=part),
            self.start,
            new=new,
            nearly_new=nearly_new,
            hint=hint,
            hint_of_open=hint_of_open,
            budget=budget,
            brief=brief,
            seed=self.seed + turn,
            tell=lambda share: self.tell(model.words, share),
        )
        self.evaluations += found.estimated.evaluations
        return found

    def refused(
        self,
        reasons: Sequence[str],
        best: Learned | None = None,
        tried: Sequence[Learned] = (),
    ) -> Calibrated:
        """Return why there is no calibration."""
        return Calibrated(
            recordings=self.recordings,
            tests=self._tests,
            start=self.start,
            actuator=None,
            reasons=tuple(reasons),
            notes=self._notes(),
            severities=severities_of(best.estimated) if best else (),
            values=(),
            tried=_evidence(tried),
            experiments=_with_constants(best) if best else (),
            seed=self.seed,
            evaluations=self.evaluations,
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
            for recording, test in zip(self.recordings, self._tests, strict=True)
        ]
        of_start = self.start.calibration
        serials = [item.serial for item in self.recordings if item.serial is not None]
        start = learned.model.of(self.start)
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
            recordings=self.recordings,
            tests=self._tests,
            start=self.start,
            actuator=unit,
            reasons=(),
            notes=self._notes(),
            severities=severities_of(checked.estimated),
            values=values_of(self.start, unit, lesson),
            tried=_evidence(tried),
            experiments=_with_constants(learned),
            seed=self.seed,
            evaluations=self.evaluations,
            elapsed=time.perf_counter() - self._begin,
        )

    def _notes(self) -> tuple[str, ...]:
        """What the recordings say of themselves, each once."""
        each = (
            (*recording.quality.notes, *remarks_on_recording(recording, test, self.start))
            for recording, test in zip(self.recordings, self._tests, strict=True)
        )
        return tuple(dict.fromkeys(note for notes in each for note in notes))


def _with_constants(learned: Learned) -> tuple[Experiment, ...]:
    """Experiments with the constants that were found, for pictures."""
    refined = learned.estimated.refined
    out = []
    for experiment in learned.estimated.experiments:
        unknowns = Unknowns((), (experiment.constants,), refined.values)
        out.append(replace(experiment, constants=unknowns.constants(np.empty(0))))
    return tuple(out)


def _evidence(tried: Sequence[Learned]) -> tuple[Tried, ...]:
    """Models with what they leave, and the evidence against each."""
    if not tried:
        return ()
    best = min(item.criterion for item in tried)
    return tuple(
        Tried(item.model.words, item.estimated.excess, item.criterion - best) for item in tried
    )
