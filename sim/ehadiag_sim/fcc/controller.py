"""Control law of the flight-control computer (PHY-2, PHY-3)."""

from __future__ import annotations

import math
from typing import NamedTuple

from ehadiag.core.actuator import Controller
from ehadiag.core.recording import CommandMode

__all__ = ["PositionController", "PositionLaw", "position_law"]


class PositionLaw(NamedTuple):
    """Gains of the controller (PHY-2).

    Attributes
    ----------
    IM : float
        Saturation, A.
    GAP : float
        A/m.
    GAI : float
        A/(m s).
    GAD : float
        A s/m.
    tick : float
        s.
    """

    IM: float
    GAP: float
    GAI: float
    GAD: float
    tick: float


def position_law(
    law: PositionLaw, integral: float, before: float, error: float
) -> tuple[float, float]:
    """One tick of the control law; plain arithmetic, which may be compiled too.

    Parameters
    ----------
    law : PositionLaw
        Its gains.
    integral : float
        Of the error before this tick, m s.
    before : float
        Error of the tick before, m; NaN: there was none.
    error : float
        Of this tick, m.

    Returns
    -------
    tuple[float, float]
        Servovalve current, A, and the integral after the tick.
    """
    slope = 0.0 if math.isnan(before) else (error - before) / law.tick
    trial = integral + error * law.tick
    wanted = law.GAP * error + law.GAI * trial + law.GAD * slope
    if abs(wanted) > law.IM and wanted * law.GAI * error > 0.0:
        wanted = law.GAP * error + law.GAI * integral + law.GAD * slope
        trial = integral
    return max(-law.IM, min(law.IM, wanted)), trial


class PositionController:
    """PID with saturation at the rated current; in current mode the command passes through.

    The integral holds while the output is saturated and the error would drive it deeper
    (conditional integration); the derivative is the difference quotient over one tick.
    """

    def __init__(self, data: Controller) -> None:
        self._law = PositionLaw(data.IM, data.GAP, data.GAI, data.GAD, 1.0 / data.rate)
        self._integral = 0.0
        self._error: float | None = None

    def reset(self) -> None:
        """Forget the past: no integral, no earlier error."""
        self._integral = 0.0
        self._error = None

    def current(self, command: float, mode: CommandMode, measured: float) -> float:
        """Servovalve current of this tick, A.

        `command` in A (current mode) or m (position mode), `measured` the digitised jack position
        of the tick before, m.
        """
        limit = self._law.IM
        if mode is CommandMode.CURRENT:
            self.reset()
            return max(-limit, min(limit, command))
        error = command - measured
        before = math.nan if self._error is None else self._error
        current, self._integral = position_law(self._law, self._integral, before, error)
        self._error = error
        return current
