"""Minimum of a function of one variable; scipy.optimize would cost every start 0.2 s and 30 MB."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

__all__ = ["ScalarMinimum", "minimise_scalar"]

GOLDEN = 0.5 * (3.0 - math.sqrt(5.0))
ROUNDING = math.sqrt(2.2e-16)
"""Closer than this, relative, two values of a smooth function near its minimum look the same."""
MAX_EVALUATIONS = 500


class ScalarMinimum(NamedTuple):
    """Place and value of the least evaluation, and how many there were."""

    x: float
    value: float
    evaluations: int


def minimise_scalar(
    cost: Callable[[float], float], low: float, high: float, tolerance: float
) -> ScalarMinimum:
    """Local minimum inside low … high, its place within about `tolerance`; ends not evaluated.

    Golden section, with steps to the vertex of a parabola where they shrink fast enough: Brent,
    *Algorithms for Minimization without Derivatives*, 1973, chapter 5. At most 500 evaluations.
    """
    best = second = third = low + GOLDEN * (high - low)
    f_best = f_second = f_third = cost(best)
    step = before = 0.0
    count = 1
    while count < MAX_EVALUATIONS:
        middle = 0.5 * (low + high)
        near = ROUNDING * abs(best) + tolerance / 3.0
        if abs(best - middle) <= 2.0 * near - 0.5 * (high - low):
            break
        vertex = None
        if abs(before) > near:
            r = (best - second) * (f_best - f_third)
            q = (best - third) * (f_best - f_second)
            p = (best - third) * q - (best - second) * r
            q = 2.0 * (q - r)
            p = -p if q > 0.0 else p
            q = abs(q)
            shrinks = abs(p) < abs(0.5 * q * before)
            before = step
            if shrinks and q * (low - best) < p < q * (high - best):
                vertex = p / q
        if vertex is None:
            before = (low if best >= middle else high) - best
            step = GOLDEN * before
        else:
            step = vertex
            if min(best + step - low, high - (best + step)) < 2.0 * near:
                step = near if middle >= best else -near
        least = near if step >= 0.0 else -near
        tried = best + (step if abs(step) >= near else least)
        f_tried = cost(tried)
        count += 1
        if f_tried <= f_best:
            low, high = (best, high) if tried >= best else (low, best)
            third, f_third = second, f_second
            second, f_second = best, f_best
            best, f_best = tried, f_tried
            continue
        low, high = (tried, high) if tried < best else (low, tried)
        if f_tried <= f_second or second == best:
            third, f_third = second, f_second
            second, f_second = tried, f_tried
        elif f_tried <= f_third or third in (best, second):
            third, f_third = tried, f_tried
    return ScalarMinimum(best, f_best, count)
