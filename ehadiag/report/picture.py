"""Draws a diagnosis: measured and modelled response, and their residuals."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis
from ehadiag.core.printable import printable
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.result import Identification
from ehadiag.model.scalar.response import respond
from ehadiag.report.faults import faults_of

__all__ = ["Picture", "diagnosis_figure", "draw_diagnosis"]

MEASURED, MODELLED, GAP = "#9aa5b1", "#c2410c", "#1d4ed8"
DPI = 110


class Picture(Figure):
    """A figure that a notebook shows by itself, whether or not pyplot is loaded."""

    def png(self) -> bytes:
        """Return it as a PNG."""
        out = io.BytesIO()
        self.savefig(out, format="png", dpi=DPI)
        return out.getvalue()

    _repr_png_ = png


def draw_diagnosis(diagnosis: Diagnosis) -> bytes:
    """Return the picture of a diagnosis as a PNG.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.

    Returns
    -------
    bytes
        The file's content.

    Raises
    ------
    ValueError
        Nothing was identified.
    """
    with matplotlib.rc_context(matplotlib.rcParamsDefault), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)  # in names of others
        return diagnosis_figure(diagnosis).png()


def diagnosis_figure(diagnosis: Diagnosis) -> Picture:
    """Draw one column for each recording: current, spool, pressure, and their residuals.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.

    Returns
    -------
    Picture
        The figure.

    Raises
    ------
    ValueError
        Nothing was identified, so there is no modelled response to draw.
    """
    found = diagnosis.identification
    if found is None:
        raise ValueError("nothing was identified, so there is no modelled response to draw")
    columns = len(diagnosis.experiments)
    figure = Picture(figsize=(9.5 * columns, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(
        5, columns, sharex="col", squeeze=False, gridspec_kw={"height_ratios": [2, 3, 1.2, 3, 1.2]}
    )
    for column, experiment in enumerate(diagnosis.experiments):
        _draw_column([axes[column] for axes in grid], experiment, found)
    constants = ",  ".join(
        f"{fault.name} {fault.value:.5f} ({fault.interval[0]:.5f} … {fault.interval[1]:.5f})"
        for fault in faults_of(diagnosis).values()
    )
    others = ",  ".join(
        f"{item.meaning} {item.shown(item.value):.3g} {item.shown_unit}"
        + (" beyond its limit" if item.beyond else "")
        for item in diagnosis.other
    )
    names = " + ".join(printable(Path(recording.source).name) for recording in diagnosis.recordings)
    title = f"{diagnosis.verdict.name.replace('_', ' ')}: {names}\n{constants}"
    title += f"\n{others}" if others else ""
    figure.suptitle(title, fontsize=11, parse_math=False)  # names of others are no formulae
    return figure


def _draw_column(axes: list[Axes], experiment: Experiment, found: Identification) -> None:
    time = np.arange(experiment.ticks, dtype=np.float64) * experiment.tick
    constants = found.constants(experiment.constants)
    model = respond(constants, experiment.trace.current, experiment.tick, origin=experiment.origin)
    spool = constants.OXS + (1.0 + constants.GXS) * model.spool
    pressure = constants.OPD + (1.0 + constants.GPD) * model.pressure
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
