"""Holds the jack's travel against what the spool let through, before anything is identified.

A sensor that shows another motion is refused at once, whatever the faults."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.position import LEAST_SAMPLES, LEAST_TRAVEL_LSB, SPAN_S, middle_of_three
from ehadiag.assess.wrong_units import relations
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.recording import Samples

__all__ = ["objections_to_travel"]

LEAST_CORRELATION = 0.7
"""0.988 at least over 80 sound units with all effects, data 5 % off, orifices and strangers, and
0.84 with a sensor 50 ms late, whatever the severities; 0.33 to -1 with another signal."""
OPPOSITE = -0.7

Floats = NDArray[np.float64]


def objections_to_travel(samples: Samples, actuator: Actuator) -> list[str]:
    """Say which sensor shows another motion than the other channels.

    The jack's velocity is close to the spool's position times flow gain over jack area
    (PHY-6, PHY-7), so that both travels correlate. Which of the two sensors is to blame is told
    by the current, which the spool follows.

    Parameters
    ----------
    samples : Samples
        Of a whole test.
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    list[str]
        Empty where the travels agree, or too little of them is known, or nothing moved.
    """
    travels = _travels(samples, actuator)
    if travels is None:
        return []
    expected, measured = travels
    least = LEAST_TRAVEL_LSB * actuator_channels(actuator).position.grain
    moved = float(expected.std()), float(measured.std())
    if max(moved) < least:
        return []
    correlation = float(np.mean((expected - expected.mean()) * (measured - measured.mean())))
    correlation /= max(moved[0] * moved[1], np.finfo(np.float64).tiny)
    if correlation >= LEAST_CORRELATION:
        return []
    spool_follows = any(
        item.upper == "spool" and item.lower == "current" and item.ratio > 0.0
        for item in relations(samples, actuator)
    )
    sensor = "position" if spool_follows else "spool"
    if correlation < OPPOSITE:
        return [f"the {sensor} sensor reads with the wrong sign"]
    what = (
        "the position does not follow the flow that the spool lets through: jack seized or at its "
        "end, or position sensor dead, frozen, or another signal"
        if spool_follows
        else "the spool follows neither the current nor the jack's motion: spool sensor dead, "
        "frozen, or another signal, or torque motor wired the wrong way round"
    )
    return [
        f"{what} (correlation of the jack's travel with the spool's flow {correlation:.2f}, "
        f"at least {LEAST_CORRELATION:g} needed)"
    ]


def _travels(samples: Samples, actuator: Actuator) -> tuple[Floats, Floats] | None:
    """Travel over the span as the spool's flow makes it and as the position shows it, m."""
    tick = samples.period_ns * 1e-9
    span = round(SPAN_S / tick)
    seen = np.flatnonzero(np.isfinite(samples.spool))
    if len(seen) < LEAST_SAMPLES * len(samples.spool) or len(samples.spool) <= span + 2:
        return None
    spool = np.interp(np.arange(len(samples.spool)), seen, samples.spool[seen])
    gain = actuator.servovalve.GQ / actuator.jack.AJ
    passed = np.concatenate([[0.0], np.cumsum(spool[:-1])]) * tick * gain
    expected = passed[span:] - passed[:-span]
    position = _without_spikes(samples.position)
    measured = position[span:] - position[:-span]
    known = np.isfinite(measured)
    if known.mean() < LEAST_SAMPLES:
        return None
    return expected[known], measured[known]


def _without_spikes(values: Floats) -> Floats:
    """Median of each known value and its known neighbours."""
    out, seen = values.copy(), np.flatnonzero(np.isfinite(values))
    known = values[seen]
    if len(seen) > 2:
        out[seen[1:-1]] = middle_of_three(known)
    return out
