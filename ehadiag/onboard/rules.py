"""What a verdict on board goes by: numbers behind the monitor's, in the same plan."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.rows import unpacker
from ehadiag.monitor.prepare import PLAN_SIZE as MONITOR_PLAN_SIZE

__all__ = ["PLAN_SIZE", "Rules", "rules_of", "with_rules"]


class Rules(NamedTuple):
    """Limits of `ehadiag diagnose`, as numbers; see `ehadiag.assess` for each.

    Attributes
    ----------
    advisory : float
        Severity from which on a unit is degraded.
    limit : float
        … and at fault.
    false_healthy : float
        Largest chance of a severity at or above the advisory level for HEALTHY.
    fault_chance : float
        Least chance of a severity at or above the limit for FAULT.
    most_outliers : float
        Share of residuals beyond three deviations that an explained recording may have.
    most_rms : float
        Rms residual that it may have, in units of noise.
    most_std : float
        Standard deviation from which on the test does not show a severity.
    most_lost : float
        Share of a channel's samples that may be missing.
    longest_gap : float
        Ticks without a sample that there may be.
    most_saturated : float
        Share of a channel's samples that may stand at its converter's ends.
    least_supply : float
        Supply above return, Pa, below which nothing is judged.
    spool_low : float
        Ends of the converters: m of the spool, Pa of the pressure, m of the jack.
    spool_high : float
        See `spool_low`.
    pressure_low : float
        See `spool_low`.
    pressure_high : float
        See `spool_low`.
    position_low : float
        See `spool_low`.
    position_high : float
        See `spool_low`.
    """

    advisory: float
    limit: float
    false_healthy: float
    fault_chance: float
    most_outliers: float
    most_rms: float
    most_std: float
    most_lost: float
    longest_gap: float
    most_saturated: float
    least_supply: float
    spool_low: float
    spool_high: float
    pressure_low: float
    pressure_high: float
    position_low: float
    position_high: float


PLAN_SIZE: Final = MONITOR_PLAN_SIZE + len(Rules._fields)
"""Of a monitor's plan with these rules behind it."""
rules_of = unpacker(Rules, MONITOR_PLAN_SIZE)


def with_rules(plan: NDArray[np.float64], rules: Rules) -> NDArray[np.float64]:
    """Plan of an identification: that of a monitor, and its rules.

    Parameters
    ----------
    plan : NDArray[np.float64]
        See `ehadiag.monitor.plan.monitor_plan`.
    rules : Rules
        What the verdict goes by.

    Returns
    -------
    NDArray[np.float64]
        Shape (PLAN_SIZE,); a monitor takes it too.
    """
    return np.array([*plan, *rules], dtype=np.float64)
