"""Descriptions of pictures, whatever draws them: panels with curves in engineering units.

`matplotlib_figures` draws a picture into a file, `bokeh_plots` draws one column into a page.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

CurveValues = NDArray[np.float64]


class CurveStyle(msgspec.Struct, frozen=True):
    """How a curve looks, in the words of bokeh."""

    colour: str
    line: str = ""
    """`solid`, `dashed`, `dotted` or `dotdash`; empty: none."""
    width: float = 1.0
    """Points."""
    marker: str = ""
    """`circle`, `square`, `triangle` or `x`; empty: none."""
    size: float = 5.0
    """Diameter of the marker, points."""
    hollow: bool = False


# Darkened from Okabe and Ito's: colour-blind people tell them apart, and from white. Severities
# have none of a traffic light.
STYLES = {
    "measured": CurveStyle("#7b8794", marker="circle", size=2.0),
    "modelled": CurveStyle("#c2410c", "solid", 1.1),
    "residual": CurveStyle("#1d4ed8", "solid", 0.6),
    "signal": CurveStyle("#0072b2", "solid"),
    "command": CurveStyle("#333333", "dashed"),
    "saturated": CurveStyle("#b3001b", marker="x"),
    "break-away": CurveStyle("#00664d", marker="triangle", hollow=True),
    "reversal": CurveStyle("#005a91", marker="circle", hollow=True),
    "end stop": CurveStyle("#8a004f", marker="square", hollow=True),
    "re-anchoring": CurveStyle("#333333", marker="x"),
    "forecast 0": CurveStyle("#0072b2", "dotted", 1.4),
    "forecast 1": CurveStyle("#7b2d8e", "dotted", 1.4),
    "forecast 2": CurveStyle("#334155", "dotted", 1.4),
    "severity 0": CurveStyle("#0072b2", "solid", 1.2, "circle"),
    "severity 1": CurveStyle("#7b2d8e", "dashed", 1.2, "square"),
    "severity 2": CurveStyle("#334155", "dotdash", 1.2, "triangle"),
    "advisory": CurveStyle("#8a5a00", "dashed"),
    "limit": CurveStyle("#b3001b", "solid"),
    "event": CurveStyle("#333333", "dotted"),
    "last test": CurveStyle("#6b7280", "dotted"),
}
"""Look of a curve or line by its role."""
BAND_COLOURS = {
    "part 0": "#fdf2c3",
    "part 1": "#dfeafd",
    "part 2": "#edf8d8",
    "missing": "#e5e7eb",
    "deviation": "#fecaca",
}
"""Colour of a band by its role."""


class Curve(msgspec.Struct, frozen=True, eq=False):
    """One curve of a panel."""

    label: str
    role: str
    """See `STYLES`."""
    y: CurveValues
    """In the panel's unit; NaN where missing."""
    x: CurveValues | None = None
    """The curve's own abscissae; None: the panel's."""
    low: CurveValues | None = None
    """Lower end of the interval about each value; None: no intervals."""
    high: CurveValues | None = None


class Band(msgspec.Struct, frozen=True):
    """A span of the horizontal axis with a colour of its own."""

    start: float
    end: float
    role: str
    """See `BAND_COLOURS`."""
    label: str = ""


class ReferenceLine(msgspec.Struct, frozen=True):
    """A line across a panel."""

    at: float
    role: str
    """See `STYLES`."""
    label: str = ""
    upright: bool = False


class Area(msgspec.Struct, frozen=True, eq=False):
    """A filled polygon, such as what a forecast spans."""

    role: str
    """See `STYLES`."""
    x: CurveValues
    y: CurveValues


