"""Estimates effects one after another where all of them at once lead astray.

A unit often has one effect that matters, or two. Where break-aways make many optima, as in closed
loop with little friction, a search over all effects may end in none of use, while one over few
finds its way; what it finds is where a last look with all effects begins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.nuisance.estimate import Estimated, estimate
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
HELD = 0.05
"""What is not known of an effect that is held at none, in deviations of its usual size."""


def stepwise(
    experiments: Sequence[Experiment],
    effects: Sequence[Parameter],
    *,
    least: float,
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
    least : float
        Excess with all effects at once. Where the first effect alone leaves more, all at once have
        not gone astray, and no more is tried.
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
            look_again=True,
        )
        evaluations += found.evaluations
        starts += found.starts
        return found

    while len(chosen) < len(effects) and (best is None or not best.explained):
        rest = [item for item in effects if item not in chosen]
        hint = None if best is None else best.refined.values
        now: Estimated | None = None
        for item in rest:
            found = tried((*chosen, item), BUDGET, hint)
            if now is None or found.excess < now.excess:
                now, added = found, item
            if found.explained:
                break
        tell(len(chosen) / len(effects))
        assert now is not None
        most = least if best is None else WORTH * best.excess
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


def _is_usual(found: Estimated, effects: Sequence[Parameter]) -> bool:
    """Whether all effects are of a size that sound units have."""
    return all(
        abs(found.refined.values[item.name] - usual(item).mean) <= MOST_DEVIATIONS * usual(item).std
        for item in effects
    )
