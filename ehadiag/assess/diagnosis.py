"""From recordings to a verdict: the one path that every command and script takes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from functools import partial

import msgspec
import numpy as np

from ehadiag.assess.acceptance import (
    notes_on_recording,
    objection_to_current,
    objection_to_frame_order,
    objection_to_lost_positions,
    objections_to_actuator,
    objections_to_conditions,
    objections_to_duplicates,
    objections_to_experiment,
    objections_to_recording,
    objections_to_travel,
    objections_to_unit,
)
from ehadiag.assess.blocks import unexplained_block
from ehadiag.assess.lost_samples import (
    has_observable_severity,
    is_reconstructible,
    reconstruct_lost_samples,
    restrict_to_observable,
    widen_intervals,
)
from ehadiag.assess.other_causes import (
    count_other_faults,
    effects_of,
    find_culprit,
    note_on_stand_ins,
    notes_on_effects,
    with_limits,
)
from ehadiag.assess.response_checks import (
    PositionFit,
    correct_delays,
    creep_note,
    fit_position,
    identified_response,
    max_position_gain_error,
    objections_to_position,
    objections_to_supply,
)
from ehadiag.assess.sampling_instants import (
    settle_instants,
    why_sampled_seldom,
    widen_by_instants,
)
from ehadiag.assess.verdict import (
    Levels,
    Verdict,
    chance_above,
    is_explained_by_discrepancy_alone,
    judge,
    objections_to_estimate,
)
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FRICTION_NAME, with_unit
from ehadiag.core.criteria import LOSSES, NOISE_LIMIT, RECORDING, ROUNDS, VERDICT
from ehadiag.estimate import Culprit, Effect
from ehadiag.identify.experiment import Experiment, build_experiment, noise_is_judged_early
from ehadiag.identify.identification_result import Identification
from ehadiag.identify.identification_session import (
    EarlierEstimate,
    IdentificationSession,
    InterimEstimate,
    NuisanceMode,
)
from ehadiag.identify.prior import DAILY_PRIORS, FAULT_OF_DATUM, unit_prior
from ehadiag.identify.solvers import CompactGa, Solver
from ehadiag.identify.staged_search import (
    STAGE_SHARES,
    StageProgress,
    first_approximation_ready_at,
    stage_ready_at,
)
from ehadiag.model.registry import parameter
from ehadiag.model.residual_models import ModelResponse
from firmware_iface.recording import Recording
from firmware_iface.stored_test import StoredTest


class Diagnosis(msgspec.Struct, frozen=True, eq=False):
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
    effects: tuple[Effect, ...]
    """Every effect of the unit and its installation that was estimated."""
    other: tuple[Effect, ...]
    """Those that have a limit of their own, in the order of the actuator file."""
    culprit: Culprit | None
    """What may keep the model from explaining the recordings; None where it explains them."""
    notes: tuple[str, ...]
    """What the recordings say of themselves, what was assumed, what is missing."""
    elapsed: float
    """Time from samples to verdict, s."""


IdentifiedRecordings = tuple[list[Experiment], Identification, tuple[str, ...], tuple[str, ...]]
"""Experiments, what they say, notes on what was put right, and why it cannot carry a verdict."""


class DiagnosisSession:
    """A diagnosis that takes a recording while it grows, and is finished with the complete one.

    A finished recording takes the same path, `diagnose`. What was computed from the beginning of a
    test is used again where the finished recording has the same samples to the last bit, so that
    the answer is that of the recording alone, only sooner. One thread at a time.

    actuator: data of the actuator; tests: tests that a recording may be of, distinguished by
    number; default: test of recordings whose bus does not carry a number; levels: advisory level
    and limit; solver: global search; the compact genetic algorithm unless given; seed: the same
    seed gives the same answer on the same machine; nuisances: which effects of the installation are
    estimated with the faults; earlier: what the unit's last diagnosis found, see
    `IdentificationSession`.
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
        nuisances: NuisanceMode = NuisanceMode.AUTO,
        earlier: EarlierEstimate | None = None,
    ) -> None:
        self._actuator = actuator
        self._tests = tuple(tests)
        self._default = default
        self._levels = levels or Levels()
        self._prior = unit_prior(actuator)
        self._session = IdentificationSession(solver, seed, nuisances, self._prior, earlier)

    @property
    def reused(self) -> int:
        """Stages that did not have to run again when the diagnosis was finished."""
        return self._session.reused

    @property
    def so_far(self) -> InterimEstimate | None:
        """Severities as the running test shows them; another thread may look."""
        return self._session.so_far

    def due_s(self, test: StoredTest) -> tuple[float, ...]:
        """Instants of a running test (s) from which there is something more to work out.

        None for a solver that holds the interpreter, nor for a test without a quiet first part.
        """
        if not isinstance(self._session.solver, CompactGa) or not noise_is_judged_early(test):
            return ()
        ends = {
            first_approximation_ready_at(test),
            *(stage_ready_at(test, i) for i in range(len(STAGE_SHARES))),
        }
        return tuple(sorted(end for end in ends if end < test.duration))

    def feed(self, recording: Recording) -> None:
        """Compute all that the samples so far allow, unless they cannot carry a verdict."""
        samples, test = recording.samples, _match_test(recording, self._tests, self._default)
        if samples is None or samples.ticks == 0 or test is None or not self.due_s(test):
            return
        if objections_to_conditions(recording.environment, samples, self._actuator):
            return
        if objections_to_actuator(self._actuator):
            return
        experiment = build_experiment(samples, recording.environment, test, self._actuator)
        for values in (experiment.spool, experiment.pressure):
            if np.isfinite(values).mean() < RECORDING.min_sample_share:
                return
        self._session.feed([experiment])

    def finish(
        self, recordings: Sequence[Recording], progress: StageProgress | None = None
    ) -> Diagnosis:
        """Diagnose one actuator from one complete recording, or from several together."""
        found = self._finished(recordings, progress)
        if found.verdict is Verdict.NOT_TESTED and any(item.as_measured for item in recordings):
            measured = self._finished([item.as_measured or item for item in recordings], progress)
            if measured.verdict is not Verdict.NOT_TESTED or found.identification is None:
                found = measured
        if found.verdict is Verdict.NOT_TESTED:
            why = (*found.reasons, *why_sampled_seldom(recordings))
            return msgspec.structs.replace(found, reasons=why)
        return found

    def _finished(
        self, recordings: Sequence[Recording], progress: StageProgress | None
    ) -> Diagnosis:
        begin = time.perf_counter()
        matched = match_tests(recordings, self._tests, self._default)
        experiments, reasons = examined_recordings(recordings, matched, self._actuator)
        orders = tuple(dict.fromkeys(filter(None, map(objection_to_frame_order, recordings))))
        loss_reasons = (*map(objection_to_lost_positions, experiments), *orders)
        hidden = tuple(dict.fromkeys(reason for reason in reasons if reason in loss_reasons))
        lost = bool(hidden) and set(reasons) <= set(hidden) and has_observable_severity(experiments)
        identification: Identification | None = None
        effects: tuple[Effect, ...] = ()
        limited: tuple[Effect, ...] = ()
        positions: tuple[PositionFit | None, ...] = ()
        culprit: Culprit | None = None
        late: tuple[str, ...] = ()
        verdict, why = Verdict.NOT_TESTED, tuple(reasons)
        reconstructed = (
            self._reconstructed(recordings, experiments, progress) if lost and not orders else None
        )
        if lost and reconstructed is None:
            found = self._session.finish(experiments, progress)
            identification, words = restrict_to_observable(found, experiments)
            why = tuple(f"{reason}: {words}" for reason in hidden)
        if reconstructed is not None or not reasons:
            experiments, identification, late, why = reconstructed or self._estimated(
                recordings, experiments, progress, ordered=not orders
            )
            modelled = [identified_response(item, identification) for item in experiments]
            slow = identification.slip_speed
            positions = tuple(map(partial(fit_position, slip_speed=slow), experiments, modelled))
            if why and orders:
                identification, words = restrict_to_observable(identification, experiments)
                why = tuple(f"{reason}: {words}" for reason in orders)
            elif why:
                culprit = find_culprit(experiments, identification, recordings[0].environment)
                if self._actuator.calibration is not None:
                    why = (*why, f"not explained: the {unexplained_block(experiments, modelled)}")
            else:
                why = (
                    *_supply_objections(experiments, modelled, identification),
                    *_position_objections(positions, max_position_gain_error(self._actuator)),
                )
                if why and is_explained_by_discrepancy_alone(identification.fit):
                    block = unexplained_block(experiments, modelled)
                    why = (*why, f"not explained to the noise either: the {block}")
            effects = effects_of(identification, self._prior, self._actuator)
            limited = with_limits(effects, self._actuator)
            unlike = creep_note(experiments, [item.spool for item in modelled])
            if self._actuator.calibration is not None:
                unlike = unlike or note_on_stand_ins(limited, identification.fit)
            if unlike:
                late = (*late, unlike)
                why = why or _objections_to_friction(identification, self._levels, unlike)
            if not why:
                verdict, why = count_other_faults(limited, *judge(identification, self._levels))
        elif identification is not None:
            effects = effects_of(identification, self._prior, self._actuator)
            limited = with_limits(effects, self._actuator)
        return Diagnosis(
            recordings=tuple(recordings),
            tests=matched,
            actuator=self._actuator,
            verdict=verdict,
            reasons=why,
            identification=identification,
            experiments=tuple(experiments) if identification else (),
            positions=positions,
            effects=effects,
            other=limited,
            culprit=culprit,
            notes=(
                *_notes(recordings, matched, self._actuator),
                *_notes_on_effects(identification, self._actuator),
                *late,
                *_notes_on_discrepancy(identification, self._actuator, verdict),
                *_notes_on_unchecked_positions(positions),
                *notes_on_effects(limited),
            ),
            elapsed=time.perf_counter() - begin,
        )

    def _estimated(
        self,
        recordings: Sequence[Recording],
        experiments: list[Experiment],
        progress: StageProgress | None,
        *,
        ordered: bool,
    ) -> IdentifiedRecordings:
        """Identify; where that does not explain the recordings, with corrected samples."""
        acquired = any(item.acquired is not None for item in experiments)
        if acquired:
            experiments, found = self._with_instants(experiments, progress)
        else:
            found = self._session.finish(experiments, progress)
        late: tuple[str, ...] = ()
        by_time = any(item.by_time for item in recordings)
        if by_time and not acquired:
            experiments, found, late = correct_delays(
                experiments, found, lambda item: self._session.finish(item, progress)
            )
        why = tuple(objections_to_estimate(found, self._actuator.calibration))
        if why and ordered and not late:
            reconstructed = self._reconstructed(recordings, experiments, progress)
            if reconstructed is not None:
                return reconstructed
        if (
            by_time
            and found.fit.outliers > LOSSES.min_outlier_share_misplaced
            and is_reconstructible(recordings, experiments)
        ):
            found = widen_intervals(found)
        return experiments, found, late, why

    def _with_instants(
        self, experiments: Sequence[Experiment], progress: StageProgress | None
    ) -> tuple[list[Experiment], Identification]:
        """Identify together with the instants at which an acquisition sampled."""
        start = self._session.searched(experiments)
        for _ in range(ROUNDS):
            settled, variance = settle_instants(experiments, start)
            found = widen_by_instants(self._session.finish(settled, progress), variance)
            if not any(objections_to_estimate(found, self._actuator.calibration)):
                break
            # Severities beside the optimum have led to instants beside theirs.
            start = {item.name: item.value for item in found.estimates}
        return settled, found

    def _reconstructed(
        self,
        recordings: Sequence[Recording],
        experiments: Sequence[Experiment],
        progress: StageProgress | None,
    ) -> IdentifiedRecordings | None:
        """Identify with reconstructed samples; None where that explains no more."""
        if not is_reconstructible(recordings, experiments):
            return None
        reconstructed = reconstruct_lost_samples(
            recordings,
            experiments,
            self._actuator,
            lambda item: self._session.finish(item, progress),
        )
        if reconstructed is None or objections_to_estimate(
            reconstructed[1], self._actuator.calibration
        ):
            return None
        now, found, note = reconstructed
        return now, widen_intervals(found), (note,), ()


