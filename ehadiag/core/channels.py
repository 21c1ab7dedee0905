"""The four measured channels and their analogue-to-digital converters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "CHANNELS",
    "CURRENT",
    "POSITION",
    "PRESSURE",
    "SCALES",
    "SPOOL",
    "USUAL_LEVELS",
    "Channel",
    "Channels",
    "Scales",
    "Stated",
    "near_ends",
]

USUAL_LEVELS: Final = 4096.0
"""Codes of the 12-bit converters of PHY-21."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One converter channel: mid-tread rounding, saturating at its ends.

    Attributes
    ----------
    name : str
        Identifier used in tables, files and reports.
    full_scale : float
        Half range, SI unit of the channel; codes cover [-full_scale, full_scale - lsb].
    unit : str
        Engineering unit shown to people.
    per_unit : float
        SI value of one engineering unit.
    levels : float
        Steps in the whole range; no whole number where the step was seen in data.
    """

    name: str
    full_scale: float
    unit: str
    per_unit: float
    levels: float = USUAL_LEVELS

    @property
    def lsb(self) -> float:
        """One code step, SI unit."""
        return 2.0 * self.full_scale / self.levels

    @property
    def half(self) -> int:
        """Code of zero; the largest code is 2 half - 1."""
        return round(0.5 * self.levels)

    @property
    def grain(self) -> float:
        """Step of a 12-bit converter of this range, or its own where that is coarser, SI unit.

        Limits in LSB that allow for more than rounding are meant in these.
        """
        return 2.0 * self.full_scale / min(self.levels, USUAL_LEVELS)

    @property
    def ends(self) -> tuple[float, float]:
        """Values at and beyond which the converter stands at its lower and upper end, SI unit."""
        return near_ends(-self.full_scale, self.full_scale - self.lsb, self.lsb)

    def encode(self, value: NDArray[np.float64]) -> NDArray[np.int64]:
        """Digitise SI values to codes 0 … 2 half - 1 (zero is code half)."""
        code = np.floor(np.asarray(value) / self.lsb + 0.5) + self.half
        return np.clip(code, 0, 2 * self.half - 1).astype(np.int64)

    def decode(self, code: NDArray[np.int64]) -> NDArray[np.float64]:
        """SI value of each code."""
        centred: NDArray[np.float64] = np.asarray(code, dtype=np.float64) - self.half
        return centred * self.lsb


def near_ends(low: float, high: float, step: float) -> tuple[float, float]:
    """Values half a step inside both ends of a range: what is at or beyond one stands at an end."""
    return low + 0.5 * step, high - 0.5 * step


class Channels(NamedTuple):
    """The four channels, in the order of all tables."""

    current: Channel
    spool: Channel
    pressure: Channel
    position: Channel


class Stated(NamedTuple):
    """What a mapping says of one converter, SI; None: nothing.

    Attributes
    ----------
    low : float | None
        Value at its lower end.
    high : float | None
        Value at its upper end.
    step : float | None
        Resolution.
    """

    low: float | None = None
    high: float | None = None
    step: float | None = None


CURRENT = Channel("current", 12e-3, "mA", 1e-3)
SPOOL = Channel("spool", 0.5e-3, "mm", 1e-3)
PRESSURE = Channel("pressure", 25e6, "MPa", 1e6)
POSITION = Channel("position", 60e-3, "mm", 1e-3)

CHANNELS = Channels(CURRENT, SPOOL, PRESSURE, POSITION)
"""Those of PHY-23: what is meant where nothing else is said."""


@dataclass(frozen=True, slots=True)
class Scales:
    """How finely, and how far, a flight-control computer sees its actuator and its commands.

    Attributes
    ----------
    channels : Channels
        Its converters.
    current_step : float
        Resolution of commanded currents on its bus (BUS-8), A; 0: exact.
    position_step : float
        Of commanded positions, m; 0: exact.
    """

    channels: Channels = CHANNELS
    current_step: float = 0.5e-6
    position_step: float = 2e-6


SCALES = Scales()
"""Those of the default bus."""
