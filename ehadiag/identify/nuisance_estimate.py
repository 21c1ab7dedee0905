"""Estimate of severities and nuisances from recordings, with a load where it is needed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import MAX_CLOGGING_EXPONENT
from ehadiag.core.conventions import FRICTION_NAME
from ehadiag.core.criteria import BREAK_AWAYS, FIT, GIVE_UP, NORMAL_HALF_WIDTH_95, RECORDING
from ehadiag.identify.estimates import (
    estimate_covariance,
    excess_cost,
    explains_far_more,
    friction_by_exponent,
    independent_covariance,
    is_near,
    is_unexplainable,
    likelihood_ratio_cost,
    misses_only_pressure,
    signal_excess_costs,
)
from ehadiag.identify.experiment import (
    Experiment,
    residuals_by_experiment,
    with_residual_noise,
)
from ehadiag.identify.least_squares import Refinement, refined_with_day, refinement_at
from ehadiag.identify.linearisation import (
    RUN_BLOCK_SIZE,
    ConsideredParameter,
    Derivatives,
    ParameterDensity,
    linearised_by_regression,
)
from ehadiag.identify.nuisance_search import (
    NUISANCE_RUN_BUDGET,
    RESTARTS,
    MultistartResult,
    NuisanceSearchSettings,
    StagedSearchResult,
    free_run_model,
    noise_scaled_model,
    search_in_stages,
)
from ehadiag.identify.partial_refinement import considered_parameters
from ehadiag.identify.posterior import (
    PosteriorResult,
    cauchy_cost,
    cauchy_costs,
    no_interruption,
    search_posterior,
)
from ehadiag.identify.prior import UnitPrior, prior_density, prior_information
from ehadiag.model.batch import SPOOL_ROW
from ehadiag.model.parameter import Parameter
from ehadiag.model.plant import ring_out_time, slip_speed
from ehadiag.model.registry import SENSOR_OFFSETS, parameter
from ehadiag.model.severities import FAULT_LAWS

HYSTERESIS_NAME = "hysteresis"
AMBIGUOUS_STDS = {name: law.ambiguous_std for name, law in FAULT_LAWS.items()}
VALLEY_SEVERITIES = ("Kintas", FRICTION_NAME)
"""Severities along whose valleys the likelihood counts: that of `FDJ` changed nothing (ADR 23)."""
PROFILE_HALF_WIDTH = RUN_BLOCK_SIZE // 2 - 1
"""Half width of the likelihood profile along a valley, deviations: one block of runs. Twice
as many points gave 350 units the same intervals (ADR 23)."""


PosteriorSearch = Callable[..., PosteriorResult]
"""`search_posterior` with all but where it begins."""


class NuisanceEstimate(msgspec.Struct, frozen=True, eq=False):
    """Estimate of the free parameters from recordings."""

    refined: Refinement
    """Optimum, residuals and derivatives over the width of what is known."""
    experiments: list[Experiment]
    """With their noise as judged."""
    covariance: Array
    """Covariance by several optima of like cost, SI, besides that of the refinement; shape (k,
    k)."""
    explained: bool
    excess: float
    """See `ehadiag.identify.estimates.excess_cost`."""
    starts: int
    """Searches that it took."""
    evaluations: int
    """Runs of the model in all."""
    slip_speed: float = 0.0
    """Speed of the jack, m/s, below which the pressure was left out; 0: none was."""
    better_exponent: float | None = None
    """Exponent of clogging, 1, that explains far more than the actuator file's; None: none does."""
    exponent_doubted: bool = False
    """Whether the file says 0, and the recording does not bear it out."""


def estimate_nuisances(
    experiments: Sequence[Experiment],
    settings: NuisanceSearchSettings,
    considered: Sequence[ConsideredParameter] = (),
) -> NuisanceEstimate:
    """Estimate parameters of one actuator from one or more recordings of it.

    considered: parameters that are held, with a tolerance that counts in the interval.
    """
    staged = search_in_stages(_searched(experiments, settings), settings)
    return estimate_about(experiments, settings, staged, considered)


def _searched(
    experiments: Sequence[Experiment], settings: NuisanceSearchSettings
) -> Sequence[Experiment]:
    """Experiments as they are searched."""
    if not settings.leave_creep_out:
        return experiments
    return [item.without_creep(followed=settings.follow) for item in experiments]


