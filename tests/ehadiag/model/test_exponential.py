"""The own exponential function against arithmetic of eighty digits."""

import math
from decimal import Decimal, localcontext

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.model.exponential import exponential, exponential_less_one


def off(value, x, less):
    """Error in units in the last place."""
    with localcontext() as context:
        context.prec = 80
        exact = Decimal(x).exp() - less
        return float(abs(Decimal(value) - exact) / Decimal(math.ulp(float(exact))))


@given(st.floats(-700.0, 700.0))
def test_power_is_within_its_bound(x):
    assert off(exponential(x), x, 0) <= 0.85


@given(st.floats(-1.0, 1.0))
def test_power_of_a_small_number_is_within_its_bound(x):
    assert off(exponential(x), x, 0) <= 0.85


@given(st.floats(-40.0, 40.0).filter(lambda x: abs(x) > 1e-20))
def test_power_less_one_is_within_its_bound(x):
    assert off(exponential_less_one(x), x, 1) <= 3.0


@pytest.mark.parametrize(
    ("x", "power"), [(-1e9, 0.0), (-math.inf, 0.0), (1e9, math.inf), (math.inf, math.inf), (0, 1)]
)
def test_beyond_its_range(x, power):
    assert exponential(float(x)) == power


def test_nothing_of_nothing():
    assert math.isnan(exponential(math.nan))
    assert math.isnan(exponential_less_one(math.nan))
