"""The detailed actuator simulator: plant, sensors and control law, tick by tick or a whole test.

Also how finely, and how far, the computer behind a mapping sees its actuator.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import (
    actuator_channels,
    largest_value,
    range_is_stated,
    stated_channels,
)
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S, PlantDynamics
from ehadiag_sim.plant_laws import PositionController
from ehadiag_sim.sensing import ChannelFault, SimulatedConverters
from firmware_iface.bus_map import BusMap, Role
from firmware_iface.codec import raw_ends
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import (
    CHANNELS,
    DEFAULT_SCALES,
    BitOutcome,
    BitState,
    Channel,
    Channels,
    CommandMode,
    Environment,
    MessageCounts,
    Quality,
    Recording,
    Samples,
    Scales,
    StatedConverter,
)
from firmware_iface.stored_test import StoredTest

if TYPE_CHECKING:
    from ehadiag_sim.foreign_plant import ForeignPlant, ForeignRun


class Plant:
    """One actuator with its converters and control law, at rest in the middle to begin with.

    In each tick the control law works on the jack position that was digitised at the end of the
    tick before, its current is held for the tick, and at the end all channels are digitised.

    actuator: data of the actuator; faults: severities of the three faults; None: as new; effects:
    effects besides the faults; None: none of them, default oil and supply; sensors: how the
    converters err; None: the specified noise, no offsets; seed: seed of the noise; the same seed
    gives the same samples; step: integration step, s; channel_faults: damage to the readings of the
    channels; None: none; scales: converters, and resolution of commands; None: the converters of
    the actuator's file, the resolution of the default bus; foreign: plant of another maker; None:
    the detailed simulator. ConfigurationError: a step that is not
    finite or not within 1 ns … one tick; sensors sampled a tick early or more.
    """

    def __init__(
        self,
        actuator: Actuator,
        faults: Faults | None = None,
        effects: Effects | None = None,
        sensors: Sensors | None = None,
        seed: int = 0,
        *,
        step: float = DEFAULT_STEP_S,
        channel_faults: Sequence[ChannelFault] = (),
        scales: Scales | None = None,
        foreign: ForeignPlant | None = None,
    ) -> None:
        self._scales = scales or Scales(actuator_channels(actuator))
        sensors, effects = sensors or Sensors(), effects or Effects()
        self._dynamics: PlantDynamics | ForeignRun
        if foreign is None:
            self._dynamics = PlantDynamics(
                actuator,
                faults,
                effects,
                step,
                filter_time=sensors.filter_time,
                early=sensors.early,
            )
        else:
            tick = 1.0 / actuator.controller.rate
            self._dynamics = foreign.begin(tick, faults or Faults(), effects, sensors)
        self._converters = SimulatedConverters(
            actuator, sensors, effects.unmodelled, seed, channel_faults, self._scales.channels
        )
        self._effects, self._sensors = effects, sensors
        self._controller = PositionController(actuator.controller)
        self._current = 0.0
        self._codes = self._converters.digitise(self._dynamics.seen)

    def change(self, faults: Faults, effects: Effects, sensors: Sensors) -> None:
        """Take other conditions from now on.

        Number of plays, time constant of the filters and instant of sampling stay.
        """
        self._effects, self._sensors = effects, sensors
        self._dynamics.change(faults, effects)
        self._converters.change(sensors, effects.unmodelled)

    def close(self) -> None:
        """Free what another maker's plant holds; the run is over."""
        if not isinstance(self._dynamics, PlantDynamics):
            self._dynamics.close()

    def tick(self, command: float, mode: CommandMode) -> NDArray[np.int64]:
        """Advance by one control tick; return the four ADC codes at its end, shape (4,).

        `command` in A (current mode) or m (position mode), taken at the bus's resolution.
        """
        command = _rounded(command, _resolution(self._scales, mode))
        measured = float(self._scales.channels.position.decode(self._codes[3:])[0])
        self._current = self._controller.current(command, mode, measured)
        self._dynamics.advance(self._current)
        self._codes = self._converters.digitise(self._dynamics.seen)
        return self._codes

    @property
    def scales(self) -> Scales:
        """Converters, and resolution of commands."""
        return self._scales

    @property
    def codes(self) -> NDArray[np.int64]:
        """ADC codes of the last tick (before the first: of the plant at rest), shape (4,)."""
        return self._codes

    @property
    def truth(self) -> tuple[float, float, float, float]:
        """Noise-free current (A), spool (m), pressure (Pa), jack position (m) now."""
        plant = self._dynamics
        return self._current, plant.spool, plant.pressure, plant.position

    @property
    def probed(self) -> tuple[float, float, float]:
        """Supply and return pressure (Pa), oil temperature (degC) as the probes read them."""
        effects, sensors = self._effects, self._sensors
        return (
            effects.supply_pressure + sensors.supply_error,
            effects.return_pressure,
            self._dynamics.oil_temperature + sensors.temperature_error,
        )


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRun:
    """One simulated test: the truth and what the converters made of it."""

    test: StoredTest
    """The stored test that ran."""
    effects: Effects
    """The conditions it ran under."""
    command: Array
    """Command of each tick at the bus's resolution, A or m, shape (ticks,)."""
    current: Array
    """Noise-free A, m, Pa, m at the end of each tick, (ticks,)."""
    spool: Array
    pressure: Array
    position: Array
    codes: NDArray[np.int64]
    """ADC codes of the four channels as sampled in each tick, shape (4, ticks)."""
    environment: Environment
    """What the probes read half-way through the test, at the bus's resolution."""
    channels: Channels = CHANNELS
    """Converters that made the codes."""

    @property
    def samples(self) -> Samples:
        """The samples as a bus without losses delivers them; time stamps from zero."""
        decoded = [
            channel.decode(codes) for channel, codes in zip(self.channels, self.codes, strict=True)
        ]
        ends = np.array([2 * channel.half - 1 for channel in self.channels])[:, None]
        period_ns = round(1e9 / self.test.rate)
        return Samples(
            period_ns=period_ns,
            mode=self.test.command_mode,
            current=decoded[0],
            spool=decoded[1],
            pressure=decoded[2],
            position=decoded[3],
            command=self.command.copy(),
            saturated=(self.codes == 0) | (self.codes == ends),
            host_ns=np.arange(1, self.test.ticks + 1, dtype=np.int64) * period_ns,
            stated=tuple(
                StatedConverter(-c.full_scale, c.full_scale - c.lsb, c.lsb) for c in self.channels
            ),
        )

    def recording(self, source: str, serial: int | None = None) -> Recording:
        """Return the test as an acquisition without a fault would hand it over.

        `source` names it in results, `serial` is the number of the actuator if the bus says one.
        """
        samples = self.samples
        perfect = MessageCounts(received=samples.ticks, accepted=samples.ticks)
        counts = samples.saturated.sum(axis=1)
        return Recording(
            source=source,
            samples=samples,
            test_id=self.test.id,
            serial=serial,
            outcome=BitOutcome(state=BitState.COMPLETE),
            environment=self.environment,
            quality=Quality(
                messages={"ServoTelemetry": perfect, "ServoCommand": perfect},
                saturated={c.name: int(n) for c, n in zip(self.channels, counts, strict=True)},
            ),
        )


