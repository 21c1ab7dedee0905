"""The scalar search takes the steps that scipy's bounded Brent search takes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from ehadiag.identify.scalar import MAX_EVALUATIONS, minimise_scalar

COSTS = {
    "parabola": lambda x: (x - 0.3) ** 2,
    "edge": lambda x: abs(x - 0.3) + 0.1 * x,
    "falls to an end": lambda x: -x,
    "rises from an end": lambda x: x**3,
    "several minima": lambda x: math.sin(25.0 * x) + x,
    "flat": lambda _x: 1.0,
    "steps": lambda x: math.floor(20.0 * abs(x - 0.6)),
    "capped": lambda x: min((x - 0.7) ** 2, 0.01),
}


@pytest.mark.parametrize("name", COSTS)
@given(
    low=st.floats(-2.0, 0.5),
    width=st.floats(1e-6, 3.0),
    tolerance=st.sampled_from([1e-2, 2e-4, 1e-9]),
)
def test_takes_scipys_steps(name: str, low: float, width: float, tolerance: float) -> None:
    cost = COSTS[name]
    ours, theirs = [], []

    def log(steps, x):
        steps.append(x)
        return cost(x)

    got = minimise_scalar(lambda x: log(ours, x), low, low + width, tolerance)
    minimize_scalar(
        lambda x: log(theirs, float(x)),
        bounds=(low, low + width),
        method="bounded",
        options={"xatol": tolerance},
    )
    assert ours == pytest.approx(theirs, rel=1e-12, abs=1e-12)
    assert got.evaluations == len(ours) <= MAX_EVALUATIONS
    assert got.value == cost(got.x) == min(cost(x) for x in ours)


def test_finds_the_place_within_the_tolerance() -> None:
    got = minimise_scalar(lambda x: math.cosh(x - 0.123), 0.0, 1.0, 1e-5)
    assert got.x == pytest.approx(0.123, abs=1e-5)
    assert got.evaluations < 15


def test_stays_within_its_bounds() -> None:
    seen = []

    def cost(x: float) -> float:
        seen.append(x)
        return -x

    minimise_scalar(cost, 0.25, 0.5, 1e-6)
    assert 0.25 < min(seen) <= max(seen) < 0.5


def test_ends_though_nothing_is_a_number() -> None:
    got = minimise_scalar(lambda _x: math.nan, 0.0, 1.0, 1e-4)
    assert got.evaluations <= MAX_EVALUATIONS
