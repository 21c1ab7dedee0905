"""Plots of the report: severities and trend; by bokeh, whose script goes into the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from bokeh.embed import components
from bokeh.models import ColumnDataSource, FactorRange, HoverTool, LayoutDOM, Range1d
from bokeh.models.annotations import Label, Span, Whisker
from bokeh.plotting import figure
from bokeh.resources import Resources

if TYPE_CHECKING:
    from ehadiag.history.records import Entry, Event

__all__ = ["TEXT", "TOOLS", "Plots", "embedded", "new_figure", "plot_severities", "plot_trend"]

COLOURS = ("#0072b2", "#b34e00", "#007a5a")
"""Darkened from Okabe and Ito's: colour-blind people tell them apart, and from white."""
DASHES = ("solid", "dashed", "dotdash")
ADVISORY, LIMIT = "#8a5a00", "#b3001b"
TEXT = "#333333"
TOOLS = "xpan,xbox_zoom,xwheel_zoom,reset,save"

Plots = Mapping[str, LayoutDOM]


def embedded(plots: Plots) -> tuple[list[str], dict[str, str]]:
    """Return the scripts of the page, bokeh's own first, and an element for each plot."""
    if not plots:
        return [], {}
    library = Resources(mode="inline", components=["bokeh"], minified=True, log_level="error")
    script, elements = components(dict(plots), wrap_script=False, wrap_plot_info=True)
    return [*library.js_raw, script], dict(elements)


def plot_severities(
    rows: Sequence[tuple[str, float, float, float]], advisory: float, limit: float
) -> LayoutDOM:
    """Draw each severity as a bar with its interval, and the two levels.

    Parameters
    ----------
    rows : Sequence[tuple[str, float, float, float]]
        Name, estimate and ends of the 95 % interval of each.
    advisory : float
        Level.
    limit : float
        Level.

    Returns
    -------
    LayoutDOM
        The plot.
    """
    names = [row[0] for row in rows]
    source = ColumnDataSource(
        {
            "name": names,
            "value": [row[1] for row in rows],
            "low": [row[2] for row in rows],
            "high": [row[3] for row in rows],
        }
    )
    out = new_figure(
        height=90 + 45 * len(rows),
        y_range=FactorRange(factors=names[::-1], range_padding=0.25),
        tools="save",
    )
    out.x_range = Range1d(start=0.0, end=1.02 * max(1.0, *(row[3] for row in rows)))
    out.hbar(y="name", right="value", height=0.5, color=COLOURS[0], source=source)
    out.add_layout(
        Whisker(
            base="name", lower="low", upper="high", dimension="width", source=source,
            line_width=2, line_color="#000000",
        )
    )  # fmt: skip
    for level, name, colour, dash in (
        (advisory, "advisory", ADVISORY, "dashed"),
        (limit, "limit", LIMIT, "solid"),
    ):
        out.add_layout(
            Span(location=level, dimension="height", line_color=colour, line_dash=dash,
                 line_width=2)
        )  # fmt: skip
        out.add_layout(
            Label(x=level, y=0, y_units="screen", text=f" {name} {level:g}", text_color=colour,
                  text_font_size="11px")
        )  # fmt: skip
    out.add_tools(
        HoverTool(tooltips=[("severity", "@name"), ("estimate", "@value{0.00000}"),
                            ("95 %", "@low{0.00000} … @high{0.00000}")])
    )  # fmt: skip
    out.xaxis.axis_label = "severity: 0 as new, 1 limit of damage"
    return out


def plot_trend(
    entries: Sequence[Entry], events: Sequence[Event], unit: str | None, levels: Sequence[float]
) -> LayoutDOM:
    """Draw a unit's severities over hours, cycles or, where neither is known, time.

    Parameters
    ----------
    entries : Sequence[Entry]
        Diagnoses that count.
    events : Sequence[Event]
        Maintenance, marked by its number.
    unit : str | None
        `hours` or `cycles`; None: time of day.
    levels : Sequence[float]
        Advisory level and limit.

    Returns
    -------
    LayoutDOM
        The plot.
    """
    out = new_figure(
        height=320, tools=TOOLS, x_axis_type="datetime" if unit is None else "linear"
    )  # fmt: skip
    lows, highs = [0.0], [0.0]
    names = list(dict.fromkeys(item.name for entry in entries for item in entry.severities))
    for index, name in enumerate(names):
        rows = sorted(
            (at, item.estimate, item.low, item.high)
            for entry in entries
            for item in entry.severities
            if item.name == name
            and item.estimate is not None
            and item.low is not None
            and item.high is not None
            for at in [_place(entry, unit)]
            if at is not None
        )
        data = {
            "at": [row[0] for row in rows],
            "value": [row[1] for row in rows],
            "low": [row[2] for row in rows],
            "high": [row[3] for row in rows],
        }
        lows += data["low"]
        highs += data["high"]
        source, colour = ColumnDataSource(data), COLOURS[index % 3]
        out.line(
            "at", "value", source=source, color=colour, line_dash=DASHES[index % 3],
            line_width=2, legend_label=name,
        )  # fmt: skip
        out.scatter("at", "value", source=source, color=colour, size=6, legend_label=name)
        out.add_layout(
            Whisker(base="at", lower="low", upper="high", source=source, line_color=colour)
        )
    for level, colour, dash in zip(levels, (ADVISORY, LIMIT), ("dashed", "solid"), strict=True):
        out.add_layout(Span(location=level, line_color=colour, line_dash=dash, line_width=1.5))
    for number, event in enumerate(events, start=1):
        at = _place(event, unit)
        if at is not None:
            out.add_layout(
                Span(location=at, dimension="height", line_color=TEXT, line_dash="dotted")
            )
            out.add_layout(Label(x=at, y=0, y_units="screen", text=f" {number}"))
    out.y_range = Range1d(start=min(0.0, *lows), end=1.05 * max(*levels, *highs))
    out.xaxis.axis_label = "time" if unit is None else unit
    out.yaxis.axis_label = "severity, 95 % interval"
    if out.legend:
        out.legend.location = "top_left"
    return out


def _place(item: Entry | Event, unit: str | None) -> float | None:
    if unit is None:
        return datetime.fromisoformat(item.when).timestamp() * 1e3
    return item.usage.hours if unit == "hours" else item.usage.cycles


def new_figure(**options: Any) -> figure:
    """Make a figure as wide as its page, with axes that all figures of the report have."""
    options = {"toolbar_location": "above"} | options
    out = figure(sizing_mode="stretch_width", **options)
    out.toolbar.logo = None
    out.min_border_left = 70
    for axis in (*out.xaxis, *out.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_color = axis.major_label_text_color = TEXT
        axis.axis_label_text_font_size = "12px"
    return out
