"""Root, logarithm, cosine, normal distribution in arithmetic alone, alike on every processor."""

from __future__ import annotations

import math

from ehadiag.compile.kernels import inlined_exact
from ehadiag.model.exponential import exponential

__all__ = ["cosine", "logarithm", "normal_below", "round_down", "round_even", "square_root"]

LN2 = 0.6931471805599453
ROOT_HALF, ROOT_TWO = 0.7071067811865476, 1.4142135623730951
TERMS = 14
"""Of the series of the logarithm: the next is below 1e-20."""
TURN = 6.283185307179586
ORDER = 28
"""Highest power in the series of the cosine: the next is below 2e-15."""

WHOLE = 4503599627370496.0
"""2^52: a number from there on is whole, and so is one that it was added to."""


@inlined_exact
def round_even(x: float) -> float:
    """Return the nearest whole number, of two the even one: exactly what C's `rint` returns."""
    if not abs(x) < WHOLE:
        return x
    return math.copysign(abs(x) + WHOLE - WHOLE, x)


@inlined_exact
def round_down(x: float) -> float:
    """Return the largest whole number that is not above: exactly what C's `floor` returns."""
    if not abs(x) < WHOLE:
        return x
    nearest = math.copysign(abs(x) + WHOLE - WHOLE, x)
    return nearest - 1.0 if nearest > x else nearest


@inlined_exact
def square_root(x: float) -> float:
    """Return the square root, rounded as IEEE 754 has it, by whole numbers alone, bit after bit.

    x = m 4^k with 1 <= m < 4. The root of m has 54 bits before it is rounded to 53; none lies in
    the middle between two doubles, so the last bit alone decides.
    """
    if not 0.0 < x < math.inf:
        return x if x == 0.0 or x > 0.0 else math.nan
    scale = 1.0
    for power in (512, 256, 128, 64, 32, 16, 8, 4, 2):
        large, small = 2.0**power, 0.5**power
        if x >= large:
            x, scale = x * small, scale * 2.0 ** (power // 2)
        elif x < 4.0 * small:
            x, scale = x * large, scale * 0.5 ** (power // 2)
    while x < 1.0:  # a subnormal number, at most 26 times
        x, scale = 4.0 * x, 0.5 * scale
    left, root, rest = int(x * WHOLE), 0, 0
    for _ in range(54):
        rest = (rest << 2) | ((left >> 52) & 3)
        left = (left << 2) & (4 * int(WHOLE) - 1)
        trial = (root << 2) | 1
        root <<= 1
        if rest >= trial:
            rest -= trial
            root |= 1
    return float((root >> 1) + (root & 1)) / WHOLE * scale


@inlined_exact
def logarithm(x: float) -> float:
    """Return the natural logarithm of a positive normal number, within 1e-15 of itself or of 1."""
    k = 0
    while x < ROOT_HALF:
        x *= 2.0
        k -= 1
    while x > ROOT_TWO:
        x *= 0.5
        k += 1
    s = (x - 1.0) / (x + 1.0)
    series = 0.0
    for i in range(TERMS):
        series = series * s * s + 1.0 / (2 * (TERMS - i) - 1)
    return 2.0 * s * series + k * LN2


@inlined_exact
def cosine(x: float) -> float:
    """Return the cosine of an angle within two turns of 0, within 1e-13."""
    y = x - TURN * math.floor(x / TURN + 0.5)
    series = 1.0
    for i in range(ORDER, 0, -2):
        series = 1.0 - series * y * y / (i * (i - 1))
    return series


@inlined_exact
def normal_below(z: float) -> float:
    """Chance that a standard normal number is below z, within 1e-7.

    Abramowitz, Stegun, Handbook of Mathematical Functions, 26.2.17.
    """
    t = 1.0 / (1.0 + 0.2316419 * abs(z))
    series = ((((1.330274429 * t - 1.821255978) * t + 1.781477937) * t - 0.356563782) * t) * t
    tail = 0.3989422804014327 * exponential(-0.5 * z * z) * (series + 0.319381530 * t)
    return 1.0 - tail if z > 0.0 else tail
