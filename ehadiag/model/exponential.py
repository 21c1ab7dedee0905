"""The exponential function in arithmetic alone: the same digits on every processor and C library.

A C library's `exp` may differ from another's in the last place, and with it a model that is
compared bit by bit between a host and a target.
"""

from __future__ import annotations

import math

from ehadiag.compile.kernels import inlined_exact

__all__ = ["exponential", "exponential_less_one"]

PER_LN2 = 1.4426950408889634
LN2_HIGH = 6.93147180369123816490e-01
"""ln 2 cut to 32 bits, so that its product with a whole number is exact."""
LN2_LOW = 1.90821492927058770002e-10
LEAST, MOST = -708.0, 709.0
NEAR = 0.34
INVERSE_FACTORIALS = (
    1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040, 1.0 / 40320, 1.0 / 362880,
    1.0 / 3628800, 1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800,
)  # fmt: skip


@inlined_exact
def exponential(x: float) -> float:
    """Return e to the power x, within 0.85 units in the last place.

    x = k ln 2 + r with |r| <= ln(2) / 2, and Taylor's series of e^r to r^13 (Muller, Elementary
    Functions, 3rd ed., section 11.2): the truncation is below 0.04 units, the sums add at most
    0.5 + 0.25 + 0.06 to it.

    Parameters
    ----------
    x : float
        Below -708 the result is 0, above 709 infinite.

    Returns
    -------
    float
        The power; NaN of NaN.
    """
    if math.isnan(x):
        return x
    if x < LEAST:
        return 0.0
    if x > MOST:
        return float("inf")
    k = int(x * PER_LN2 + (0.5 if x >= 0.0 else -0.5))
    high, low = x - k * LN2_HIGH, k * LN2_LOW
    r = high - low
    series = 0.0
    for i in range(len(INVERSE_FACTORIALS)):
        series = series * r + INVERSE_FACTORIALS[len(INVERSE_FACTORIALS) - 1 - i]
    power = 1.0 + (high - (low - r * r * series))
    factor, left = 2.0, k
    if k < 0:
        factor, left = 0.5, -k
    while left > 0:
        if left & 1:
            power *= factor
        factor *= factor
        left >>= 1
    return power


@inlined_exact
def exponential_less_one(x: float) -> float:
    """Return e to the power x, less 1, within 3 units in the last place.

    Near 0 by the same series, further off by the difference, which cancels at most 1.8 bits.

    Parameters
    ----------
    x : float
        Any; see `exponential`.

    Returns
    -------
    float
        The power less 1; NaN of NaN.
    """
    if abs(x) > NEAR:
        return exponential(x) - 1.0
    series = 0.0
    for i in range(len(INVERSE_FACTORIALS)):
        series = series * x + INVERSE_FACTORIALS[len(INVERSE_FACTORIALS) - 1 - i]
    return x + x * x * series
