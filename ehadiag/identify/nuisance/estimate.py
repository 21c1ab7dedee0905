"""Severities and nuisances of one actuator from its recordings: search, noise, uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.nuisance.explained import Explains, excess, is_hopeless, is_noise
from ehadiag.identify.nuisance.prior import (
    Joint,
    Known,
    belief_of,
    information_of,
)
from ehadiag.identify.nuisance.staged import Settings, free_running, scaled, search_in_stages
from ehadiag.identify.nuisance.starts import Found
from ehadiag.identify.refine.derivatives import Considered, Derivatives
from ehadiag.identify.refine.last_round import by_a_finer_model
from ehadiag.identify.refine.least_squares import Refinement, described
from ehadiag.identify.refine.linearisation import Belief, Linearised, linearised
from ehadiag.identify.refine.posterior import LAST, nothing, robust_cost, sharpen
from ehadiag.identify.spans import by_experiment, judge_noise
from ehadiag.identify.uncertainty import independent
from ehadiag.model.parameters import Parameter

__all__ = ["BUDGET", "HYSTERESIS", "Estimated", "estimate", "spread_of_optima"]

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
OTHER_PLACE = 30.0
"""Gain of a look further about from which on it is another place, not one as good."""
Linearise = Callable[[Derivatives, Belief], Linearised]


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
    hint_of_open: bool = False,
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
    hint_of_open : bool
        Whether these are of the open-loop recordings alone: a search with the others then begins
        where that with these ends.
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
    settings = Settings(
        free=tuple(free),
        known=known,
        joint=joint,
        hint=hint,
        hint_of_open=hint_of_open,
        budget=budget,
        seed=seed,
        tell=tell,
        give_up=give_up,
        left_before=left_before,
        explains=explains,
        patient=patient,
    )
    staged = search_in_stages(experiments, settings)
    model, found = staged.model, staged.found
    judged = _judged(experiments, found.residuals)
    held = [item.parameter for item in considered]
    fine = scaled(free_running(judged, (*free, *held), staged.levels), judged, considered)
    at_first = belief_of(fine, known, joint), information_of(fine, known, joint)
    between = nothing if tell is None else partial(tell, 1.0)
    belief = Belief(found.belief.x * model.scale / fine.scale, found.belief.root)
    if not (give_up and not found.explained and is_hopeless(found.residuals, found.starts)):
        draw = partial(linearised, rng=np.random.default_rng([seed, -1 % 2**32]))
        if patient and not found.confirmed:
            # A break-away may stand between the end of the search and the optimum.
            belief = _looked_about(fine, belief, staged.again, at_first, draw, between, OTHER_PLACE)
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
        evaluations=staged.evaluations + fine.evaluations,
    )


def _spread_of_twins(refined: Refinement, experiments: Sequence[Experiment]) -> NDArray[np.float64]:
    """Covariance of places that are alike where hysteresis is small, SI, shape (k, k)."""
    values = refined.values
    alike = (
        HYSTERESIS in values
        and all(item.test.closed_loop for item in experiments)
        and values[HYSTERESIS] + experiments[0].constants.HYS < LITTLE_HYSTERESIS
    )
    return independent(refined.parameters, TWINS if alike else {})


def _judged(experiments: Sequence[Experiment], residuals: NDArray[np.float64]) -> list[Experiment]:
    """Weigh the experiments by the noise that residuals of all their ticks show."""
    parts = by_experiment(experiments, residuals)
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
