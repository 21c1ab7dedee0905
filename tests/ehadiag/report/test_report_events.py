"""Events of a modelled motion, and which ticks of a long one are drawn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.report.events import events_of
from ehadiag.report.thin import EXTREMES, thinned


def test_a_body_breaks_away_turns_and_meets_its_stop() -> None:
    place = np.array([0.0, 0.0, 0.1, 0.2, 0.2, 0.3, 0.25, 0.1, 0.5, 0.5, 0.4])
    found = events_of(place, 0.5)
    assert found.breakaways.tolist() == [1, 4]  # leaving its stop is none
    assert found.reversals.tolist() == [5, 7]
    assert found.stops.tolist() == [8]


@pytest.mark.parametrize("ticks", [0, 1, 2])
def test_so_short_a_motion_has_no_events(ticks: int) -> None:
    assert not events_of(np.arange(float(ticks)), 9.0).breakaways.size


@given(
    st.lists(st.floats(-1e3, 1e3) | st.just(float("nan")), min_size=1, max_size=300),
    st.integers(EXTREMES, 100),
)
def test_thinning_loses_no_extreme_and_keeps_to_its_number(values: list[float], most: int) -> None:
    first = np.array(values)
    second = np.roll(first, len(values) // 3)
    kept = thinned(first, second, most)
    assert len(kept) <= max(most, EXTREMES)
    assert (np.diff(kept) > 0).all()
    for signal in (first, second):
        if np.isfinite(signal).any():
            assert np.nanmax(signal[kept]) == np.nanmax(signal)
            assert np.nanmin(signal[kept]) == np.nanmin(signal)


def test_what_is_short_is_drawn_whole() -> None:
    assert thinned(np.zeros(50), np.zeros(50), 50).tolist() == list(range(50))