def estimate_about(
    experiments: Sequence[Experiment],
    settings: NuisanceSearchSettings,
    staged: StagedSearchResult,
    considered: Sequence[ConsideredParameter] = (),
) -> NuisanceEstimate:
    """Estimate parameters about the end of a search, see `estimate_nuisances`."""
    model, found = staged.model, staged.found
    judged = _with_judged_noise(_searched(experiments, settings), found.residuals)
    if found.explained:
        offset = model.named(found.density.x)["spool_offset"]
        experiments = [item.with_origin(offset) for item in experiments]
        # Where the model follows the spool's sensor the search has explained it from there.
        judged = [item if item.followed else item.with_origin(offset) for item in judged]
    held = [item.parameter for item in considered]

    def model_of(items: Sequence[Experiment]) -> Derivatives:
        free_run = free_run_model(items, (*settings.free, *held), staged.levels)
        return noise_scaled_model(free_run, items, considered)

    fine = model_of(judged)
    priors = settings.priors, settings.joint
    prior, information = prior_density(fine, *priors), prior_information(fine, *priors)
    density = ParameterDensity(found.density.x * model.scale / fine.scale, found.density.root)
    covariance = optima_covariance(found, model.scale)
    evaluations = staged.evaluations
    alone = settings.joint is None and all(
        item.test.closed_loop and item.constants.OIL == 0.0 for item in judged
    )
    far_off = misses_only_pressure(found.residuals) or not is_near(found.residuals)
    if found.explained or not (settings.give_up and far_off):
        rng = np.random.default_rng([settings.seed, -1 % 2**32])
        progress = settings.progress
        search = partial(
            search_posterior,
            prior=prior,
            information=information,
            linearise=partial(linearised_by_regression, rng=rng),
            between=no_interruption if progress is None else partial(progress, 1.0),
        )
        if not alone:
            density = _search_about(fine, search, density, RESTARTS.end_spread * density.root)
        else:
            late, begin = fine, replace(density, root=RESTARTS.end_spread * density.root)
            whole = [a.with_noise(b.noise) for a, b in zip(experiments, judged, strict=True)]
            for items in (whole, judged) if any(item.creep_end for item in judged) else (judged,):
                evaluations += fine.evaluations
                fine = model_of(items)
                end = search(fine, begin=begin)
                density, residuals = end.density, end.residuals
                creeps = (residuals != 0.0) & (late.model.batch.weight == 0.0)
                if settings.explains(residuals) and not _has_event(residuals, creeps):
                    break
            judged = items
            counted = fine.model.batch.weight > 0.0
            if settings.explains(residuals) and _has_event(residuals, counted):
                wide = RESTARTS.event_spread * density.root
                density = _search_about(fine, search, density, wide)
    linear = linearised_by_regression(fine, density, np.random.default_rng(settings.seed))
    refined = refinement_at(
        fine, density.x, linear, settled=found.explained, information=information
    )
    for name in VALLEY_SEVERITIES:
        if name in refined.values:  # a calibration holds the severities
            covariance = covariance + _profile_covariance(fine, refined, name)
    refined = refined_with_day(fine, refined, linear)
    ambiguous = _is_hysteresis_small(refined, judged)
    if alone:
        # What a first start explains, and all of it, other optima do not.
        ambiguous = (ambiguous and found.starts > 1) or _has_event(
            refined.residuals, refined.weighted
        )
    if ambiguous:
        covariance = (
            covariance
            + independent_covariance(refined.parameters, AMBIGUOUS_STDS)
            + _ends_covariance(found, model.scale)
        )
    return NuisanceEstimate(
        refined=refined,
        experiments=judged,
        covariance=covariance,
        explained=settings.explains(refined.residuals),
        excess=excess_cost(refined.residuals),
        starts=found.starts,
        evaluations=evaluations + fine.evaluations,
    )


