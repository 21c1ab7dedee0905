"""Counts what a bus carries: frames, their rate, the share of the bit rate that they take."""

from __future__ import annotations

import time

__all__ = ["Traffic"]

STANDARD_BITS = 47
"""Of a data frame beside its data, the pause behind it included, stuff bits not (ISO 11898-1)."""
EXTENDED_BITS = 67
SILENT_S = 1.0
"""Without a frame for so long a bus is silent."""
LEAST_S = 0.5
"""Over less time no rate is told."""


class Traffic:
    """One thread takes frames, another may ask; takes no lock.

    Parameters
    ----------
    bitrate : float | None
        Of the bus, bit/s; None where it is not known.
    """

    def __init__(self, bitrate: float | None = None) -> None:
        self._bitrate = bitrate
        self.frames = 0
        """Taken since the beginning."""
        self._bits = 0
        self._before = (time.monotonic(), 0, 0)
        self._changed = (time.monotonic(), 0)
        self._rate: float | None = None
        self._load: float | None = None

    def take(self, size: int, *, extended: bool = False) -> None:
        """Count a frame with so many bytes of data."""
        self.frames += 1
        self._bits += 8 * size + (EXTENDED_BITS if extended else STANDARD_BITS)

    def measure(self) -> tuple[float | None, float | None, bool]:
        """Return rate (frames/s), load (0 … 1) and whether the bus is silent; for one asker.

        Returns
        -------
        tuple[float | None, float | None, bool]
            None where not known yet, or at all.
        """
        now, frames, bits = time.monotonic(), self.frames, self._bits
        then, frames_then, bits_then = self._before
        if now - then >= LEAST_S:
            self._rate = (frames - frames_then) / (now - then)
            if self._bitrate:
                self._load = min((bits - bits_then) / (now - then) / self._bitrate, 1.0)
            self._before = (now, frames, bits)
        if frames != self._changed[1]:
            self._changed = (now, frames)
        return self._rate, self._load, now - self._changed[0] >= SILENT_S
