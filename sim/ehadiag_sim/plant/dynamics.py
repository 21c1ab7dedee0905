"""The plant without sensors: servovalve current in, noise-free response out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag_sim.plant.coefficients import coefficients
from ehadiag_sim.plant.conditions import Effects, Faults
from ehadiag_sim.plant.kernels import P12, P12_SEEN, STATES, XJ, XS, XS_SEEN, advance
from ehadiag_sim.plant.torque_motor import TorqueMotor

__all__ = ["DEFAULT_STEP", "Dynamics", "respond"]

DEFAULT_STEP = 0.25e-6
"""Integration step, s: errors below a fiftieth of a converter's step (detailed-model.md)."""
SHORTEST_STEP = 1e-9
LAG_PIECE = 50e-6
"""Pieces of constant torque into which a current that lags divides a tick, s."""
DRIFT_TICKS = 10
"""A drifting oil temperature is brought into the coefficients so often."""


class Dynamics:
    """Torque motor, spool, second stage and jack, at rest in the middle to begin with.

    Parameters
    ----------
    actuator : Actuator
        The unit and what it suffers from.
    faults : Faults | None
        See `actuator`.
    effects : Effects | None
        See `actuator`.
    step : float
        Longest integration step, s; a whole number of equal steps makes a tick.
    filter_time : float
        Time constant of the analogue filter before the spool's and the pressure's converter, s.
    early : float
        What is `seen` was sampled so long before the end of the tick, s.

    Raises
    ------
    ConfigurationError
        A step that is not within 1 ns … one tick, an instant outside the tick.
    """

    def __init__(
        self,
        actuator: Actuator,
        faults: Faults | None = None,
        effects: Effects | None = None,
        step: float = DEFAULT_STEP,
        *,
        filter_time: float = 0.0,
        early: float = 0.0,
    ) -> None:
        self._period = 1.0 / actuator.controller.rate
        if not (math.isfinite(step) and SHORTEST_STEP <= step <= self._period):
            raise ConfigurationError(f"integration step {step:g} s: need 1e-9 … {self._period:g} s")
        if not 0.0 <= early < self._period:
            raise ConfigurationError(
                f"sensor early (s): {early:g} is not from 0 to below a tick, {self._period:g}"
            )
        self._actuator, self._filter_time = actuator, filter_time
        self._faults, self._effects = faults or Faults(), effects or Effects()
        self._longest = step
        # Before and after the instant at which the sensors are sampled.
        self._spans = [part for part in (self._period - early, early) if part > 0.0]
        self._ticks = 0
        self._flowing = 0.0
        self._state = np.zeros(STATES)
        self._take_coefficients()
        self._motor = TorqueMotor(self._coefficients.GM, actuator.controller.IM, self._effects)
        self._seen = (0.0, 0.0, 0.0, 0.0)

    def advance(self, current: float) -> None:
        """Hold `current` (A) for one control tick."""
        if self._effects.strangers.oil_drift and self._ticks % DRIFT_TICKS == 0:
            self._take_coefficients()
        for index, span in enumerate(self._spans):
            if self._effects.strangers.driver_lag > 0.0:
                self._lag(current, span)
            else:
                self._flowing = current
                self._integrate(current, span)
            if index == 0:
                state = self._state
                self._seen = (
                    self._flowing,
                    float(state[XS_SEEN]),
                    float(state[P12_SEEN]),
                    float(state[XJ]),
                )
        self._ticks += 1

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
    def seen(self) -> tuple[float, float, float, float]:
        """Current (A), spool (m), pressure (Pa), jack (m) behind the filters when sampled last."""
        return self._seen

    @property
    def motor_current(self) -> float:
        """Current behind the torque motor's bias and hysteresis, A."""
        return self._motor.current

    @property
    def oil_temperature(self) -> float:
        """Of the oil now, degC."""
        drift = self._effects.strangers.oil_drift
        return self._effects.oil_temperature + drift * self._ticks * self._period

    @property
    def state(self) -> NDArray[np.float64]:
        """Copy of the state, shape (STATES,), indices in `ehadiag_sim.plant.kernels`."""
        return self._state.copy()

    def _take_coefficients(self) -> None:
        self._coefficients = coefficients(
            self._actuator,
            self._faults,
            self._effects,
            filter_time=self._filter_time,
            oil_temperature=self.oil_temperature,
        )

    def _lag(self, current: float, span: float) -> None:
        """Let the current approach the held one; its mean over each piece drives the motor."""
        pieces = math.ceil(span / LAG_PIECE - 1e-6)
        piece = span / pieces
        left = math.exp(-piece / self._effects.strangers.driver_lag)
        for _ in range(pieces):
            before = self._flowing
            self._flowing = current + (before - current) * left
            self._integrate(0.5 * (before + self._flowing), piece)

    def _integrate(self, current: float, span: float) -> None:
        # The slack keeps a step that divides the span but for rounding.
        substeps = math.ceil(span / self._longest - 1e-6)
        advance(
            self._state,
            self._coefficients,
            self._motor.torque(current),
            span / substeps,
            substeps,
        )


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
