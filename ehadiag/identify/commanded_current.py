"""Rebuilds the commanded servovalve current, free of measurement noise wherever possible.

Measured current carries the converter's noise; the commanded one is known better. In open loop it
is the command. In closed loop the control law is repeated on the *digitised* jack position, as the
flight-control computer saw it (BUS-7: the position of the tick before feeds the control law).
Where that sample is lost, its code follows from the measured current: one code of position is
many codes of current.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Controller
from ehadiag.core.channels import CHANNELS, CURRENT, POSITION, Channels
from ehadiag.core.recording import CommandMode, Samples
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.command_step import step_by_current
from ehadiag.model.control import ControlLaw, commanded_currents, control_law

__all__ = ["CurrentTrace", "commanded_current", "guessed_positions"]

FRAME_TOLERANCE = {
    CommandMode.CURRENT: 20e-6 / CURRENT.full_scale,
    CommandMode.POSITION: 50e-6 / POSITION.full_scale,
}
"""A command frame that far from the stored test says that another command was played: shares of
the converter's half range, 20 µA and 50 µm of the default ones."""
LEAST_LEVELS = 100
"""Values sent that it takes to know their resolution."""
LONG_HOLE = 50
"""Ticks of a hole that count as guessed: amidst a longer one there is no sample either that a wrong
current could be held against. An integral in the control law remembers all of them."""
EXACTLY = 1e-6
"""Steps of the converter by which its own values may be off."""
ROUNDED_AGAIN = 0.1
"""The same of values that a bus of another scale rounded once more."""
CONTROL_LAW_LSB = 4.0
"""Residual (LSB rms) beyond which the control law does not explain the measured current."""


@dataclass(frozen=True, slots=True, eq=False)
class CurrentTrace:
    """Commanded current of each tick.

    Attributes
    ----------
    current: A, shape (n,).
    residual_lsb: rms of measured less commanded current, converter steps; NaN without measurement.
    offset: constant error of the measured current, A.
    rebuilt: whether the measured current bears it out.
    command_deviation: largest distance of a command frame from the stored test, A or m.
    command_step: resolution of the commands, A or m, as frames tell it, or where there are none
        the measured current of a closed loop; 0 where nothing does.
    guessed: share of ticks whose current follows from a position that was lost, and that the
        measured current does not tell either; of a hole at most `LONG_HOLE` ticks count.
    """

    current: NDArray[np.float64]
    residual_lsb: float
    offset: float
    rebuilt: bool
    command_deviation: float
    guessed: float = 0.0
    command_step: float = 0.0


def commanded_current(
    samples: Samples, test: StoredTest, controller: Controller, channels: Channels = CHANNELS
) -> CurrentTrace:
    """Rebuild the commanded current of a test from its samples, and what converters they are of."""
    n = samples.ticks
    stored = _fit_length(test.command(), n)
    known = np.isfinite(samples.command)
    deviation = np.abs(samples.command - stored)[known]
    command_deviation = float(deviation.max()) if deviation.size else 0.0
    law = control_law(controller, samples.period_ns * 1e-9)
    command, step = _command(stored, samples, law, channels, closed=test.closed_loop)
    guessed = 0.0
    if not test.closed_loop:
        current = np.clip(command, -controller.IM, controller.IM)
    else:
        seen, unknown = _positions_seen(command, samples, controller, channels)
        current = commanded_currents(law, command - seen)
        # What the control law did after the last sample explains none.
        last = np.flatnonzero(np.isfinite(samples.spool) | np.isfinite(samples.pressure))
        until = int(last[-1]) + 1 if last.size else n
        guessed = _guessed_share(unknown[:until], n if controller.GAI else LONG_HOLE)
    # A code at the converter's end says no more than that the current is at least so large.
    finite = np.isfinite(samples.current) & ~samples.saturated[0]
    difference = samples.current[finite] - current[finite]
    if difference.size == 0:
        return CurrentTrace(current, float("nan"), 0.0, True, command_deviation, guessed, step)
    offset = float(np.median(difference))
    # A handful of ticks may be far off where samples were lost: compare most of them.
    spread = np.sort(np.abs(difference - offset))[: max(1, int(0.98 * difference.size))]
    residual_lsb = float(np.sqrt(np.mean(spread**2))) / channels.current.grain
    rebuilt = residual_lsb < CONTROL_LAW_LSB
    return CurrentTrace(current, residual_lsb, offset, rebuilt, command_deviation, guessed, step)


def guessed_positions(
    samples: Samples, test: StoredTest, controller: Controller, channels: Channels
) -> NDArray[np.int64]:
    """Ticks of a closed loop whose current follows from a position that nothing tells."""
    stored = _fit_length(test.command(), samples.ticks)
    law = control_law(controller, samples.period_ns * 1e-9)
    command, _ = _command(stored, samples, law, channels, closed=True)
    return np.flatnonzero(_positions_seen(command, samples, controller, channels)[1])


