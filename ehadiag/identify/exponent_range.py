"""Estimates of a valve whose exponent of clogging is known by a range alone.

The spool breaks away and creeps by the ratio of its friction and the first stage's pressure gain,
GPF k^m (PHY-45). So a recording shows FSS / k^m, and hardly m: with each exponent there is a
friction that explains it as well. The estimate is the middle of these, its interval holds them all.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ehadiag.core.conventions import EXPONENT_NAME, FRICTION_NAME
from ehadiag.core.criteria import FIT
from ehadiag.identify.estimates import STANDARD_NORMAL, interval95
from ehadiag.identify.identification_result import Identification, Nuisance
from ehadiag.model.plant import PlantConstants
from ehadiag.model.severities import FAULT_LAWS


def over_exponents(
    found: Identification, constants: PlantConstants, exponents: tuple[float, float]
) -> Identification:
    """Return an identification with the friction that any exponent of a range makes of it.

    Parameters
    ----------
    found : Identification
        With the largest exponent.
    constants : PlantConstants
        Of the unit as new, the exponent in the middle of the range.
    exponents : tuple[float, float]
        Least and largest exponent.

    Returns
    -------
    Identification
        The same where the range is a number.
    """
    low, high = exponents
    if low == high:
        return found
    share = 1.0 + FAULT_LAWS["Kintas"].change * found.named("Kintas").value
    new = float(constants.FSS / (constants.FSS1 - constants.FSS))
    friction = found.named(FRICTION_NAME)
    least = max(friction.value + new, 1e-9)
    ends = [min(max(least * share ** (m - high) - new, 0.0), 1.0) for m in (high, low)]
    value = sum(ends) / 2.0
    ratio = (value + new) / least
    std = ratio * friction.std + (ends[1] - ends[0]) / 2.0 / STANDARD_NORMAL.inv_cdf(0.975)
    exponent = high + (math.log(ratio) / math.log(share) if share < 1.0 else 0.0)
    estimate = replace(
        friction,
        value=value,
        std=std,
        interval95=interval95(value, std),
        at_bound=not 0.0 < value < 1.0,
        shown=std < FIT.max_shown_std,
    )
    place = [item.name for item in found.estimates].index(FRICTION_NAME)
    covariance = found.covariance.copy()
    covariance[place] *= std / friction.std
    covariance[:, place] *= std / friction.std
    nuisance = Nuisance(
        exponent - (low + high) / 2.0, (high - low) / math.sqrt(12.0), at_bound=False
    )
    return replace(
        found,
        estimates=tuple(estimate if item is friction else item for item in found.estimates),
        nuisances={**found.nuisances, EXPONENT_NAME: nuisance},
        covariance=covariance,
    )