def _profile_covariance(model: Derivatives, refined: Refinement, name: str) -> Array:
    """Covariance of a valley in which a severity and others trade, beyond that of the curvature at
    its floor, SI, shape (k, k).

    Break-aways make the floor uneven, and flatter than its curvature. The likelihood of points
    along it, each parameter as the curvature has it by the severity, gives the second moment.
    """
    covariance = estimate_covariance(refined) / np.outer(refined.scale, refined.scale)
    place = [item.name for item in refined.parameters].index(name)
    along = covariance[place] / np.sqrt(covariance[place, place])
    shifts = np.arange(-PROFILE_HALF_WIDTH, PROFILE_HALF_WIDTH + 1.0)
    points = np.clip(refined.x + shifts[:, None] * along, model.lower, model.upper)
    # At a bound of the severity the points go no farther.
    reached = (points[:, place] - refined.x[place]) / along[place]
    shifts, kept = np.unique(reached, return_index=True)
    unit = max(excess_cost(refined.residuals), 1.0)
    costs = cauchy_cost(model.many(points[kept])) / unit
    weights = np.exp(-0.5 * (costs - costs.min()))
    extra = max(float(weights @ shifts**2 / weights.sum()) - 1.0, 0.0)
    out = extra * np.outer(along, along) * np.outer(refined.scale, refined.scale)
    beside = np.abs(np.diff(costs))[np.abs(shifts[1:] - 0.5) <= 1.0]
    if beside.max(initial=0.0) > BREAK_AWAYS.event_cost:
        # Where the floor ends a break-away comes at another tick: what the model errs decides that.
        out[place, place] += AMBIGUOUS_STDS[name] ** 2
    return np.asarray(out)


def _is_hysteresis_small(refined: Refinement, experiments: Sequence[Experiment]) -> bool:
    """Whether hysteresis is so small in closed loop that the noise breaks the spool away."""
    values = refined.values
    return (
        HYSTERESIS_NAME in values
        and all(item.test.closed_loop for item in experiments)
        and values[HYSTERESIS_NAME] + experiments[0].constants.HYS
        < GIVE_UP.min_unambiguous_hysteresis
    )


def _with_judged_noise(experiments: Sequence[Experiment], residuals: Array) -> list[Experiment]:
    """Weight the experiments by the noise that residuals of all their ticks show."""
    parts = residuals_by_experiment(experiments, residuals)
    return [with_residual_noise(item, part) for item, part in zip(experiments, parts, strict=True)]


def _search_about(
    fine: Derivatives, search: PosteriorSearch, there: ParameterDensity, root: Array
) -> ParameterDensity:
    """Search about a density; the end of it if that is better, else the density.

    root: of the covariance over which it searches.
    """
    end = search(fine, begin=ParameterDensity(there.x, root))
    better = cauchy_cost(end.first) > cauchy_cost(end.residuals)
    return end.density if better else there


def _has_event(residuals: Array, counted: NDArray[np.bool_]) -> bool:
    """Whether residuals show a break-away at a wrong tick where they count.

    residuals, counted: shape (signals, N).
    """
    count = residuals.shape[1] // BREAK_AWAYS.block
    ticks = count * BREAK_AWAYS.block
    costs = cauchy_costs(residuals[:, :ticks]).sum(axis=0).reshape(count, -1).sum(axis=1)
    among = counted[:, :ticks].any(axis=0).reshape(count, -1).any(axis=1)
    over = costs[among] - np.median(costs[among]) if among.any() else np.zeros(1)
    return bool(over.max(initial=0.0) > BREAK_AWAYS.event_cost)


def optima_covariance(found: MultistartResult, scale: Array) -> Array:
    """Covariance of the optima that the starts ended in, about the best, SI, shape (k, k).

    Each has the weight of its likelihood, exp(-cost / 2), costs in units of what the best one
    leaves unexplained (a Birge ratio, R. T. Birge, Phys. Rev. 40, 1932): a mixture density, as
    JCGM 101:2008 would sample it.
    """
    count = max(int((found.residuals != 0.0).sum()), 1)
    unit = max(found.cost / count, 1.0)
    costs = np.array([place.cost for place in found.places])
    weights = np.exp(-0.5 * (costs - found.cost) / unit)
    shifts = np.array([place.x - found.density.x for place in found.places]) * scale
    return np.asarray((shifts.T * (weights / weights.sum())) @ shifts)


