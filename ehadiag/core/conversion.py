"""Decides which converters a recording went through, and where they stood at their ends.

What the mapping states comes first, then the actuator file, then the step that the data show.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, ConverterSpec
from firmware_iface.recording import (
    CHANNELS,
    Channel,
    Channels,
    Samples,
    StatedConverter,
    end_thresholds,
)


class StepLimits(msgspec.Struct, frozen=True):
    """Limits of the search for a converter's step in its values."""

    levels: int = 30
    """Least number of different values."""
    single: float = 1.6
    """Largest ratio of one step to the least one seen: a bus that rounds codes again varies it."""
    same: float = 1e-6
    """Share of the range within which two values are the same, in single precision."""
    deviation: float = 0.26
    """Steps by which a value may be off whole steps: a bus may round to half a step."""
    share: float = 0.99
    """Least share of the values that are off by no more."""
    tolerance: float = 0.005
    """Relative distance within which a step is the expected one."""
    ratio: float = 4.0
    """Expected steps beyond which a step is a damaged converter's, not a coarser one's."""


STEPS = StepLimits()


def observed_step(values: NDArray[np.float64]) -> float | None:
    """Return the step of which all values, less a constant, are whole multiples.

    values: samples of one channel, shape (n,); what is not finite does not count. Returns in the
    unit of the values; None: too few different values, or no such step, as in resampled or exact
    data.
    """
    known = values[np.isfinite(values)]
    levels = np.unique(known)
    if levels.size < STEPS.levels:
        return None
    distances = np.diff(levels)
    distances = distances[distances > STEPS.same * (levels[-1] - levels[0]) / STEPS.levels]
    if distances.size < STEPS.levels - 1:
        return None
    least = float(distances.min())
    step = float(distances[distances < STEPS.single * least].mean())
    # Steps are counted between neighbours: over more of them an error of the step would add up.
    for _ in range(3):
        number = np.cumsum(np.concatenate([[0.0], np.rint(np.diff(levels) / step)]))
        centred = number - number.mean()
        step = float(centred @ (levels - levels.mean())) / float(centred @ centred)
    origin = float(np.median(levels - number * step))
    off = np.abs(levels - origin - number * step) / step
    return step if float(np.mean(off <= STEPS.deviation)) >= STEPS.share else None


class Conversion(NamedTuple):
    """The converters of a recording."""

    channels: Channels
    saturated: NDArray[np.bool_]
    """Shape (4, ticks): the converter stood at its end."""


def actuator_channels(actuator: Actuator) -> Channels:
    """Converters of an actuator, as its file states them.

    A converter that the file leaves out has the range of PHY-23 or, where the channel's largest
    value is beyond it, 1.25 times that value, in 4096 steps.
    """
    return stated_channels((), actuator)


def stated_channels(stated: tuple[StatedConverter | None, ...], actuator: Actuator) -> Channels:
    """Converters as mapping and actuator file state them, see `actuator_channels`.

    stated: the mapping's statement on each channel, which comes first; empty: none on any.
    """
    statements = stated or (None,) * len(CHANNELS)
    own = (_channel_in_file(actuator, channel) for channel in CHANNELS)
    return Channels(
        *(_with_statement(item, channel) for item, channel in zip(statements, own, strict=True))
    )


def range_is_stated(stated: StatedConverter | None, actuator: Actuator, channel: Channel) -> bool:
    """Tell whether mapping (`stated`) or actuator file say what range a converter has."""
    return _converter_in_file(actuator, channel) is not None or (
        stated is not None and stated.low is not None
    )


def largest_value(actuator: Actuator, channel: Channel) -> float:
    """Return the largest value that a channel has on an actuator: current, stops, supply; SI."""
    return {
        "current": actuator.controller.IM,
        "spool": actuator.servovalve.XSM,
        "pressure": actuator.servovalve.PSR,
        "position": actuator.jack.XJM,
    }[channel.name]


def conversion_of(samples: Samples, actuator: Actuator) -> Conversion:
    """Converters that samples went through.

    Where neither mapping nor actuator file states a step, the samples show it, perhaps a coarser
    one than the bus has; else that of `actuator_channels` is assumed. A sample is at an end if the
    bus said so, or if it lies at the end of a range that is stated.

    Returns converters, and which samples stood at their ends.
    """
    statements = samples.stated or (None,) * len(CHANNELS)
    channels, saturated = [], samples.saturated
    for index, (item, channel) in enumerate(
        zip(statements, stated_channels(samples.stated, actuator), strict=True)
    ):
        values = np.asarray(getattr(samples, channel.name))
        in_file = _converter_in_file(actuator, channel) is not None
        if not in_file and (item is None or item.step is None):
            channels.append(_with_observed_step(values, channel))
        else:
            channels.append(channel)
        low, high = (None, None) if item is None else (item.low, item.high)
        if in_file and low is None:
            low, high = -channel.full_scale, channel.full_scale - channel.lsb
        if low is not None and high is not None:
            lower, upper = end_thresholds(low, high, channels[-1].lsb)
            at_end = (values <= lower) | (values >= upper)
            if (at_end & ~saturated[index]).any():
                saturated = saturated.copy()
                saturated[index] |= at_end
    return Conversion(Channels(*channels), saturated)


def _converter_in_file(actuator: Actuator, channel: Channel) -> ConverterSpec | None:
    """What the actuator file says of a converter, if anything."""
    if actuator.converters is msgspec.UNSET:
        return None
    found: ConverterSpec | msgspec.UnsetType = getattr(actuator.converters, channel.name)
    return None if found is msgspec.UNSET else found


def _channel_in_file(actuator: Actuator, usual: Channel) -> Channel:
    item = _converter_in_file(actuator, usual)
    if item is not None:
        return replace(usual, full_scale=item.full_scale, levels=float(1 << item.bits))
    largest = largest_value(actuator, usual)
    return usual if largest <= usual.full_scale else replace(usual, full_scale=1.25 * largest)


def _with_statement(stated: StatedConverter | None, channel: Channel) -> Channel:
    """A converter, with the range and step that the mapping states in place of its own."""
    if stated is None:
        return channel
    if stated.low is not None and stated.high is not None:
        channel = replace(channel, full_scale=max(-stated.low, stated.high))
    if stated.step is not None:
        channel = replace(channel, levels=2.0 * channel.full_scale / stated.step)
    return channel


def _with_observed_step(values: NDArray[np.float64], channel: Channel) -> Channel:
    """A converter with the step that its values show, unless as expected or far too coarse."""
    step = observed_step(values)
    if step is None or step > STEPS.ratio * channel.lsb:
        return channel
    if abs(step / channel.lsb - 1.0) <= STEPS.tolerance:
        return channel
    return replace(channel, levels=2.0 * channel.full_scale / step)
