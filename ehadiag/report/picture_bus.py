"""Draws what was heard of a bus: each channel over time, in its unit and in shares of its range."""

from __future__ import annotations

import io

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from ehadiag.core.channels import Channel
from ehadiag.core.conversion import Conversion
from ehadiag.core.printable import printable
from ehadiag.core.recording import CommandMode, Samples

__all__ = ["draw_bus"]

HEARD, COMMANDED, AT_END = "#1d4ed8", "#c2410c", "#dc2626"
MOST_POINTS = 4000
"""Of a line; of more samples the least and the most of each stretch are drawn."""
DPI = 110


def draw_bus(samples: Samples, conversion: Conversion, title: str) -> bytes:
    """Draw current, spool, pressure and jack position, the command beside what it commands.

    Parameters
    ----------
    samples : Samples
        All that was heard, on ticks.
    conversion : Conversion
        Converters, which give the shares of the range, and samples at their ends.
    title : str
        What was listened to.

    Returns
    -------
    bytes
        PNG.
    """
    with matplotlib.rc_context(matplotlib.rcParamsDefault):
        figure = Figure(figsize=(10.0, 9.0), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, 1, sharex=True)
        commanded = "position" if samples.mode is CommandMode.POSITION else "current"
        for index, (axis, channel) in enumerate(zip(axes, conversion.channels, strict=True)):
            command = samples.command if channel.name == commanded else None
            _draw(axis, samples, channel, conversion.saturated[index], command)
        axes[-1].set_xlabel("time, s")
        figure.suptitle(printable(title), fontsize=11, parse_math=False)
        out = io.BytesIO()
        figure.savefig(out, format="png", dpi=DPI)
    return out.getvalue()


def _draw(
    axis: Axes,
    samples: Samples,
    channel: Channel,
    saturated: NDArray[np.bool_],
    command: NDArray[np.float64] | None,
) -> None:
    time, per_unit = samples.time, channel.per_unit
    values = np.asarray(getattr(samples, channel.name)) / per_unit
    axis.set_ylabel(f"{channel.name}, {channel.unit}")
    if not np.isfinite(values).any():
        axis.text(0.5, 0.5, "no sample", ha="center", va="center", transform=axis.transAxes)
        return
    if command is not None and np.isfinite(command).any():
        axis.plot(*_thinned(time, command / per_unit), color=COMMANDED, lw=1.0, label="command")
    axis.plot(*_thinned(time, values), color=HEARD, lw=0.8, label="heard")
    if saturated.any():
        label = f"at the converter's end ({int(saturated.sum())})"
        at = np.flatnonzero(saturated)[:MOST_POINTS]
        axis.plot(time[at], values[at], "x", color=AT_END, ms=4.0, label=label)
    axis.legend(loc="upper right", fontsize=8)
    full = channel.full_scale / per_unit

    def share_of(value: ArrayLike) -> ArrayLike:
        return 100.0 * np.asarray(value) / full

    def value_of(share: ArrayLike) -> ArrayLike:
        return np.asarray(share) * full / 100.0

    share = axis.secondary_yaxis("right", functions=(share_of, value_of))
    share.set_ylabel("% of half range")


def _thinned(
    time: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same line with few points: least and most of each stretch, one after the other."""
    length = 2 * len(values) // MOST_POINTS
    if length < 2:
        return time, values
    stretches = len(values) // length
    parts = values[: stretches * length].reshape(stretches, length)
    some = np.isfinite(parts).any(axis=1)
    low = np.where(some, np.where(np.isfinite(parts), parts, np.inf).min(axis=1), np.nan)
    high = np.where(some, np.where(np.isfinite(parts), parts, -np.inf).max(axis=1), np.nan)
    begin = time[: stretches * length : length]
    return np.repeat(begin, 2), np.column_stack([low, high]).ravel()