def examined_recordings(
    recordings: Sequence[Recording], matched: Sequence[StoredTest | None], actuator: Actuator
) -> tuple[list[Experiment], list[str]]:
    """What can be identified from recordings of one actuator, and why that cannot be.

    matched: stored test of each recording.
    """
    reasons, experiments = objections_to_actuator(actuator), []
    for recording, test in zip(recordings, matched, strict=True):
        objections = objections_to_recording(recording, test, actuator)
        if not objections and test is not None and recording.samples is not None:
            experiment = build_experiment(recording.samples, recording.environment, test, actuator)
            objections = objections_to_experiment(experiment)
            if objections == [objection_to_current(experiment)] and objection_to_frame_order(
                recording
            ):
                objections = [objection_to_frame_order(recording)]
            objections = objections or objections_to_travel(recording.samples, test, actuator)
            experiments.append(experiment)
        reasons += objections
    if len({recording.serial for recording in recordings} - {None}) > 1:
        reasons.append("the recordings are of actuators with different serial numbers")
    else:
        reasons += objections_to_duplicates(recordings)
    reasons += objections_to_unit(recordings, actuator)
    return experiments, reasons


def _objections_to_friction(
    identification: Identification, levels: Levels, unlike: str
) -> tuple[str, ...]:
    """Why a spool whose friction is unlike the law has no verdict: unless another severity decides.

    unlike: how it shows.
    """
    others = [item for item in identification.estimates if item.name != FRICTION_NAME]
    if any(chance_above(item, levels.limit) >= VERDICT.min_chance_fault for item in others):
        return ()
    return (f"FSS is not shown: {unlike}",)


