"""What is tried where all effects at once do not explain a recording: a load beside them, or one
effect after another; and where neither is worth its time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.nuisance.astray import may_be_astray, would_explain
from ehadiag.identify.nuisance.estimate import Estimated, estimate
from ehadiag.identify.nuisance.explained import is_of_the_pressure, outliers_of
from ehadiag.identify.nuisance.prior import nuisances_of
from ehadiag.identify.nuisance.stepwise import stepwise
from ehadiag.identify.refine.first_part import considered_in
from ehadiag.model.parameters import FAULTS, OFFSETS, REGISTRY, parameter

__all__ = ["looked_further"]

BEYOND_STEPS = 15.0
"""Excess after all nuisances at once from which on nothing further is tried."""
ACCEPTED = 0.015
"""Share of residuals beyond three deviations up to which the estimate would be believed as it is:
its accuracy is worth the time, unless another search has come to it too."""


def looked_further(
    experiments: Sequence[Experiment], found: Estimated, seed: int, tell: Callable[[float], None]
) -> Estimated:
    """Estimate a load too, or few effects, where that may explain what all at once leave.

    Parameters
    ----------
    experiments : sequence of Experiment
    found : Estimated
        With all effects at once; not explained.
    seed : int
        The same seed gives the same answer.
    tell : callable
        Called with the share of what is tried; what it raises ends it.

    Returns
    -------
    Estimated
        The same where nothing explains more.
    """
    if found.excess > BEYOND_STEPS:
        return found
    load = parameter("load")
    effects = (*nuisances_of(REGISTRY), load)
    considered = considered_in(experiments)
    believed = outliers_of(found.refined.residuals) <= ACCEPTED and not found.confirmed
    if not believed and not may_be_astray(experiments, found):
        too_much = is_of_the_pressure(found.refined.residuals)
        if too_much or not would_explain(load, found, seed):
            return found
        loaded = estimate(
            experiments,
            (*FAULTS, *OFFSETS, *effects),
            considered=considered,
            hint=found.refined.values,
            seed=seed,
            tell=tell,
            give_up=True,
        )
        if loaded.explained:
            return _with_the_work_of(found, loaded)
        found = _with_the_work_of(loaded, found)
    few = stepwise(
        experiments, effects, all_at_once=found, considered=considered, seed=seed, tell=tell
    )
    return found if few is None else _with_the_work_of(found, few)


def _with_the_work_of(other: Estimated, one: Estimated) -> Estimated:
    """Count what another estimate has cost in one."""
    return replace(
        one, evaluations=one.evaluations + other.evaluations, starts=one.starts + other.starts
    )
