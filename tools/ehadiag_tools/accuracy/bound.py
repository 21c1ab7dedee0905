"""The Cramér–Rao bound: the smallest deviation that any unbiased estimate can have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.identify.experiment import Experiment
from ehadiag.model.parameters import FAULTS
from ehadiag.model.scalar.response import respond
from ehadiag_sim.plant.conditions import Sensors
from ehadiag_tools.damaged import damaged

__all__ = ["cramer_rao", "information"]

STEPS = (2e-5, 5e-6)
"""Half-widths of the differences."""
AGREE = 0.2
"""Derivatives by both widths that differ by more than this share (plus a little) are left out."""


def cramer_rao(experiments: Sequence[Experiment], faults: Sequence[float]) -> NDArray[np.float64]:
    """Deviations of all severities at the truth, sensor offsets known to be zero, shape (k,).

    Noise of the converters as in PHY-21 and PHY-22: 0.5 LSB rms and rounding, taken as Gaussian
    of variance 0.25 + 1/12 LSB². Ticks at which a break-away tips between both sides of a
    difference are left out: there the response has no derivative. NaN for a severity that shows
    nowhere.
    """
    total = sum((information(item, faults) for item in experiments), np.zeros((len(FAULTS),) * 2))
    out = np.full(len(FAULTS), np.nan)
    shown = np.diag(total) > 0.0
    inverse = np.linalg.inv(total[np.ix_(shown, shown)])
    out[shown] = np.sqrt(np.diag(inverse))
    return out


def information(experiment: Experiment, faults: Sequence[float]) -> NDArray[np.float64]:
    """Fisher information of one test, shape (k, k)."""
    truth = np.asarray(faults, dtype=np.float64)
    wide, narrow = (_derivatives(experiment, truth, step) for step in STEPS)
    scale = np.sqrt(np.mean(narrow**2, axis=2, keepdims=True))
    smooth = (np.abs(wide - narrow) <= AGREE * (np.abs(narrow) + scale)).all(axis=0)
    seen = np.vstack([np.isfinite(experiment.spool), np.isfinite(experiment.pressure)])
    rows = narrow[:, smooth & seen]
    return np.asarray(rows @ rows.T)


def _derivatives(
    experiment: Experiment, truth: NDArray[np.float64], step: float
) -> NDArray[np.float64]:
    """Derivatives of spool and pressure in units of their noise, shape (k, 2, n)."""
    noise = np.sqrt(Sensors().noise_lsb ** 2 + 1.0 / 12.0) * np.array([SPOOL.lsb, PRESSURE.lsb])
    out = np.empty((len(FAULTS), len(noise), experiment.ticks))
    for j in range(len(FAULTS)):
        sides = []
        for sign in (1.0, -1.0):
            x = truth.copy()
            x[j] = min(max(x[j] + sign * step, 0.0), 1.0)
            constants = damaged(experiment.constants, x)
            answer = respond(constants, experiment.trace.current, experiment.tick)
            sides.append((x[j], np.vstack([answer.spool, answer.pressure])))
        (high, above), (low, below) = sides
        out[j] = (above - below) / (high - low) / noise[:, None]
    return out
