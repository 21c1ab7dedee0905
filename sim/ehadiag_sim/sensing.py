"""Sensors and converters of the simulated unit, and what broken sensors and wires read.

Damage strikes before conversion, so that the control law works on the damaged jack position.
Each kind keeps its own past; a plant takes copies, so that every test begins with fresh ones.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag_sim.conditions import Sensors, UnmodelledEffects
from firmware_iface.recording import CHANNELS, Channels


class ChannelFault(Protocol):
    """Damage to sensors or wires."""

    def __call__(self, tick: int, values: list[float], channels: Channels, /) -> None:
        """Change the four readings of a tick in place: A, m, Pa, m; by shares of the ranges."""


class SimulatedConverters:
    """The four channels of one unit: bend, gain, damage, offset, noise, rounding, in that order.

    actuator: its stops scale the bends; sensors: gains, offsets, noise; unmodelled: bends of the
    two displacement sensors; seed: of the noise; faults: damage to sensors and wires, in turn;
    copied; channels: ranges and steps.
    """

    def __init__(
        self,
        actuator: Actuator,
        sensors: Sensors,
        unmodelled: UnmodelledEffects,
        seed: int,
        faults: Sequence[ChannelFault] = (),
        channels: Channels = CHANNELS,
    ) -> None:
        self._channels = channels
        self._lsb = np.array([channel.lsb for channel in channels])
        self._half = np.array([channel.half for channel in channels])
        self._top = 2 * self._half - 1
        self._stops = actuator.servovalve.XSM, actuator.jack.XJM
        self.change(sensors, unmodelled)
        self._faults = copy.deepcopy(tuple(faults))
        self._ticks = 0
        self._noise = np.random.default_rng(seed)

    def change(self, sensors: Sensors, unmodelled: UnmodelledEffects) -> None:
        """Take other offsets, gains, bends and another noise from now on."""
        self._noise_lsb = sensors.noise_lsb
        self._offsets = np.array(sensors.offsets_lsb)
        self._gains = 1.0 + np.array(sensors.gains)
        stops = self._stops
        self._bent = any(
            (
                unmodelled.spool_bend_2,
                unmodelled.spool_bend_3,
                unmodelled.jack_bend_2,
                unmodelled.jack_bend_3,
            )
        )
        self._second = np.array(
            [0.0, unmodelled.spool_bend_2 / stops[0], 0.0, unmodelled.jack_bend_2 / stops[1]]
        )
        self._third = np.array(
            [
                0.0,
                unmodelled.spool_bend_3 / stops[0] ** 2,
                0.0,
                unmodelled.jack_bend_3 / stops[1] ** 2,
            ]
        )

    def read(self, seen: tuple[float, float, float, float]) -> Array:
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

    def _curved(self, seen: tuple[float, float, float, float]) -> Array:
        values = np.array(seen)
        if self._bent:
            values = values * (1.0 + values * (self._second + self._third * values))
        return values * self._gains

    def _damaged(self, readings: Array) -> Array:
        values: list[float] = readings.tolist()
        for fault in self._faults:
            fault(self._ticks, values, self._channels)
        self._ticks += 1
        return np.array(values)


@dataclass(slots=True)
class DeadSensor:
    """A dead channel: reads the same share of its half range whatever happens."""

    channel: int
    share: float = 0.0

    def __call__(self, _tick: int, values: list[float], channels: Channels) -> None:
        """Overwrite the reading."""
        values[self.channel] = self.share * channels[self.channel].full_scale


@dataclass(slots=True)
class ScaledSensor:
    """A reading times a factor; -1 is a reversed wire."""

    channel: int
    factor: float

    def __call__(self, _tick: int, values: list[float], _channels: Channels) -> None:
        """Scale the reading."""
        values[self.channel] *= self.factor


@dataclass(slots=True)
class DriftingSensor:
    """A reading that runs away, by so many half ranges a tick."""

    channel: int
    per_tick: float

    def __call__(self, tick: int, values: list[float], channels: Channels) -> None:
        """Add what has gathered."""
        values[self.channel] += self.per_tick * tick * channels[self.channel].full_scale


@dataclass(slots=True)
class FrozenSensor:
    """A reading that stands still from a tick on."""

    channel: int
    since: int
    _held: float | None = None

    def __call__(self, tick: int, values: list[float], _channels: Channels) -> None:
        """Hold the reading."""
        if tick >= self.since:
            if self._held is None:
                self._held = values[self.channel]
            values[self.channel] = self._held


@dataclass(slots=True)
class LateSensor:
    """A reading that comes some ticks late."""

    channel: int
    ticks: int
    _past: deque[float] = field(default_factory=deque)

    def __call__(self, _tick: int, values: list[float], _channels: Channels) -> None:
        """Give the old reading."""
        self._past.append(values[self.channel])
        values[self.channel] = self._past[0]
        if len(self._past) > self.ticks:
            self._past.popleft()


@dataclass(slots=True)
class SwappedWires:
    """Two wires exchanged: each converter gets the other's volts."""

    first: int
    second: int

    def __call__(self, _tick: int, values: list[float], channels: Channels) -> None:
        """Exchange the readings, each as a share of its half range."""
        ratio = channels[self.first].full_scale / channels[self.second].full_scale
        one, other = values[self.first], values[self.second]
        values[self.first], values[self.second] = other * ratio, one / ratio


@dataclass(slots=True)
class LooseContact:
    """A reading that drops to zero for some ticks, repeatedly."""

    channel: int
    every: int
    length: int
    since: int = 0

    def __call__(self, tick: int, values: list[float], _channels: Channels) -> None:
        """Drop the reading while the contact is open."""
        if (tick - self.since) % self.every < self.length and tick >= self.since:
            values[self.channel] = 0.0


@dataclass(slots=True)
class LostLowBits:
    """A converter that lost its low bits: steps of so many LSB."""

    channel: int
    codes: int

    def __call__(self, _tick: int, values: list[float], channels: Channels) -> None:
        """Round the reading."""
        step = self.codes * channels[self.channel].lsb
        values[self.channel] = step * round(values[self.channel] / step)


@dataclass(slots=True)
class SpikingSensor:
    """Single readings off by so many half ranges, one every so many ticks, signs in turn."""

    channel: int
    every: int
    share: float

    def __call__(self, tick: int, values: list[float], channels: Channels) -> None:
        """Add a spike when its tick has come."""
        if tick % self.every == self.every - 1:
            sign = 1.0 if tick // self.every % 2 else -1.0
            values[self.channel] += sign * self.share * channels[self.channel].full_scale


@dataclass(slots=True)
class MainsHum:
    """A sine of the mains or the aircraft's supply on a reading; cycles a tick, half ranges."""

    channel: int
    per_tick: float
    share: float

    def __call__(self, tick: int, values: list[float], channels: Channels) -> None:
        """Add the sine."""
        sine = math.sin(2.0 * math.pi * self.per_tick * tick)
        values[self.channel] += self.share * channels[self.channel].full_scale * sine