def _ends_covariance(found: MultistartResult, scale: Array) -> Array:
    """Covariance of the ends that cost little more than the best one, SI, shape (k, k).

    Where the noise breaks the spool away, costs of ends differ by break-aways at other ticks, which
    is no likelihood of the severities: such ends have the same weight.
    """
    most = BREAK_AWAYS.max_end_cost * found.cost
    alike = [item for item in found.places if item.cost <= most]
    shifts = np.array([item.x - found.density.x for item in alike]) * scale
    return np.asarray(shifts.T @ shifts / len(alike))


def _better_of(found: NuisanceEstimate, further: NuisanceEstimate) -> NuisanceEstimate:
    """The further estimate if it explains more of the recordings, with the effort of both.

    Of two that explain them the one without a break-away at a wrong tick does.
    """

    def explains(item: NuisanceEstimate) -> tuple[bool, bool, float]:
        event = _has_event(item.refined.residuals, item.refined.weighted)
        return item.explained, not (item.explained and event), -item.excess

    best = max(found, further, key=explains)
    return replace(
        best,
        evaluations=found.evaluations + further.evaluations,
        starts=found.starts + further.starts,
    )


def without_slips(experiment: Experiment, slip_speed: float, severity: float) -> Experiment:
    """Experiment without the pressure on a jack that slips in steps, and the ring of the last one.

    The ring is left out in part where less than `RECORDING.min_samples` of the pressure would stay;
    in closed loop, where the jack reverses before a ring dies away, not at all. severity: of `FDJ`.
    """
    ring_out = 0.0
    if not experiment.test.closed_loop:
        ring_out = ring_out_time(experiment.constants, severity, experiment.pressure_noise)
    while True:
        out = experiment.sliding(slip_speed, ring_out)
        enough = np.isfinite(out.pressure).sum() >= RECORDING.min_samples
        if enough or ring_out == 0.0:
            return out
        ring_out = 0.5 * ring_out if ring_out > experiment.tick else 0.0


def _may_gain_by_following(
    experiments: Sequence[Experiment], found: NuisanceEstimate, *, exact: bool
) -> bool:
    """Whether a model that follows the spool's sensor before the motion may explain more.

    Running free it may stick elsewhere; other friction then explains the rest but for a break-away.
    exact: whether what is explained leaves but noise, so that such a break-away shows.
    """
    left = found.refined.residuals
    if not found.explained:
        return not _leaves_too_much(left)
    if not exact:
        return False
    parts = residuals_by_experiment(experiments, np.where(found.refined.weighted, left, 0.0))
    return any(
        item.creeps and _has_event(part, part != 0.0)
        for item, part in zip(experiments, parts, strict=True)
    )


def _leaves_too_much(residuals: Array) -> bool:
    """Whether another kind of search will not explain what one leaves either."""
    return is_unexplainable(residuals) or misses_only_pressure(residuals)


