"""A short history of the four signals and the command, thinned out."""

from __future__ import annotations

from collections import deque

from ehadiag.core.recording import CommandMode
from ehadiag.live.snapshot import Signals, known

__all__ = ["Trace"]

LENGTH_S = 10.0
SPACING_S = 0.05
SCALES = (1e3, 1e3, 1e-6, 1e3)
"""From A, m, Pa, m to mA, mm, MPa, mm."""
COMMAND_SCALE = 1e3
"""From A to mA, from m to mm."""
Row = tuple[float | None, ...]
"""As the fields of `Signals`."""


class Trace:
    """The newest value in each twentieth of a second, for ten seconds.

    One thread takes samples, another may ask for them; takes no lock.
    """

    def __init__(self) -> None:
        self._rows: deque[Row] = deque(maxlen=round(LENGTH_S / SPACING_S))
        self._due_s = 0.0

    def take(
        self,
        time_s: float,
        mode: CommandMode | None,
        command: float,
        signals: tuple[float, float, float, float],
    ) -> None:
        """Take a sample: time since the session began, command, and the four signals; SI."""
        if time_s < self._due_s:
            return
        self._due_s = time_s + SPACING_S
        sent = known(command * COMMAND_SCALE)
        self._rows.append(
            (
                time_s,
                sent if mode is CommandMode.CURRENT else None,
                sent if mode is CommandMode.POSITION else None,
                *(known(value * scale) for value, scale in zip(signals, SCALES, strict=True)),
            )
        )

    def signals(self) -> Signals:
        """Return what was kept, in engineering units."""
        rows = tuple(self._rows)
        if not rows:
            return Signals()
        times, *columns = zip(*rows, strict=True)
        return Signals(tuple(float(time or 0.0) for time in times), *columns)
