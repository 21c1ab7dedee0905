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
Row = tuple[float, CommandMode | None, float, tuple[float, float, float, float]]


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
        self._rows.append((time_s, mode, command, signals))

    def signals(self) -> Signals:
        """Return what was kept, in engineering units."""
        rows = tuple(self._rows)

        def column(index: int) -> tuple[float | None, ...]:
            return tuple(known(row[3][index] * SCALES[index]) for row in rows)

        def command(mode: CommandMode) -> tuple[float | None, ...]:
            return tuple(
                known(value * COMMAND_SCALE) if said is mode else None for _, said, value, _ in rows
            )

        return Signals(
            time_s=tuple(row[0] for row in rows),
            command_mA=command(CommandMode.CURRENT),
            command_mm=command(CommandMode.POSITION),
            current_mA=column(0),
            spool_mm=column(1),
            pressure_MPa=column(2),
            position_mm=column(3),
        )
