"""Which effects of a unit its recordings ask for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ehadiag.calibration.effects import asked_for

NAMES = ("KSF", "load", "torque_odd", "spool_bow")
BESIDE = NAMES[1:]


def test_what_is_clear_stays_and_what_is_not_goes():
    values, std = np.array([0.02, 1.0, -0.05, 0.001]), np.array([0.01, 30.0, 0.001, 0.001])
    assert asked_for(BESIDE, NAMES, values, np.diag(std**2), 10.0) == ("torque_odd",)


def test_of_two_that_do_the_same_one_stays():
    # Either alone is in doubt since the other may stand for it, both are not.
    values = np.array([0.0, 0.0, 1.0, 1.0])
    spread = np.diag([1.0, 1.0, 1.0, 1.0]) * 0.26
    spread[2, 3] = spread[3, 2] = -0.25
    spread[0, 0] = spread[1, 1] = 1.0
    kept = asked_for(BESIDE, NAMES, values, spread, 10.0)
    assert len(kept) == 1
    assert kept[0] in ("torque_odd", "spool_bow")


@given(
    values=st.lists(st.floats(-10.0, 10.0), min_size=4, max_size=4),
    std=st.lists(st.floats(0.1, 10.0), min_size=4, max_size=4),
)
def test_of_what_is_independent_each_is_judged_alone(values, std):
    assume(all(abs(abs(v / s) - 2.0) > 1e-6 for v, s in zip(values, std, strict=True)))
    kept = asked_for(BESIDE, NAMES, np.array(values), np.diag(np.square(std)), 4.0)
    alone = tuple(n for n, v, s in zip(NAMES, values, std, strict=True) if abs(v / s) >= 2.0)
    assert kept == tuple(name for name in alone if name in BESIDE)


@pytest.mark.parametrize("worth", [0.0, 1e9])
def test_the_price_of_an_unknown_decides(worth):
    kept = asked_for(BESIDE, NAMES, np.ones(4), np.eye(4), worth)
    assert kept == (() if worth else BESIDE)
