"""The monitor for free motion: as in a test, but silent where the measured signals decide nothing.

Between tests a surface is mostly held. The spool then stands within a few converter steps of the
middle, where less than a step decides whether the jack slides or sticks, and by the pressure gain
(PHY-6) what the differential pressure is: at 2e12 Pa/m one step of 0.24 µm is 0.5 MPa, forty steps
of the pressure's converter. The modelled pressure is of no use there, however right the model. So
the sums of the pressure rest while the spool, measured or modelled, is that near to the middle;
those of the spool go on.

Nobody tells in what state a unit is when the watching begins: where friction holds the spool is not
in the middle, and a measured sample is a converter step off. A third of a converter step that
lasts is an alarm before long. So at first the modelled spool is moved by the mean of its
innovations, with ever smaller steps, and no alarm counts.
"""

from __future__ import annotations

import math

from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.recording import CommandMode
from ehadiag.model.plant import PlantConstants
from ehadiag.model.severity import worn
from ehadiag.model.unit import unit_constants
from ehadiag.monitor.monitor import Monitor, Reading

__all__ = ["FreeMotionMonitor", "undecided_spool"]

STEPS = 3.0
"""Converter steps of the spool within which its modelled position is known."""
FRICTIONS = 2.0
"""Static friction of the jack, over the dynamic one (PHY-15)."""
SETTLING = 300
"""Ticks with a spool sample until alarms count."""
AFTER = 5
"""Ticks for which the pressure rests behind the last undecided one: the jack may still stick."""


class FreeMotionMonitor:
    """Follows an actuator tick by tick, in tests and between them.

    Parameters
    ----------
    monitor : Monitor
        The monitor that it pushes into, with the unit's own severities.
    undecided : float
        Spool position either side of the middle within which the pressure says nothing, m; see
        `undecided_spool`.
    offset : float
        Constant error of the spool's sensor, m.
    """

    def __init__(self, monitor: Monitor, undecided: float, offset: float = 0.0) -> None:
        self.monitor = monitor
        """What it pushes into."""
        self._undecided, self._offset = undecided, offset
        self._resting = 0
        self._age = 0

    @property
    def settled(self) -> bool:
        """Whether alarms count."""
        return self._age >= SETTLING

    def settle(self) -> None:
        """Go on from the present state, but as one that is not known well."""
        self._age = 0

    def push(self, sample: tuple[float, float, float, float, float]) -> Reading:
        """Advance by one tick, see `Monitor.push`.

        Parameters
        ----------
        sample : tuple[float, float, float, float, float]
            The tick: command, current, spool, pressure, position.

        Returns
        -------
        Reading
            The monitor's reading, always the same object; residual of the pressure NaN where it
            says nothing.
        """
        command, current, spool, _, position = sample
        monitor, near = self.monitor, self._undecided
        if abs(spool - self._offset) < near or abs(monitor.reading.predicted[0]) < near:
            self._resting = AFTER
        if self._resting:
            self._resting -= 1
            sample = command, current, spool, math.nan, position
        reading = monitor.push(sample)
        if self._age < SETTLING:
            residual = float(reading.residual[0])
            if math.isfinite(residual):
                self._age += 1
                monitor.nudge(residual * monitor.noise[0] / (self._age + 1))
        return reading

    def follow(self, mode: CommandMode) -> None:
        """Take commands as of this mode from the next tick on, see `Monitor.follow`."""
        self.monitor.follow(mode)

    def reset(self, spool: float = 0.0) -> None:
        """Begin anew, from rest with the spool there (m)."""
        self._resting, self._age = AFTER, 0
        self.monitor.reset(spool)


def undecided_spool(actuator: Actuator, severity: float) -> float:
    """Return within what of the middle the spool does not decide what the pressure is, m.

    The jack sticks where the pressure gain times the spool's position is less than its static
    friction; what the converter hides comes on top.

    Parameters
    ----------
    actuator : Actuator
        Data of the actuator.
    severity : float
        Of the jack's friction, FDJ, 0 … 1.

    Returns
    -------
    float
        m.
    """
    constants: PlantConstants = unit_constants(actuator)
    step = actuator_channels(actuator).spool.grain
    friction = FRICTIONS * float(worn(constants.FDJ, constants.FDJ1, severity))
    return friction / (actuator.jack.AJ * actuator.servovalve.GP) + STEPS * step