def simulate(
    actuator: Actuator,
    test: StoredTest,
    faults: Faults | None = None,
    effects: Effects | None = None,
    sensors: Sensors | None = None,
    *,
    seed: int = 0,
    step: float = DEFAULT_STEP_S,
    channel_faults: Sequence[ChannelFault] = (),
    scales: Scales | None = None,
    foreign: ForeignPlant | None = None,
) -> SimulatedRun:
    """Run a stored test from rest; the same seed gives the same run.

    Arguments are those of `Plant`; the integration step is shortened so that a whole number makes a
    tick. A step out of range, or test and controller at different rates, raise ConfigurationError.
    """
    refuse_other_rate(test, actuator)
    effects = effects or Effects()
    plant = Plant(
        actuator,
        faults,
        effects,
        sensors,
        seed,
        step=step,
        channel_faults=channel_faults,
        scales=scales,
        foreign=foreign,
    )
    command, mode = bus_command(test, plant.scales), test.command_mode
    truth = np.empty((4, test.ticks))
    codes = np.empty((4, test.ticks), dtype=np.int64)
    probed = plant.probed
    for tick, value in enumerate(command.tolist()):
        codes[:, tick] = plant.tick(value, mode)
        truth[:, tick] = plant.truth
        if tick == test.ticks // 2:
            probed = plant.probed
    return SimulatedRun(
        test=test,
        effects=effects,
        command=command,
        current=truth[0],
        spool=truth[1],
        pressure=truth[2],
        position=truth[3],
        codes=codes,
        environment=_on_the_bus(*probed),
        channels=plant.scales.channels,
    )


def refuse_other_rate(test: StoredTest, actuator: Actuator) -> None:
    """Raise ConfigurationError for a test at another rate than the controller's."""
    if test.rate != actuator.controller.rate:
        raise ConfigurationError(
            f"test {test.name!r} runs at {test.rate:g} Hz, the controller of actuator "
            f"{actuator.name!r} at {actuator.controller.rate:g} Hz"
        )


def bus_command(test: StoredTest, scales: Scales = DEFAULT_SCALES) -> Array:
    """Command of each tick as the control computer holds it, SI (A or m), shape (ticks,).

    It has the resolution of the bus signal. The reference recordings show this: their currents
    follow the rounded command, and 2 µm of it are 0.6 LSB of current.
    """
    step = _resolution(scales, test.command_mode)
    if step == 0.0:
        return test.command()
    rounded: Array = np.rint(test.command() / step) * step
    return rounded


def _on_the_bus(supply: float, drain: float, degc: float) -> Environment:
    """Probes' readings as the bus carries them: 10 kPa and 0.1 K (`Environment` of the DBC)."""
    return Environment(
        supply_pressure=round(supply / 1e4) * 1e4,
        return_pressure=round(drain / 1e4) * 1e4,
        oil_temperature=round(10.0 * degc) / 10.0,
        temperature_std=0.1 / math.sqrt(12.0),
        supply_std=1e4 / math.sqrt(6.0),
    )


def _resolution(scales: Scales, mode: CommandMode) -> float:
    """Return that of commands, A or m: the computer acts on what its bus shows (BUS-8)."""
    return scales.current_step if mode is CommandMode.CURRENT else scales.position_step


def _rounded(command: float, step: float) -> float:
    return command if step == 0.0 else round(command / step) * step


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
