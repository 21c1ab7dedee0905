"""Draws a calibration: measured and modelled response of each recording that it learned from."""

from __future__ import annotations

import warnings
from pathlib import Path

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ehadiag.calibration.result import Calibrated
from ehadiag.core.printable import printable
from ehadiag.report.picture import Picture, draw_column

__all__ = ["calibration_figure", "draw_calibration"]


def draw_calibration(found: Calibrated) -> bytes:
    """Return the picture of a calibration as a PNG.

    Parameters
    ----------
    found : Calibrated
        With experiments.

    Returns
    -------
    bytes
        The file's content.

    Raises
    ------
    ValueError
        Nothing was learned.
    """
    with matplotlib.rc_context(matplotlib.rcParamsDefault), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)  # in names of others
        return calibration_figure(found).png()


def calibration_figure(found: Calibrated) -> Picture:
    """Draw one column for each recording: current, spool, pressure, and their residuals.

    Parameters
    ----------
    found : Calibrated
        With experiments.

    Returns
    -------
    Picture
        The figure.

    Raises
    ------
    ValueError
        Nothing was learned, so there is no modelled response to draw.
    """
    if not found.experiments:
        raise ValueError("nothing was learned, so there is no modelled response to draw")
    columns = len(found.experiments)
    figure = Picture(figsize=(9.5 * columns, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(
        5, columns, sharex="col", squeeze=False, gridspec_kw={"height_ratios": [2, 3, 1.2, 3, 1.2]}
    )
    for column, experiment in enumerate(found.experiments):
        draw_column([axes[column] for axes in grid], experiment, experiment.constants)
    names = " + ".join(printable(Path(item.source).name) for item in found.recordings)
    state = "CALIBRATED" if found.actuator else "NOT CALIBRATED"
    figure.suptitle(f"{state}: {names}", fontsize=11, parse_math=False)
    return figure
