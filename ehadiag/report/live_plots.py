"""Plots of a running session: empty figures that the live page fills as values come."""

from __future__ import annotations

from bokeh.layouts import column
from bokeh.models import ColumnDataSource, DataRange1d, LayoutDOM
from bokeh.plotting import figure

from ehadiag.report.plots import COLOURS, TEXT

__all__ = ["plot_signals"]

HEIGHT = 190
CHARTS = (
    ("current, mA", (("current_mA", "current"), ("command_mA", "command"))),
    ("spool, mm", (("spool_mm", "spool"),)),
    ("pressure, MPa", (("pressure_MPa", "pressure"),)),
    ("position, mm", (("position_mm", "position"), ("command_mm", "command"))),
)
"""Label of the axis; column and legend of each line."""


def plot_signals() -> LayoutDOM:
    """Draw the four signals and the command over time, linked, without values yet.

    Returns
    -------
    LayoutDOM
        The plot; its source has the name `signals` and the columns of
        `ehadiag.live.snapshot.Signals`.
    """
    names = ["time_s", *(name for _, lines in CHARTS for name, _ in lines)]
    source = ColumnDataSource({name: [] for name in names}, name="signals")
    shown = DataRange1d(range_padding=0.0)
    charts = []
    for label, lines in CHARTS:
        chart = figure(
            height=HEIGHT, sizing_mode="stretch_width", toolbar_location=None, tools="",
            x_range=shown, y_axis_label=label, min_border_left=70,
        )  # fmt: skip
        for place, (name, legend) in enumerate(lines):
            chart.line(
                "time_s", name, source=source, legend_label=legend,
                color=(COLOURS[0], TEXT)[place], line_dash=("solid", "dashed")[place],
                line_width=2,
            )  # fmt: skip
        chart.legend.location = "top_left"
        chart.legend.background_fill_alpha = 0.6
        charts.append(chart)
    charts[-1].xaxis.axis_label = "time, s"
    return column(charts, sizing_mode="stretch_width")
