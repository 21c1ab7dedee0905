"""What a unit's surroundings, as the bus reports them, make of what its monitor is told."""

from __future__ import annotations

import math

from ehadiag.compile.address import array_at
from ehadiag.compile.kernels import brief_kernel, inlined_exact
from ehadiag.model.exponential import exponential
from ehadiag.model.plant import WALTHER_POINTS
from ehadiag.monitor.prepare import UNIT_SIZE, Unit
from ehadiag.onboard.elementary import logarithm

__all__ = ["set_environment"]

VISCOSITY = Unit._fields.index("viscosity")
SUPPLY = Unit._fields.index("supply")
ZERO = 273.15
"""K, of 0 degC."""
LN10 = math.log(10.0)
(T1, V1), (T2, V2) = WALTHER_POINTS
Y1, Y2 = math.log10(math.log10(V1 + 0.7)), math.log10(math.log10(V2 + 0.7))
SLOPE = (Y1 - Y2) / (math.log10(T2 + ZERO) - math.log10(T1 + ZERO))
COLDEST, HOTTEST = -60.0, 200.0


@brief_kernel
def set_environment(unit_address: int, around: tuple[float, float, float]) -> int:
    """Set viscosity and supply of a unit, see `ehadiag.model.plant.plant_constants`.

    Parameters
    ----------
    unit_address : int
        Of the numbers of a `Unit`.
    around : tuple[float, float, float]
        Oil temperature in degC, within -60 … 200; supply and return pressure in Pa.

    Returns
    -------
    int
        0; 1: a number is out of its range, and nothing was written.
    """
    oil, supply = around[0], around[1] - around[2]
    if not (COLDEST <= oil <= HOTTEST and 0.0 < supply < math.inf):
        return 1
    unit = array_at(unit_address, (UNIT_SIZE,))
    unit[VISCOSITY] = _viscosity(oil)
    unit[SUPPLY] = supply
    return 0


@inlined_exact
def _viscosity(oil: float) -> float:
    """Relative viscosity by Walther's law, see `ehadiag.model.plant.relative_viscosity`."""
    y = Y1 - SLOPE * (logarithm((oil + ZERO) / (T1 + ZERO)) / LN10)
    return (exponential(LN10 * exponential(LN10 * y)) - 0.7) / V1
