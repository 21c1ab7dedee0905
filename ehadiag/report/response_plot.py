"""Plots of a test's signals for the report: measured on modelled, residuals, events; times linked.

By bokeh. Models cost time in the making and in the page, so figures share sources of data, shades
are strips and not boxes with handles, and residuals have no tools of their own but the wheel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from bokeh.core.property.vectorization import value
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, CrosshairTool, LayoutDOM, Line, Range1d, Scatter, VStrip
from bokeh.models.annotations import Label, Legend, LegendItem, Span
from bokeh.models.renderers import GlyphRenderer
from bokeh.plotting import figure

from ehadiag.model.parameters import FAULTS
from ehadiag.report.modelled import Signal
from ehadiag.report.plots import TEXT, TOOLS, new_figure
from ehadiag.report.thin import thinned

if TYPE_CHECKING:
    from ehadiag.core.stored_test import StoredTest

__all__ = ["plot_response"]

MEASURED, MODELLED, GAP = "#555555", "#c2410c", "#1d4ed8"
SHADES = ("#fde68a", "#bfdbfe", "#d9f99d")
SEARCH = "search"
SMALL = 1e3
"""Small units in a unit, see `Signal`."""
SPREAD = 99.5
"""Percentile of the residuals to whose double the axis goes."""
EVENTS = (
    ("breakaways", "break-away", "triangle", "#00664d"),
    ("reversals", "reversal", "circle", "#005a91"),
    ("stops", "end stop", "square", "#8a004f"),
)


def plot_response(
    signals: Sequence[Signal], tick: float, test: StoredTest | None, most: int
) -> LayoutDOM:
    """Draw measured and modelled signals with their residuals, times linked.

    Parameters
    ----------
    signals : Sequence[Signal]
        Of one recording.
    tick : float
        s.
    test : StoredTest | None
        Whose parts are shaded; None where it is unknown.
    most : int
        Of ticks, in each signal: of more, the extremes are drawn.

    Returns
    -------
    LayoutDOM
        The plots, one below the other.
    """
    x_range = Range1d(start=0.0, end=len(signals[0].measured) * tick, bounds="auto")
    cross = CrosshairTool(overlay=Span(dimension="height", line_dash="dotted"), dimensions="height")
    spans = _spans(test) if test is not None else {}
    shades = ColumnDataSource(
        {
            "start": [start for start, _ in spans],
            "end": [end for _, end in spans],
            "colour": [SHADES[index % len(SHADES)] for index in range(len(spans))],
        }
    )
    strip = VStrip(x0="start", x1="end", fill_color="colour", fill_alpha=0.35, line_color=None)
    out = []
    for signal in signals:
        source = _source(signal, tick, most)
        upper = new_figure(height=240, x_range=x_range, tools=TOOLS, active_drag="xbox_zoom")
        upper.yaxis.axis_label = f"{signal.name}, {signal.unit}"
        _draw_pair(upper, source, signal, tick)
        out.append(upper)
        if np.isfinite(signal.residual).any():
            lower = new_figure(height=120, x_range=x_range, tools="", toolbar_location=None)
            lower.yaxis.axis_label = f"residual, {signal.small_unit}"
            lower.add_glyph(source, Line(x="time", y="residual", line_color=GAP, line_width=0.8))
            lower.y_range = _range_of(signal)
            out.append(lower)
    for part in out:
        part.add_glyph(shades, strip, level="image")
        part.add_tools(cross.clone())
        part.xaxis.visible = part is out[-1]
    for (start, _), names in spans.items():
        words = Label(
            x=start, y=2, y_units="screen", text=f" {', '.join(names)}", text_color=TEXT,
            text_font_size="11px",
        )  # fmt: skip
        out[0].add_layout(words)
    out[-1].xaxis.axis_label = "time, s"
    out[-1].height = (out[-1].height or 0) + 30
    return column(*out, sizing_mode="stretch_width")


def _spans(test: StoredTest) -> dict[tuple[float, float], list[str]]:
    """Parts of the test by their times, with the searches that use them."""
    windows = test.windows
    used = {item.name: getattr(windows, item.name) for item in FAULTS}
    used[SEARCH] = windows.refinement
    out: dict[tuple[float, float], list[str]] = {}
    for name, spans in used.items():
        for span in spans:
            out.setdefault(span, []).append(name)
    return dict(sorted(out.items()))


def _source(signal: Signal, tick: float, most: int) -> ColumnDataSource:
    kept = thinned(signal.measured, signal.residual, most)
    return ColumnDataSource(
        {
            "time": (kept * tick).astype(np.float32),
            "measured": signal.measured[kept].astype(np.float32),
            "modelled": signal.modelled[kept].astype(np.float32),
            "residual": (SMALL * signal.residual[kept]).astype(np.float32),
        }
    )


def _draw_pair(upper: figure, source: ColumnDataSource, signal: Signal, tick: float) -> None:
    """Draw measured and modelled signal with the events of the motion, and name them."""
    points = Scatter(x="time", y="measured", size=2.5, fill_color=MEASURED, line_color=MEASURED)
    line = Line(x="time", y="modelled", line_color=MODELLED, line_width=1.5)
    named: dict[str, GlyphRenderer[Any]] = {"measured": upper.add_glyph(source, points)}
    if signal.beside:
        named[signal.beside] = upper.add_glyph(source, line)
    for name, words, marker, colour in EVENTS:
        ticks = getattr(signal.events, name)
        if ticks.size:
            where = ColumnDataSource(
                {
                    "time": (ticks * tick).astype(np.float32),
                    "place": signal.modelled[ticks].astype(np.float32),
                }
            )
            marks = Scatter(
                x="time", y="place", marker=value(marker), size=7, fill_color=None,
                line_color=colour, line_width=1.2,
            )  # fmt: skip
            named[words] = upper.add_glyph(where, marks)
    items = [LegendItem(label=words, renderers=[item]) for words, item in named.items()]
    legend = Legend(
        items=items, location="top_left", orientation="horizontal", ncols=2, click_policy="hide",
        label_text_font_size="11px", background_fill_alpha=0.7, margin=4,
    )  # fmt: skip
    upper.add_layout(legend)


def _range_of(signal: Signal) -> Range1d:
    seen = np.abs(signal.residual[np.isfinite(signal.residual)])
    most = SMALL * 2.0 * float(np.percentile(seen, SPREAD)) or 1.0
    return Range1d(start=-most, end=most)
