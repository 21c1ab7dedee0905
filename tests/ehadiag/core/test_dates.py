"""Time stamps as text."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ehadiag.core.dates import date_text, start_text


def test_a_date_where_the_stamp_has_one() -> None:
    assert date_text(1_700_000_000_001_168_012) == "2023-11-14T22:13:20.001Z"
    assert date_text(1_500_000_000) is None
    assert date_text(None) is None
    assert start_text(1_500_000_000) == "1.500 s"
    assert start_text(None) is None


@given(st.integers(-(2**70), 2**70))
def test_any_stamp_has_a_text(stamp: int) -> None:
    assert start_text(stamp)
