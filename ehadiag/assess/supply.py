"""Finds a supply that is lower than its probe says.

The measured pressure stops where the identified actuator's goes on."""

from __future__ import annotations

import numpy as np

from ehadiag.identify.experiment import Experiment
from ehadiag.model.scalar.response import Response

__all__ = ["objections_to_supply"]

BEYOND_NOISE = 10.0
"""Modelled over largest measured pressure, in units of noise, from which on a tick counts."""
BEYOND_SHARE = 0.12
"""The same as a share of the largest measured pressure: the peak of a break-away, which lasts two
ticks, was 10 % lower than modelled in a sound unit with friction of another law."""
MOST_TICKS = 1
"""Break-aways a tick apart make one such tick in 32 recordings of sound units, none more."""


def objections_to_supply(experiment: Experiment, modelled: Response, offset: float) -> list[str]:
    """Say that the measured pressure is cut off.

    Supply less return pressure bounds the differential pressure (PHY-6); a probe that reads too
    much shows only where that bound is reached, often for a few milliseconds of the test.

    Parameters
    ----------
    experiment : Experiment
        What was measured.
    modelled : Response
        Of the identified actuator, over the same ticks.
    offset : float
        Of the pressure sensor, beyond the one that `experiment` is free of, Pa.

    Returns
    -------
    list[str]
        Empty where nothing is cut off.
    """
    measured = experiment.pressure - offset
    seen = np.isfinite(measured)
    if not seen.any():
        return []
    for side in (1.0, -1.0):
        got, expected = side * measured[seen], side * modelled.pressure[seen]
        top = float(got.max())
        margin = max(BEYOND_NOISE * experiment.pressure_noise, BEYOND_SHARE * abs(top))
        if np.count_nonzero(expected > top + margin) > MOST_TICKS:
            return [
                f"the pressure stops at {side * top * 1e-6:.2f} MPa where the model goes on to "
                f"{side * float(expected.max()) * 1e-6:.2f} MPa: supply lower than its probe says,"
                " or pressure sensor cut off"
            ]
    return []
