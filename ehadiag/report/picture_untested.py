"""Draws recordings without an estimate: what was measured, what was expected, where they part."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis
from ehadiag.core.printable import printable
from ehadiag.core.recording import Samples
from ehadiag.core.stored_test import StoredTest
from ehadiag.report.expected import Curves, expected_curves

__all__ = ["draw_untested"]

MEASURED, EXPECTED, PARTED, MISSING = "#9aa5b1", "#c2410c", "#fee2e2", "#e5e7eb"
APART = 0.05
"""Share of a signal's range by which measured and expected differ where they part."""
LEAST_SPAN_S = 0.02
"""Shorter spans are not shown."""


def draw_untested(figure: Figure, diagnosis: Diagnosis) -> None:
    """Draw one column for each recording that has samples.

    Current, command (closed loop), spool, differential pressure, jack position; beside them, where
    the test is known, its command and the response of a unit as new. Spans in which they part are
    marked, and spans without samples.

    Parameters
    ----------
    figure : Figure
        Empty.
    diagnosis : Diagnosis
        With at least one recording that has samples.
    """
    shown = [
        (recording, recording.samples, test)
        for recording, test in zip(diagnosis.recordings, diagnosis.tests, strict=True)
        if recording.samples is not None and recording.samples.ticks
    ]
    grid = figure.subplots(4, len(shown), sharex="col", squeeze=False)
    for column, (recording, samples, test) in enumerate(shown):
        expected = expected_curves(recording, samples, test, diagnosis.actuator)
        _draw_column([axes[column] for axes in grid], samples, test, expected)


def _draw_column(
    axes: list[Axes], samples: Samples, test: StoredTest | None, expected: Curves
) -> None:
    time = samples.time
    rows = (
        ("current", "current, mA", samples.current * 1e3),
        ("spool", "spool, mm", samples.spool * 1e3),
        ("pressure", "differential pressure, MPa", samples.pressure * 1e-6),
        ("position", "jack position, mm", samples.position * 1e3),
    )
    for axis, (name, label, measured) in zip(axes, rows, strict=True):
        axis.plot(time, measured, ".", color=MEASURED, ms=2.5, label="measured")
        axis.set_ylabel(label)
        tick = samples.period_ns * 1e-9
        for start, end in _spans(~np.isfinite(measured), tick):
            axis.axvspan(start, end, color=MISSING, zorder=0)
        model = expected.get(name)
        if model is None:
            continue
        said = "command" if name in ("current", "position") else "expected of a unit as new"
        axis.plot(time, model, color=EXPECTED, lw=0.8, label=said)
        if said != "command":
            for start, end in _spans(_apart(measured, model), tick):
                axis.axvspan(start, end, color=PARTED, zorder=0)
        axis.legend(loc="lower left", fontsize=8, framealpha=1.0, markerscale=3)
    name = "test unknown" if test is None else f"test {printable(test.name)!r}"
    title = f"{name};  grey: no samples,  red: measured and expected part"
    axes[0].set_title(title, fontsize=10, parse_math=False)
    axes[-1].set_xlabel("time, s")
    end = float(time[-1]) + samples.period_ns * 1e-9
    planned = end if test is None else max(end, test.duration)
    axes[-1].set_xlim(0.0, planned)
    if planned > end:
        for axis in axes:
            axis.axvspan(end, planned, color=MISSING, zorder=0)


def _apart(measured: NDArray[np.float64], model: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where a signal is far from what was expected, whatever its constant offset."""
    gap = measured - model
    seen = np.isfinite(gap)
    if not seen.any():
        return seen
    reach = np.nanmax(np.abs(model)) or 1.0
    return seen & (np.abs(np.where(seen, gap, 0.0) - np.median(gap[seen])) > APART * reach)


def _spans(marked: NDArray[np.bool_], tick: float) -> Iterator[tuple[float, float]]:
    """Begin and end (s) of the spans that are marked, gaps of a few ticks closed."""
    least = max(round(LEAST_SPAN_S / tick), 1)
    places = np.flatnonzero(marked)
    if not places.size:
        return
    breaks = np.flatnonzero(np.diff(places) > least)
    begins = places[np.concatenate([[0], breaks + 1])]
    ends = places[np.concatenate([breaks, [places.size - 1]])]
    for begin, end in zip(begins, ends, strict=True):
        if end - begin + 1 >= least:
            yield float(begin * tick), float((end + 1) * tick)
