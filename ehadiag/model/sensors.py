"""Model of the sensors' effect on the signals: gain, offset, filter lag and sampling instant.

Before its converter a signal passes a first-order filter, and it is sampled some time before the
end of the tick. The path of a signal is a chain of cubics in u = 0 … 1, and over a cubic the filter
is integrated exactly.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ehadiag.compile.kernels import inlined
from ehadiag.compile.vector import packed
from ehadiag.model.collocation import C1, C2
from ehadiag.model.plant import PlantConstants

__all__ = [
    "LATE",
    "Follow",
    "SensorLaw",
    "followed",
    "following",
    "read_pressure",
    "read_spool",
    "sensing",
    "sensor_law",
    "through_ends",
    "through_stages",
]

LATE = 1.0 + 1e-6
"""Share of a piece up to which an instant counts as within it: what rounding may add."""
SHORT = 1e-3
"""Share of the filter's time constant in which all that a signal does is its mean."""


class SensorLaw(NamedTuple):
    """How the sensors of one candidate show spool, pressure and jack.

    Attributes
    ----------
    spool_offset, pressure_offset, position_offset: constant errors, m, Pa, m.
    spool_gain, pressure_gain, position_gain: what is shown over what is there; of the spool about
        the middle, and
    spool_even, spool_odd: what its gain grows by with the position (1/m) and its square (1/m²).
    pressure_even, pressure_odd: the same of the pressure, 1/Pa and 1/Pa².
    lead: all are sampled so long before the end of the tick, s.
    lag: time constant of the filter before the converters of spool and pressure, s; 0: none.
    """

    spool_offset: Any
    pressure_offset: Any
    position_offset: Any
    spool_gain: Any
    pressure_gain: Any
    position_gain: Any
    lead: Any
    lag: Any
    spool_even: Any
    spool_odd: Any
    pressure_even: Any
    pressure_odd: Any


@inlined
def sensor_law(c: PlantConstants) -> SensorLaw:
    """Precombine what the sensors' laws need (PHY-33 to PHY-36)."""
    return SensorLaw(
        c.OXS,
        c.OPD,
        c.OXJ,
        1.0 + c.GXS,
        1.0 + c.GPD,
        1.0 + c.GXJ,
        c.DLY,
        c.TAU,
        c.BX2 / c.XSM,
        c.BX3 / (c.XSM * c.XSM),
        c.BP2 / c.PSR,
        c.BP3 / (c.PSR * c.PSR),
    )


@packed
def read_spool(law: SensorLaw, place: Any) -> Any:
    """What the spool's sensor reads of a position (m), but for noise and rounding."""
    bent = place * (law.spool_even + law.spool_odd * place)
    return law.spool_offset + place * (law.spool_gain + bent)


@packed
def read_pressure(law: SensorLaw, p12: Any) -> Any:
    """What the sensor of differential pressure reads of one (Pa), but for noise and rounding."""
    bent = p12 * (law.pressure_even + law.pressure_odd * p12)
    return law.pressure_offset + p12 * (law.pressure_gain + bent)


@inlined
def sensing(law: SensorLaw) -> bool:
    """Whether spool and pressure are seen otherwise than at the end of the tick."""
    return law.lag > 0.0 or law.lead > 0.0


class Follow(NamedTuple):
    """How the filter's output hangs on a cubic a0 + a1 u + a2 u² + a3 u³ and on itself before.

    Attributes
    ----------
    keep: share of the output before that is left.
    m0, m1, m2, m3: weights of the cubic's coefficients.
    """

    keep: Any
    m0: Any
    m1: Any
    m2: Any
    m3: Any


@inlined
def following(lag: float, span: float, upto: float) -> Follow:
    """Follow a cubic of a duration `span` from its start for `upto` seconds; lag 0: the cubic."""
    u = upto / span
    if lag <= 0.0:
        return Follow(0.0, 1.0, u, u * u, u * u * u)
    keep = math.exp(-upto / lag)
    m0 = -math.expm1(-upto / lag)
    if upto < SHORT * lag:
        return Follow(keep, m0, m0 * u / 2.0, m0 * u * u / 3.0, m0 * u * u * u / 4.0)
    # By parts: the moments of exp((s - upto) / lag) / lag.
    r = lag / span
    m1 = u - r * m0
    m2 = u * u - 2.0 * r * m1
    return Follow(keep, m0, m1, m2, u * u * u - 3.0 * r * m2)


@packed
def followed(f: Follow, before: Any, cubic: Any) -> Any:
    """Output of the filter after a cubic, its four coefficients; `before`: output at its start."""
    return f.keep * before + f.m0 * cubic[0] + f.m1 * cubic[1] + f.m2 * cubic[2] + f.m3 * cubic[3]


@packed
def through_ends(x0: Any, x1: Any, rise0: Any, rise1: Any) -> Any:
    """Coefficients of the cubic with these ends and slopes (by du) there."""
    gain = x1 - x0
    return x0, rise0, 3.0 * gain - 2.0 * rise0 - rise1, rise0 + rise1 - 2.0 * gain


def _inverse() -> list[list[float]]:
    """Coefficients of u, u², u³, a row each, of the cubics that are 1 at C1, C2 or 1 and else 0."""
    table: list[list[float]] = np.linalg.inv(
        np.vander([C1, C2, 1.0], 4, increasing=True)[:, 1:]
    ).tolist()
    return table


(B11, B12, B13), (B21, B22, B23), (B31, B32, B33) = _inverse()


@packed
def through_stages(p0: Any, p1: Any, p2: Any, p3: Any) -> Any:
    """Coefficients of the cubic with these values at 0, C1, C2 and 1."""
    d1, d2, d3 = p1 - p0, p2 - p0, p3 - p0
    return (
        p0,
        B11 * d1 + B12 * d2 + B13 * d3,
        B21 * d1 + B22 * d2 + B23 * d3,
        B31 * d1 + B32 * d2 + B33 * d3,
    )
