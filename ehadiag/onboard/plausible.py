"""Recordings that carry no verdict, whatever is identified from them: dead, frozen or cut signals.

Of `ehadiag.assess.acceptance` what needs no more than the samples and the supply.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel
from ehadiag.monitor.layout import NUMBER
from ehadiag.monitor.prepare import UNIT_SIZE, Unit
from ehadiag.onboard.layout import UNIT
from ehadiag.onboard.rules import rules_of

__all__ = ["carries_verdict"]

SUPPLY = Unit._fields.index("supply")


@brief_kernel
def carries_verdict(
    address: int, plan: NDArray[np.float64], ticks: NDArray[np.float64], count: int
) -> bool:
    """Tell whether signals move, converters do not stand at their ends, and there is a supply.

    Parameters
    ----------
    address : int
        Of an identification that was begun.
    plan : NDArray[np.float64]
        With the rules.
    ticks : NDArray[np.float64]
        Shape (count, 5): command, current, spool, pressure, position; NaN where lost.
    count : int
        Of the ticks.

    Returns
    -------
    bool
        False: NOT TESTED.
    """
    r = rules_of(plan)
    unit = array_at(address + NUMBER * UNIT, (UNIT_SIZE,))
    if unit[SUPPLY] < r.least_supply:
        return False
    for channel in range(2, 5):
        low, high = r.spool_low, r.spool_high
        if channel == 3:
            low, high = r.pressure_low, r.pressure_high
        elif channel == 4:
            low, high = r.position_low, r.position_high
        least, most, cut = math.inf, -math.inf, 0.0
        for k in range(count):
            value = ticks[k, channel]
            if math.isfinite(value):
                least, most = min(least, value), max(most, value)
                if value <= low or value >= high:
                    cut += 1.0
        if cut > r.most_saturated * count:
            return False
        # A frozen position is none of the model's: it shows in closed loop by what it makes.
        if channel < 4 and not least < most:
            return False
    return True
