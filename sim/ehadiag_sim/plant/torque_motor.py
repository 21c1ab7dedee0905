"""Torque motor: from controller current to flapper torque, with bias, hysteresis and gain."""

from __future__ import annotations

import math

import numpy as np

from ehadiag_sim.plant.conditions import Effects

__all__ = ["TorqueMotor", "play"]


def play(held: float, value: float, half_width: float) -> float:
    """Play operator: the output follows `value` at a distance of at most `half_width`."""
    return max(value - half_width, min(value + half_width, held))


class TorqueMotor:
    """Null bias, hysteresis and gain of one torque motor (PHY-16, 17, 29, 30).

    Hysteresis is the mean of n plays (Prandtl-Ishlinskii) with half-widths
    `r_i = hyst·IM·(i + 0.5)/n`; for n = 1 the play of section 4, of half-width hyst·IM/2.

    Parameters
    ----------
    gain : float
        Torque-motor gain with its change, N m/A.
    rated : float
        Rated current, A.
    effects : Effects
        Null bias, hysteresis, and the strangers among them.
    """

    def __init__(self, gain: float, rated: float, effects: Effects) -> None:
        count = int(effects.plays)
        places = (np.arange(count) + 0.5) / count
        weights = np.exp(-effects.strangers.play_skew * places)
        self._widths: list[float] = (effects.hysteresis * rated * places).tolist()
        self._weights: list[float] = (weights / weights.sum()).tolist()
        self._held = [0.0] * count
        self._gain, self._rated = gain, rated
        self._bias = effects.null_bias
        self._cubic = effects.strangers.torque_cubic

    @property
    def current(self) -> float:
        """Current behind bias and hysteresis, A."""
        return math.fsum(w * h for w, h in zip(self._weights, self._held, strict=True))

    def torque(self, current: float) -> float:
        """Torque (N m) at a servovalve current (A) that changes no way but straight to there."""
        value = current + self._bias
        self._held = [
            play(held, value, width) for held, width in zip(self._held, self._widths, strict=True)
        ]
        inside = self.current
        torque = self._gain * inside
        if self._cubic:
            torque *= 1.0 + self._cubic * (inside / self._rated) ** 2
        return torque
