"""Says how finely, and how far, the computer behind a mapping sees its actuator."""

from __future__ import annotations

from msgspec.structs import replace

from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import largest_value, range_is_stated, stated_channels
from firmware_iface.bus_map import BusMap, Role
from firmware_iface.codec import raw_ends
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import CHANNELS, DEFAULT_SCALES, Channel, Channels, Scales

RESOLUTION_TOLERANCE = 1e-9
"""Relative distance within which a resolution is that of the default bus."""


def scales_of(bus_map: BusMap, actuator: Actuator) -> Scales:
    """Return converters and resolution of commands for an emulated computer on a bus.

    bus_map: what it states of converters comes before the actuator file; its signals carry both;
    actuator: data of the actuator. Returns those of the default bus unless others are stated.
    ConfigurationError: a signal cannot carry the range of its converter, or the rated current.
    """
    stated_by_bus = bus_map.stated or (None,) * len(CHANNELS)
    channels = []
    for stated, channel in zip(
        stated_by_bus, stated_channels(bus_map.stated, actuator), strict=True
    ):
        found = bus_map.find(f"channels.{channel.name}")
        if found is not None:
            assumed = not range_is_stated(stated, actuator, channel)
            least = largest_value(actuator, channel) if assumed else channel.full_scale
            channels.append(_carried(bus_map, found[1], channel, least))
        else:
            channels.append(channel)
    current = bus_map.find("command.current")
    if current is not None:
        reach = actuator.controller.IM
        low, high = _signal_ends(current[1])
        if reach > min(-low, high) * (1.0 + RESOLUTION_TOLERANCE):
            raise ConfigurationError(
                f"bus {bus_map.name}: signal {current[1].signal.name} carries {1e3 * low:.5g} …"
                f" {1e3 * high:.5g} mA, the rated current of actuator {actuator.name!r} is"
                f" {1e3 * reach:g} mA: name a mapping whose command fits, --mapping"
            )
    return Scales(
        Channels(*channels),
        _step(current[1] if current else None, DEFAULT_SCALES.current_step),
        _step(
            found[1] if (found := bus_map.find("command.position")) else None,
            DEFAULT_SCALES.position_step,
        ),
    )


def _carried(bus_map: BusMap, role: Role, channel: Channel, least: float) -> Channel:
    """Return a converter within what its signal carries, which must be `least` (SI) either way."""
    low, high = _signal_ends(role)
    slack = abs(role.signal.scale * role.gain) + channel.lsb
    carried = max(min(-low, high + slack), 0.0)
    if carried >= channel.full_scale:
        return channel
    if carried >= least:
        return replace(channel, full_scale=min(-low, channel.full_scale))
    unit, per_unit = channel.unit, channel.per_unit
    raise ConfigurationError(
        f"bus {bus_map.name}: signal {role.signal.name} carries {low / per_unit:.5g} …"
        f" {high / per_unit:.5g} {unit}, {channel.name} reaches ±{least / per_unit:.5g} {unit} by"
        " the actuator file: name a mapping whose signals fit, --mapping, or state the converter's"
        " range in it, or in the actuator file's [converters]"
    )


def _signal_ends(role: Role) -> tuple[float, float]:
    """SI values of the ends of what a signal can carry."""
    if role.signal.is_float:
        return -float("inf"), float("inf")
    low, high = sorted(role.gain * value + role.bias for value in raw_ends(role.signal))
    return low, high


def _step(role: Role | None, usual: float) -> float:
    """Resolution of a signal, SI; that of the default bus to the last digit; 0 of a float."""
    if role is None:
        return usual
    if role.signal.is_float:
        return 0.0
    step = abs(role.signal.scale * role.gain)
    return usual if abs(step / usual - 1.0) <= RESOLUTION_TOLERANCE else step
