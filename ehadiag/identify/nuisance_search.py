"""Search for severities and nuisances from several starts: open-loop recordings first, then all.

A search may end away from the optimum, which its residuals show; further starts go on until the
recording is explained or further ones will not help.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.criteria import FIT, GIVE_UP
from ehadiag.identify.estimates import (
    ExplanationTest,
    excess_cost,
    explains_far_more,
    explains_spool,
    is_near,
    is_noise,
    is_unexplainable,
    misses_only_pressure,
)
from ehadiag.identify.experiment import Experiment, lay_out_spans, unknowns_of
from ehadiag.identify.linearisation import (
    RUN_BLOCK_SIZE,
    ConsideredParameter,
    Derivatives,
    ParameterDensity,
    linearised_by_regression,
)
from ehadiag.identify.posterior import (
    MANY_UNKNOWNS_SCHEDULE,
    SLOW_SCHEDULE,
    PosteriorResult,
    cauchy_cost,
    search_posterior,
)
from ehadiag.identify.prior import (
    SPOOL_OFFSET_ALIAS,
    WIDTHS,
    JointPrior,
    ParameterPrior,
    density_about,
    prior_density,
    prior_information,
    small_effects_density,
)
from ehadiag.identify.signals import median_of
from ehadiag.model.batch import SPOOL_ROW
from ehadiag.model.parameter import Parameter, ParameterKind
from ehadiag.model.residual_models import SimdModel


class RestartRules(msgspec.Struct, frozen=True):
    """Restarts of a search."""

    end_spread: float = 3.0
    """Spread of a look about an end that misses only the pressure, and of the last one with the
    noise as judged, in spreads of that end: with looks of the first kind 1 of 40 units ended beside
    the optimum, 13 without (ADR 23); other spreads were not recorded."""
    event_spread: float = 10.0
    """Spread of a look about the end of a search that leaves a break-away at a wrong tick, in
    spreads of that end: of a unit whose end was 4 % of `FSS` off three looks of three came to the
    optimum, with 90 runs each; with 3 none did."""
    alias_half_span: float = 1.25
    """Half-width over which a parameter is moved against its alias, in units of its scale: a
    quarter of what the null bias may span, to either side."""
    alias_points: int = 128
    """Points on it where little is left, 1: null biases 4 µA apart are spools 0.15 µm apart, or
    0.3 MPa on a jack that sticks; with 16 what explains the pressure was passed over."""
    relaxed_noise: float = 100.0
    """Weight of the spool over the pressure while the spool is explained first, 1. With
    no weight of the pressure, and narrower starts, three of ten units with orifices more are NOT
    TESTED (ADR 24); of a calibrated unit it has none."""
    scans: int = 3
    """Scans of the jack's friction, 1: the spacing of the last is 0.05 % of the severity."""
    scan_spread: float = 2.0
    """Spread about the best place of the last scan, in its spacings: both neighbours are within
    it."""


RESTARTS = RestartRules()

NUISANCE_RUN_BUDGET = 3200
"""Runs of the model after which no further start is made, 1, if `GIVE_UP` allows more: a start in
closed loop takes some 200 to 700, and looks about its end as many."""


class StartEnd(msgspec.Struct, frozen=True, eq=False):
    """End of one start."""

    x: Array
    """Shape (k,)."""
    cost: float


class MultistartResult(msgspec.Struct, frozen=True, eq=False):
    """Best end of a search from several starts."""

    density: ParameterDensity
    residuals: Array
    """Weighted, at its mean; shape (signals, N)."""
    cost: float
    """Robust, see `cauchy_cost`."""
    explained: bool
    places: tuple[StartEnd, ...]
    """Where all starts ended."""

    @property
    def starts(self) -> int:
        """How many it took."""
        return len(self.places)


