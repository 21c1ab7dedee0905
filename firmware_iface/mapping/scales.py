"""Says how finely, and how far, the computer behind a mapping sees its actuator."""

from __future__ import annotations

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import SCALES, Channel, Scales
from ehadiag.core.conversion import stated_channels
from ehadiag.core.errors import ConfigurationError
from firmware_iface.codec.decode import raw_ends
from firmware_iface.mapping.bus_map import BusMap, Role

__all__ = ["scales_of"]

SAME = 1e-9
"""Relative distance within which a resolution is that of the default bus."""


def scales_of(bus_map: BusMap, actuator: Actuator) -> Scales:
    """Return converters and resolution of commands for an emulated computer on a bus.

    Parameters
    ----------
    bus_map : BusMap
        What it states of converters comes before the actuator file; its signals carry both.
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    Scales
        Those of the default bus where nothing else is said.

    Raises
    ------
    ConfigurationError
        A signal cannot carry the range of its converter, or the rated current.
    """
    channels = stated_channels(bus_map.stated, actuator)
    for channel in channels:
        found = bus_map.find(f"channels.{channel.name}")
        if found is not None:
            _carries(bus_map, found[1], channel)
    current = bus_map.find("command.current")
    if current is not None:
        reach = actuator.controller.IM
        low, high = _span(current[1])
        if reach > min(-low, high) * (1.0 + SAME):
            raise ConfigurationError(
                f"bus {bus_map.name}: signal {current[1].signal.name} carries {1e3 * low:.5g} …"
                f" {1e3 * high:.5g} mA, the rated current of actuator {actuator.name!r} is"
                f" {1e3 * reach:g} mA: name a mapping whose command fits, --mapping"
            )
    return Scales(
        channels,
        _step(current[1] if current else None, SCALES.current_step),
        _step(
            found[1] if (found := bus_map.find("command.position")) else None, SCALES.position_step
        ),
    )


def _carries(bus_map: BusMap, role: Role, channel: Channel) -> None:
    """Refuse a signal whose numbers end before the converter does."""
    low, high = _span(role)
    slack = abs(role.signal.scale * role.gain) + channel.lsb
    if low <= -channel.full_scale + slack and high >= channel.full_scale - slack:
        return
    unit, per_unit = channel.unit, channel.per_unit
    raise ConfigurationError(
        f"bus {bus_map.name}: signal {role.signal.name} carries {low / per_unit:.5g} …"
        f" {high / per_unit:.5g} {unit}, the {channel.name} converter reaches"
        f" ±{channel.full_scale / per_unit:.5g} {unit}: name a mapping whose signals"
        " fit, --mapping, or state the converter's range in it, or in the actuator file's"
        " [converters]"
    )


def _span(role: Role) -> tuple[float, float]:
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
    return usual if abs(step / usual - 1.0) <= SAME else step