class Panel(msgspec.Struct, frozen=True, eq=False):
    """Curves over one vertical axis."""

    name: str
    unit: str
    x: CurveValues
    curves: tuple[Curve, ...]
    bands: tuple[Band, ...] = ()
    lines: tuple[ReferenceLine, ...] = ()
    areas: tuple[Area, ...] = ()
    small_unit: str = ""
    """A thousandth of the unit, for the residual; empty: no residual is drawn."""
    full_scale: float | None = None
    """Half the converter's range, in the unit, for a second axis in percent."""
    y_range: tuple[float, float] | None = None
    """Ends of the vertical axis; None: as the curves need."""
    offset: float = 0.0
    """Taken off the recorded values, in the unit."""
    noise: float | None = None
    """Standard deviation of the recorded values, in the unit; None: not judged."""

    @property
    def y_label(self) -> str:
        """Name and unit."""
        return f"{self.name}, {self.unit}".removesuffix(", ")

    @property
    def empty(self) -> bool:
        """Whether no curve has a value."""
        return not any(np.isfinite(curve.y).any() for curve in self.curves)

    def strips(self, most: int) -> list[Panel]:
        """Return the panel and, below it, its residual if any; of more values the extremes."""
        out = [self]
        if (residual := self.residual) is not None:
            present = np.abs(residual[np.isfinite(residual)])
            # Outliers, such as a few late samples, are cut off.
            top = 2.0 * float(np.percentile(present, 99.5)) or 1.0
            curve = Curve("residual", "residual", residual)
            out.append(
                replace(
                    self,
                    name="residual",
                    unit=self.small_unit,
                    curves=(curve,),
                    y_range=(-top, top),
                )
            )
        shared = [curve for panel in out for curve in panel.curves if curve.x is None]
        kept = thin_to_extremes([curve.y for curve in shared], most)
        if len(kept) == len(self.x):
            return out
        return [
            replace(
                panel,
                x=panel.x[kept],
                curves=tuple(
                    replace(curve, y=curve.y[kept]) if curve.x is None else curve
                    for curve in panel.curves
                ),
            )
            for panel in out
        ]

    @property
    def residual(self) -> CurveValues | None:
        """The first curve less the second, in the small unit; None where there is no such value."""
        if not self.small_unit or len(self.curves) < 2:
            return None
        gap = 1e3 * (self.curves[0].y - self.curves[1].y)
        return gap if np.isfinite(gap).any() else None


class PictureColumn(msgspec.Struct, frozen=True, eq=False):
    """Panels one below the other over one horizontal axis: the response of one recording."""

    title: str
    panels: tuple[Panel, ...]
    x_label: str
    details: str = ""
    """Test, and what the colours of the bands mean."""
    x_range: tuple[float, float] | None = None
    """Ends of the horizontal axis; None: as the curves need."""
    parts: tuple[Band, ...] = ()
    """Named spans of all panels."""
    dates: bool = False
    """Whether the abscissae are times of day, s since 1970."""
    source: str = ""

    @property
    def events(self) -> bool:
        """Whether events are marked on a curve."""
        return any(len(panel.curves) > 2 for panel in self.panels)


class Picture(msgspec.Struct, frozen=True, eq=False):
    """Columns side by side under one title."""

    title: str
    columns: tuple[PictureColumn, ...]
    bold: bool = False
    """Whether the title, which is a sentence, is bold."""


def thin_to_extremes(curves: Sequence[CurveValues], most: int) -> NDArray[np.intp]:
    """Return ascending indices of the values to draw of curves, shape (n,) each.

    All, where they are not more than `most`; else of equal parts those of the least and greatest
    value of each curve. Nothing is averaged: what is drawn was there, and no extreme is lost.
    """
    count = len(curves[0]) if curves else 0
    if count <= most:
        return np.arange(count)
    width = -(-count // max(1, most // (2 * len(curves))))
    begin = np.arange(0, count, width)
    kept = []
    for values in curves:
        table = np.full(len(begin) * width, np.nan)
        table[:count] = values
        for extreme, beyond in ((np.argmin, np.inf), (np.argmax, -np.inf)):
            # The first of a part where all is missing.
            filled = np.where(np.isnan(table), beyond, table).reshape(-1, width)
            kept.append(begin + extreme(filled, axis=1))
    return np.unique(np.concatenate(kept).astype(np.intp))


def marked_spans(marked: NDArray[np.bool_], tick: float) -> Iterator[tuple[float, float]]:
    """Give begin and end (s) of marked spans; shorter ones and gaps than 20 ms do not count."""
    least = max(round(0.02 / tick), 1)
    places = np.flatnonzero(marked)
    if not places.size:
        return
    for part in np.split(places, np.flatnonzero(np.diff(places) > least) + 1):
        if part[-1] - part[0] + 1 >= least:
            yield float(part[0] * tick), float((part[-1] + 1) * tick)