def multistart_search(
    model: Derivatives,
    prior: ParameterDensity,
    information: Array,
    origins: Sequence[ParameterDensity],
    explains: Callable[[Array], bool],
    *,
    restart_root: Array | None = None,
    slow_restarts: bool = False,
    alias: str = "",
    budget: int = NUISANCE_RUN_BUDGET,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    gives_up: Callable[[Array], bool] | None = None,
    goes_slow: bool = False,
    looks_about: bool = False,
) -> MultistartResult:
    """Search from several starts until the residuals are explained, or the budget is spent.

    model: free-running model; prior: density before the recordings; information: inverse covariance
    of the prior, shape (k, k); origins: every other start, in turn; the starts between are near the
    best end so far; explains: whether residuals leave no better optimum to search for;
    restart_root: root of the covariance about the best end for a start near it, shape (c, c); a
    tenth of the prior's unless given; slow_restarts: whether such a start takes the slow schedule;
    alias: name of a parameter that is an alias of a sensor's constant error; budget: runs of the
    model after which no further start is made; seed: the same seed gives the same answer; progress:
    called before each round and after each start with the share of the budget that is spent; what
    it raises ends the search; gives_up: whether further starts will not help, by the best
    residuals; if given, two starts that only miss the pressure end the search, too, and
    `GIVE_UP.starts`; goes_slow: whether all starts but the first are slow and from the last origin;
    else every other start is near the best end so far; looks_about: whether the first start, and
    each that leaves little, looks again about its end as long as that gains. Returns best
    end, and those of all starts.
    """
    until = model.evaluations + budget
    restart_root = WIDTHS.near * prior.root if restart_root is None else restart_root

    def between() -> None:
        if progress is not None:
            progress(min(1.0 - (until - model.evaluations) / max(budget, 1), 1.0))

    best: MultistartResult | None = None
    places: list[StartEnd] = []
    while best is None or (not best.explained and model.evaluations < until):
        turn, from_best = divmod(len(places), 2)
        slow = best is not None and (goes_slow or (from_best and slow_restarts))
        schedule = SLOW_SCHEDULE if slow else MANY_UNKNOWNS_SCHEDULE
        if goes_slow:
            begin = origins[0 if best is None else -1]
        elif best is None or not from_best:
            begin = origins[turn % len(origins)]
        else:
            begin = ParameterDensity(_best_along_alias(model, best, alias), restart_root)
        rng = np.random.default_rng([seed, len(places)])
        linearise = partial(linearised_by_regression, rng=rng)
        look = partial(
            search_posterior, model, prior, information=information, linearise=linearise,
            schedule=schedule, between=between,
        )  # fmt: skip
        end = _end_of(look(begin=begin), explains)
        gains = looks_about and (best is None or is_near(end.residuals))
        while gains and not end.explained:
            near = _density_about_end(model, end, alias, restart_root)
            other = _end_of(look(begin=near), explains)
            left = excess_cost(other.residuals), excess_cost(end.residuals)
            gains = explains_far_more(*left)
            end = min(end, other, key=lambda item: item.cost)
        places.append(StartEnd(end.density.x, end.cost))
        again = best is not None and all(
            misses_only_pressure(item.residuals) for item in (best, end)
        )
        if best is None or end.cost < best.cost:
            best = end
        if gives_up is not None and (
            again or len(places) >= GIVE_UP.starts or gives_up(best.residuals)
        ):
            break
        between()
    return replace(best, places=tuple(places))


def _end_of(found: PosteriorResult, explains: Callable[[Array], bool]) -> MultistartResult:
    """Return the end of one search."""
    explained = found.settled and explains(found.residuals)
    cost = float(cauchy_cost(found.residuals))
    return MultistartResult(found.density, found.residuals, cost, explained, ())


