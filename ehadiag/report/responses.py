"""Responses of a page's recordings: plots, and words of each for those who do not see them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from bokeh.models import LayoutDOM
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.printable import printable
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment
from ehadiag.model.plant import PlantConstants
from ehadiag.report.expected import expected_signals
from ehadiag.report.modelled import Signal, signals_of
from ehadiag.report.response_plot import plot_response

__all__ = ["Drawn", "Response", "draw_responses", "expected", "modelled"]

MOST_RESPONSES = 4
"""That are drawn: some two seconds of processor time, and less than three megabytes."""
MOST_TICKS = 16_000
"""Of all responses together: the page stays below three megabytes."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What is drawn of a recording."""

    title: str
    source: str
    signals: tuple[Signal, ...]
    tick: float
    """s."""
    test: StoredTest | None


@dataclass(frozen=True, slots=True)
class Response:
    """A recording's response in a page."""

    key: str
    """Of its plot."""
    source: str
    title: str
    words: str
    parts: bool
    """Whether parts of its test are shaded."""
    events: bool
    """Whether any are marked."""
    ticks: int
    """Of the recording, in each signal."""
    drawn: int
    """At most, in each signal."""


def modelled(
    recorded: Iterable[tuple[Experiment, PlantConstants, Recording]],
) -> list[Drawn]:
    """Choose what a page draws of recordings that were identified, as many as it bears.

    Parameters
    ----------
    recorded : Iterable[tuple[Experiment, PlantConstants, Recording]]
        Recordings with the actuator's constants as they were found.

    Returns
    -------
    list[Drawn]
        Measured on modelled signals.
    """
    return [
        Drawn(
            "Measured and modelled",
            recording.source,
            signals_of(experiment, constants, recording.samples.current),
            experiment.tick,
            experiment.test,
        )
        for experiment, constants, recording in itertools.islice(recorded, MOST_RESPONSES)
        if recording.samples is not None
    ]


def expected(
    recorded: Iterable[tuple[Recording, StoredTest | None]], actuator: Actuator
) -> list[Drawn]:
    """Choose what a page draws of recordings without an estimate.

    Parameters
    ----------
    recorded : Iterable[tuple[Recording, StoredTest | None]]
        Recordings with their tests, as far as these are known.
    actuator : Actuator
        Data of the unit.

    Returns
    -------
    list[Drawn]
        Measured signals on those to be expected of a unit as new.
    """
    return [
        Drawn(
            "Measured and expected",
            recording.source,
            expected_signals(recording, recording.samples, test, actuator),
            recording.samples.period_ns * 1e-9,
            test,
        )
        for recording, test in itertools.islice(recorded, MOST_RESPONSES)
        if recording.samples is not None and recording.samples.ticks
    ]


def draw_responses(chosen: Sequence[Drawn], plots: dict[str, LayoutDOM]) -> list[Response]:
    """Add a plot for each recording.

    Parameters
    ----------
    chosen : Sequence[Drawn]
        Recordings with their signals.
    plots : dict[str, LayoutDOM]
        Of the page; added to.

    Returns
    -------
    list[Response]
        What was added.
    """
    out = []
    for number, item in enumerate(chosen):
        key, most = f"response{number}", MOST_TICKS // len(chosen)
        plots[key] = plot_response(item.signals, item.tick, item.test, most)
        ticks = len(item.signals[0].measured)
        out.append(
            Response(
                key=key,
                source=printable(item.source),
                title=item.title,
                parts=item.test is not None,
                events=any(signal.events.any for signal in item.signals),
                words=f"{item.title} current, spool position, differential pressure and"
                f" jack position over {ticks * item.tick:g} s{_gaps(item.signals)}.",
                ticks=ticks,
                drawn=min(most, ticks),
            )
        )
    return out


def _gaps(signals: Iterable[Signal]) -> str:
    """Residuals in words."""
    parts = [
        f"{item.name} {1e3 * _rms(item.residual):.3g} {item.small_unit}"
        for item in signals
        if np.isfinite(item.residual).any()
    ]
    return "; rms residual over the whole test: " + ", ".join(parts) if parts else ""


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
