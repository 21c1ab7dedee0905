"""An identification from first approximation to uncertainty, fed while the test still runs.

`warm_up` loads, or compiles, every kernel that a diagnosis runs.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from functools import partial

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import MAX_CLOGGING_EXPONENT, MAX_NOISE_EXCESS, Actuator
from ehadiag.core.conventions import FRICTION_NAME
from ehadiag.core.criteria import FIT, LOSSES, NORMAL_HALF_WIDTH_95
from ehadiag.identify import compact_ga
from ehadiag.identify.estimates import (
    estimate_covariance,
    excess_cost,
    explains_far_more,
    friction_by_exponent,
    identification_result,
    independent_covariance,
    likelihood_ratio_cost,
    over_exponents,
    refinement_outlier_share,
)
from ehadiag.identify.experiment import Experiment, build_experiment, lay_out_spans, share_offsets
from ehadiag.identify.identification_result import Identification, IdentificationTiming
from ehadiag.identify.least_squares import Refinement
from ehadiag.identify.nuisance_estimate import NuisanceEstimate, NuisanceEstimator
from ehadiag.identify.nuisance_search import is_calibrated_oil
from ehadiag.identify.partial_refinement import (
    FirstPart,
    SeverityAttempt,
    StartResiduals,
    first_part_spans,
    first_part_ticks,
    is_current_guessed,
    refine_first_part,
    refine_near,
    refined_attempt,
    severities_by_name,
    start_residuals,
)
from ehadiag.identify.posterior import no_interruption
from ehadiag.identify.prior import EXACT_UNIT_PRIOR, UnitPrior, basic_nuisances_of
from ehadiag.identify.solvers import CompactGa, SearchResult, Solver
from ehadiag.identify.staged_search import (
    STAGE_SHARES,
    FirstApproximation,
    StageMemory,
    StageProgress,
    experiment_arrays,
    first_approximation_ready_at,
    inputs_digest,
    recalled_first_approximation,
    search_stages,
    stage_ready_at,
    staged_search,
)
from ehadiag.model.plant import PlantConstants, slip_speed
from ehadiag.model.registry import FAULTS
from ehadiag.model.residual_models import model_response
from firmware_iface.recording import CommandMode, Environment, Samples
from firmware_iface.stored_test import Line, SearchWindows, StoredTest

NOT_SEARCHED = SearchResult(np.full(len(FAULTS), np.nan), np.nan, 0, 0, np.zeros(0))
"""Of a refinement that needed no search."""


class NuisanceMode(Enum):
    """Which effects of the installation are estimated besides the severities and the offsets."""

    AUTO = "auto"
    """Those that are needed: none where the severities alone explain the recording."""
    NONE = "none"
    ALL = "all"
    """From the start."""


class InterimEstimate(msgspec.Struct, frozen=True):
    """Severities as a test that still runs shows them."""

    stage: str
    """What was done last, in words."""
    values: Mapping[str, float]
    """Severities by name."""
    std: Mapping[str, float] | None = None
    """Their standard deviations by name; None before a refinement."""


class EarlierEstimate(msgspec.Struct, frozen=True):
    """What an earlier diagnosis of the unit found; a refinement may begin there."""

    severities: Mapping[str, float]
    """By name."""
    source: str
    """Which diagnosis it was, in words."""


class IdentificationSession:
    """An identification that takes recordings while they grow, and is finished with complete ones.

    What was computed from the beginning of a test is used again where the samples are the same to
    the last bit, so the answer is that of the recording alone, only sooner. One thread at a time.
    solver: global search, the compact genetic algorithm unless given; prior: of the unit, whose
    inexact data are always estimated, too; earlier: where a refinement begins if that explains the
    recordings. It has no weight in the estimate.
    """

    def __init__(
        self,
        solver: Solver | None = None,
        seed: int = 0,
        nuisances: NuisanceMode = NuisanceMode.AUTO,
        prior: UnitPrior = EXACT_UNIT_PRIOR,
        earlier: EarlierEstimate | None = None,
    ) -> None:
        self.earlier = earlier
        self.solver = solver or CompactGa()
        self.seed = seed
        self.nuisances = nuisances
        self.prior = prior
        self._memory = StageMemory()
        self._latest_start: tuple[bytes, StartResiduals] | None = None
        self._latest_digest: tuple[tuple[Experiment, ...], bytes] = (), b""
        self.so_far: InterimEstimate | None = None
        """What the latest `feed` showed; None before the first. Another thread may look."""

    @property
    def reused(self) -> int:
        """Stages that did not have to run again."""
        return self._memory.reused

    def feed(self, experiments: Sequence[Experiment]) -> None:
        """Run the stages for which the samples so far suffice: of tests that have begun."""
        ready = min(_ready_stages(item) for item in experiments)
        if ready < 0:
            return
        self._memory.is_fed = True
        experiments, self._latest_digest = self._prepared(experiments), ((), b"")
        best = start = self._first(experiments)[1]
        self.so_far = InterimEstimate("first approximation", severities_by_name(best))
        for stage, result in enumerate(
            itertools.islice(self._stages(experiments, best, lambda _share: None), ready)
        ):
            best = result.best
            self.so_far = InterimEstimate(
                f"search, stage {stage + 1} of {len(STAGE_SHARES)}", severities_by_name(best)
            )
        if ready < len(STAGE_SHARES):
            return
        for point in (start, best):
            if self._resembles(experiments, point):
                part = self._first_part(experiments, point, no_interruption)
                self.so_far = _interim_estimate(part.refined)
                return

    def searched(self, experiments: Sequence[Experiment]) -> dict[str, float]:
        """Severities by the search alone, from complete recordings of one actuator."""
        experiments, self._latest_digest = share_offsets(experiments), ((), b"")
        start = self._first(experiments)[1]
        stages = self._stages(experiments, start, lambda _share: None)
        return severities_by_name(staged_search(stages, lambda _stage, _share: None).best)

    def finish(
        self, experiments: Sequence[Experiment], progress: StageProgress | None = None
    ) -> Identification:
        """Estimate the severities from one or more complete recordings of one actuator."""
        windows = [repr(item.test.windows) for item in experiments]
        arrays = [array for item in experiments for array in experiment_arrays(item)]
        settings = f"{self.seed} {self.solver!r} {self.nuisances} {self.earlier}"
        key = inputs_digest(f"identify {settings} {windows}", arrays)
        callback = progress or (lambda _stage, _share: None)
        return self._memory.recall(
            key,
            Identification,
            lambda: self._over_exponents(
                self._with_exponent_tested(
                    self._identify(experiments, callback), experiments, callback
                ),
                experiments[0].constants,
            ),
        )

    def _with_exponent_tested(
        self,
        found: Identification,
        experiments: Sequence[Experiment],
        progress: StageProgress,
    ) -> Identification:
        """Return an identification with its exponent of 0 tested by the middle and the largest one.

        `FSS / k^m` is what a recording shows (PHY-45): a valve with m > 0 is explained nearly as
        well with 0, and its friction is beyond the interval. Not tested: a file that states the law
        of `FSS` without discrepancy, so that it is exact; friction that is the same with either;
        what is refused; and a calibrated unit with oil, of which the search tests it.
        """
        middle = MAX_CLOGGING_EXPONENT / 2.0
        prior, law = self.prior, self.prior.discrepancy.get(FRICTION_NAME, 0.0)
        first, clogging = experiments[0].constants, found.named("Kintas")
        friction = found.named(FRICTION_NAME).value
        worst = {"Kintas": clogging.interval95[1], FRICTION_NAME: friction}
        other = friction_by_exponent(worst, first, middle)
        alike = abs(other - friction) <= NORMAL_HALF_WIDTH_95 * law * friction
        if (
            prior.exponents != (0.0, 0.0)
            or law == 0.0
            or alike
            or found.fit.unexplained_outliers > FIT.max_outlier_share_poor_calibration
            or (
                prior.joint is not None
                and any(slip_speed(item.constants) > 0.0 for item in experiments)
            )
        ):
            return found
        mode = self.nuisances if found.freed else NuisanceMode.NONE
        before, excesses = excess_cost(found.residuals), {}
        to_noise = before <= FIT.max_explained_excess
        for exponent in (middle, MAX_CLOGGING_EXPONENT):
            of_other = replace(prior, exponents=(exponent, exponent))
            session = IdentificationSession(self.solver, self.seed, mode, of_other)
            others = [item.with_exponent(exponent, prior.bridge) for item in experiments]
            there = session.finish(others, progress).residuals
            excesses[exponent] = excess_cost(there)
            more = likelihood_ratio_cost(there, found.residuals)
            if to_noise and more < 2.0 * math.log(FIT.min_likelihood_ratio):
                return replace(found, exponent_doubted=True)
        if to_noise:
            return found
        better = min(excesses, key=lambda exponent: excesses[exponent])
        if explains_far_more(excesses[better], before):
            return replace(found, better_exponent=better)
        return replace(found, exponent_doubted=not explains_far_more(before, excesses[better]))

    def _over_exponents(self, found: Identification, constants: PlantConstants) -> Identification:
        """Return an identification with the friction of all exponents that may be."""
        stated = self.prior.exponents
        of_all = (0.0, MAX_CLOGGING_EXPONENT) if found.exponent_doubted else stated
        return over_exponents(found, constants, of_all, with_exponent=stated[1])

    def _prepared(self, experiments: Sequence[Experiment]) -> list[Experiment]:
        """Experiments with offsets shared; of exponents of clogging with the largest one.

        Friction and exponent act by their ratio alone: with the largest exponent the friction is
        within its bounds for all of them (`over_exponents`).
        """
        shared = share_offsets(experiments)
        low, high = self.prior.exponents
        if low == high:
            return shared
        return [replace(item, constants=item.constants._replace(CLE=high)) for item in shared]

    def _identify(
        self, experiments: Sequence[Experiment], progress: StageProgress
    ) -> Identification:
        begin = time.perf_counter()
        experiments, self._latest_digest = self._prepared(experiments), ((), b"")
        if not self._memory.is_fed:
            self._latest_start = None
        if self.earlier is not None:
            found_before = self._from_earlier(experiments, self.earlier, begin, progress)
            if found_before is not None:
                return found_before
        progress("first approximation", 0.0)
        first, start = self._first(experiments)
        searched_at = time.perf_counter()
        found = staged_search(
            self._stages(experiments, start, partial(progress, "search")), progress
        )
        search_s = time.perf_counter() - searched_at
        progress("refinement", 0.0)
        has_inexact_data = self.prior.has_inexact_data
        alone = self.nuisances is NuisanceMode.NONE and not has_inexact_data
        start, near = self._refinement_start(experiments, start, found.best)
        best: SeverityAttempt | None = None
        if alone or (near and self.nuisances is NuisanceMode.AUTO and not has_inexact_data):
            between = partial(progress, "refinement", 0.0)
            first_part = self._first_part(experiments, start, between)
            best = refined_attempt(experiments, found, first_part, between)
            best = replace(best, evaluations=best.evaluations + found.evaluations)
        freed: NuisanceEstimate | None = None
        if best is None or not _severities_suffice(best.refined):
            hint = best.refined.values if best else severities_by_name(start)
            progress("nuisances", 0.0)
            basic = basic_nuisances_of(experiments[0].constants.OIL)
            freeing = NuisanceEstimator(
                self.prior,
                () if self.nuisances is NuisanceMode.NONE else basic,
                partial(progress, "nuisances"),
            )
            near_enough = near or is_calibrated_oil(experiments, self.prior.joint)
            freed = freeing.estimated(experiments, hint if near_enough else None)
        if best is not None and (freed is None or _nuisances_explain_no_more(freed, best)):
            return self._concluded_by_severities(
                first,
                best,
                first.evaluations + (freed.evaluations if freed else 0),
                freed.starts if freed else 0,
                _timing(begin, searched_at, search_s),
            )
        assert freed is not None
        values = freed.refined.values
        severities = np.array([values[item.name] for item in FAULTS])
        before = best.evaluations if best else found.evaluations
        concluded = self._concluded(
            first,
            replace(found, best=severities, cost=freed.refined.cost),
            freed.refined,
            estimate_covariance(freed.refined)
            + freed.covariance
            + self.prior.spread(freed.refined.parameters, values, experiments[0].constants),
            freed.experiments,
            doubt=self._discrepancy(freed.refined),
            evaluations=first.evaluations + before + freed.evaluations,
            attempts=freed.starts + (1 if best else 0),
            timing=_timing(begin, searched_at, search_s),
        )
        closed = all(item.test.closed_loop for item in experiments)
        return replace(
            concluded,
            slip_speed=freed.slip_speed,
            better_exponent=freed.better_exponent,
            exponent_doubted=freed.exponent_doubted,
            ambiguous=closed and self.prior.joint is None and not freed.explained,
        )

    def _from_earlier(
        self,
        experiments: Sequence[Experiment],
        earlier: EarlierEstimate,
        begin: float,
        progress: StageProgress,
    ) -> Identification | None:
        """Estimate about an earlier one; None where that does not explain the recordings, or where
        more than the severities is to be estimated."""
        if self.nuisances is NuisanceMode.ALL or self.prior.has_inexact_data:
            return None
        progress("refinement", 0.0)
        near = refine_near(experiments, earlier.severities, partial(progress, "refinement", 0.0))
        if near is None or not _severities_suffice(near[0]):
            return None
        best = SeverityAttempt(NOT_SEARCHED, *near, near[0].evaluations)
        first = FirstApproximation({item.name: np.nan for item in FAULTS}, 0)
        timing = _timing(begin, begin, 0.0)
        found = self._concluded_by_severities(first, best, 0, 0, timing)
        return replace(found, begun_from=earlier.source)

    def _concluded_by_severities(
        self,
        first: FirstApproximation,
        best: SeverityAttempt,
        evaluations: int,
        attempts: int,
        timing: IdentificationTiming,
    ) -> Identification:
        """Result by the severities alone; evaluations, attempts: others than those of `best`."""
        return self._concluded(
            first,
            best.found,
            best.refined,
            estimate_covariance(best.refined) + _guessed_covariance(best.refined),
            best.experiments,
            doubt=self._discrepancy(best.refined),
            evaluations=best.evaluations + evaluations,
            attempts=1 + attempts,
            timing=timing,
        )

    @property
    def _concluded(self) -> Callable[..., Identification]:
        """What puts a result together, see `identification_result`."""
        return partial(
            identification_result,
            solver=self.solver.name,
            seed=self.seed,
            about=self.prior.about,
            discrepancy=self.prior.discrepancy,
        )

    def _discrepancy(self, refined: Refinement) -> Array:
        """Covariance by wrong laws of the faults."""
        return self.prior.discrepancy_covariance(
            refined.parameters, refined.values, excess_cost(refined.residuals)
        )

    def _refinement_start(
        self, experiments: Sequence[Experiment], first: Array, searched: Array
    ) -> tuple[Array, bool]:
        """Return the point a refinement begins from, and whether it may explain the recordings: the
        first approximation, which has no seed, unless only the optimum of the search resembles
        them."""
        for point in (first, searched):
            if self._resembles(experiments, point):
                return point, True
        return searched, False

    def _resembles(self, experiments: Sequence[Experiment], point: Array) -> bool:
        """Whether a refinement from a point may explain the recordings."""
        look = self._start_residuals(experiments, point)
        return look.outlier_share <= FIT.max_start_outliers

    def _first(self, experiments: Sequence[Experiment]) -> tuple[FirstApproximation, Array]:
        """First approximation, and the same as a point among the severities."""
        first = recalled_first_approximation(experiments, self._memory)
        return first, np.array([first.values[item.name] for item in FAULTS])

    def _stages(
        self, experiments: Sequence[Experiment], start: Array, progress: Callable[[float], None]
    ) -> Iterator[SearchResult]:
        return search_stages(experiments, start, self.solver, self.seed, self._memory, progress)

    def _first_part(
        self, experiments: Sequence[Experiment], start: Array, between: Callable[[], None]
    ) -> FirstPart:
        """Refinement on the first parts of the tests, from memory if the inputs are the same."""
        until = [first_part_ticks(item) for item in experiments]
        return self._memory.recall_stage(
            lambda: self._first_part_digest(experiments, until, start),
            FirstPart,
            lambda: refine_first_part(
                experiments,
                until,
                severities_by_name(start),
                between,
                self._start_residuals(experiments, start),
            ),
        )

    def _start_residuals(self, experiments: Sequence[Experiment], start: Array) -> StartResiduals:
        """Look at the first parts of the tests; the latest one is kept."""
        until = [first_part_ticks(item) for item in experiments]
        is_fed = self._memory.is_fed
        key = self._first_part_digest(experiments, until, start) if is_fed else start.tobytes()
        if self._latest_start is None or self._latest_start[0] != key:
            self._latest_start = key, start_residuals(experiments, until, severities_by_name(start))
        return self._latest_start[1]

    def _first_part_digest(
        self, experiments: Sequence[Experiment], until: Sequence[int], start: Array
    ) -> bytes:
        """Fingerprint of the first parts of the tests and a start among the severities.

        That of the parts is worked out once in a call for the same experiments.
        """
        if self._latest_digest[0] != tuple(experiments):
            free = lay_out_spans(experiments, first_part_spans(experiments, until))
            base = [np.array(item.constants) for item in experiments]
            self._latest_digest = tuple(experiments), inputs_digest("first part", [*free, *base])
        return inputs_digest(
            "start", [np.frombuffer(self._latest_digest[1], dtype=np.uint8), start]
        )


def identify(
    experiments: Sequence[Experiment],
    *,
    solver: Solver | None = None,
    seed: int = 0,
    nuisances: NuisanceMode = NuisanceMode.AUTO,
    prior: UnitPrior = EXACT_UNIT_PRIOR,
    progress: StageProgress | None = None,
) -> Identification:
    """Estimate the severities from one or more recordings of one actuator, fed once."""
    return IdentificationSession(solver, seed, nuisances, prior).finish(experiments, progress)


def _guessed_covariance(refinement: Refinement) -> Array:
    """Covariance that a guessed current adds to the severities'."""
    std = LOSSES.guessed_current_std if is_current_guessed(refinement) else 0.0
    return independent_covariance(
        refinement.parameters, dict.fromkeys((item.name for item in FAULTS), std)
    )


