"""How many threads one diagnosis uses."""

from __future__ import annotations

import pytest

from ehadiag.model.simd.model import processors


def test_a_variable_bounds_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EHADIAG_THREADS", raising=False)
    there = processors()
    assert there >= 1
    for told, expected in (("1", 1), ("999999", there), ("0", there), ("two", there), ("", there)):
        monkeypatch.setenv("EHADIAG_THREADS", told)
        assert processors() == expected
