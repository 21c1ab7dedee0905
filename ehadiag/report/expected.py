"""The response to expect of a unit as new, for recordings of which nothing was identified."""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import CommandMode, Recording, Samples
from ehadiag.core.stored_test import SAME_RATE, StoredTest
from ehadiag.identify.experiment import build_experiment
from ehadiag.model.scalar.response import respond
from ehadiag.report.modelled import Signal

__all__ = ["Curves", "expected_curves", "expected_signals"]

LEAST_CURRENT = 0.5
"""Share of ticks whose current is known, for a response to be expected."""
NAMES = {
    "current": ("servovalve current", "mA", "µA", 1e3, "command"),
    "spool": ("spool position", "mm", "µm", 1e3, "expected of a unit as new"),
    "pressure": ("differential pressure", "MPa", "kPa", 1e-6, "expected of a unit as new"),
    "position": ("jack position", "mm", "µm", 1e3, "command"),
}
"""Of a curve: the signal's name, its units, factor from SI, and what is beside the measured."""

Curves = dict[str, NDArray[np.float64]]


def expected_signals(
    recording: Recording, samples: Samples, test: StoredTest | None, actuator: Actuator
) -> tuple[Signal, ...]:
    """Set what was measured beside what was commanded and what a unit as new would have done.

    Parameters
    ----------
    recording : Recording
        Without an estimate.
    samples : Samples
        Of it.
    test : StoredTest | None
        None where it is unknown.
    actuator : Actuator
        Data of the unit.

    Returns
    -------
    tuple[Signal, ...]
        Current, spool, differential pressure, jack position; NaN where nothing is to be expected.
    """
    curves = expected_curves(recording, samples, test, actuator)
    nothing = np.full(samples.ticks, np.nan)
    return tuple(
        Signal(
            name,
            unit,
            small,
            scale * getattr(samples, key),
            curves.get(key, nothing),
            beside=words if key in curves else "",
        )
        for key, (name, unit, small, scale, words) in NAMES.items()
    )


def expected_curves(
    recording: Recording, samples: Samples, test: StoredTest | None, actuator: Actuator
) -> Curves:
    """Tell what a unit as new would have done, as far as that can be told.

    Parameters
    ----------
    recording : Recording
        Without an estimate.
    samples : Samples
        Of it.
    test : StoredTest | None
        None where it is unknown.
    actuator : Actuator
        Data of the unit.

    Returns
    -------
    Curves
        By the names `current` (mA) or `position` (mm), which is the command, `spool` (mm) and
        `pressure` (MPa), shape (ticks,) each; what cannot be told is missing.
    """
    if test is None or abs(samples.period_ns * 1e-9 * test.rate - 1.0) > SAME_RATE:
        return {}
    out: Curves = {}
    closed = samples.mode is CommandMode.POSITION
    if test.closed_loop == closed:
        ticks = min(test.ticks, samples.ticks)
        name, scale = ("position", 1e3) if closed else ("current", 1e3)
        out[name] = _as_long_as(test.command()[:ticks] * scale, samples.ticks)
    if test.closed_loop != closed or np.isfinite(samples.current).mean() < LEAST_CURRENT:
        return out
    # Of a recording that is unlike its test nothing may be expected at all.
    with contextlib.suppress(ValueError, IndexError, ZeroDivisionError):
        experiment = build_experiment(samples, recording.environment, test, actuator)
        response = respond(experiment.constants, experiment.trace.current, experiment.tick)
        out["spool"] = _as_long_as(response.spool * 1e3, samples.ticks)
        out["pressure"] = _as_long_as(response.pressure * 1e-6, samples.ticks)
    return out


def _as_long_as(values: NDArray[np.float64], ticks: int) -> NDArray[np.float64]:
    out = np.full(ticks, np.nan)
    out[: min(len(values), ticks)] = values[:ticks]
    return out