def _timing(begin: float, searched_at: float, search_s: float) -> IdentificationTiming:
    """Time spent so far, s: on the first approximation, on searches, and on the rest."""
    return IdentificationTiming(
        searched_at - begin, search_s, time.perf_counter() - searched_at - search_s
    )


def _interim_estimate(refined: Refinement) -> InterimEstimate:
    """Severities of a refinement on the first part of a test."""
    std = dict(
        zip(
            (item.name for item in refined.parameters),
            np.sqrt(np.diag(estimate_covariance(refined))).tolist(),
            strict=True,
        )
    )
    values = {item.name: refined.values[item.name] for item in FAULTS}
    return InterimEstimate("refinement of its first part", values, std)


def _severities_suffice(refinement: Refinement) -> bool:
    """Whether the severities alone explain a recording, without slow residuals, of which
    small nuisances would be the cause."""
    return (
        refinement_outlier_share(refinement) <= FIT.max_outliers_of_noise
        and excess_cost(refinement.residuals) <= MAX_NOISE_EXCESS
    )


def _nuisances_explain_no_more(freed: NuisanceEstimate, alone: SeverityAttempt) -> bool:
    """Whether nuisances explain a recording no better than the severities alone do: what is left
    is none of theirs, as where guessed positions stand in for lost ones."""
    return not freed.explained and freed.excess >= excess_cost(alone.refined.residuals)


