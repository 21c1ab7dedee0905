"""Draws a diagnosis: measured and modelled response, and their residuals."""

from __future__ import annotations

import io
import math
import textwrap
import warnings
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis
from ehadiag.assess.verdict import Levels
from ehadiag.core.dates import date_text
from ehadiag.core.printable import printable
from ehadiag.identify.experiment import Experiment
from ehadiag.model.plant import PlantConstants
from ehadiag.report.faults import faults_of
from ehadiag.report.modelled import sensed
from ehadiag.report.picture_untested import draw_untested

__all__ = ["Picture", "can_be_drawn", "diagnosis_figure", "draw_column", "draw_diagnosis"]

MEASURED, MODELLED, GAP = "#9aa5b1", "#c2410c", "#1d4ed8"
DPI = 110
LETTERS = 110
"""Of a line of the title, for each column."""
MOST_REASONS = 3


class Picture(Figure):
    """A figure that a notebook shows by itself, whether or not pyplot is loaded."""

    def png(self) -> bytes:
        """Return it as a PNG."""
        out = io.BytesIO()
        self.savefig(out, format="png", dpi=DPI)
        return out.getvalue()

    _repr_png_ = png


def can_be_drawn(diagnosis: Diagnosis) -> bool:
    """Whether there is anything to draw: samples, be there an estimate or not."""
    return any(item.samples is not None and item.samples.ticks for item in diagnosis.recordings)


def draw_diagnosis(diagnosis: Diagnosis, levels: Levels | None = None) -> bytes:
    """Return the picture of a diagnosis as a PNG; see `diagnosis_figure`."""
    with matplotlib.rc_context(matplotlib.rcParamsDefault), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)  # in names of others
        return diagnosis_figure(diagnosis, levels).png()


def diagnosis_figure(diagnosis: Diagnosis, levels: Levels | None = None) -> Picture:
    """Draw one column for each recording: current, spool, pressure, and their residuals.

    Without an estimate: what was measured, beside it what was expected (`draw_untested`).

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    levels : Levels | None
        By which it was judged; None: not told.

    Returns
    -------
    Picture
        The figure.

    Raises
    ------
    ValueError
        There are no samples to draw.
    """
    if not can_be_drawn(diagnosis):
        raise ValueError("no samples, so there is nothing to draw")
    found = diagnosis.identification
    columns = len(diagnosis.recordings)
    figure = Picture(figsize=(9.5 * columns, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    if found is None or not all(math.isfinite(item.value) for item in found.estimates):
        draw_untested(figure, diagnosis)
    else:
        grid = figure.subplots(
            5, columns, sharex="col", squeeze=False,
            gridspec_kw={"height_ratios": [2, 3, 1.2, 3, 1.2]},
        )  # fmt: skip
        for column, experiment in enumerate(diagnosis.experiments):
            constants = found.constants(experiment.constants)
            draw_column([axes[column] for axes in grid], experiment, constants)
    title = "\n".join(_title(diagnosis, levels))
    figure.suptitle(title, fontsize=11, parse_math=False)  # names of others are no formulae
    return figure


def _title(diagnosis: Diagnosis, levels: Levels | None) -> list[str]:
    """Verdict, estimates, reasons; of which unit, when, by which levels."""
    names = " + ".join(printable(Path(recording.source).name) for recording in diagnosis.recordings)
    lines = [f"{diagnosis.verdict.name.replace('_', ' ')}: {names}"]
    if diagnosis.identification is not None:
        lines.append(
            ",  ".join(
                f"{item.name} {item.value:.5f} ({item.interval[0]:.5f} … {item.interval[1]:.5f})"
                for item in faults_of(diagnosis).values()
            )
        )
    if diagnosis.other:
        lines.append(
            ",  ".join(
                f"{item.meaning} {item.shown(item.value):.3g} {item.shown_unit}"
                + (" beyond its limit" if item.beyond else "")
                for item in diagnosis.other
            )
        )
    width = LETTERS * len(diagnosis.recordings)
    for reason in diagnosis.reasons[:MOST_REASONS]:
        lines += textwrap.wrap(printable(reason), width)[:MOST_REASONS]
    about = [f"actuator {printable(diagnosis.actuator.name)}"]
    about += [f"serial {item.serial}" for item in diagnosis.recordings if item.serial is not None][
        :1
    ]
    dates = [date_text(item.start_ns) for item in diagnosis.recordings]
    about += [date for date in dates if date is not None][:1]
    if levels is not None:
        about.append(f"DEGRADED from {levels.advisory:g}, FAULT from {levels.limit:g}")
    return [*lines, ",  ".join(about)]


def draw_column(axes: list[Axes], experiment: Experiment, constants: PlantConstants) -> None:
    """Draw what was measured and what the model with these constants does, with the residuals.

    Parameters
    ----------
    axes : list[Axes]
        Five: current, spool, its residual, pressure, its residual.
    experiment : Experiment
        The recording.
    constants : PlantConstants
        Of the actuator as it was found.
    """
    time = np.arange(experiment.ticks, dtype=np.float64) * experiment.tick
    spool, pressure, _ = sensed(experiment, constants)
    axes[0].plot(time, experiment.trace.current * 1e3, color=MODELLED, lw=0.8)
    axes[0].set_ylabel("current, mA")
    axes[0].set_title(f"test {printable(experiment.test.name)!r}", fontsize=10, parse_math=False)
    _pair(axes[1], axes[2], time, experiment.spool * 1e3, spool * 1e3, "spool, mm", "µm", 1e3)
    _pair(
        axes[3],
        axes[4],
        time,
        experiment.pressure * 1e-6,
        pressure * 1e-6,
        "differential pressure, MPa",
        "kPa",
        1e3,
    )
    axes[1].legend(loc="lower left", fontsize=8, framealpha=1.0, borderaxespad=0.2, markerscale=3)
    for start, end in experiment.test.windows.refinement:
        for item in axes:
            item.axvspan(start, end, color="#fef3c7", zorder=0)
    axes[0].text(
        experiment.test.windows.refinement[0][0],
        0.97,
        " part for the search",
        transform=axes[0].get_xaxis_transform(),
        va="top",
        fontsize=8,
    )
    axes[4].set_xlabel("time, s")
    axes[4].set_xlim(0.0, time[-1])


def _pair(
    upper: Axes,
    lower: Axes,
    time: NDArray[np.float64],
    measured: NDArray[np.float64],
    modelled: NDArray[np.float64],
    label: str,
    gap_unit: str,
    gap_scale: float,
) -> None:
    upper.plot(time, measured, ".", color=MEASURED, ms=2.5, label="measured")
    upper.plot(time, modelled, color=MODELLED, lw=0.8, label="modelled")
    upper.set_ylabel(label)
    lower.plot(time, (measured - modelled) * gap_scale, color=GAP, lw=0.5)
    lower.set_ylabel(f"residual, {gap_unit}")
    spread = np.nanpercentile(np.abs(measured - modelled), 99.5) * gap_scale
    lower.set_ylim(-2.0 * spread, 2.0 * spread)
