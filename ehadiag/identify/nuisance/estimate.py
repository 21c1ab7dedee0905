"""Severities and nuisances of one actuator from its recordings: search, noise, uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.nuisance.explained import Explains, excess, is_hopeless, is_noise
from ehadiag.identify.nuisance.open_loop_first import carried_over, open_loop_first
from ehadiag.identify.nuisance.prior import (
    ALIAS,
    Joint,
    Known,
    belief_of,
    beside,
    information_of,
    small_effects,
)
from ehadiag.identify.nuisance.starts import AGAIN, Found, search
from ehadiag.identify.refine.derivatives import Considered, Derivatives
from ehadiag.identify.refine.last_round import by_a_finer_model
from ehadiag.identify.refine.least_squares import Refinement, described
from ehadiag.identify.refine.linearisation import Belief, Linearised, linearised
from ehadiag.identify.refine.posterior import LAST, nothing, robust_cost, sharpen
from ehadiag.identify.spans import judge_noise, lay_out, unknowns_of
from ehadiag.identify.uncertainty import independent
from ehadiag.model.batch import SPOOL_ROW
from ehadiag.model.parameters import Parameter
from ehadiag.model.simd.model import SimdModel

__all__ = ["BUDGET", "Estimated", "estimate", "spread_of_optima"]

BUDGET = 1600
"""Runs of the model after which no further start is made."""
LOOK = 3.0
"""Spread of the last look, with the noise as judged, in spreads of the search's end."""
HYSTERESIS = "hysteresis"
LITTLE_HYSTERESIS = 5e-3
"""Full width, relative, below which closed loop keeps the spool breaking away."""
TWINS = {"Kintas": 2e-3, "FSS": 7e-4, "FDJ": 5e-5}
"""Deviation of each severity where there is so little: places beside the optimum explain such
recordings as well, the noise deciding which break-aways there were. Errors in 48 of them (eight
noises, six units) were 0.47, 0.19 and 0.02 % at most, up to 46 deviations without this."""
NEARLY_EXPLAINED = 1.3
"""Excess of open loop alone up to which what is believed after it is gone on with: where more is
left the search has ended beside the optimum, and believes too much."""
CLOSER = 0.3
"""Spread of a further look about the best place, in spreads of what open loop alone leaves."""
OTHER_PLACE = 30.0
"""Gain of a look further about from which on it is another place, not one as good."""
Linearise = Callable[[Derivatives, Belief], Linearised]
Hopeless = Callable[[NDArray[np.float64], int], bool]
RELAXED = 100.0
"""Weight of the spool over the pressure while the spool is explained first."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimated:
    """What recordings say of the free parameters.

    Attributes
    ----------
    refined : Refinement
        Optimum, residuals and derivatives over the width of what is known.
    experiments : list of Experiment
        With their noise as judged.
    covariance : shape (k, k)
        SI, of what several optima of like cost leave open, beside that of the refinement.
    explained : bool
    confirmed : bool
        See `ehadiag.identify.nuisance.starts.Found`.
    excess : float
        See `ehadiag.identify.nuisance.explained.excess`.
    starts : int
        Searches that it took.
    evaluations : int
        Runs of the model, all told.
    """

    refined: Refinement
    experiments: list[Experiment]
    covariance: NDArray[np.float64]
    explained: bool
    confirmed: bool
    excess: float
    starts: int
    evaluations: int


def estimate(
    experiments: Sequence[Experiment],
    free: Sequence[Parameter],
    *,
    known: Mapping[str, Known] | None = None,
    joint: Joint | None = None,
    considered: Sequence[Considered] = (),
    hint: Mapping[str, float] | None = None,
    budget: int = BUDGET,
    seed: int = 0,
    tell: Callable[[float], None] | None = None,
    give_up: bool = False,
    left_before: float = np.inf,
    explains: Explains = is_noise,
    patient: bool = False,
) -> Estimated:
    """Estimate parameters of one actuator from one or more recordings of it.

    Parameters
    ----------
    experiments : sequence of Experiment
    free : sequence of Parameter
        What is estimated.
    known : mapping, optional
        What is known of some of them beforehand, by name.
    joint : Joint, optional
        What is known of some others together.
    considered : sequence of Considered
        What is held, with a tolerance that counts in the interval.
    hint : mapping, optional
        Values by name (0 where not named) beside which the optimum probably lies.
    budget : int
        See `BUDGET`.
    seed : int
        The same seed gives the same answer.
    tell : callable, optional
        Called again and again with the share of the budget that is spent; what it raises ends the
        estimation.
    give_up : bool
        Whether to stop early where nothing explains the recordings.
    left_before : float
        Excess that is left with none of the effects.
    explains : callable
        Of residuals, shape (signals, N): whether there is nothing better to look for.
    patient : bool
        Whether further starts take their time, see `ehadiag.identify.nuisance.starts.search`.
    """
    known = known or {}
    searched = partial(
        _searched,
        free=free,
        known=known,
        joint=joint,
        hint=hint,
        budget=budget,
        seed=seed,
        tell=tell,
        give_up=give_up,
        left_before=left_before,
        explains=explains,
        patient=patient,
    )
    part = open_loop_first(experiments)
    before = searched(part) if part else None
    led = before is not None and excess(before.found.residuals) <= NEARLY_EXPLAINED
    whole = searched(experiments, before=before if led else None)
    model, found = whole.model, whole.found
    judged = _judged(experiments, found.residuals)
    held = [item.parameter for item in considered]
    fine = _scaled(_free_running(judged, (*free, *held), whole.levels), judged, considered)
    at_first = belief_of(fine, known, joint), information_of(fine, known, joint)
    between = nothing if tell is None else partial(tell, 1.0)
    belief = Belief(found.belief.x * model.scale / fine.scale, found.belief.root)
    if not (give_up and not found.explained and is_hopeless(found.residuals, found.starts)):
        draw = partial(linearised, rng=np.random.default_rng([seed, -1 % 2**32]))
        if patient and not found.confirmed:
            # A break-away may stand between the end of the search and the optimum.
            root = whole.again
            belief = _looked_about(fine, belief, root, at_first, draw, between, OTHER_PLACE)
        belief = _looked_about(fine, belief, LOOK * belief.root, at_first, draw, between)
    linear = linearised(fine, belief, np.random.default_rng(seed))
    refined = described(fine, belief.x, linear, settled=found.explained, information=at_first[1])
    refined = by_a_finer_model(fine, refined, linear)
    return Estimated(
        refined=refined,
        experiments=judged,
        covariance=spread_of_optima(found, model.scale) + _spread_of_twins(refined, judged),
        explained=explains(refined.residuals),
        confirmed=found.confirmed,
        excess=excess(refined.residuals),
        starts=found.starts,
        evaluations=sum(item.evaluations for item in (before, whole, fine) if item),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Searched:
    """What a search found.

    Attributes
    ----------
    model : Derivatives
        Of whole tests, which it ran.
    found : Found
    levels : NDArray[np.int64]
        Of that model.
    again : shape (c, c)
        Root of the covariance over which a further look is taken.
    evaluations : int
        Runs of the model, with those of the search that showed where to begin.
    """

    model: Derivatives
    found: Found
    levels: NDArray[np.int64]
    again: NDArray[np.float64]
    evaluations: int


def _searched(
    experiments: Sequence[Experiment],
    *,
    before: _Searched | None = None,
    free: Sequence[Parameter],
    known: Mapping[str, Known],
    joint: Joint | None,
    hint: Mapping[str, float] | None,
    budget: int,
    seed: int,
    tell: Callable[[float], None] | None,
    give_up: bool,
    left_before: float,
    explains: Explains,
    patient: bool,
) -> _Searched:
    """Search with some recordings; before: with a part of them, see `open_loop_first`."""
    patient = patient and before is None and any(item.test.closed_loop for item in experiments)
    coarse = _free_running(experiments, free)
    model = _scaled(coarse, experiments)
    first, information = belief_of(model, known, joint), information_of(model, known, joint)
    origins = [first] if patient else [first, small_effects(model, first)]
    if hint is not None:
        origins = [beside(model, first, hint), *origins[::-1]]
    guide: Derivatives | None = None
    again = AGAIN * first.root
    if before is not None:
        there = carried_over(before.model, before.found.belief, model)
        origins, again = [there], CLOSER * there.root
        if hint is not None:
            origins = [Belief(beside(model, first, hint).x, again), there]
    elif any(item.constants.OIL > 0.0 for item in experiments):
        guide = _spool_guide(experiments, free, coarse.levels)
        guided = search(
            guide,
            first,
            information,
            origins,
            _spool_is_noise,
            budget=budget // 2,
            seed=seed,
            hopeless=_spool_is_hopeless if give_up else None,
            tell=tell,
        )
        values = (guided.belief.x * guide.scale).tolist()
        names = [item.name for item in guide.estimated]
        origins = [beside(model, first, dict(zip(names, values, strict=True))), *origins]
    found = search(
        model,
        first,
        information,
        origins,
        explains,
        again=again,
        calmly=before is not None,
        alias=ALIAS,
        budget=budget,
        seed=seed,
        tell=tell,
        hopeless=_hopeless(give_up=give_up, patient=patient),
        patient=patient,
        confirms=give_up,
        before=left_before,
    )
    runs = sum(item.evaluations for item in (guide, model) if item)
    return _Searched(model, found, coarse.levels, again, runs)


def _hopeless(*, give_up: bool, patient: bool) -> Hopeless | None:
    """Judge when further starts will not help."""
    if not give_up:
        return None
    return partial(is_hopeless, astray=True) if patient else is_hopeless


def _spread_of_twins(refined: Refinement, experiments: Sequence[Experiment]) -> NDArray[np.float64]:
    """Covariance of places that are alike where hysteresis is small, SI, shape (k, k)."""
    values = refined.values
    alike = (
        HYSTERESIS in values
        and all(item.test.closed_loop for item in experiments)
        and values[HYSTERESIS] + experiments[0].constants.HYS < LITTLE_HYSTERESIS
    )
    return independent(refined.parameters, TWINS if alike else {})


def _free_running(
    experiments: Sequence[Experiment],
    parameters: Sequence[Parameter],
    levels: NDArray[np.int64] | None = None,
) -> SimdModel:
    """Model of whole tests; `levels`: of one of the same tests, if there was one."""
    return SimdModel(lay_out(experiments), unknowns_of(experiments, parameters), levels=levels)


def _scaled(
    model: SimdModel, experiments: Sequence[Experiment], considered: Sequence[Considered] = ()
) -> Derivatives:
    """Coordinates scaled by the noise."""
    return Derivatives(model, experiments[0].noise, considered)


def _spool_guide(
    experiments: Sequence[Experiment], free: Sequence[Parameter], levels: NDArray[np.int64]
) -> Derivatives:
    """Model that shows where to begin where the oil stores the pressure: it goes by the spool.

    Compressible oil remembers what the spool did for tenths of a second and rings, so that far from
    the optimum the pressure says little and leads the search astray; the spool, which does not feel
    it, is explained first.
    """
    relaxed = [
        item.with_noise((item.spool_noise, RELAXED * item.pressure_noise, item.position_noise))
        for item in experiments
    ]
    return Derivatives(_free_running(relaxed, free, levels), experiments[0].noise)


def _spool_is_noise(residuals: NDArray[np.float64]) -> bool:
    return is_noise(residuals[SPOOL_ROW : SPOOL_ROW + 1])


def _spool_is_hopeless(residuals: NDArray[np.float64], starts: int) -> bool:
    return is_hopeless(residuals[SPOOL_ROW : SPOOL_ROW + 1], starts)


def _judged(experiments: Sequence[Experiment], residuals: NDArray[np.float64]) -> list[Experiment]:
    """Weigh the experiments by the noise that residuals of all their ticks show."""
    ends = np.cumsum([item.ticks for item in experiments])[:-1]
    parts = np.split(residuals, ends, axis=1)
    return [judge_noise(item, part) for item, part in zip(experiments, parts, strict=True)]


def _looked_about(
    fine: Derivatives,
    there: Belief,
    root: NDArray[np.float64],
    before: tuple[Belief, NDArray[np.float64]],
    draw: Linearise,
    between: Callable[[], None],
    least_gain: float = 0.0,
) -> Belief:
    """Search about a place; where that ends, if it is better by so much, else the place.

    root: of the covariance over which it looks; before: what was known, and its information.
    """
    wider = Belief(there.x, root)
    seen = sharpen(fine, before[0], wider, before[1], draw, LAST, between).belief
    costs = robust_cost(fine.many(np.vstack([there.x, seen.x])))
    return seen if costs[0] - costs[1] > least_gain else there


def spread_of_optima(found: Found, scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of the optima that the starts ended in, about the best, SI, shape (k, k).

    Each has the weight of its likelihood, exp(-cost / 2), costs in units of what the best one
    leaves unexplained (a Birge ratio, R. T. Birge, Phys. Rev. 40, 1932): a mixture density, as
    JCGM 101:2008 would sample it.
    """
    count = max(int((found.residuals != 0.0).sum()), 1)
    unit = max(found.cost / count, 1.0)
    costs = np.array([place.cost for place in found.places])
    weights = np.exp(-0.5 * (costs - found.cost) / unit)
    shifts = np.array([place.x - found.belief.x for place in found.places]) * scale
    return np.asarray((shifts.T * (weights / weights.sum())) @ shifts)
