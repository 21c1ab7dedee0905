"""Draws pictures with matplotlib: PNG files, and figures that a notebook shows."""

from __future__ import annotations

import io
import textwrap
import warnings
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ehadiag.report.picture import (
    BAND_COLOURS,
    STYLES,
    Curve,
    CurveValues,
    Panel,
    Picture,
    PictureColumn,
)

LINE_STYLES = {"": "", "solid": "-", "dashed": "--", "dotdash": "-.", "dotted": ":"}
MARKERS = {"": "", "circle": "o", "square": "s", "triangle": "^", "x": "x"}
TITLE_CHARACTERS = 10.0
"""Characters of a title, an inch of the picture's width: 11 fit in bold."""


class NotebookFigure(Figure):
    """A figure that a notebook shows by itself, whether or not pyplot is loaded."""

    def png(self) -> bytes:
        """Return the figure as a PNG, 110 dots an inch."""
        out = io.BytesIO()
        self.savefig(out, format="png", dpi=110)
        return out.getvalue()

    _repr_png_ = png


def picture_png(picture: Picture) -> bytes:
    """Draw a picture with matplotlib's default settings; return it as a PNG."""
    with matplotlib.rc_context(matplotlib.rcParamsDefault), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)  # in texts of others
        return draw_picture(picture).png()


def draw_picture(picture: Picture) -> NotebookFigure:
    """Draw a picture: its columns side by side, under each panel its residual."""
    columns = [[panel.strips(most=16_000) for panel in column.panels] for column in picture.columns]
    # Panels in one row have as many strips: a column without a residual has an empty one there.
    strips = [max(map(len, row)) for row in zip(*columns, strict=True)]
    ratios = [ratio for count in strips for ratio in (2.2, 1.0)[:count]]
    second_axis = any(panel.full_scale for column in picture.columns for panel in column.panels)
    # Inches; set here, since matplotlib's own layouts take twice as long as all else.
    left, right, gap, bottom = 0.95, 0.8 if second_axis else 0.25, 0.25, 0.5
    inside, width = max(3.5, 0.95 * sum(ratios)), 10.0 * len(columns)
    title = "\n".join(
        textwrap.fill(line, int(TITLE_CHARACTERS * width)) for line in picture.title.split("\n")
    )
    top = 0.6 + 0.2 * (title.count("\n") + 1)
    height = bottom + inside + gap * (len(ratios) - 1) + top
    figure = NotebookFigure(figsize=(width, height))
    FigureCanvasAgg(figure)
    grid = figure.subplots(
        len(ratios), len(columns), sharex="col", squeeze=False,
        gridspec_kw={
            "height_ratios": ratios, "left": left / width, "right": 1.0 - right / width,
            "bottom": bottom / height, "top": 1.0 - top / height,
            "hspace": gap * len(ratios) / inside, "wspace": (left + right) / (10.0 - left - right),
        },
    )  # fmt: skip
    for axes, column, drawn in zip(grid.T, picture.columns, columns, strict=True):
        rows = [
            panel for found, count in zip(drawn, strips, strict=True)
            for panel in (*found, *[None] * (count - len(found)))
        ]  # fmt: skip
        _draw_column(list(axes), rows, column)
    # Names of others are no formulae.
    figure.suptitle(
        title, y=1.0 - 0.08 / height, fontsize=11, va="top", parse_math=False,
        fontweight="bold" if picture.bold else "normal",
    )  # fmt: skip
    return figure


def _draw_column(axes: list[Axes], rows: list[Panel | None], column: PictureColumn) -> None:
    for axis, panel in zip(axes, rows, strict=True):
        if panel is None or panel.empty:
            text = "no sample" if panel else "no residual"
            axis.text(0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes)
        if panel is not None:
            _draw_panel(axis, panel, column.dates)
        for part in column.parts:
            axis.axvspan(part.start, part.end, color=BAND_COLOURS[part.role], zorder=-1)
    if column.parts:
        axes[0].margins(y=0.15)
    for part in column.parts:
        axes[0].text(
            part.start, 0.98, f" {part.label}", transform=axes[0].get_xaxis_transform(), va="top",
            fontsize=8,
        )  # fmt: skip
    title = ", ".join(text for text in (column.title, column.details) if text)
    axes[0].set_title(title, fontsize=10, loc="left", pad=18.0, parse_math=False)
    axes[-1].set_xlabel(column.x_label)
    if column.dates:
        axes[-1].xaxis_date()
    if column.x_range is not None:
        axes[-1].set_xlim(*column.x_range)


def _draw_panel(axis: Axes, panel: Panel, dates: bool) -> None:
    unit = 86400.0 if dates else 1.0  # matplotlib counts days
    for band in panel.bands:
        axis.axvspan(band.start, band.end, color=BAND_COLOURS[band.role], zorder=0)
    for area in panel.areas:
        axis.fill(area.x / unit, area.y, color=STYLES[area.role].colour, alpha=0.15, lw=0)
    for curve in panel.curves:
        _draw_curve(axis, curve, (panel.x if curve.x is None else curve.x) / unit)
    for line in panel.lines:
        draw = axis.axvline if line.upright else axis.axhline
        at = line.at / unit if line.upright else line.at
        style = STYLES[line.role]
        draw(at, color=style.colour, lw=0.9, ls=LINE_STYLES[style.line])
        if line.label and not line.upright:
            axis.text(
                1.0, at, f"{line.label} ", va="bottom", ha="right", fontsize=8,
                transform=axis.get_yaxis_transform(), color=style.colour,
            )  # fmt: skip
        elif line.label:
            # At the last test the worst severity is high.
            place, side = (0.01, "bottom") if line.role == "last test" else (1.0, "top")
            axis.text(
                at, place, f" {line.label}", rotation=90, va=side, fontsize=8,
                transform=axis.get_xaxis_transform(), parse_math=False,
            )  # fmt: skip
    if panel.y_range is not None:
        axis.set_ylim(*panel.y_range)
    axis.set_ylabel(panel.y_label)
    axis.yaxis.set_label_coords(-0.077, 0.5)
    if len(panel.curves) > 1:
        # Rows in the order of the curves; matplotlib fills columns.
        found = dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
        labels = [item.label for item in panel.curves if not item.role.startswith("forecast")]
        columns = 5 if len(labels) <= 5 else (len(labels) + 1) // 2
        labels = [label for start in range(columns) for label in labels[start::columns]]
        axis.legend(
            [found[label] for label in labels], labels,
            loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False, ncols=columns,
            borderaxespad=0.1, markerscale=1.5,
        )  # fmt: skip
    if panel.full_scale is not None and not panel.empty:
        scale = 100.0 / panel.full_scale
        share = axis.secondary_yaxis(
            "right", functions=(lambda y: np.asarray(y) * scale, lambda y: np.asarray(y) / scale)
        )
        share.set_ylabel("% of half range")


def _draw_curve(axis: Axes, curve: Curve, x: CurveValues) -> None:
    style = STYLES[curve.role]
    look: dict[str, Any] = {
        "color": style.colour, "ls": LINE_STYLES[style.line], "lw": style.width,
        "marker": MARKERS[style.marker], "ms": style.size, "label": curve.label,
        "mfc": "none" if style.hollow else style.colour,
    }  # fmt: skip
    if curve.low is None or curve.high is None:
        axis.plot(x, curve.y, **look)
    else:
        errors = np.maximum([curve.y - curve.low, curve.high - curve.y], 0.0)
        axis.errorbar(x, curve.y, errors, elinewidth=1.0, capsize=2.0, **look)
