"""Draws one column of a picture with bokeh, and live signals, for pages that zoom or run along."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.layouts import column as stacked
from bokeh.models import (
    ColumnDataSource,
    CrosshairTool,
    DataRange1d,
    HoverTool,
    LayoutDOM,
    Range1d,
)
from bokeh.models.annotations import Label, Span, Whisker
from bokeh.models.renderers import GlyphRenderer
from bokeh.plotting import figure

from ehadiag.report.picture import BAND_COLOURS, STYLES, Band, Panel, PictureColumn

MAX_PAGE_VALUES = 16_000
"""Number of values of each curve in all plots together, for a page below three megabytes."""
TEXT_COLOUR = STYLES["event"].colour
MAIN_STRIP: dict[str, Any] = {
    "height": 250, "toolbar_location": "above", "tools": "xpan,xbox_zoom,xwheel_zoom,reset,save",
    "active_drag": "xbox_zoom",
}  # fmt: skip
RESIDUAL_STRIP: dict[str, Any] = {"height": 120, "toolbar_location": None, "tools": ""}
LIVE_CHARTS = (
    ("current, mA", (("current_mA", "current", "signal"), ("command_mA", "command", "command"))),
    ("spool, mm", (("spool_mm", "spool", "signal"),)),
    ("pressure, MPa", (("pressure_MPa", "pressure", "signal"),)),
    ("position, mm", (("position_mm", "position", "signal"), ("command_mm", "command", "command"))),
)
"""Label of the axis; column, legend and role of each line."""


def plot_column(column: PictureColumn, most: int = MAX_PAGE_VALUES) -> LayoutDOM:
    """Draw panels and residuals one below the other, times linked; of more values the extremes."""
    options: dict[str, Any] = {"x_axis_type": "datetime"} if column.dates else {}
    if column.x_range is not None:
        start, end = column.x_range
        options["x_range"] = Range1d(start=start, end=end, bounds="auto")
    cross = CrosshairTool(overlay=Span(dimension="height", line_dash="dotted"), dimensions="height")
    plots = []
    for panel in column.panels:
        for look, strip in zip((MAIN_STRIP, RESIDUAL_STRIP), panel.strips(most), strict=False):
            plot = _new_figure(**look, **options)
            options["x_range"] = plot.x_range
            _shade(plot, column.parts)
            _plot_panel(plot, strip, 1e3 if column.dates else 1.0)  # bokeh counts milliseconds
            plot.add_tools(cross.clone())
            plot.xaxis.visible = False
            plots.append(plot)
    for number, part in enumerate(column.parts):
        # In two rows: on a narrow page neighbours would overlap.
        place = 2 + 13 * (number % 2)
        label = Label(x=part.start, y=place, y_units="screen", text=f" {part.label}")
        label.text_color, label.text_font_size = TEXT_COLOUR, "11px"
        plots[0].add_layout(label)
    plots[-1].xaxis.visible = True
    plots[-1].xaxis.axis_label = column.x_label
    plots[-1].height = (plots[-1].height or 0) + 30
    return stacked(*plots, sizing_mode="stretch_width")


def _plot_panel(plot: figure, panel: Panel, scale: float) -> None:
    """Draw curves, bands and lines of a panel; scale: from its abscissae to the plot's."""
    plot.yaxis.axis_label = panel.y_label
    _shade(plot, panel.bands)
    shared = {f"y{n}": curve.y for n, curve in enumerate(panel.curves) if curve.x is None}
    source = _source(x=panel.x * scale, **shared)
    drawn = []
    for number, curve in enumerate(panel.curves):
        data, y = source, f"y{number}"
        if curve.x is not None:
            data, y = _source(x=curve.x * scale, y=curve.y, low=curve.low, high=curve.high), "y"
        label = curve.label if len(panel.curves) > 1 else ""
        drawn.append(_plot_curve(plot, curve.role, data, "x", y, label))
        if curve.low is not None:
            colour = STYLES[curve.role].colour
            plot.add_layout(
                Whisker(base="x", lower="low", upper="high", source=data, line_color=colour)
            )
    for area in panel.areas:
        plot.patch(
            area.x * scale, area.y, fill_color=STYLES[area.role].colour, fill_alpha=0.15,
            line_color=None,
        )  # fmt: skip
    for line in panel.lines:
        at, style = line.at * scale if line.upright else line.at, STYLES[line.role]
        mark = Span(location=at, line_color=style.colour, line_dash=style.line, line_width=1.5)
        mark.dimension = "height" if line.upright else "width"
        plot.add_layout(mark)
        place: dict[str, Any] = {"x": at, "y": 0, "y_units": "screen"}
        if not line.upright:
            place = {"x": 0, "x_units": "screen", "y": at}
        colour = style.colour
        plot.add_layout(
            Label(text=f" {line.label}", text_color=colour, text_font_size="11px", **place)
        )
    _show_values(plot, panel, drawn, dates=scale != 1.0)
    if panel.y_range is not None:
        plot.y_range = Range1d(start=panel.y_range[0], end=panel.y_range[1])
    if plot.legend:
        legend = plot.legend[0]
        legend.update(
            location="left", orientation="horizontal", click_policy="hide", border_line_color=None,
            label_text_font_size="11px", background_fill_alpha=0.0, margin=0, padding=2,
            ncols=2 if any(len(curve.label) > 13 for curve in panel.curves) else 3,
        )  # fmt: skip
        plot.center = [item for item in plot.center if item is not legend]
        plot.add_layout(legend, "above")


