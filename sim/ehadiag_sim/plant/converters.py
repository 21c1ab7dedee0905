"""Sensors and analogue-to-digital converters of the simulated plant."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CHANNELS, Channels
from ehadiag_sim.plant.conditions import Sensors, Strangers

__all__ = ["ChannelFault", "Converters"]


class ChannelFault(Protocol):
    """Damage to sensors or wires."""

    def __call__(self, tick: int, values: list[float], channels: Channels, /) -> None:
        """Change the four readings of a tick in place: A, m, Pa, m; by shares of the ranges."""


class Converters:
    """The four channels of one unit: bend, gain, damage, offset, noise, rounding, in that order.

    Parameters
    ----------
    actuator : Actuator
        Its stops scale the bends.
    sensors : Sensors
        Gains, offsets, noise.
    strangers : Strangers
        Bends of the two displacement sensors.
    seed : int
        Of the noise.
    faults : Sequence[ChannelFault]
        Damage to sensors and wires, in turn; copied.
    channels : Channels
        Ranges and steps.
    """

    def __init__(
        self,
        actuator: Actuator,
        sensors: Sensors,
        strangers: Strangers,
        seed: int,
        faults: Sequence[ChannelFault] = (),
        channels: Channels = CHANNELS,
    ) -> None:
        self._channels = channels
        self._lsb = np.array([channel.lsb for channel in channels])
        self._half = np.array([channel.half for channel in channels])
        self._top = 2 * self._half - 1
        self._noise_lsb = sensors.noise_lsb
        self._offsets = np.array(sensors.offsets_lsb)
        self._gains = 1.0 + np.array(sensors.gains)
        stops = actuator.servovalve.XSM, actuator.jack.XJM
        self._bent = any(
            (
                strangers.spool_bend_2,
                strangers.spool_bend_3,
                strangers.jack_bend_2,
                strangers.jack_bend_3,
            )
        )
        self._second = np.array(
            [0.0, strangers.spool_bend_2 / stops[0], 0.0, strangers.jack_bend_2 / stops[1]]
        )
        self._third = np.array(
            [
                0.0,
                strangers.spool_bend_3 / stops[0] ** 2,
                0.0,
                strangers.jack_bend_3 / stops[1] ** 2,
            ]
        )
        self._faults = copy.deepcopy(tuple(faults))
        self._ticks = 0
        self._noise = np.random.default_rng(seed)

    def read(self, seen: tuple[float, float, float, float]) -> NDArray[np.float64]:
        """Current (A), spool (m), pressure (Pa), jack (m) as read without noise, shape (4,)."""
        return self._curved(seen) + self._offsets * self._lsb

    def digitise(self, seen: tuple[float, float, float, float]) -> NDArray[np.int64]:
        """ADC codes of the four channels, shape (4,); the noise goes on from call to call."""
        noise = self._noise_lsb * self._noise.standard_normal(len(CHANNELS))
        readings = self._curved(seen)
        if self._faults:
            readings = self._damaged(readings)
        volts = readings + (self._offsets + noise) * self._lsb
        # `Channel.encode` for the four at once: the emulator does this a thousand times a second.
        codes = np.floor(volts / self._lsb + 0.5).astype(np.int64) + self._half
        return np.minimum(np.maximum(codes, 0), self._top)

    def _curved(self, seen: tuple[float, float, float, float]) -> NDArray[np.float64]:
        values = np.array(seen)
        if self._bent:
            values = values * (1.0 + values * (self._second + self._third * values))
        return values * self._gains

    def _damaged(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        values: list[float] = readings.tolist()
        for fault in self._faults:
            fault(self._ticks, values, self._channels)
        self._ticks += 1
        return np.array(values)
