"""The four measured channels and their analogue-to-digital converters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["CHANNELS", "CURRENT", "POSITION", "PRESSURE", "SPOOL", "Channel"]


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
    bits : int
        Converter width.
    """

    name: str
    full_scale: float
    unit: str
    per_unit: float
    bits: int = 12

    @property
    def lsb(self) -> float:
        """One code step, SI unit."""
        return 2.0 * self.full_scale / float(1 << self.bits)

    def encode(self, value: NDArray[np.float64]) -> NDArray[np.int64]:
        """Digitise SI values to codes 0 … 2^bits - 1 (half range = code 2^(bits-1))."""
        half = 1 << (self.bits - 1)
        code = np.floor(np.asarray(value) / self.lsb + 0.5) + half
        return np.clip(code, 0, 2 * half - 1).astype(np.int64)

    def decode(self, code: NDArray[np.int64]) -> NDArray[np.float64]:
        """SI value of each code."""
        centred: NDArray[np.float64] = np.asarray(code, dtype=np.float64) - (1 << (self.bits - 1))
        return centred * self.lsb


CURRENT = Channel("current", 12e-3, "mA", 1e-3)
SPOOL = Channel("spool", 0.5e-3, "mm", 1e-3)
PRESSURE = Channel("pressure", 25e6, "MPa", 1e6)
POSITION = Channel("position", 60e-3, "mm", 1e-3)

CHANNELS: tuple[Channel, ...] = (CURRENT, SPOOL, PRESSURE, POSITION)