def _show_values(
    plot: figure, panel: Panel, drawn: Sequence[GlyphRenderer[Any]], dates: bool
) -> None:
    """Show abscissa and values under the pointer, of each source that has values of its own."""
    for source in dict.fromkeys(item.data_source for item in drawn):
        mine = [item for item in drawn if item.data_source is source]
        when = "@x{%F %H:%M}" if dates else "@x{0.0000}"
        values = {item.glyph.y: item.name for item in mine}
        tips = [
            (name or panel.name, f"@{{{y}}}{{0.0000}} {panel.unit}") for y, name in values.items()
        ]
        hover = HoverTool(
            renderers=[*mine[:1]], tooltips=[("at", when), *tips], mode="vline", visible=False,
            formatters={"@x": "datetime" if dates else "numeral"}, point_policy="snap_to_data",
            line_policy="nearest",
        )  # fmt: skip
        plot.add_tools(hover)


def _plot_curve(
    plot: figure, role: str, source: ColumnDataSource, x: str, y: str, label: str
) -> GlyphRenderer[Any]:
    """Draw a curve; return what was drawn last of it."""
    style = STYLES[role]
    look: dict[str, Any] = {"source": source, "line_color": style.colour}
    if label and not role.startswith("forecast"):  # dotted in its severity's colour
        look["legend_label"] = label
    drawn: GlyphRenderer[Any] | None = None
    if style.line:
        drawn = plot.line(
            x, y, name=label, line_dash=style.line, line_width=1.4 * style.width, **look
        )
    if style.marker:
        fill = None if style.hollow else style.colour
        drawn = plot.scatter(
            x, y, name=label, marker=style.marker, size=1.3 * style.size, fill_color=fill, **look
        )
    assert drawn is not None
    return drawn


def _shade(plot: figure, bands: tuple[Band, ...]) -> None:
    if bands:
        starts, ends = [band.start for band in bands], [band.end for band in bands]
        colours = [BAND_COLOURS[band.role] for band in bands]
        plot.vstrip(x0=starts, x1=ends, fill_color=colours, line_color=None, level="image")


def _source(**columns: Any) -> ColumnDataSource:
    """Hold columns in single precision, except dates, which need more digits."""
    data = {name: values for name, values in columns.items() if values is not None}
    for name, values in data.items():
        if np.nanmax(np.abs(values), initial=0.0) < 1e9:  # ms since 1970 are more
            data[name] = values.astype(np.float32)
    return ColumnDataSource(data)


def _new_figure(**options: Any) -> figure:
    """Make a figure as wide as its page, with axes that all figures of the pages have."""
    out = figure(sizing_mode="stretch_width", min_border_left=70, **options)
    out.toolbar.logo = None
    for axis in (*out.xaxis, *out.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_color = axis.major_label_text_color = TEXT_COLOUR
        axis.axis_label_text_font_size = "12px"
    return out


def plot_live_signals() -> LayoutDOM:
    """Draw the four signals and the command over time, linked, without values yet.

    The plot's source has the name `signals` and the columns of `ehadiag.live.Signals`.
    """
    names = ["time_s", *(name for _, lines in LIVE_CHARTS for name, _, _ in lines)]
    source = ColumnDataSource({name: [] for name in names}, name="signals")
    shared = DataRange1d(range_padding=0.0)
    charts = []
    for label, lines in LIVE_CHARTS:
        chart = _new_figure(
            height=190, toolbar_location=None, tools="", x_range=shared, y_axis_label=label
        )
        for name, text, role in lines:
            _plot_curve(chart, role, source, "time_s", name, text)
        chart.legend.update(
            location="left", orientation="horizontal", border_line_color=None, margin=0, padding=2
        )
        chart.add_layout(chart.legend[0], "above")
        charts.append(chart)
    charts[-1].xaxis.axis_label = "time, s"
    return stacked(charts, sizing_mode="stretch_width")
