"""The trend of a unit is drawn with the intervals that its diagnoses stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bokeh.models import ColumnDataSource
from history_cases import an_entry

from ehadiag.report.history_picture import draw_history
from ehadiag.report.picture import Picture
from ehadiag.report.plots import plot_trend

LOW, HIGH = 0.0, 0.4


@pytest.fixture
def stated():
    """A diagnosis whose interval is neither symmetrical nor 1.96 deviations wide."""
    usual = an_entry(hours=100.0)
    severities = tuple(
        replace(item, estimate=0.1, std=0.001, low=LOW, high=HIGH) for item in usual.severities
    )
    unknown = replace(severities[0], estimate=None, std=None, low=None, high=None)
    return [replace(usual, severities=severities), replace(usual, severities=(unknown,))]


def test_picture(stated, monkeypatch):
    drawn = []
    monkeypatch.setattr(Picture, "png", lambda self: drawn.append(self) or b"")
    draw_history(stated, [])
    (axes,) = drawn[0].axes
    assert len(axes.containers) == len(stated[0].severities)
    for bars in axes.containers:
        (lines,) = bars[2]
        np.testing.assert_allclose([line[:, 1] for line in lines.get_segments()], [[LOW, HIGH]])
    assert axes.get_ylim()[0] > -0.02


def test_page(stated):
    page = plot_trend(stated, [], "hours", (0.25, 0.75))
    sources = [item.data for item in page.select({"type": ColumnDataSource}) if "low" in item.data]
    assert sources
    assert all((item["low"], item["high"]) == ([LOW], [HIGH]) for item in sources)
