"""The plant without sensors: servovalve current in, noise-free response out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag_sim.plant.coefficients import coefficients
from ehadiag_sim.plant.conditions import Effects, Faults
from ehadiag_sim.plant.kernels import P12, STATES, XJ, XS, step_tick

__all__ = ["DEFAULT_STEP", "Dynamics", "respond"]

DEFAULT_STEP = 0.25e-6
"""Integration step, s: errors below a fiftieth of a converter's step (detailed-model.md)."""
SHORTEST_STEP = 1e-9


class Dynamics:
    """Torque motor, spool, second stage and jack, at rest in the middle to begin with.

    `step` is the longest integration step in s; a whole number of equal steps makes a tick.

    Raises
    ------
    ConfigurationError: a step that is not within 1 ns … one tick.
    """

    def __init__(
        self,
        actuator: Actuator,
        faults: Faults | None = None,
        effects: Effects | None = None,
        step: float = DEFAULT_STEP,
    ) -> None:
        period = 1.0 / actuator.controller.rate
        if not (math.isfinite(step) and SHORTEST_STEP <= step <= period):
            raise ConfigurationError(f"integration step {step:g} s: need 1e-9 … {period:g} s")
        # The slack keeps a step that divides the tick but for rounding.
        self._substeps = math.ceil(period / step - 1e-6)
        self._step = period / self._substeps
        self._coefficients = coefficients(actuator, faults or Faults(), effects or Effects())
        self._state = np.zeros(STATES)

    def advance(self, current: float) -> None:
        """Hold `current` (A) for one control tick."""
        step_tick(self._state, self._coefficients, current, self._step, self._substeps)

    @property
    def spool(self) -> float:
        """Spool position, m."""
        return float(self._state[XS])

    @property
    def pressure(self) -> float:
        """Differential pressure, Pa."""
        return float(self._state[P12])

    @property
    def position(self) -> float:
        """Jack position, m."""
        return float(self._state[XJ])

    @property
    def state(self) -> NDArray[np.float64]:
        """Copy of the state, shape (STATES,), indices in `ehadiag_sim.plant.kernels`."""
        return self._state.copy()


def respond(
    actuator: Actuator,
    currents: NDArray[np.float64],
    faults: Faults | None = None,
    effects: Effects | None = None,
    step: float = DEFAULT_STEP,
) -> NDArray[np.float64]:
    """Response of the plant alone to given currents (A, one a tick), from rest.

    Returns spool (m), pressure (Pa), jack position (m) at the end of each tick, shape (3, ticks).
    """
    plant = Dynamics(actuator, faults, effects, step)
    out = np.empty((3, len(currents)))
    for tick, current in enumerate(currents.tolist()):
        plant.advance(current)
        out[:, tick] = plant.spool, plant.pressure, plant.position
    return out
