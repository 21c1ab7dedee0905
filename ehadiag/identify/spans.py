"""Lays out time spans of tests for the kernels: which windows count, and how each one starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.stored_test import Window
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.noise import TYPICAL_NOISE_LSB, relative_noise, rounding_noise
from ehadiag.model.anchor import FREE_RUN, Anchor
from ehadiag.model.batch import POSITION_ROW, Batch
from ehadiag.model.parameter import sized
from ehadiag.model.parameters import FAULTS, OFFSETS, Parameter, Unknowns

__all__ = [
    "ANCHOR_LSB",
    "Spans",
    "by_experiment",
    "even_levels",
    "judge_noise",
    "lay_out",
    "unknowns_of",
]

Spans = Sequence[Sequence[Window]]
"""Of each test, s."""
ANCHOR_GAIN = 0.3
ANCHOR_LSB = (1.3, 6.0)
"""Filtered and single innovations beyond which the model is put back on the spool, LSB."""
EVEN_LEVEL = 2
FOLLOW = 0.01
"""Share of the jack's innovation by which the model is moved each tick: what lasts longer than a
tenth of a second is taken away from the residual."""


def lay_out(
    experiments: Sequence[Experiment],
    windows: Sequence[Sequence[Window]] | None = None,
    *,
    lead: float = 0.0,
    channels: tuple[bool, ...] = (True, True),
    anchor_lsb: tuple[float, float] | None = None,
) -> Batch:
    """Lay spans of experiments one behind the other.

    Parameters
    ----------
    windows: for each experiment the spans (s) to explain; None: all of every test.
    lead: run-in before each span, s, without weight.
    channels: whether spool and pressure count, and the jack's position where it is named.
    anchor_lsb: re-anchoring thresholds (small, large) in units of LSB-sized noise; None: free run.
    """
    parts: list[tuple[int, int, int, int]] = []
    for index, experiment in enumerate(experiments):
        spans = [(0.0, experiment.ticks * experiment.tick)] if windows is None else windows[index]
        for start, end in spans:
            a = round(start / experiment.tick)
            b = min(round(end / experiment.tick), experiment.ticks)
            first = max(0, a - round(lead / experiment.tick))
            if b - a > 1:
                parts.append((index, first, a, b))
    if not parts:
        raise ValueError("no span of any experiment is inside its recording")
    weight, anchors, origins, places = [], [], [], []
    for index, first, a, b in parts:
        experiment = experiments[index]
        inside = np.arange(first, b) >= a
        on_spool = inside & np.isfinite(experiment.spool[first:b]) & channels[0]
        on_pressure = inside & np.isfinite(experiment.pressure[first:b]) & channels[1]
        rows = [on_spool / experiment.spool_noise, on_pressure / experiment.pressure_noise]
        if len(channels) > POSITION_ROW:
            on_position = (
                inside & np.isfinite(experiment.position[first:b]) & channels[POSITION_ROW]
            )
            rows.append(on_position / experiment.position_noise)
        weight.append(np.vstack(rows))
        unit = experiment.spool_noise / TYPICAL_NOISE_LSB
        anchor = FREE_RUN
        if anchor_lsb is not None:
            anchor = Anchor(ANCHOR_GAIN, anchor_lsb[0] * unit, anchor_lsb[1] * unit, FOLLOW)
        anchors.append(anchor.as_array())
        origins.append(_origin(experiment, first))
        places.append(_place(experiment, first))
    # Nothing after the spans: a stage's inputs must not change while the test goes on.
    ends = [max((b for i, _, _, b in parts if i == k), default=0) for k in range(len(experiments))]
    begins = np.cumsum([0, *ends])
    return Batch(
        test=np.array([index for index, _, _, _ in parts]),
        tick=np.array([experiments[i].tick for i, _, _, _ in parts]),
        start=np.concatenate([[0], np.cumsum([b - first for _, first, _, b in parts])]),
        origin=np.array(origins),
        place=np.array(places),
        history=np.array([first for _, first, _, _ in parts]),
        since=np.array([begins[i] + first for i, first, _, _ in parts]),
        current=np.concatenate(
            [item.trace.current[:end] for item, end in zip(experiments, ends, strict=True)]
        ),
        spool=np.concatenate([experiments[i].spool[first:b] for i, first, _, b in parts]),
        pressure=np.concatenate([experiments[i].pressure[first:b] for i, first, _, b in parts]),
        position=np.concatenate([experiments[i].position[first:b] for i, first, _, b in parts]),
        weight=np.hstack(weight),
        anchor=np.array(anchors),
    )


def even_levels(batch: Batch) -> NDArray[np.int64]:
    """Halvings of the jack's ticks, the same for all, for few runs of a model, shape (N,).

    For few it takes longer to find how each tick is to be cut than to take four steps in each.
    """
    return np.full(batch.weight.shape[1], EVEN_LEVEL)


def _origin(experiment: Experiment, first: int) -> float:
    """Spool position before tick `first`, m: where it rests before the test, else measured."""
    if first == 0:
        return experiment.origin
    before = experiment.spool[max(0, first - 5) : first]
    seen = before[np.isfinite(before)]
    return float(seen[-1]) if seen.size else 0.0


def _place(experiment: Experiment, first: int) -> float:
    """Jack position before tick `first`, m: in the middle before the test, else measured."""
    if first == 0:
        return 0.0
    before = experiment.position[max(0, first - 5) : first]
    seen = before[np.isfinite(before)]
    return float(seen.mean()) if seen.size else 0.0


def by_experiment(
    experiments: Sequence[Experiment], residuals: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Residuals of each of several experiments, all its ticks, shape (signals, ticks) each.

    residuals: of all, one behind the other, shape (signals, N).
    """
    return np.split(residuals, np.cumsum([item.ticks for item in experiments])[:-1], axis=1)


def judge_noise(experiment: Experiment, residuals: NDArray[np.float64]) -> Experiment:
    """Weigh an experiment anew, by the noise that its residuals show, shape (signals, n).

    A signal without residuals keeps the noise that it has.
    """
    shown = [
        max(noise * relative_noise(row), rounding_noise(channel))
        for noise, row, channel in zip(
            experiment.noise, residuals, experiment.channels[1:], strict=False
        )
    ]
    return experiment.with_noise((*shown, *experiment.noise[len(shown) :]))


def unknowns_of(
    experiments: Sequence[Experiment], free: Sequence[Parameter] = (*FAULTS, *OFFSETS)
) -> Unknowns:
    """Space of the unknowns of experiments with one actuator, on the scales of its converters."""
    mine = tuple(sized(item, experiments[0].channels) for item in free)
    return Unknowns(mine, tuple(item.constants for item in experiments), {})
