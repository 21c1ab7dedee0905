"""Elementary functions in arithmetic alone, with the same digits on every processor.

Exponential, logarithm, cosine, square root, rounding and normal distribution. A C library's
functions may differ from another's in the last place, and with them a model that is compared bit by
bit.
"""

from __future__ import annotations

import math

from ehadiag.compile.jit import inlined_exact

INVERSE_FACTORIALS = (
    1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040, 1.0 / 40320, 1.0 / 362880,
    1.0 / 3628800, 1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800,
)  # fmt: skip


@inlined_exact
def exponential(x: float) -> float:
    """Return e to the power x, within 0.85 units in the last place; 0 below -708, infinite above
    709.

    x = k ln 2 + r with |r| <= ln(2) / 2, and Taylor's series of e^r to r^13 (Muller, Elementary
    Functions, 3rd ed., section 11.2): the truncation is below 0.04 units, the sums add at most 0.5
    + 0.25 + 0.06 to it.
    """
    if math.isnan(x):
        return x
    if x < -708.0:
        return 0.0
    if x > 709.0:
        return float("inf")
    k = int(x * 1.4426950408889634 + (0.5 if x >= 0.0 else -0.5))
    # ln 2 cut to 32 bits, so that its product with a whole number is exact.
    high, low = x - k * 6.93147180369123816490e-01, k * 1.90821492927058770002e-10
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

    Near 0 by the series of `exponential`, further off by the difference, which cancels at most 1.8
    bits.
    """
    if abs(x) > 0.34:
        return exponential(x) - 1.0
    series = 0.0
    for i in range(len(INVERSE_FACTORIALS)):
        series = series * x + INVERSE_FACTORIALS[len(INVERSE_FACTORIALS) - 1 - i]
    return x + x * x * series


LN2 = 0.6931471805599453
LOGARITHM_TERMS = 14
"""Of the series of the logarithm: the next is below 1e-20."""
TWO_PI = math.tau

TWO_POWER_52 = 4503599627370496.0
"""2^52: a number from there on is whole, and so is one that it was added to."""


@inlined_exact
def round_even(x: float) -> float:
    """Return the nearest whole number, of two the even one: exactly what C's `rint` returns."""
    if not abs(x) < TWO_POWER_52:
        return x
    return math.copysign(abs(x) + TWO_POWER_52 - TWO_POWER_52, x)


@inlined_exact
def round_down(x: float) -> float:
    """Return the largest whole number that is not above: exactly what C's `floor` returns."""
    if not abs(x) < TWO_POWER_52:
        return x
    nearest = math.copysign(abs(x) + TWO_POWER_52 - TWO_POWER_52, x)
    return nearest - 1.0 if nearest > x else nearest


LARGE_POWERS = tuple(2.0**power for power in (512, 256, 128, 64, 32, 16, 8, 4, 2))
SMALL_POWERS = tuple(1.0 / large for large in LARGE_POWERS)
LARGE_ROOTS = tuple(math.sqrt(large) for large in LARGE_POWERS)
SMALL_ROOTS = tuple(1.0 / root for root in LARGE_ROOTS)
"""Powers of 2 by which a number is scaled before its root is taken, their reciprocals, and the
roots of both. As powers of a variable a compiler would square them until they overflow."""


@inlined_exact
def square_root(x: float) -> float:
    """Return the square root, rounded as IEEE 754 has it, by whole numbers alone, bit after bit.

    x = m 4^k with 1 <= m < 4. The root of m has 54 bits before it is rounded to 53; none lies in
    the middle between two doubles, so the last bit alone decides.
    """
    if not 0.0 < x < math.inf:
        return x if x == 0.0 or x > 0.0 else math.nan
    scale = 1.0
    for k in range(len(LARGE_POWERS)):
        if x >= LARGE_POWERS[k]:
            x, scale = x * SMALL_POWERS[k], scale * LARGE_ROOTS[k]
        elif x < 4.0 * SMALL_POWERS[k]:
            x, scale = x * LARGE_POWERS[k], scale * SMALL_ROOTS[k]
    while x < 1.0:  # a subnormal number, at most 26 times
        x, scale = 4.0 * x, 0.5 * scale
    left, root, rest = int(x * TWO_POWER_52), 0, 0
    for _ in range(54):
        rest = (rest << 2) | ((left >> 52) & 3)
        left = (left << 2) & (4 * int(TWO_POWER_52) - 1)
        trial = (root << 2) | 1
        root <<= 1
        if rest >= trial:
            rest -= trial
            root |= 1
    return float((root >> 1) + (root & 1)) / TWO_POWER_52 * scale


@inlined_exact
def logarithm(x: float) -> float:
    """Return the natural logarithm of a positive normal number, within 1e-15 of itself or of 1."""
    k = 0
    while x < 0.7071067811865476:
        x *= 2.0
        k -= 1
    while x > 1.4142135623730951:
        x *= 0.5
        k += 1
    s = (x - 1.0) / (x + 1.0)
    series = 0.0
    for i in range(LOGARITHM_TERMS):
        series = series * s * s + 1.0 / (2 * (LOGARITHM_TERMS - i) - 1)
    return 2.0 * s * series + k * LN2


@inlined_exact
def cosine(x: float) -> float:
    """Return the cosine of an angle within two turns of 0, within 1e-13."""
    y = x - TWO_PI * math.floor(x / TWO_PI + 0.5)
    series = 1.0
    # The next term is below 2e-15.
    for i in range(28, 0, -2):
        series = 1.0 - series * y * y / (i * (i - 1))
    return series


@inlined_exact
def normal_cdf(z: float) -> float:
    """Chance that a standard normal number is below z, within 1e-7.

    Abramowitz, Stegun, Handbook of Mathematical Functions, 26.2.17.
    """
    t = 1.0 / (1.0 + 0.2316419 * abs(z))
    series = ((((1.330274429 * t - 1.821255978) * t + 1.781477937) * t - 0.356563782) * t) * t
    tail = 0.3989422804014327 * exponential(-0.5 * z * z) * (series + 0.319381530 * t)
    return 1.0 - tail if z > 0.0 else tail


@inlined_exact
def round_up(x: float) -> float:
    """Return the smallest whole number that is not below: exactly what C's `ceil` returns."""
    return -round_down(-x)


C_FUNCTIONS = {
    "exp": exponential,
    "expm1": exponential_less_one,
    "log": logarithm,
    "cos": cosine,
}
"""What stands for functions of the C library, whose last digit differs from one to the next."""
ROUNDING_FUNCTIONS = {"rint": round_even, "floor": round_down, "ceil": round_up}
"""The same for a processor without such instructions; exact, so that no digit depends on it."""
