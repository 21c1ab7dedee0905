"""The step of a converter found in the values that it gave."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.core.step_seen import LEAST_LEVELS, step_seen

SIGNAL = np.sin(np.linspace(0.0, 40.0, 5000)) + 0.001 * np.random.default_rng(1).normal(size=5000)


def digitised(step: float, bus: float | None = None, signal: np.ndarray = SIGNAL) -> np.ndarray:
    """Rounded by a converter, then by a bus."""
    codes = step * np.rint(signal / step)
    return codes if bus is None else bus * np.rint(codes / bus)


@given(st.floats(1e-4, 2e-2), st.floats(-3.0, 3.0), st.floats(1e-6, 1e6))
def test_step_of_a_converter_is_found_whatever_offset_and_unit(step, offset, unit):
    seen = step_seen(unit * (digitised(step) + offset))
    assert seen == pytest.approx(unit * step, rel=1e-6)


@pytest.mark.parametrize("share", [1e-4, 0.01, 0.09, 0.2, 0.34, 0.41, 0.45])
def test_step_is_found_behind_a_bus_that_rounds_finer(share):
    assert step_seen(digitised(2.0 / 4096, 2.0 / 4096 * share)) == pytest.approx(
        2.0 / 4096, rel=1e-3
    )


def test_a_bus_coarser_than_its_converter_is_the_step():
    assert step_seen(digitised(2.0 / 65536, 2.0 / 4096)) == pytest.approx(2.0 / 4096)


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(SIGNAL, id="exact"),
        pytest.param(SIGNAL.astype(np.float32).astype(np.float64), id="single precision"),
        pytest.param(np.convolve(digitised(0.001), np.ones(7) / 7.0, "same"), id="averaged"),
        pytest.param(digitised(2.0 / (LEAST_LEVELS - 4)), id="few levels"),
        pytest.param(np.full(100, 0.3), id="constant"),
        pytest.param(np.full(100, np.nan), id="nothing"),
        pytest.param(np.empty(0), id="empty"),
    ],
)
def test_no_step_is_seen_where_none_can_be(values):
    seen = step_seen(values)
    # An average of seven codes does have one: a seventh of the step.
    assert seen is None or seen == pytest.approx(0.001 / 7.0, rel=1e-3) or seen < 1e-6


def test_missing_samples_do_not_matter():
    values = digitised(0.001)
    values[::3] = np.nan
    assert step_seen(values) == pytest.approx(0.001)