def _ready_stages(experiment: Experiment) -> int:
    """Stages of the genetic search that the samples so far suffice for, -1: not even the first."""
    test, seconds = experiment.test, experiment.ticks * experiment.tick
    if seconds < first_approximation_ready_at(test):
        return -1
    return sum(seconds >= stage_ready_at(test, stage) for stage in range(len(STAGE_SHARES)))


def warm_up(actuator: Actuator, test: StoredTest) -> None:
    """Identify from a fraction of a second at rest, in the loop that the test closes."""
    ticks = 200
    rest = np.zeros(ticks)
    samples = Samples(
        period_ns=round(1e9 / test.rate),
        mode=CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT,
        current=rest,
        spool=rest,
        pressure=rest,
        position=rest,
        command=rest,
        saturated=np.zeros((4, ticks), dtype=np.bool_),
        host_ns=np.arange(ticks),
    )
    length = ticks / test.rate
    whole = ((0.0, length),)
    silence = StoredTest(
        name="silence",
        id=test.id,
        mode=test.mode,
        unit=test.unit,
        rate=test.rate,
        segment=(Line(((0.0, 0.0), (length, 0.0))),),
        windows=SearchWindows(whole, whole, whole, whole),
    )
    experiment = build_experiment(samples, Environment(), silence, actuator)
    identify([experiment], solver=CompactGa(budget=20))
    state = compact_ga.initial_state(np.full(3, 0.5), np.full(3, 0.1), seed=0)
    population = np.empty((2, 3))
    compact_ga.draw_generation(state, population)
    compact_ga.update_state(state, population, np.zeros(2), 2.0, 1.0, np.empty(3))
    model_response(experiment.constants, experiment.trace.current, experiment.tick)