class NuisanceEstimator(msgspec.Struct, frozen=True):
    """Estimator of severities with other parameters free."""

    prior: UnitPrior
    """Of the unit."""
    effects: tuple[Parameter, ...]
    """Free parameters besides the severities, the sensors' offsets and inexact data."""
    progress: Callable[[float], None]
    """Called repeatedly with the share of a search's budget that is spent."""

    def estimated(
        self, experiments: Sequence[Experiment], hint: Mapping[str, float] | None
    ) -> NuisanceEstimate:
        """Estimate severities and all free parameters from recordings of one actuator.

        hint: values by name near which the optimum probably lies.
        """
        calibrated = self.prior.joint is not None
        if calibrated and any(slip_speed(item.constants) > 0.0 for item in experiments):
            return self._of_oil(experiments, hint)
        creeps = [item.creeps for item in experiments]
        # Most are explained by one start without following the sensor, which costs more looks.
        budget = 1 if all(creeps) else NUISANCE_RUN_BUDGET
        found = self._with(experiments, self.prior, hint, budget=budget)
        exact = self.prior.joint is None
        if any(creeps) and _may_gain_by_following(experiments, found, exact=exact):
            followed = self._with(experiments, self.prior, hint, follow=True)
            found = _better_of(found, followed)
        begins_as_read = any(item.origin_read and not item.creeps for item in experiments)
        if not found.explained and begins_as_read:
            found = self._from_origin(experiments, found, hint)
        if found.explained:
            return found
        if not self.prior.has_inexact_data:
            return self._with_load(experiments, found) if self.effects else found
        return self._loosened(experiments, found, hint) if calibrated else found

    def _from_origin(
        self,
        experiments: Sequence[Experiment],
        found: NuisanceEstimate,
        hint: Mapping[str, float] | None,
    ) -> NuisanceEstimate:
        """Estimate with the spool's origin less the offset that was found, if that explains more.

        Where friction holds the spool the first break-away comes at another tick otherwise, and
        hysteresis stands in for friction.
        """
        offset = found.refined.values["spool_offset"]
        moved = [item.with_origin(offset) for item in experiments]
        return _better_of(found, self._with(moved, self.prior, hint))

    def _loosened(
        self, experiments: Sequence[Experiment], found: NuisanceEstimate,
        hint: Mapping[str, float] | None,
    ) -> NuisanceEstimate:  # fmt: skip
        """Estimate where effects may have changed since the calibration, if that explains more."""
        loose = self._with_changed_effects(experiments, found, hint)
        return loose if explains_far_more(loose.excess, found.excess) else found

    def _with_changed_effects(
        self, experiments: Sequence[Experiment], found: NuisanceEstimate,
        hint: Mapping[str, float] | None, budget: int = NUISANCE_RUN_BUDGET,
    ) -> NuisanceEstimate:  # fmt: skip
        """Estimate where effects may have changed; the same where what is left is of no change."""
        if found.explained or found.excess <= FIT.max_explained_excess:
            return found
        return self._with(experiments, self.prior.loosened(), hint, budget=budget)

    def _of_oil(
        self, experiments: Sequence[Experiment], hint: Mapping[str, float] | None
    ) -> NuisanceEstimate:
        """Estimate a calibrated unit with oil in its second stage.

        Where one start does not explain all the pressure on a jack that slips in steps is left out,
        by the friction found. A calibration leaves it out by the friction as new; a worn jack slips
        at up to twenty times that speed.
        """
        settings, considered = self._search(experiments, self.prior, hint, budget=1)
        staged = search_in_stages(experiments, settings)
        if staged.found.explained:
            found = estimate_about(experiments, settings, staged, considered)
            better, doubted = self._other_exponent(experiments, found, found)
            return replace(found, better_exponent=better, exponent_doubted=doubted)
        values = staged.model.named(staged.found.density.x)
        friction = min(max(values["FDJ"], 0.0), 1.0)
        slow = max(slip_speed(item.constants, friction) for item in experiments)
        sliding = [without_slips(item, slow, friction) for item in experiments]
        found = self._with(sliding, self.prior, values)
        loose = self._with_changed_effects(sliding, found, values, budget=1)
        better, doubted = self._other_exponent(sliding, found, loose)
        if better is None and explains_far_more(loose.excess, found.excess):
            found = loose
        return replace(
            found,
            slip_speed=slow,
            better_exponent=better,
            exponent_doubted=doubted,
            evaluations=staged.evaluations + found.evaluations,
            starts=staged.found.starts + found.starts,
        )

    def _other_exponent(
        self, experiments: Sequence[Experiment], found: NuisanceEstimate, loose: NuisanceEstimate
    ) -> tuple[float | None, bool]:
        """Return the end of the exponents farther from the stated one, where it explains far more
        of the spool; and whether the stated one is 0, and is not borne out.

        One start with the other end decides. What was calibrated with the stated law is loosened,
        since it stands in for what that law leaves out. Where neither end leaves half of what the
        other one does, the recording shows `FSS / k^m` alone (PHY-45): 0 is not believed then,
        which a file says that does not say anything. Where the model explains the unit to the
        noise, as new and now, 0 is believed if the recording is likelier with it than with the
        middle (one search may end beside the optimum) and the other end, or if the other end's
        friction is within the law's discrepancy: a file may say that its laws are exact.
        """
        low, stated = self.prior.exponents
        before, own = (
            float(signal_excess_costs(item.refined.residuals)[SPOOL_ROW]) for item in (found, loose)
        )
        other = 0.0 if stated > MAX_CLOGGING_EXPONENT / 2.0 else MAX_CLOGGING_EXPONENT
        c, values = experiments[0].constants, found.refined.values
        friction = friction_by_exponent(values, c, other - stated)
        shows = before > FIT.max_explained_excess
        to_noise = stated == 0.0 and not shows and self.prior.explains_unit_as_new
        if stated == 0.0:
            law = self.prior.discrepancy.get(FRICTION_NAME, 0.0) * values[FRICTION_NAME]
            apart = abs(friction - values[FRICTION_NAME])
            shows = not to_noise or apart > NORMAL_HALF_WIDTH_95 * law > 0.0
        elif found.explained:
            shows = False
        if low < stated or not shows:
            return None, False
        if to_noise:
            middle = MAX_CLOGGING_EXPONENT / 2.0
            return None, any(self._is_likely(experiments, found, m) for m in (middle, other))
        others = [item.with_exponent(other, self.prior.bridge) for item in experiments]
        hint = {**values, FRICTION_NAME: min(max(friction, 0.0), 1.0)}
        residuals = search_in_stages(others, self._one_start(others, hint)).found.residuals
        left = float(signal_excess_costs(residuals)[SPOOL_ROW])
        least = min(own, before)
        if least > FIT.max_explained_excess and explains_far_more(left, least):
            return other, False
        return None, stated == 0.0 and not explains_far_more(before, left)

    def _is_likely(
        self, experiments: Sequence[Experiment], found: NuisanceEstimate, exponent: float
    ) -> bool:
        """Whether another exponent than the stated 0 is not ten times less likely."""
        values = found.refined.values
        friction = friction_by_exponent(values, experiments[0].constants, exponent)
        others = [item.with_exponent(exponent, self.prior.bridge) for item in experiments]
        hint = {**values, FRICTION_NAME: min(max(friction, 0.0), 1.0)}
        there = estimate_nuisances(others, self._one_start(others, hint)).refined.residuals
        more = likelihood_ratio_cost(there, found.refined.residuals)
        return more < 2.0 * math.log(FIT.min_likelihood_ratio)

    def _one_start(
        self, experiments: Sequence[Experiment], hint: Mapping[str, float]
    ) -> NuisanceSearchSettings:
        """Settings of one start from values, by name, with what may have changed since a
        calibration."""
        return self._search(experiments, self.prior.loosened(), hint, budget=1)[0]

    def _with_load(
        self, experiments: Sequence[Experiment], found: NuisanceEstimate
    ) -> NuisanceEstimate:
        """Estimate a constant load, too, where that explains what the other effects do not."""
        left = found.refined.residuals
        if not (misses_only_pressure(left) and is_near(left)):
            return found
        values = found.refined.values
        load = (parameter("load"),)
        more = self._with(experiments, self.prior, values, load, budget=1)
        return _better_of(found, more)

    def _with(
        self,
        experiments: Sequence[Experiment],
        prior: UnitPrior,
        hint: Mapping[str, float] | None,
        further: tuple[Parameter, ...] = (),
        budget: int = NUISANCE_RUN_BUDGET,
        *,
        follow: bool = False,
    ) -> NuisanceEstimate:
        settings, considered = self._search(experiments, prior, hint, further, budget)
        settings = replace(settings, follow=follow)
        return estimate_nuisances(experiments, settings, considered)

    def _search(
        self,
        experiments: Sequence[Experiment],
        prior: UnitPrior,
        hint: Mapping[str, float] | None,
        further: tuple[Parameter, ...] = (),
        budget: int = NUISANCE_RUN_BUDGET,
    ) -> tuple[NuisanceSearchSettings, tuple[ConsideredParameter, ...]]:
        """Settings of a search, and what is considered with it."""
        effects = (*self.effects, *further)
        free = (*prior.severities, *SENSOR_OFFSETS, *prior.with_free(effects))
        settings = NuisanceSearchSettings(
            free,
            priors=prior.priors,
            joint=prior.joint,
            hint=hint,
            budget=budget,
            progress=self.progress,
            # Of other units the first starts may leave as much as of an unknown effect.
            give_up=prior.explains_sound_units,
            explains=prior.explains,
            goes_slow=any(item.test.closed_loop for item in experiments),
            leave_creep_out=True,
        )
        return settings, considered_parameters(experiments, free)