def _command(
    stored: NDArray[np.float64],
    samples: Samples,
    law: ControlLaw,
    channels: Channels,
    *,
    closed: bool,
) -> tuple[NDArray[np.float64], float]:
    """Command that was acted on, and its resolution, A or m."""
    known = np.isfinite(samples.command)
    step = _resolution(samples.command[known])
    if closed and not known.any():
        step = _step_followed(stored, samples, law, channels)
    return np.where(known, samples.command, _as_sent(stored, step)), step


def _step_followed(
    stored: NDArray[np.float64], samples: Samples, law: ControlLaw, channels: Channels
) -> float:
    """Resolution, m, of commands that no frame told: that which the measured current follows."""
    seen = np.concatenate([[np.nan], _as_digitised(samples.position[:-1], channels.position.lsb)])
    present = np.isfinite(seen)
    if not present.any():
        return 0.0
    ticks = np.arange(len(seen))
    bridged = np.interp(ticks, ticks[present], seen[present])
    at_end = samples.saturated[0] | (np.abs(samples.current) > law.IM - channels.current.grain)
    measured = np.where(present & ~at_end, samples.current, np.nan)
    return step_by_current(
        stored,
        lambda command: commanded_currents(law, command - bridged),
        measured,
        channels.position.lsb,
    )


def _as_digitised(position: NDArray[np.float64], lsb: float) -> NDArray[np.float64]:
    """Positions as the converter gave them, where a bus of another scale has rounded them again.

    The control law worked on the converter's codes. What lies near none of its steps was measured
    by something else, and stays.
    """
    nearest = np.round(position / lsb) * lsb
    away = np.abs(position - nearest)[np.isfinite(position)] / lsb
    if away.size == 0 or away.max() < EXACTLY or np.quantile(away, 0.99) > ROUNDED_AGAIN:
        return position
    return np.asarray(nearest)


def _guessed_share(unknown: NDArray[np.bool_], longest: int) -> float:
    """Share of ticks that are unknown; of a hole no more than its first `longest` ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], unknown.astype(np.int8), [0]])))
    lengths = edges[1::2] - edges[::2]
    return float(np.minimum(lengths, longest).sum()) / max(len(unknown), 1)


def _fit_length(command: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Cut the stored command to n ticks, or hold its last value."""
    if len(command) >= n:
        return command[:n]
    return np.concatenate([command, np.full(n - len(command), command[-1])])


def _resolution(sent: NDArray[np.float64]) -> float:
    """Smallest distance between two values sent; 0 of too few."""
    levels = np.unique(sent)
    return 0.0 if levels.size < LEAST_LEVELS else float(np.diff(levels).min())


def _as_sent(stored: NDArray[np.float64], resolution: float) -> NDArray[np.float64]:
    """Round the stored command to the resolution of the command frames.

    The flight-control computer acts on what the frame says.
    """
    if resolution == 0.0:
        return stored
    return np.asarray(np.round(stored / resolution) * resolution)


def _positions_seen(
    command: NDArray[np.float64], samples: Samples, controller: Controller, channels: Channels
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Digitised jack position that each tick's control law worked on, m, shape (n,).

    Also the ticks whose position was lost and is bridged over: the sensor's noise in that sample,
    which the control law turned into current, cannot be told. A current at its limit is none of
    them: there the position did not matter.
    """
    lsb = channels.position.lsb
    seen = np.concatenate([[np.nan], _as_digitised(samples.position[:-1], lsb)])
    lost = np.flatnonzero(np.isnan(seen))
    unknown = np.zeros(len(seen), dtype=np.bool_)
    if lost.size == 0:
        return seen, unknown
    ticks = np.arange(len(seen))
    present = np.isfinite(seen)
    bridged = np.interp(ticks, ticks[present], seen[present]) if present.any() else 0.0 * command
    seen = np.where(present, seen, np.round(bridged / lsb) * lsb)
    clear = controller.GAP * lsb > 6.0 * channels.current.lsb
    unknown[lost] = True
    if not clear or controller.GAI or controller.GAD:
        return seen, unknown
    linear = np.abs(samples.current) < controller.IM - 3.0 * channels.current.grain
    linear &= ~samples.saturated[0]
    exact = present & linear
    offset = 0.0
    if exact.any():
        law = controller.GAP * (command - seen)
        offset = float(np.median(samples.current[exact] - law[exact]))
    for k in lost:
        if linear[k]:
            position = command[k] - (samples.current[k] - offset) / controller.GAP
            seen[k] = np.round(position / lsb) * lsb
    return seen, unknown & np.isnan(samples.current)
