"""A whole stretch of motion of the simulated actuator in one compiled call.

Tick by tick what `ehadiag_sim.plant.simulator.Plant` does for a unit without effects, at a
fraction of the time.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag_sim.fcc.controller import PositionLaw, position_law
from ehadiag_sim.plant.coefficients import Coefficients
from ehadiag_sim.plant.kernels import P12, STATES, XJ, XS, advance

__all__ = ["moved"]

_law = numba.njit(error_model="numpy")(position_law)


@kernel
def moved(
    commands: NDArray[np.float64],
    closed: bool,
    centring: float,
    follow: float,
    resolution: float,
    law: PositionLaw,
    p: Coefficients,
    noise: NDArray[np.float64],
    lsb: NDArray[np.float64],
    half: NDArray[np.float64],
    substeps: int,
) -> NDArray[np.float64]:
    """Move a unit from rest.

    Parameters
    ----------
    commands : NDArray[np.float64]
        Of each tick, A or m, shape (ticks,).
    closed : bool
        Commands are positions.
    centring : float
        What brings the jack back, A/m or 0.
    follow : float
        Share by which its mean position follows the jack in a tick.
    resolution : float
        Of a command on the bus, A or m.
    law : PositionLaw
        Control law.
    p : Coefficients
        Of the unit.
    noise : NDArray[np.float64]
        Of the first reading at rest and of each tick's, LSB, shape (ticks + 1, 4).
    lsb : NDArray[np.float64]
        Steps of the converters, SI, shape (4,).
    half : NDArray[np.float64]
        Their codes of zero, shape (4,).
    substeps : int
        Of the integration in each tick.

    Returns
    -------
    NDArray[np.float64]
        Shape (ticks, 5): command as sent, current, spool, pressure, position as digitised, SI.
    """
    out = np.empty((len(commands), 5))
    state, seen, away = np.zeros(STATES), np.zeros(4), 0.0
    integral, before = 0.0, math.nan
    measured = _digitised(0.0, noise[0, 3], lsb[3], half[3])
    for k in range(len(commands)):
        command = np.rint((commands[k] - centring * away) / resolution) * resolution
        if closed:
            error = command - measured
            current, integral = _law(law, integral, before, error)
            before = error
        else:
            current = max(-law.IM, min(law.IM, command))
        advance(state, p, p.GM * current, law.tick / substeps, substeps)
        seen[0], seen[1], seen[2], seen[3] = current, state[XS], state[P12], state[XJ]
        out[k, 0] = command
        for i in range(4):
            out[k, 1 + i] = _digitised(seen[i], noise[k + 1, i], lsb[i], half[i])
        measured = out[k, 4]
        away += follow * (state[XJ] - away)
    return out


@kernel
def _digitised(value: float, noise: float, lsb: float, half: float) -> float:
    code = math.floor((value + noise * lsb) / lsb + 0.5) + half
    return (min(max(code, 0.0), 2.0 * half - 1.0) - half) * lsb