def diagnose(
    recordings: Sequence[Recording],
    actuator: Actuator,
    tests: Iterable[StoredTest],
    *,
    default: StoredTest | None = None,
    levels: Levels | None = None,
    solver: Solver | None = None,
    seed: int = 0,
    nuisances: NuisanceMode = NuisanceMode.AUTO,
    progress: StageProgress | None = None,
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
        effects=(),
        other=(),
        culprit=None,
        notes=_notes(recordings, tests, actuator),
        elapsed=elapsed,
    )


def match_tests(
    recordings: Sequence[Recording], tests: Iterable[StoredTest], default: StoredTest | None = None
) -> tuple[StoredTest | None, ...]:
    """Find the test that each recording is of; None where it is none of `tests`."""
    candidates = tuple(tests)
    return tuple(_match_test(recording, candidates, default) for recording in recordings)


def _match_test(
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
        (*recording.quality.notes, *notes_on_recording(recording, test, actuator))
        for recording, test in zip(recordings, tests, strict=True)
    )
    return tuple(dict.fromkeys(note for notes in each for note in notes))


def _supply_objections(
    experiments: Sequence[Experiment],
    modelled: Sequence[ModelResponse],
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


def _position_objections(positions: Sequence[PositionFit | None], most: float) -> list[str]:
    """Reasons why the position sensor is not trusted, each once."""
    found = (objections_to_position(fit, most) for fit in positions if fit)
    return list(dict.fromkeys(why for reasons in found for why in reasons))


def _notes_on_unchecked_positions(positions: Sequence[PositionFit | None]) -> tuple[str, ...]:
    """Whether the position sensor went unchecked."""
    if None not in positions:
        return ()
    return ("too few samples of the jack position: its sensor is not checked",)


def _notes_on_discrepancy(
    identification: Identification | None, actuator: Actuator, verdict: Verdict
) -> tuple[str, ...]:
    if identification is None:
        return ()
    fit = identification.fit
    slow = identification.slip_speed
    out: tuple[str, ...] = ()
    if slow:
        out += (
            f"the jack slips in steps below {slow * 1e3:.1f} mm/s, by the friction found: the"
            " pressure is left out where it is slower",
        )
    if identification.exponent_doubted:
        out += (
            "the recording does not bear out servovalve.clogging_exponent 0: FSS is that of any"
            " exponent",
        )
    if verdict is Verdict.NOT_TESTED or not is_explained_by_discrepancy_alone(
        fit, actuator.calibration
    ):
        return out
    return (
        *out,
        f"{fit.outliers:.1%} of the residuals are beyond three times the noise, as the discrepancy"
        " of the faults' laws in the actuator file allows; limits of other effects are not judged",
    )


def _notes_on_effects(identification: Identification | None, actuator: Actuator) -> tuple[str, ...]:
    """Notes on effects that were estimated with the faults."""
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
            f"{parameter(name).short} has changed since: "
            f"{with_unit(value, parameter(name).unit)} then, "
            f"{with_unit(identification.nuisances[name].value, parameter(name).unit)} now"
            for name, value in calibration.effects.items()
            if name in identification.nuisances
            and abs(identification.nuisances[name].value - value)
            > max(NOISE_LIMIT * stds[name], parameter(name).scale)
        ]
    learned = (*learned, *DAILY_PRIORS)
    words = [parameter(name).short for name in identification.freed if name not in learned]
    if words:
        out.append(f"estimated beside the faults: {', '.join(words)}")
    aliases = [name for name in FAULT_OF_DATUM if actuator.tolerance.of(name) > 0.0]
    if aliases and calibration is None:
        out.append(
            f"held, with the tolerance in the intervals: {', '.join(aliases)}, which no recording "
            "tells from a fault"
        )
    return tuple(out)
