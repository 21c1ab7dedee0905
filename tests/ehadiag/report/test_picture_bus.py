"""The picture of a bus: lines of few points that leave nothing out."""

from __future__ import annotations

import numpy as np

from ehadiag.core.channels import CHANNELS
from ehadiag.core.conversion import Conversion
from ehadiag.core.recording import CommandMode, Samples
from ehadiag.report.picture_bus import MOST_POINTS, _thinned, draw_bus


def test_a_short_line_is_left_alone():
    time, values = np.arange(5.0), np.array([0.0, np.nan, 1.0, 2.0, 3.0])
    assert _thinned(time, values)[1] is values


def test_a_long_line_keeps_its_extremes_and_its_gaps():
    values = np.sin(np.arange(100_000) / 5000.0)
    values[50_000:60_000] = np.nan
    values[77_777] = 9.0
    time, thin = _thinned(np.arange(100_000.0), values)
    assert len(time) == len(thin) <= MOST_POINTS
    assert (np.nanmin(thin), np.nanmax(thin)) == (np.nanmin(values), 9.0)
    assert np.isnan(thin[(time > 50_100) & (time < 59_900)]).all()


def test_channels_without_a_sample_and_at_their_ends_are_drawn():
    ticks = 500
    nothing = np.full(ticks, np.nan)
    samples = Samples(
        1_000_000, CommandMode.POSITION, nothing, np.linspace(-1, 1, ticks) * 1e-3, nothing,
        np.zeros(ticks), np.zeros(ticks), np.zeros((4, ticks), dtype=bool), np.arange(ticks),
    )  # fmt: skip
    saturated = np.abs(samples.spool) > 0.5e-3
    marks = np.stack([saturated if k == 1 else ~saturated & False for k in range(4)])
    assert draw_bus(samples, Conversion(CHANNELS, marks), "log $a$\x1b").startswith(b"\x89PNG")
