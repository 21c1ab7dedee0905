"""Estimates how much later than the model says the spool and the pressure were sampled.

A message sampled or placed later than the others shows what its signal was before: measured less
modelled then follows the modelled derivative, and their regression is the delay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.modelled import response_of
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.result import Identification

__all__ = ["Delay", "delays_of", "in_time", "put_back", "said", "worth_it"]

LEAST = 0.05
"""Ticks from which on a delay is put back."""
WHOLE = 0.15
"""Distance from whole ticks up to which a delay is held to be such: of frames it always is."""
SPAN = 20
"""Ticks over which the jack's travel is regarded: its position runs away from the model's."""
SURE = 5.0
"""Deviations beyond which it is one."""
STRANGE = 4.0
"""Deviations beyond which a residual is none of the delay."""
ROUNDS = 3
"""Times that delays are put back at most."""
REGRESSIONS = 5
"""Each without what was strange in the one before."""
LEAST_USED = 100
LAGS = 20
"""Ticks over which what the model leaves out is held to be alike."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Delay:
    """Delay of a signal's samples.

    Attributes
    ----------
    name : str
        The signal.
    value : float
        Ticks; positive: late.
    std : float
        Standard deviation, ticks.
    """

    name: str
    value: float
    std: float


def delays_of(experiment: Experiment, found: Identification) -> tuple[Delay, ...]:
    """Regress the residuals of spool and pressure on the modelled derivatives.

    Parameters
    ----------
    experiment : Experiment
        What was identified from.
    found : Identification
        What was identified.

    Returns
    -------
    tuple[Delay, ...]
        Of spool, pressure and position; that of the position infinitely unsure where the jack
        hardly moves.
    """
    model = response_of(experiment, found)
    return (
        _delay("spool", experiment.spool, model.spool),
        _delay("pressure", experiment.pressure, model.pressure),
        _delay("position", _travel(experiment.position), _travel(model.position)),
    )


def worth_it(delays: Sequence[Delay]) -> bool:
    """Whether a delay is large and sure enough to be put back.

    Parameters
    ----------
    delays : Sequence[Delay]
        Of one test's signals.

    Returns
    -------
    bool
        False where all are none.
    """
    return any(abs(item.value) > max(LEAST, SURE * item.std) for item in delays)


def in_time(
    experiments: list[Experiment],
    found: Identification,
    identify: Callable[[Sequence[Experiment]], Identification],
) -> tuple[list[Experiment], Identification, tuple[str, ...]]:
    """Put delays back that the response tells, if that explains more of the recordings.

    A delay of whole ticks is seen only roughly before it is put back: so several times.

    Parameters
    ----------
    experiments : list[Experiment]
        As recorded.
    found : Identification
        From these.
    identify : Callable[[Sequence[Experiment]], Identification]
        Identifies anew.

    Returns
    -------
    tuple[list[Experiment], Identification, tuple[str, ...]]
        The experiments in time, what they say, and what was put back in words; as they came and
        nothing where no delay is sure.
    """
    first, best = experiments, found
    total = [delays_of(item, found) for item in experiments]
    notes: tuple[str, ...] = ()
    for _ in range(ROUNDS):
        if not any(map(worth_it, total)):
            break
        moved = [put_back(item, own) for item, own in zip(first, total, strict=True)]
        other = identify(moved)
        if other.fit.outliers >= best.fit.outliers:
            break
        experiments, best = moved, other
        notes = tuple(said(own, first[0].tick) for own in total)
        left = [delays_of(item, best) for item in experiments]
        if not any(map(worth_it, left)):
            break
        total = [_added(own, rest) for own, rest in zip(total, left, strict=True)]
    return experiments, best, notes


def _added(before: Sequence[Delay], left: Sequence[Delay]) -> tuple[Delay, ...]:
    """Delays in all, after some were put back and others are left."""
    return tuple(
        replace(rest, value=own.value + rest.value) for own, rest in zip(before, left, strict=True)
    )


def put_back(experiment: Experiment, delays: Sequence[Delay]) -> Experiment:
    """Read spool and pressure as much later as their samples are late.

    Parameters
    ----------
    experiment : Experiment
        As recorded.
    delays : Sequence[Delay]
        Of spool, pressure and position, in all.

    Returns
    -------
    Experiment
        With the samples at the ticks whose ends they are of: between two samples a straight line.
    """
    spool, pressure, position = (item.value for item in delays)
    return replace(
        experiment,
        spool=_later(experiment.spool, spool),
        pressure=_later(experiment.pressure, pressure),
        position=_later(experiment.position, position),
    )


def said(delays: Sequence[Delay], tick: float) -> str:
    """Say what was put back.

    Parameters
    ----------
    delays : Sequence[Delay]
        In all.
    tick : float
        Length of a tick, s.

    Returns
    -------
    str
        A sentence.
    """
    each = ", ".join(
        f"{item.name} {1e3 * tick * item.value:+.3f} ± {1e3 * tick * item.std:.3f} ms"
        for item in delays
    )
    return f"samples later than the ticks' ends, told by the response and put back: {each}"


def _later(values: Floats, ticks: float) -> Floats:
    """Values that many ticks later; NaN where one of two neighbours is missing."""
    near = abs(ticks - round(ticks)) < WHOLE
    whole = round(ticks) if near else math.floor(ticks)
    part = 0.0 if near else ticks - whole
    moved = _moved(values, whole)
    return moved if part == 0.0 else (1.0 - part) * moved + part * _moved(values, whole + 1)


def _moved(values: Floats, ticks: int) -> Floats:
    out = np.full(len(values), np.nan)
    if ticks >= 0:
        out[: len(values) - ticks] = values[ticks:]
    else:
        out[-ticks:] = values[:ticks]
    return out


def _travel(position: Floats) -> Floats:
    return position[SPAN:] - position[:-SPAN]


def _delay(name: str, measured: Floats, modelled: Floats) -> Delay:
    slope = np.gradient(modelled)
    left = measured - modelled
    used = np.isfinite(left)
    value, std = 0.0, np.inf
    for _ in range(REGRESSIONS):
        if used.sum() < LEAST_USED or not np.ptp(slope[used]):
            return Delay(name, 0.0, np.inf)
        middle = slope[used].mean()
        centred = slope[used] - middle
        power = float(centred @ centred)
        value = -float(centred @ left[used]) / power
        away = left + value * slope
        away = away - np.nanmean(away[used])
        spread = 1.4826 * float(np.nanmedian(np.abs(away)))
        std = spread / float(np.sqrt(power))
        used = np.isfinite(left) & (np.abs(away) <= STRANGE * spread)
    return Delay(name, float(value), std * float(np.sqrt(LAGS)))
