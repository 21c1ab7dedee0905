"""Decides which converters a recording went through, and where they stood at their ends.

What the mapping states comes first, then the actuator file, then the step that the data show.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CHANNELS, Channel, Channels, Stated, near_ends
from ehadiag.core.converters import Converter
from ehadiag.core.recording import Samples
from ehadiag.core.step_seen import step_seen

__all__ = [
    "Conversion",
    "actuator_channels",
    "conversion_of",
    "range_is_stated",
    "reach_of",
    "stated_channels",
]

MARGIN = 1.25
"""Range over the actuator's own reach, of a converter of which nothing is known."""
SAME_STEP = 0.005
"""Relative distance within which a step that data show is the one that is expected."""
COARSEST = 4.0
"""Expected steps beyond which a step in the data is a damaged converter's, not a coarser one's."""


class Conversion(NamedTuple):
    """The converters of a recording.

    Attributes
    ----------
    channels : Channels
        Ranges and steps.
    saturated : NDArray[np.bool_]
        Shape (4, ticks): the converter stood at its end.
    """

    channels: Channels
    saturated: NDArray[np.bool_]


def actuator_channels(actuator: Actuator) -> Channels:
    """Converters of an actuator, as its file states them.

    Of one that it leaves out the range of PHY-23 is assumed, or 1.25 times the actuator's reach
    where that is beyond it, in 4096 steps.

    Parameters
    ----------
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    Channels
        Ranges and steps.
    """
    return stated_channels((), actuator)


def stated_channels(stated: tuple[Stated | None, ...], actuator: Actuator) -> Channels:
    """Converters as mapping and actuator file state them, see `actuator_channels`.

    Parameters
    ----------
    stated : tuple[Stated | None, ...]
        By the mapping, which comes first, of each channel; empty: nothing.
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    Channels
        Ranges and steps.
    """
    said = stated or (None,) * len(CHANNELS)
    own = (_of_file(actuator, channel) for channel in CHANNELS)
    return Channels(*(_told(item, channel) for item, channel in zip(said, own, strict=True)))


def range_is_stated(stated: Stated | None, actuator: Actuator, channel: Channel) -> bool:
    """Tell whether mapping (`stated`) or actuator file say what range a converter has."""
    return _converter(actuator, channel) is not None or (
        stated is not None and stated.low is not None
    )


def reach_of(actuator: Actuator, channel: Channel) -> float:
    """Return the largest value that a channel has on an actuator: current, stops, supply; SI."""
    return {
        "current": actuator.controller.IM,
        "spool": actuator.servovalve.XSM,
        "pressure": actuator.servovalve.PSR,
        "position": actuator.jack.XJM,
    }[channel.name]


def conversion_of(samples: Samples, actuator: Actuator) -> Conversion:
    """Converters that samples went through.

    A step that neither mapping nor actuator file states is the smallest one that the samples show,
    which may be coarser than the bus's own, or else the assumed one. A sample is at an end if the
    bus said so, or if it lies at the end of a range that is stated.

    Parameters
    ----------
    samples : Samples
        One test.
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    Conversion
        Converters, and which samples stood at their ends.
    """
    said = samples.stated or (None,) * len(CHANNELS)
    channels, saturated = [], samples.saturated
    for index, (item, channel) in enumerate(
        zip(said, stated_channels(samples.stated, actuator), strict=True)
    ):
        values = np.asarray(getattr(samples, channel.name))
        filed = _converter(actuator, channel) is not None
        if not filed and (item is None or item.step is None):
            channels.append(_seen(values, channel))
        else:
            channels.append(channel)
        low, high = (None, None) if item is None else (item.low, item.high)
        if filed and low is None:
            low, high = -channel.full_scale, channel.full_scale - channel.lsb
        if low is not None and high is not None:
            lower, upper = near_ends(low, high, channels[-1].lsb)
            at_end = (values <= lower) | (values >= upper)
            if (at_end & ~saturated[index]).any():
                saturated = saturated.copy()
                saturated[index] |= at_end
    return Conversion(Channels(*channels), saturated)


def _converter(actuator: Actuator, channel: Channel) -> Converter | None:
    """What the actuator file says of a converter, if anything."""
    if actuator.converters is msgspec.UNSET:
        return None
    found: Converter | msgspec.UnsetType = getattr(actuator.converters, channel.name)
    return None if found is msgspec.UNSET else found


def _of_file(actuator: Actuator, usual: Channel) -> Channel:
    item = _converter(actuator, usual)
    if item is not None:
        return replace(usual, full_scale=item.full_scale, levels=float(1 << item.bits))
    reach = reach_of(actuator, usual)
    return usual if reach <= usual.full_scale else replace(usual, full_scale=MARGIN * reach)


def _told(stated: Stated | None, channel: Channel) -> Channel:
    """A converter with what the mapping says of it in the place of what was known."""
    if stated is None:
        return channel
    if stated.low is not None and stated.high is not None:
        channel = replace(channel, full_scale=max(-stated.low, stated.high))
    if stated.step is not None:
        channel = replace(channel, levels=2.0 * channel.full_scale / stated.step)
    return channel


def _seen(values: NDArray[np.float64], channel: Channel) -> Channel:
    """A converter with the step that its values show, where that is another one."""
    step = step_seen(values)
    if step is None or step > COARSEST * channel.lsb:
        return channel
    if abs(step / channel.lsb - 1.0) <= SAME_STEP:
        return channel
    return replace(channel, levels=2.0 * channel.full_scale / step)
