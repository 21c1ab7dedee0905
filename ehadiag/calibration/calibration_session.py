"""Checks the recordings of one unit, fits models to them, and packs the calibrated data."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from enum import Enum
from functools import partial

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.assess.acceptance import (
    notes_on_recording,
    objections_to_duplicates,
    objections_to_experiment,
    objections_to_recording,
    objections_to_unit,
)
from ehadiag.assess.blocks import pulls_of_blocks, words_of_pulls
from ehadiag.assess.diagnosis import match_tests
from ehadiag.calibration.unit_models import (
    CRITERIA,
    SEARCHES,
    Calibrated,
    CalibratedValue,
    LearnedModel,
    TriedModel,
    UnitModel,
    learn_model,
    learned_severities,
)
from ehadiag.core.actuator import Actuator, Calibration, CalibrationSource, FitQuality, Tolerance
from ehadiag.identify.estimates import estimate_covariance, fit_quality
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.nuisance_estimate import NuisanceEstimate
from ehadiag.identify.prior import DAILY_PRIORS, JointPrior
from ehadiag.identify.ring import Ring
from ehadiag.model.parameter import Parameter
from ehadiag.model.plant import slip_speed
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS, Unknowns
from firmware_iface.recording import Recording
from firmware_iface.stored_test import StoredTest

NOTE_HARDLY_SHOWN = "the recordings hardly show it: little is known but its usual size"


class LearnedParameters(msgspec.Struct, frozen=True, eq=False):
    """What was learned of the unit's own parameters.

    values: SI, data by their relative error, shape (k,); covariance: shape (k, k); before:
    deviations of what was known beforehand, shape (k,).
    """

    parameters: tuple[Parameter, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    before: NDArray[np.float64]

    @property
    def std(self) -> NDArray[np.float64]:
        """Standard deviations, shape (k,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def shown(self) -> list[bool]:
        """What the recordings show."""
        return [bool(item) for item in self.std < CRITERIA.max_std_ratio * self.before]


def learned_parameters(found: NuisanceEstimate, before: Mapping[str, float]) -> LearnedParameters:
    """Take out what the unit keeps: no severity, nor what each recording shows of its day.

    before: deviations of what was known beforehand, by name.
    """
    refined = found.refined
    apart = {*DAILY_PRIORS, *(item.name for item in (*FAULTS, *SENSOR_OFFSETS))}
    kept = [k for k, item in enumerate(refined.parameters) if item.name not in apart]
    items = tuple(refined.parameters[k] for k in kept)
    spread = estimate_covariance(refined) + found.covariance
    return LearnedParameters(
        parameters=items,
        values=(refined.x * refined.scale)[kept],
        covariance=spread[np.ix_(kept, kept)],
        before=np.array([before[item.name] for item in items]),
    )


def calibrated_actuator(
    start: Actuator,
    lesson: LearnedParameters,
    found: NuisanceEstimate,
    *,
    plays: int,
    date: str,
    serial: int | None,
    sources: Sequence[CalibrationSource],
    evidence: Mapping[str, float],
) -> Actuator:
    """Return the unit's data with its calibration.

    start: its data with the class of second stage that was chosen; where it is calibrated itself
    the lesson is of deviations from it.
    """
    about = start.calibration.effects if start.calibration else {}
    effects, changes = dict(about), {}
    std = lesson.std.copy()
    for k, item in enumerate(lesson.parameters):
        value = float(lesson.values[k])
        symbol = item.datum
        if symbol is None:
            effects[item.name] = about.get(item.name, 0.0) + value
        else:
            changes[symbol] = 1.0 + value
            std[k] /= 1.0 + value
    correlation = lesson.covariance / np.outer(lesson.std, lesson.std)
    fit = fit_quality(found.refined, found.experiments)
    calibration = Calibration(
        date=date,
        start=start.calibration.start if start.calibration else start.name,
        serial=serial,
        plays=plays,
        effects=effects,
        parameters=tuple(item.name for item in lesson.parameters),
        std=tuple(std.tolist()),
        root=_cholesky_rows(correlation),
        held={
            item.name: NOTE_HARDLY_SHOWN
            for item, shown in zip(lesson.parameters, lesson.shown, strict=True)
            if not shown
        },
        fit=FitQuality(
            excess=found.excess,
            outliers=fit.outliers,
            spool_rms=fit.spool_rms,
            pressure_rms=fit.pressure_rms,
        ),
        evidence=dict(evidence),
        recordings=tuple(sources),
    )
    return msgspec.structs.replace(
        start,
        servovalve=_scaled_data(start.servovalve, changes),
        jack=_scaled_data(start.jack, changes),
        second_stage=_scaled_data(start.second_stage, changes),
        tolerance=Tolerance(),
        calibration=calibration,
    )


def calibrated_values(
    start: Actuator, unit: Actuator, lesson: LearnedParameters
) -> tuple[CalibratedValue, ...]:
    """Rows of a table: what was learned, beside what the first file said."""
    out = []
    about = start.calibration.effects if start.calibration else {}
    effects = unit.calibration.effects if unit.calibration else {}
    for item, std, shown in zip(lesson.parameters, lesson.std.tolist(), lesson.shown, strict=True):
        symbol = item.datum
        if symbol is None:
            before, value = about.get(item.name, 0.0), effects[item.name]
        else:
            before, value = _datum(start, symbol), _datum(unit, symbol)
        out.append(
            CalibratedValue(
                name=item.name,
                symbol=symbol or item.symbol,
                meaning=item.short,
                unit=item.unit if symbol is None else item.datum_unit,
                start=before,
                value=value,
                std=std if symbol is None else std * before,
                shown=shown,
            )
        )
    return tuple(out)


def _datum(actuator: Actuator, symbol: str) -> float:
    parts = (actuator.servovalve, actuator.jack, actuator.second_stage)
    return float(next(getattr(part, symbol) for part in parts if hasattr(part, symbol)))


def _scaled_data(part: msgspec.Struct, factors: Mapping[str, float]) -> msgspec.Struct:
    mine = {name: factor for name, factor in factors.items() if hasattr(part, name)}
    return msgspec.structs.replace(
        part, **{name: getattr(part, name) * factor for name, factor in mine.items()}
    )


def _cholesky_rows(correlation: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    """Lower triangle of the correlation, row by row."""
    lower = np.linalg.cholesky(correlation)
    return tuple(tuple(row[: k + 1].tolist()) for k, row in enumerate(lower))


CalibrationProgress = Callable[[str, float], None]
"""Called with the stage and its share done, 0 … 1."""


class RecordingSelection(Enum):
    """Which of the recordings are learned from."""

    ALL = "all"
    EACH_TEST = "the first of each test"
    OPEN_LOOP = "the first of each open-loop test, or of each test if none is"


class CalibrationSession:
    """Recordings, the tests that they are of, and the unit's data to begin with."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        start: Actuator,
        tests: Iterable[StoredTest],
        default: StoredTest | None,
        seed: int,
        progress: CalibrationProgress | None,
    ) -> None:
        self._begin = time.perf_counter()
        self.recordings = tuple(recordings)
        self._tests = match_tests(recordings, tests, default)
        self.start = start
        self.seed = seed
        self.evaluations = 0
        self.ring: Ring | None = None
        """Ring of a unit with orifices, where it was looked for."""
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
            *objections_to_duplicates(self.recordings),
            *objections_to_unit(self.recordings, self.start),
        ]

    def build(
        self, actuator: Actuator, part: RecordingSelection = RecordingSelection.ALL
    ) -> list[Experiment]:
        """Experiments of a part of the recordings."""
        return [
            self._experiment(self.recordings[index], self._tests[index], actuator)
            for index in self._indices(part)
        ]

    def _sliding(self, actuator: Actuator, part: RecordingSelection) -> list[Experiment]:
        """Experiments to learn from."""
        return [item.sliding(slip_speed(item.constants)) for item in self.build(actuator, part)]

    def _indices(self, part: RecordingSelection) -> list[int]:
        known = [(index, test) for index, test in enumerate(self._tests) if test is not None]
        if part is RecordingSelection.ALL:
            return [index for index, _ in known]
        if part is RecordingSelection.OPEN_LOOP:
            known = [item for item in known if not item[1].closed_loop] or known
        return sorted({test.name: index for index, test in reversed(known)}.values())

    def _experiment(
        self, recording: Recording, test: StoredTest | None, actuator: Actuator
    ) -> Experiment:
        assert recording.samples is not None
        assert test is not None
        built = build_experiment(recording.samples, recording.environment, test, actuator)
        # With the largest exponent of clogging, as a diagnosis identifies (`over_exponents`).
        largest = actuator.servovalve.clogging_range[1]
        return replace(built, constants=built.constants._replace(CLE=largest))

    def learn(
        self,
        model: UnitModel,
        *,
        new: bool = False,
        nearly_new: bool = False,
        hint: Mapping[str, float] | None = None,
        hint_of_open: bool = False,
        joint: JointPrior | None = None,
        budget: int = SEARCHES.max_runs,
        brief: bool = False,
        part: RecordingSelection = RecordingSelection.ALL,
        turn: int = 0,
    ) -> LearnedModel:
        """Learn with a model; see `ehadiag.calibration.unit_models.learn_model`.

        part: of the recordings; turn: of several searches with it.
        """
        found = learn_model(
            model,
            partial(self._sliding, part=part),
            self.start,
            new=new,
            nearly_new=nearly_new,
            hint=hint,
            hint_of_open=hint_of_open,
            joint=joint,
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
        best: LearnedModel | None = None,
        tried: Sequence[LearnedModel] = (),
    ) -> Calibrated:
        """Return why there is no calibration."""
        return Calibrated(
            recordings=self.recordings,
            tests=self._tests,
            start=self.start,
            actuator=None,
            reasons=(*reasons, *self._ring_notes()),
            notes=self._notes(),
            severities=learned_severities(best.estimated) if best else (),
            values=(),
            tried=_evidence(tried),
            experiments=_with_constants(best) if best else (),
            seed=self.seed,
            evaluations=self.evaluations,
            elapsed=time.perf_counter() - self._begin,
        )

    def done(
        self,
        lesson: LearnedParameters,
        learned: LearnedModel,
        checked: LearnedModel,
        tried: Sequence[LearnedModel],
        sources: Sequence[CalibrationSource] | None,
    ) -> Calibrated:
        """Return the unit.

        checked: with the severities estimated.
        """
        own = [
            CalibrationSource(name=recording.source, test=test.name if test else "")
            for recording, test in zip(self.recordings, self._tests, strict=True)
        ]
        of_start = self.start.calibration
        serials = [item.serial for item in self.recordings if item.serial is not None]
        start = learned.model.of(self.start)
        unit = calibrated_actuator(
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
            notes=(*self._notes(), *_unexplained(learned, self.start), *self._ring_notes(learned)),
            severities=learned_severities(checked.estimated),
            values=calibrated_values(self.start, unit, lesson),
            tried=_evidence(tried),
            experiments=_with_constants(learned),
            seed=self.seed,
            evaluations=self.evaluations,
            elapsed=time.perf_counter() - self._begin,
        )

    def _ring_notes(self, learned: LearnedModel | None = None) -> tuple[str, ...]:
        """What the ring says of the file's volume, unless what was learned contradicts it."""
        ring = self.ring
        if ring is None or not ring.is_of_other_volume:
            return ()
        if learned is not None and not ring.agrees_with(learned.estimated.refined.values):
            return ()
        return (ring.words,)

    def _notes(self) -> tuple[str, ...]:
        """What the recordings say of themselves, each once."""
        each = (
            (*recording.quality.notes, *notes_on_recording(recording, test, self.start))
            for recording, test in zip(self.recordings, self._tests, strict=True)
        )
        return tuple(dict.fromkeys(note for notes in each for note in notes))


def _unexplained(learned: LearnedModel, start: Actuator) -> tuple[str, ...]:
    """What the model could not explain, in units of the severities, by block."""
    if learned.estimated.explained:
        return ()
    found = learned.estimated
    return (words_of_pulls(pulls_of_blocks(found.experiments, found.refined, start)),)


def _with_constants(learned: LearnedModel) -> tuple[Experiment, ...]:
    """Experiments with the constants that were found, for pictures."""
    refined = learned.estimated.refined
    out = []
    for experiment in learned.estimated.experiments:
        unknowns = Unknowns((), (experiment.constants,), refined.values)
        out.append(replace(experiment, constants=unknowns.constants(np.empty(0))))
    return tuple(out)


def _evidence(tried: Sequence[LearnedModel]) -> tuple[TriedModel, ...]:
    """Models with what they leave, and the evidence against each."""
    if not tried:
        return ()
    best = min(item.criterion for item in tried)
    return tuple(
        TriedModel(item.model.words, item.estimated.excess, item.criterion - best) for item in tried
    )
