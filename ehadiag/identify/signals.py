"""Signals of a recording before identification: sensor noise and commanded current.

Noise is judged by second differences, which slow motion does not enter. The commanded current is
rebuilt from the stored test or, in closed loop, from the control law on the digitised jack
position. Where the signals were measured separately, nobody recorded the codes of the computer's
own position converter: the measured current tells them, at each tick it is that of one code; where
it does not, the measured current itself is the input.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.criteria import ESTIMATION, NUMERICAL_ZERO, RECORDING
from ehadiag.model.laws import ControlLaw, control_currents, control_law
from firmware_iface.recording import CHANNELS, Acquisition, Channel, Channels, CommandMode, Samples
from firmware_iface.stored_test import Controller, StoredTest

QUIET_BLOCK_RATIO = 0.867
"""Deviation of white noise in the quietest fifth of blocks of `ESTIMATION.min_ticks`, 1 (0.864 to
0.869 for 2 to 5.5 s; a tenth of a chi-square of the 51 degrees of freedom of second differences has
0.870)."""


def rounding_noise(channel: Channel) -> float:
    """Standard deviation that the converter's rounding alone makes, SI unit of the channel."""
    return channel.lsb / float(np.sqrt(12.0))


def noise_of_signal(values: Array, channel: Channel) -> float:
    """Noise of a channel from the quietest blocks of what is handed in, SI unit of the channel.

    Second differences do not see a steady slope; the quietest fifth of the blocks is where the
    actuator rests or creeps. Never below what the converter's rounding alone makes.
    """
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    blocks = second[: len(second) // ESTIMATION.min_ticks * ESTIMATION.min_ticks].reshape(
        -1, ESTIMATION.min_ticks
    )
    enough = np.isfinite(blocks).sum(axis=1) > ESTIMATION.min_ticks // 2
    if not enough.any():
        return float(channel.lsb * ESTIMATION.noise_lsb)
    power = np.sort(np.nanmean(blocks[enough] ** 2, axis=1)) / 6.0
    quiet = power[: max(1, len(power) // 5)]
    return float(max(np.sqrt(np.median(quiet)) / QUIET_BLOCK_RATIO, rounding_noise(channel)))


def median_of(values: Array) -> Array:
    """Median along the last axis, shape (…, n): shape (…); no value may be missing.

    The same as numpy's, which looks for three places in order and for missing values: a fifth of
    its time.
    """
    middle = values.shape[-1] // 2
    parts = np.partition(values, middle, axis=-1)
    upper = parts[..., middle]
    if values.shape[-1] % 2:
        return np.asarray(upper)
    return np.asarray((parts[..., :middle].max(axis=-1) + upper) / 2.0)


def relative_noise(residuals: Array) -> float:
    """Noise that weighted residuals show, in units of the noise that weights them.

    Second differences contain the noise; what the model fails to explain moves slowly and stays
    out, so that it still shows as a residual that the noise does not cover. Residuals without noise
    show what a double rounds. residuals: 0 where no sample counts, shape (n,).
    """
    present = residuals != 0.0
    second = residuals[2:] - 2.0 * residuals[1:-1] + residuals[:-2]
    second = second[present[2:] & present[1:-1] & present[:-2]]
    kept = int(ESTIMATION.noise_kept_share * second.size)
    if not kept:
        return 1.0
    least = np.partition(np.abs(second), kept - 1)[:kept]
    noise = float(np.mean(least) / (ESTIMATION.noise_kept_mean * np.sqrt(6.0)))
    return max(noise, NUMERICAL_ZERO)


COMMAND_RESOLUTIONS = np.sort(
    np.concatenate([digit * 10.0 ** np.arange(-7, -4) for digit in (1, 2, 2.5, 5)])
)
"""m: resolutions that buses have."""
CODE_RESOLUTION_RATIOS = 2.0 ** -np.arange(9)
"""Of the converter's step: those of a computer that calculates in its codes."""


class CommandRules(msgspec.Struct, frozen=True):
    """Reconstruction of commands and currents."""

    min_misfit_gain: float = 30.0
    """Least gain in the sum of squares of a rounding over none, in variances: a
    likelihood ratio of e^15, whichever of 21 resolutions is tried."""
    max_guessed_ticks: int = 50
    """Largest number of ticks of a hole that count as guessed, 1: in a longer one there is no
    sample either that a wrong current could affect. An integral in the control law keeps all of
    them."""
    rescaled_tolerance_lsb: float = 0.1
    """Rounding of values that a bus of another scale rounded once more, LSB: a fifth of half a
    step, so that the nearest step is the converter's."""


COMMANDS = CommandRules()


def resolution_by_current(
    stored: Array, current_of: Callable[[Array], Array], measured: Array, converter: float
) -> float:
    """Resolution of the command that explains the measured current best, m; 0: none is needed.

    stored: command of the test, m; current_of: current by the control law for a command, A;
    measured: current, A, NaN where it shows nothing; converter: step of the jack position's
    converter, m.
    """
    usable = np.isfinite(measured)
    if not usable.any():
        return 0.0

    def residual(command: Array) -> Array:
        away = (measured - current_of(command))[usable]
        return np.asarray(away - np.median(away))

    plain = residual(stored)
    scale = 1.4826 * float(np.median(np.abs(plain)))
    if scale == 0.0:
        return 0.0

    def misfit(away: Array) -> float:
        largest = ESTIMATION.cauchy_scale
        return float(np.sum(np.clip(away / scale, -largest, largest) ** 2))

    steps = np.concatenate([COMMAND_RESOLUTIONS, converter * CODE_RESOLUTION_RATIOS])
    found = [misfit(residual(np.round(stored / step) * step)) for step in steps]
    best = int(np.argmin(found))
    return float(steps[best]) if found[best] < misfit(plain) - COMMANDS.min_misfit_gain else 0.0


COMMAND_FRAME_TOLERANCE = {
    CommandMode.CURRENT: 20e-6 / CHANNELS.current.full_scale,
    CommandMode.POSITION: 50e-6 / CHANNELS.position.full_scale,
}
"""A command frame that far from the stored test says that another command was played: shares of
the converter's half range, 20 µA and 50 µm of the default ones."""


class CurrentTrace(msgspec.Struct, frozen=True, eq=False):
    """Commanded current of each tick."""

    current: Array
    """A, shape (n,)."""
    residual_lsb: float
    """Rms of measured less commanded current, converter steps; NaN without measurement."""
    offset: float
    """Constant error of the measured current, A."""
    rebuilt: bool
    """Whether the measured current bears it out."""
    command_deviation: float
    """Largest distance of a command frame from the stored test, A or m."""
    guessed: float = 0.0
    """Share of ticks whose current follows from a position that was lost, and that the measured
    current does not show either; of a hole at most `max_guessed_ticks` count."""
    command_step: float = 0.0
    """Resolution of the commands by their frames, else by the measured current of
    a closed loop, A or m; 0: unknown."""


def commanded_current(
    samples: Samples, test: StoredTest, controller: Controller, channels: Channels = CHANNELS
) -> CurrentTrace:
    """Rebuild the commanded current of a test from its samples, and what converters they are of."""
    n = samples.ticks
    law = control_law(controller, samples.period_ns * 1e-9)
    command, step, command_deviation = command_of(test, samples, law, channels)
    guessed = 0.0
    if not test.closed_loop:
        current = np.clip(command, -controller.IM, controller.IM)
    else:
        seen, unknown = _positions_seen(command, samples, controller, channels)
        current = control_currents(law, command - seen)
        # What the control law did after the last sample explains none.
        last = np.flatnonzero(np.isfinite(samples.spool) | np.isfinite(samples.pressure))
        until = int(last[-1]) + 1 if last.size else n
        guessed = _guessed_share(
            unknown[:until], n if controller.GAI else COMMANDS.max_guessed_ticks
        )
    # A code at the converter's end says no more than that the current is at least so large.
    finite = np.isfinite(samples.current) & ~samples.saturated[0]
    difference = samples.current[finite] - current[finite]
    if difference.size == 0:
        return CurrentTrace(current, float("nan"), 0.0, True, command_deviation, guessed, step)
    offset = float(median_of(difference))
    residual_lsb = _kept_rms(difference - offset) / channels.current.grain
    rebuilt = residual_lsb < RECORDING.max_control_residual_lsb
    return CurrentTrace(current, residual_lsb, offset, rebuilt, command_deviation, guessed, step)


def _kept_rms(away: Array) -> float:
    """Rms of all but the largest values: a handful of ticks may be of lost samples."""
    kept = max(1, int(ESTIMATION.noise_kept_share * away.size))
    return float(np.sqrt(np.mean(np.sort(np.abs(away))[:kept] ** 2)))


def command_of(
    test: StoredTest, samples: Samples, law: ControlLaw, channels: Channels
) -> tuple[Array, float, float]:
    """Command that was acted on, its resolution, and the frames' largest deviation, A or m."""
    stored = _fit_length(test.command(), samples.ticks)
    deviation = np.abs(samples.command - stored)
    most = float(np.nanmax(deviation, initial=0.0))
    return (*_command(stored, samples, law, channels, closed=test.closed_loop), most)


def guessed_positions(
    samples: Samples, test: StoredTest, controller: Controller, channels: Channels
) -> NDArray[np.int64]:
    """Ticks of a closed loop whose current follows from an unknown position."""
    stored = _fit_length(test.command(), samples.ticks)
    law = control_law(controller, samples.period_ns * 1e-9)
    command, _ = _command(stored, samples, law, channels, closed=True)
    return np.flatnonzero(_positions_seen(command, samples, controller, channels)[1])


def _command(
    stored: Array, samples: Samples, law: ControlLaw, channels: Channels, *, closed: bool
) -> tuple[Array, float]:
    """Command that was acted on, and its resolution, A or m."""
    present = np.isfinite(samples.command)
    step = _resolution(samples.command[present])
    if closed and not present.any():
        step = _step_followed(stored, samples, law, channels)
    return np.where(present, samples.command, _as_sent(stored, step)), step


def _step_followed(stored: Array, samples: Samples, law: ControlLaw, channels: Channels) -> float:
    """Resolution of commands without frames, m: that which the measured current follows."""
    seen = np.concatenate([[np.nan], _as_digitised(samples.position[:-1], channels.position.lsb)])
    present = np.isfinite(seen)
    if not present.any():
        return 0.0
    ticks = np.arange(len(seen))
    bridged = np.interp(ticks, ticks[present], seen[present])
    at_end = samples.saturated[0] | (np.abs(samples.current) > law.IM - channels.current.grain)
    measured = np.where(present & ~at_end, samples.current, np.nan)
    return resolution_by_current(
        stored,
        lambda command: control_currents(law, command - bridged),
        measured,
        channels.position.lsb,
    )


def _as_digitised(position: Array, lsb: float) -> Array:
    """Positions of the converter, where a bus of another scale has rounded them once more.

    The control law worked on the converter's codes. What lies near none of its steps was measured
    by something else, and stays.
    """
    nearest = np.round(position / lsb) * lsb
    away = np.abs(position - nearest)[np.isfinite(position)] / lsb
    if (
        away.size == 0
        or away.max() < NUMERICAL_ZERO
        or np.quantile(away, 0.99) > COMMANDS.rescaled_tolerance_lsb
    ):
        return position
    return np.asarray(nearest)


def _guessed_share(unknown: NDArray[np.bool_], longest: int) -> float:
    """Share of ticks that are unknown; of a hole no more than its first `longest` ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], unknown.astype(np.int8), [0]])))
    lengths = edges[1::2] - edges[::2]
    return float(np.minimum(lengths, longest).sum()) / max(len(unknown), 1)


def _fit_length(command: Array, n: int) -> Array:
    """Cut the stored command to n ticks, or hold its last value."""
    if len(command) >= n:
        return command[:n]
    return np.concatenate([command, np.full(n - len(command), command[-1])])


def _resolution(sent: Array) -> float:
    """Smallest distance between two values sent; 0 of too few."""
    levels = np.unique(sent)
    return 0.0 if levels.size < RECORDING.min_samples else float(np.diff(levels).min())


def _as_sent(stored: Array, resolution: float) -> Array:
    """Round the stored command to the resolution of the command frames.

    The flight-control computer acts on what the frame says.
    """
    if resolution == 0.0:
        return stored
    return np.asarray(np.round(stored / resolution) * resolution)


def _positions_seen(
    command: Array, samples: Samples, controller: Controller, channels: Channels
) -> tuple[Array, NDArray[np.bool_]]:
    """Digitised jack position that each tick's control law worked on, m, shape (n,).

    Also the ticks whose position was lost and is bridged over: the sensor's noise in that sample,
    which the control law turned into current, is unknown. A current at its limit is none of
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


class CodeLimits(msgspec.Struct, frozen=True):
    """Limits by which a current tells the code of the position that it follows."""

    linear: float = 0.95
    """Largest demand at which the current follows the position, of the rated current, 1: a
    twentieth below it the noise of a current does not reach it."""
    limited: float = 1.2
    """Least demand at which the current stands at its limit, of the rated current, 1: noise of the
    position does not bring it back."""
    min_concentration: float = 0.5
    """Least mean of the positions' phases within a code, 1: 0.9 for noise of half a step of a
    12-bit current, 0.5 where it deviates by 0.19 codes, beyond which neighbours are mixed up."""
    max_spread_codes: float = 2.0
    """Largest deviation of the position measured from that acted on, in codes of the computer's
    converter, 1: half a code of noise and rounding by both, and some of motion between them."""


CODES = CodeLimits()


def acquired_current(
    samples: Samples,
    acquired: Acquisition,
    test: StoredTest,
    controller: Controller,
    channels: Channels,
    computer: Channels,
) -> CurrentTrace:
    """Rebuild the current of a closed loop from what an acquisition measured.

    channels: converters of the acquisition; computer: those that the control law works with.
    """
    law, code = control_law(controller, samples.period_ns * 1e-9), computer.position.lsb
    command, step, deviation = command_of(test, samples, law, channels)
    before = _position_before(samples, acquired)
    measured = np.where(samples.saturated[0], np.nan, samples.current)
    if controller.GAI or controller.GAD or not controller.GAP:
        return _as_measured(measured, command, 0.0, controller, deviation, step)
    demand = controller.GAP * (command - before)
    limit = controller.IM
    limited = np.isfinite(measured) & (np.abs(demand) > CODES.limited * limit)
    offset = 0.0
    if limited.sum() >= ESTIMATION.min_samples:
        offset = float(np.median(measured[limited] - np.copysign(limit, demand[limited])))
    linear = np.isfinite(measured) & (np.abs(measured - offset) < CODES.linear * limit)
    if linear.sum() < ESTIMATION.min_ticks:
        return _as_measured(measured, command, offset, controller, deviation, step)
    acted = command - measured / controller.GAP
    seen, shift = acted + offset / controller.GAP, 0.0
    phase = np.mean(np.exp(2j * np.pi * acted[linear] / code))
    if abs(phase) >= CODES.min_concentration:
        place = float(np.angle(phase)) / (2.0 * np.pi)
        shift = float(np.rint(place + offset / (controller.GAP * code))) - place
        offset = shift * controller.GAP * code
        seen = np.rint(acted / code + shift) * code
        if not np.isfinite(samples.command).any():
            step = resolution_by_current(
                command,
                lambda other: np.clip(controller.GAP * (other - seen), -limit, limit),
                np.where(linear, measured, np.nan),
                code,
            )
            command = command if step == 0.0 else np.round(command / step) * step
    away = np.where(linear, seen - before, np.nan)
    if not np.isfinite(away).any():
        return _as_measured(measured, command, offset, controller, deviation, step)
    middle = float(np.nanmedian(away))
    seen = np.where(linear, seen, before + middle)
    current = np.clip(controller.GAP * (command - seen), -limit, limit)
    known = np.isfinite(current)
    current = np.where(known, current, np.interp(_ticks(current), _ticks(current)[known],
                                                 current[known]))  # fmt: skip
    spread = _kept_rms((away - middle)[np.isfinite(away)])
    residual = _kept_rms((measured - current - offset)[np.isfinite(measured)])
    if spread > CODES.max_spread_codes * code:
        residual = controller.GAP * spread
    return CurrentTrace(
        current,
        residual / channels.current.grain,
        offset,
        True,
        deviation,
        float(np.mean(np.isnan(measured) & (np.abs(demand) < limit))),
        step,
    )


def _ticks(values: Array) -> Array:
    return np.arange(len(values), dtype=np.float64)


def _position_before(samples: Samples, acquired: Acquisition) -> Array:
    """Measured position at the beginning of each tick, m: the computer's sample is of then."""
    share = acquired.lead / (samples.period_ns * 1e-9)
    position = samples.position
    at_end = position + share * np.gradient(position)
    return np.concatenate([[np.nan], at_end[:-1]])


def _as_measured(
    measured: Array,
    command: Array,
    offset: float,
    controller: Controller,
    deviation: float,
    step: float,
) -> CurrentTrace:
    """Take the measured current for the commanded one."""
    known = np.isfinite(measured)
    ticks = _ticks(command)
    current = np.interp(ticks, ticks[known], measured[known] - offset)
    current = np.clip(current, -controller.IM, controller.IM)
    return CurrentTrace(current, 0.0, offset, True, deviation, float(np.mean(~known)), step)
