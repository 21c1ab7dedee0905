"""The picture of a bus: lines of few points that leave nothing out.

The picture of a recording that carries no verdict. The trend of a unit is drawn with the intervals
that its diagnoses stated. Events of a modelled motion, and which ticks of a long one are drawn.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bokeh.models import ColumnDataSource
from history_cases import an_entry, an_event
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from msgspec import structs
from msgspec.structs import replace
from places import LOGS

import ehadiag
from ehadiag import CommandMode, Samples
from ehadiag.core.conversion import Conversion
from ehadiag.history.records import Usage
from ehadiag.prognosis.units import prognosis_of
from ehadiag.report.bokeh_plots import plot_column
from ehadiag.report.matplotlib_figures import draw_picture, picture_png
from ehadiag.report.picture import BAND_COLOURS, Curve, Panel, thin_to_extremes
from ehadiag.report.response_signals import motion_events
from ehadiag.report.trend_bus_pictures import bus_picture, history_picture, trend_column
from firmware_iface import FREE_MOTION
from firmware_iface.recording import CHANNELS


def panel(time, values):
    return Panel("spool", "mm", time, (Curve("measured", "signal", values),))


def test_a_short_line_is_left_alone():
    time, values = np.arange(5.0), np.array([0.0, np.nan, 1.0, 2.0, 3.0])
    (strip,) = panel(time, values).strips(5)
    np.testing.assert_array_equal(strip.curves[0].y, values)


def test_a_long_line_keeps_its_extremes_and_its_gaps():
    values = np.sin(np.arange(100_000) / 5000.0)
    values[50_000:60_000] = np.nan
    values[77_777] = 9.0
    (strip,) = panel(np.arange(100_000.0), values).strips(4000)
    time, thin = strip.x, strip.curves[0].y
    assert len(time) == len(thin) <= 4000
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
    picture = bus_picture(samples, Conversion(CHANNELS, marks), "log $a$\x1b")
    assert picture_png(picture).startswith(b"\x89PNG")
    current, spool, _, _ = picture.columns[0].panels
    assert current.empty
    assert [curve.label for curve in spool.curves] == [
        "measured", f"at the converter's end ({saturated.sum()})"
    ]  # fmt: skip
    np.testing.assert_allclose(spool.curves[1].y, 1e3 * samples.spool[saturated])


def cut(log: str, tmp_path: Path) -> ehadiag.Result:
    content = (LOGS / log).read_bytes()
    half = tmp_path / "half$x^2$.blf"
    half.write_bytes(content[: len(content) // 2])
    return ehadiag.diagnose(half)


def signals(figure: Figure) -> list[Axes]:
    """Those of current, spool, pressure and position, without residuals."""
    return [axes for axes in figure.axes if not axes.get_ylabel().startswith("residual")]


@pytest.mark.parametrize("log", ["paper-open-3.blf", "paper-closed-3.blf"])
def test_measured_beside_expected(log: str, tmp_path: Path) -> None:
    result = cut(log, tmp_path)
    assert result.verdict.name == "NOT_TESTED"
    figure = result.plot()
    title = figure.get_suptitle()
    words = " ".join(title.split())
    assert title.startswith("Unit 1: NOT TESTED\nThe recording ends early: ")
    assert "Record the test to its end, then diagnose again." in words
    assert "recorded 2023-11-14 22:13 UTC, unit 1, " in words
    assert words.endswith("actuator type reference-31, half$x^2$.blf")
    current, spool, pressure, position = signals(figure)
    assert len(spool.lines) == len(pressure.lines) == 2
    assert len((position if "closed" in log else current).lines) == 2
    assert spool.get_xlim() == (0.0, 5.5)
    assert figure._repr_png_()[:4] == b"\x89PNG"  # type: ignore[attr-defined]


def test_where_a_signal_is_stuck_they_part(tmp_path: Path) -> None:
    (recording,) = ehadiag.read(LOGS / "healthy-open.blf")
    assert recording.samples is not None
    stuck = replace(recording.samples, spool=np.zeros(recording.samples.ticks))
    result = ehadiag.diagnose(replace(recording, samples=stuck))
    spool = signals(result.plot())[1]
    assert result.verdict.name == "NOT_TESTED"
    parted = to_hex(BAND_COLOURS["deviation"])
    assert parted in [to_hex(patch.get_facecolor()) for patch in spool.patches]


def test_of_an_unknown_test_only_what_was_measured() -> None:
    (recording,) = ehadiag.read(LOGS / "healthy-open.blf")
    assert recording.samples is not None
    other = replace(recording, test_id=77)
    figure = ehadiag.diagnose(other).plot()
    assert [len(axes.lines) for axes in signals(figure)] == [1, 1, 1, 1]
    assert len(figure.axes) == len(signals(figure))
    samples = replace(recording.samples, mode=CommandMode.POSITION)
    figure = ehadiag.diagnose(replace(recording, samples=samples)).plot()
    assert [len(axes.lines) for axes in signals(figure)] == [1, 1, 1, 1]
    assert len(figure.axes) == len(signals(figure))


def test_no_picture_where_there_are_no_samples() -> None:
    (recording,) = ehadiag.read(LOGS / "healthy-open.blf")
    with pytest.raises(ehadiag.NotTestedError, match="nothing to plot"):
        ehadiag.diagnose(replace(recording, samples=None)).plot()


LOW, HIGH = 0.0, 0.4


@pytest.fixture
def stated():
    """A diagnosis whose interval is neither symmetrical nor 1.96 deviations wide."""
    usual = an_entry(hours=100.0)
    severities = tuple(
        structs.replace(item, estimate=0.1, std=0.001, interval95=(LOW, HIGH))
        for item in usual.severities
    )
    unknown = structs.replace(severities[0], estimate=None, std=None, interval95=None)
    return [replace(usual, severities=severities), replace(usual, severities=(unknown,))]


def future(entries, events=()):
    return prognosis_of(entries[-1].serial, entries, events, (0.25, 0.75))


def test_a_trend_has_levels_and_a_forecast_and_is_broken_at_an_event():
    worn = [an_entry(1, 100.0 * n, (0.02 * (n if n < 8 else n - 7), 0.02 * n, 0.01 * n))
            for n in range(1, 15)]  # fmt: skip
    event = an_event("filter changed", hours=750.0, serial=1)
    column = trend_column(worn, [event], future(worn, [event]))
    (panel,) = column.panels
    assert [(line.at, line.label) for line in panel.lines] == [
        (25.0, "advisory level 25 %"), (75.0, "limit 75 %"), (750.0, "1"), (1400.0, "last test"),
    ]  # fmt: skip
    kintas = panel.curves[0]
    assert np.isnan(kintas.y[np.asarray(kintas.x) == 750.0]).all()
    assert [area.role for area in panel.areas]
    ahead = [curve for curve in panel.curves if curve.role.startswith("forecast")]
    assert ahead
    assert ahead[0].y[-1] == 75.0
    assert column.x_label == "operating hours"


def test_the_last_test_of_a_trend_is_no_free_motion():
    worn = [an_entry(1, 100.0 * n, (0.02 * n, 0.02 * n, 0.01 * n)) for n in range(1, 5)]
    flown = structs.replace(worn[-1], usage=Usage(450.0), test=FREE_MOTION, verdict="NOT_TESTED")
    entries = [*worn, flown]
    (panel,) = trend_column(entries, [], future(entries)).panels
    assert [line.at for line in panel.lines if line.label == "last test"] == [400.0]
    assert panel.curves[0].x[-1] == 450.0


def test_a_trend_leaves_out_what_no_test_explains():
    worn = [an_entry(1, 100.0 * n, (0.02 * n, 0.02 * n, 0.01 * n)) for n in range(1, 5)]
    unexplained = structs.replace(worn[-1], usage=Usage(450.0), verdict="NOT_TESTED")
    entries = [*worn, unexplained]
    (panel,) = trend_column(entries, [], future(entries)).panels
    assert [line.at for line in panel.lines if line.label == "last test"] == [450.0]
    assert panel.curves[0].x[-1] == 400.0


def test_a_slow_severity_does_not_squeeze_the_trend_of_a_fast_one():
    """The picture ends some time after the first limit, not with the longest forecast."""
    worn = [an_entry(1, 100.0 * n, (0.002 * n, 0.05 * n, 0.003 * n)) for n in range(1, 13)]
    found = future(worn)
    column = trend_column(worn, [], found)
    assert column.x_range
    start, end = column.x_range
    left = {item.name: item.remaining[-1].median for item in found.forecasts}
    assert start <= 100.0
    assert 1200.0 + left["FSS"] < end < 1200.0 + left["Kintas"]
    picture = history_picture(worn, [], found)
    first, second = picture.title.splitlines()
    assert first.startswith(f"Unit {worn[0].serial}: Spool friction reaches its limit in about")
    assert second == "Plan to replace the servovalve."
    assert picture.columns[0].title == f"actuator type {worn[0].actuator}"
    (axes,) = draw_picture(picture).axes
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "filter clogging", "spool friction", "jack friction",
    ]  # fmt: skip


def test_a_severity_at_its_limit_is_the_title_of_the_trend():
    worn = [an_entry(1, 100.0 * n, (0.01 * n, 0.06 * n, 0.01 * n)) for n in range(1, 14)]
    assert history_picture(worn, [], future(worn)).title.splitlines() == [
        "Unit 1: Spool friction is at 78 %, its limit is 75 %.", "Act now: replace the servovalve.",
    ]  # fmt: skip


def test_a_long_title_stays_within_the_picture():
    """That of a unit whose usage goes on since its last test was cut at both ends."""
    days = [f"2026-01-{n:02}T12:00:00.000Z" for n in range(1, 13)]
    worn = [
        an_entry(1, 100.0 * (n + 1), (0.01 * n, 0.03 * n, 0.01 * n), tested=day)
        for n, day in enumerate(days)
    ]
    now = "2026-01-20T00:00:00.000Z"
    found = prognosis_of(1, worn, [], (0.25, 0.75), actuator=worn[0].actuator, now=now)
    picture = history_picture(worn, [], found)
    assert "it may be past it: 17 %, from now at about" in picture.title
    figure = draw_picture(picture)
    box = figure._suptitle.get_window_extent(figure.canvas.get_renderer())
    assert 0.0 <= box.x0 < box.x1 <= figure.bbox.x1
    assert " ".join(figure.get_suptitle().split()) == " ".join(picture.title.split())


def test_picture(stated):
    (axes,) = draw_picture(history_picture(stated, [], future(stated))).axes
    assert len(axes.containers) == len(stated[0].severities)
    for bars in axes.containers:
        (lines,) = bars[2]
        np.testing.assert_allclose(
            [line[:, 1] for line in lines.get_segments()], [[LOW, 100 * HIGH]]
        )
    assert axes.get_ylim()[0] > -2.0


def test_page(stated):
    page = plot_column(trend_column(stated, [], future(stated)), 100)
    sources = [item.data for item in page.select({"type": ColumnDataSource}) if "low" in item.data]
    assert sources
    for item in sources:
        np.testing.assert_allclose([item["low"], item["high"]], [[LOW], [100 * HIGH]])


def test_a_body_breaks_away_turns_and_meets_its_stop() -> None:
    place = np.array([0.0, 0.0, 0.1, 0.2, 0.2, 0.3, 0.25, 0.1, 0.5, 0.5, 0.4])
    found = motion_events(place, 0.5)
    assert found["break-away"].tolist() == [1, 4]  # leaving its stop is none
    assert found["reversal"].tolist() == [5, 7]
    assert found["end stop"].tolist() == [8]


@pytest.mark.parametrize("ticks", [0, 1, 2])
def test_so_short_a_motion_has_no_events(ticks: int) -> None:
    assert not motion_events(np.arange(float(ticks)), 9.0)["break-away"].size


@given(
    st.lists(st.floats(-1e3, 1e3) | st.just(float("nan")), min_size=1, max_size=300),
    st.integers(4, 100),
)
def test_thinning_loses_no_extreme_and_keeps_to_its_number(values: list[float], most: int) -> None:
    first = np.array(values)
    second = np.roll(first, len(values) // 3)
    kept = thin_to_extremes([first, second], most)
    assert len(kept) <= most
    assert (np.diff(kept) > 0).all()
    for signal in (first, second):
        if np.isfinite(signal).any():
            assert np.nanmax(signal[kept]) == np.nanmax(signal)
            assert np.nanmin(signal[kept]) == np.nanmin(signal)


def test_what_is_short_is_drawn_whole() -> None:
    assert thin_to_extremes([np.zeros(50)] * 2, 50).tolist() == list(range(50))
