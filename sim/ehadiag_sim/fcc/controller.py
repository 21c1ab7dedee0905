"""Control law of the flight-control computer (PHY-2, PHY-3)."""

from __future__ import annotations

from ehadiag.core.actuator import Controller
from ehadiag.core.recording import CommandMode

__all__ = ["PositionController"]


class PositionController:
    """PID with saturation at the rated current; in current mode the command passes through.

    The integral holds while the output is saturated and the error would drive it deeper
    (conditional integration); the derivative is the difference quotient over one tick.
    """

    def __init__(self, data: Controller) -> None:
        self._data = data
        self._period = 1.0 / data.rate
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
        limit = self._data.IM
        if mode is CommandMode.CURRENT:
            self.reset()
            return max(-limit, min(limit, command))
        error = command - measured
        slope = 0.0 if self._error is None else (error - self._error) / self._period
        self._error = error
        integral = self._integral + error * self._period
        wanted = self._law(error, integral, slope)
        if abs(wanted) > limit and wanted * self._data.GAI * error > 0.0:
            wanted = self._law(error, self._integral, slope)
        else:
            self._integral = integral
        return max(-limit, min(limit, wanted))

    def _law(self, error: float, integral: float, slope: float) -> float:
        data = self._data
        return data.GAP * error + data.GAI * integral + data.GAD * slope
