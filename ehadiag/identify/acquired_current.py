"""Commanded current of a closed loop whose signals were measured separately.

The control law worked on the codes of the computer's own position converter, which nobody recorded.
The measured current tells them: at each tick it is that of one code. Where the codes are not to be
told the measured current itself is the input.
"""

from __future__ import annotations

import msgspec
import numpy as np

from ehadiag.compile.jit import Array
from ehadiag.identify.signals import CurrentTrace, command_of, resolution_by_current
from ehadiag.model.laws import control_law
from firmware_iface.recording import Acquisition, Channels, Samples
from firmware_iface.stored_test import Controller, StoredTest


class CodeLimits(msgspec.Struct, frozen=True):
    """Limits by which a current tells the code of the position that it follows."""

    linear: float = 0.95
    """Largest demand at which the current follows the position, of the rated current, 1."""
    limited: float = 1.2
    """Least demand at which the current stands at its limit, of the rated current, 1: noise of the
    position does not bring it back."""
    min_ticks: int = 100
    """Least number of such ticks, 1."""
    min_limited_ticks: int = 10
    """Least number of ticks at the limit that show the offset of the current, 1."""
    min_concentration: float = 0.5
    """Least mean of the positions' phases within a code, 1: 0.9 for noise of half a step of a
    12-bit current, 0.5 where it deviates by 0.19 codes, beyond which neighbours are mixed up."""
    max_spread_codes: float = 2.0
    """Largest deviation of the position measured from that acted on, in codes of the computer's
    converter, 1: half a code of noise and rounding by both, and some of motion between them."""
    trim: float = 0.98
    """Share of the ticks that the spread is of, 1: a handful may be of another tick."""


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
    if limited.sum() >= CODES.min_limited_ticks:
        offset = float(np.median(measured[limited] - np.copysign(limit, demand[limited])))
    linear = np.isfinite(measured) & (np.abs(measured - offset) < CODES.linear * limit)
    if linear.sum() < CODES.min_ticks:
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
    left = np.sort(np.abs(away - middle)[np.isfinite(away)])
    left = left[: max(1, int(CODES.trim * left.size))]
    spread = float(np.sqrt(np.mean(left**2)))
    rest = np.sort(np.abs(measured - current - offset)[np.isfinite(measured)])
    rest = rest[: max(1, int(CODES.trim * rest.size))]
    residual = float(np.sqrt(np.mean(rest**2)))
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