def _density_about_end(
    model: Derivatives, end: MultistartResult, alias: str, root: Array
) -> ParameterDensity:
    """Density about the best point along the alias, see `_best_along_alias`, for a further look.

    Where only the pressure is not explained, the alias alone is at a wrong place: all others stay
    near that of the end. root: of the covariance where more than that is wrong.
    """
    names = [model.estimated[j].name for j in model.curved]
    points = RESTARTS.alias_points if is_near(end.residuals) else RUN_BLOCK_SIZE
    if alias in names and explains_spool(end.residuals):
        root, place = RESTARTS.end_spread * end.density.root, names.index(alias)
        root[place] = 0.0
        covariance = root @ root.T
        covariance[place, place] = (2.0 * RESTARTS.alias_half_span / points) ** 2
        root = np.asarray(np.linalg.cholesky(covariance))
    return ParameterDensity(_best_along_alias(model, end, alias, points), root)


def _best_along_alias(
    model: Derivatives, best: MultistartResult, alias: str, count: int = RUN_BLOCK_SIZE
) -> Array:
    """Best point of a line on which a parameter and a sensor's constant error trade."""
    names = [item.name for item in model.estimated]
    x = best.density.x
    if alias not in names:
        return x
    j = names.index(alias)
    shifts = RESTARTS.alias_half_span * (2.0 * (np.arange(count) + 1.0) / count - 1.0)
    points = np.repeat(x[None, :], count, axis=0)
    points[:, j] = np.clip(x[j] + shifts, model.lower[j], model.upper[j])
    nodes = points[:: count // RUN_BLOCK_SIZE]
    _take_off_offsets(model, nodes, model.many(nodes))
    points = np.column_stack([np.interp(points[:, j], nodes[:, j], row) for row in nodes.T])
    return points[int(np.argmin(cauchy_cost(model.many(points))))]


def _take_off_offsets(model: Derivatives, points: Array, runs: Array) -> None:
    """Move points, and their residuals, by the sensors' constant errors that their medians show.

    Medians do not see the samples that a wrong pair spoils.
    """
    slopes = model.additive_slopes()
    for k, item in enumerate(model.estimated):
        if item.adds_to is not None and item.adds_to < slopes.shape[1]:
            slope, run = slopes[k, item.adds_to], runs[:, item.adds_to]
            used = slope != 0.0
            if not used.any():  # none of the pressure counts on a jack that slips throughout
                continue
            offsets = median_of(run[:, used] / slope[used])
            points[:, k] -= offsets
            run -= offsets[:, None] * slope


class NuisanceSearchSettings(msgspec.Struct, frozen=True, eq=False):
    """Parameters that are estimated, their priors, and end of the search."""

    free: Sequence[Parameter]
    """Parameters that are estimated."""
    priors: Mapping[str, ParameterPrior] = msgspec.field(default_factory=dict)
    """Priors of some of them by name."""
    joint: JointPrior | None = None
    """Prior of some others together."""
    hint: Mapping[str, float] | None = None
    """Values by name (0 where not named) near which the optimum probably lies."""
    hint_of_open: bool = False
    """Whether the hint is of the open-loop recordings alone: a search with the others then starts
    where that with these ends."""
    budget: int = NUISANCE_RUN_BUDGET
    seed: int = 0
    """The same seed gives the same answer."""
    progress: Callable[[float], None] | None = None
    """Called repeatedly with the share of the budget that is spent; what it raises ends the
    estimation."""
    give_up: bool = False
    """Whether to stop early where no effect explains the recordings."""
    explains: ExplanationTest = is_noise
    """Whether residuals leave no better optimum to search for."""
    goes_slow: bool = False
    """See `multistart_search`."""
    leave_creep_out: bool = False
    """Whether to search without what comes before a closed loop's motion, and take it back where
    that is explained, too."""
    follow: bool = False
    """Whether the model follows the spool's sensor until then."""

    @property
    def frees_severities(self) -> bool:
        """Whether the severities are estimated: a calibration holds them."""
        return any(item.kind is ParameterKind.FAULT for item in self.free)


def is_calibrated_oil(experiments: Sequence[Experiment], joint: JointPrior | None) -> bool:
    """Whether little but the severities is unknown of a unit with oil in its second stage."""
    return joint is not None and any(item.constants.OIL > 0.0 for item in experiments)


class StagedSearchResult(msgspec.Struct, frozen=True, eq=False):
    """Result of a search in stages."""

    model: Derivatives
    """Of whole tests, which it ran."""
    found: MultistartResult
    levels: NDArray[np.int64]
    """Of that model."""
    evaluations: int
    """Runs of the model, with those of all stages."""


def search_in_stages(
    experiments: Sequence[Experiment], settings: NuisanceSearchSettings
) -> StagedSearchResult:
    """Search with the open-loop recordings alone, if there are others, then with all."""
    part = [item for item in experiments if not item.test.closed_loop]
    if not 0 < len(part) < len(experiments):
        return _search_recordings(experiments, settings)
    before = _search_recordings(part, settings)
    led = excess_cost(before.found.residuals) <= FIT.max_explained_excess
    whole = _search_recordings(experiments, settings, before if led else None)
    return replace(whole, evaluations=before.evaluations + whole.evaluations)


def _search_recordings(
    experiments: Sequence[Experiment],
    settings: NuisanceSearchSettings,
    before: StagedSearchResult | None = None,
) -> StagedSearchResult:
    """Search with some recordings; before: result of the open-loop ones among them."""
    priors, joint, hint = settings.priors, settings.joint, settings.hint
    goes_slow = (
        settings.goes_slow and before is None and any(item.test.closed_loop for item in experiments)
    )
    oil = any(item.constants.OIL > 0.0 for item in experiments)
    coarse = free_run_model(experiments, settings.free)
    model = noise_scaled_model(coarse, experiments)
    first, information = (
        prior_density(model, priors, joint),
        prior_information(model, priors, joint),
    )
    origins = [first] if goes_slow else [first, small_effects_density(model, first)]
    known = settings.frees_severities and is_calibrated_oil(experiments, joint)
    if hint is not None:
        origins = [density_about(model, first, hint, known=known), *origins[::-1]]
    guide: Derivatives | None = None
    restart_root = WIDTHS.near * first.root
    if before is not None:
        there = density_of_all_recordings(before.model, before.found.density, model)
        origins, restart_root = [there], WIDTHS.near * there.root
        if hint is not None and not settings.hint_of_open:
            origins = [ParameterDensity(density_about(model, first, hint).x, restart_root), there]
    elif oil:
        relaxed = np.inf if known else RESTARTS.relaxed_noise
        guide = _spool_guide(experiments, settings.free, coarse.levels, relaxed)
        search_spool = partial(
            multistart_search,
            guide,
            first,
            information,
            explains=_spool_is_noise,
            budget=settings.budget // 2,
            seed=settings.seed,
            gives_up=_spool_is_unexplainable if settings.give_up else None,
            progress=settings.progress,
        )
        guided = search_spool(origins=origins)
        if known:
            if not guided.explained:  # in closed loop the hint may be far off
                other = search_spool(origins=origins[-1:])
                guided = min(guided, other, key=lambda item: item.cost)
            origins = [_jack_density(model, guided.density, hint), *origins]
        else:
            origins = [density_about(model, first, guide.named(guided.density.x)), *origins]
    found = multistart_search(
        model,
        first,
        information,
        origins,
        settings.explains,
        restart_root=restart_root,
        slow_restarts=before is not None,
        alias=SPOOL_OFFSET_ALIAS,
        budget=settings.budget,
        seed=settings.seed,
        progress=settings.progress,
        gives_up=is_unexplainable if settings.give_up else None,
        goes_slow=goes_slow,
        # Inexact data explain nearly all from an end beside the optimum, too.
        looks_about=goes_slow and not (oil or priors or joint),
    )
    runs = sum(item.evaluations for item in (guide, model) if item)
    return StagedSearchResult(model, found, coarse.levels, runs)


def density_of_all_recordings(
    part: Derivatives, found: ParameterDensity, whole: Derivatives
) -> ParameterDensity:
    """Return the density of a part of the recordings in the coordinates of a model of all of them.

    Both models have the same parameters. A constant error of a sensor that each recording has for
    itself begins at that of the first.
    """
    values: dict[str, float] = {}
    for item, value in zip(part.estimated, (found.x * part.scale).tolist(), strict=True):
        values.setdefault(item.name, value)
    x = np.array([values[item.name] for item in whole.estimated]) / whole.scale
    widths = part.scale[part.curved] / whole.scale[whole.curved]
    return ParameterDensity(np.clip(x, whole.lower, whole.upper), widths[:, None] * found.root)


def free_run_model(
    experiments: Sequence[Experiment],
    parameters: Sequence[Parameter],
    levels: NDArray[np.int64] | None = None,
) -> SimdModel:
    """Model of whole tests; `levels`: of one of the same tests, if there was one."""
    return SimdModel(
        lay_out_spans(experiments), unknowns_of(experiments, parameters), levels=levels
    )


def noise_scaled_model(
    model: SimdModel,
    experiments: Sequence[Experiment],
    considered: Sequence[ConsideredParameter] = (),
) -> Derivatives:
    """Coordinates scaled by the noise."""
    return Derivatives(model, experiments[0].noise, considered)


def _spool_guide(
    experiments: Sequence[Experiment],
    free: Sequence[Parameter],
    levels: NDArray[np.int64],
    relaxed_noise: float,
) -> Derivatives:
    """Model of the spool alone, for a start where the oil stores the pressure.

    Compressible oil keeps for tenths of a second what the spool did and rings, so that far from the
    optimum the pressure misleads the search; the spool, which is independent of it, is explained
    first.
    """
    relaxed = [
        item.with_noise(
            (item.spool_noise, relaxed_noise * item.pressure_noise, item.position_noise)
        )
        for item in experiments
    ]
    return Derivatives(free_run_model(relaxed, free, levels), experiments[0].noise)


def _jack_density(
    model: Derivatives, guided: ParameterDensity, hint: Mapping[str, float] | None
) -> ParameterDensity:
    """Density about the end of the spool's search, at the jack's friction that fits best.

    With the spool explained, and all else known by a calibration, that friction is what is left;
    where the jack slips in steps its cost has many dips, so that it is scanned, ever finer.
    """
    x, j = guided.x, [item.name for item in model.estimated].index("FDJ")
    low, high = model.lower[j], model.upper[j]
    places = np.linspace(low, high, 2 * RUN_BLOCK_SIZE - 1)
    if hint is not None:
        places = np.append(places, hint.get("FDJ", 0.0))
    about = (2.0 * np.arange(RUN_BLOCK_SIZE) + 1.0) / RUN_BLOCK_SIZE - 1.0
    for span in (places[1] - places[0]) / (0.5 * RUN_BLOCK_SIZE) ** np.arange(RESTARTS.scans):
        points = np.repeat(x[None, :], len(places), axis=0)
        points[:, j] = np.clip(places, low, high)
        runs = model.many(points)
        _take_off_offsets(model, points, runs)
        x = points[int(np.argmin(cauchy_cost(runs)))]
        places = x[j] + span * about
    row = model.curved.tolist().index(j)
    root = WIDTHS.loosened * guided.root
    root[row] *= RESTARTS.scan_spread * span / np.linalg.norm(root[row])
    return ParameterDensity(x, root)


def _spool_is_noise(residuals: Array) -> bool:
    return is_noise(residuals[SPOOL_ROW : SPOOL_ROW + 1])


def _spool_is_unexplainable(residuals: Array) -> bool:
    return is_unexplainable(residuals[SPOOL_ROW : SPOOL_ROW + 1])
