"""Estimates effects one after another where all of them at once lead astray.

A unit often has one effect that matters, or two. Where break-aways make many optima, as in closed
loop with little friction, a search over all effects may end in none of use, while one over few
finds its way; what it finds is where a last look with all effects begins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.nuisance.estimate import Estimated, estimate
from ehadiag.identify.nuisance.explained import is_of_the_pressure
from ehadiag.identify.nuisance.prior import usual
from ehadiag.identify.refine.derivatives import Considered
from ehadiag.model.parameters import FAULTS, OFFSETS, Parameter

__all__ = ["stepwise"]

BUDGET = 300
"""Runs of the model after which no further start is made with few effects."""
WORTH = 0.8
"""Excess that a further effect must leave, over that of the step before."""
ONE_START = 1
MOST_DEVIATIONS = 4.0
"""Of an effect's usual size; a larger one is a fault, to be named."""
AS_MUCH = 0.02
"""Relative difference up to which one effect leaves as much as all at once."""
HELD = 0.05
"""What is not known of an effect that is held at none, in deviations of its usual size."""


def stepwise(
    experiments: Sequence[Experiment],
    effects: Sequence[Parameter],
    *,
    all_at_once: Estimated,
    considered: Sequence[Considered],
    seed: int,
    tell: Callable[[float], None],
) -> Estimated | None:
    """Add one effect after another, each time the one that leaves the least.

    Parameters
    ----------
    experiments : sequence of Experiment
    effects : sequence of Parameter
        To choose from.
    all_at_once : Estimated
        With all effects. Where the best one alone leaves more, or any alone as much, or one leaves
        next to nothing but pressure, all at once have not gone astray, and no more is tried.
    considered : sequence of Considered
        What is held, with a tolerance that counts in the interval.
    seed : int
        The same seed gives the same answer.
    tell : callable
        Called with the share of the effects that were tried.

    Returns
    -------
    Estimated or None
        With all effects where these explain the recordings from there, else with the few that do,
        and what is not known of the others in the intervals; None where nothing does.
    """
    chosen: list[Parameter] = []
    best: Estimated | None = None
    evaluations = starts = 0

    def tried(
        free: Sequence[Parameter],
        budget: int,
        hint: Mapping[str, float] | None,
        held: Sequence[Considered] = (),
        most: float = np.inf,
    ) -> Estimated:
        nonlocal evaluations, starts
        found = estimate(
            experiments,
            (*FAULTS, *OFFSETS, *free),
            considered=(*considered, *held),
            hint=hint,
            budget=budget,
            seed=seed,
            give_up=True,
            look_below=most,
        )
        evaluations += found.evaluations
        starts += found.starts
        return found

    while len(chosen) < len(effects) and (best is None or not best.explained):
        rest = [item for item in effects if item not in chosen]
        before = best or all_at_once
        hint = None if best is None else best.refined.values
        now: Estimated | None = None
        for item in rest:
            found = tried((*chosen, item), BUDGET, hint, most=before.cost)
            if now is None or found.excess < now.excess:
                now, added = found, item
            if found.explained:
                break
            if _is_no_way(found, all_at_once):
                return None
        tell(len(chosen) / len(effects))
        assert now is not None
        most = all_at_once.excess if best is None else WORTH * best.excess
        if now.excess > most and not now.explained:
            return None
        best = now
        chosen.append(added)
    if best is None or not best.explained or not _is_usual(best, chosen):
        return None
    whole = tried(effects, ONE_START, best.refined.values)
    if whole.explained:
        best = whole
    else:
        held = [Considered(item, HELD * usual(item).std) for item in effects if item not in chosen]
        again = tried(chosen, ONE_START, best.refined.values, held)
        best = again if again.explained else best
    return replace(best, evaluations=evaluations, starts=starts)


def _is_no_way(found: Estimated, all_at_once: Estimated) -> bool:
    """Whether a few effects leave what all at once do, or what none of them is the cause of."""
    if is_of_the_pressure(found.refined.residuals):
        return True
    return abs(found.excess - all_at_once.excess) <= AS_MUCH * all_at_once.excess


def _is_usual(found: Estimated, effects: Sequence[Parameter]) -> bool:
    """Whether all effects are of a size that sound units have."""
    return all(
        abs(found.refined.values[item.name] - usual(item).mean) <= MOST_DEVIATIONS * usual(item).std
        for item in effects
    )
