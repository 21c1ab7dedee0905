"""Pushes what a bus brings into the monitor, in every mode, through tests and between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ehadiag.cli.watch.known import KnownUnit
from ehadiag.cli.watch.persistence import Persistence
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import stated_channels
from ehadiag.core.recording import BitState, CommandMode, Environment
from ehadiag.core.stored_test import StoredTest
from ehadiag.live.snapshot import Residuals, RunningTest, known
from ehadiag.live.trace import Trace
from ehadiag.monitor import FreeMotionMonitor, Monitor, undecided_spool
from ehadiag.monitor.plan import usual_noise
from firmware_iface.alignment.live_ticks import LiveTick, LiveTicks
from firmware_iface.codec.live_decode import LiveDecoder, checked_values
from firmware_iface.codec.live_messages import BitStatus
from firmware_iface.mapping.bus_map import BusMap, MessageMap

if TYPE_CHECKING:
    from firmware_iface.transport.frames import Frame

__all__ = ["Heard", "Watcher"]

SIDES = (("spool", "above"), ("spool", "below"), ("pressure", "above"), ("pressure", "below"))
"""Of the four sums, in the order of `Reading.alarmed`."""
LONG_LOSS = 20
"""Ticks lost in a row after which it settles again."""
PATIENCE_S = 1.0
"""So long it waits for oil and supply before it takes those of the actuator's file."""
NOTICED = (0.2e6, 0.2e6, 2.0)
"""Changes of supply and return pressure (Pa) and oil temperature (K) that make a new monitor."""
QUIET_S = 10.0
"""An alarm of one sum that comes sooner after the one before belongs to it."""
KEYS = ("supply_pressure", "return_pressure", "oil_temperature")
Key = tuple[int, bool]
"""Identifier of a message, and whether it is extended."""


@dataclass(frozen=True, slots=True)
class Heard:
    """An alarm as the watcher raises it."""

    signal: str
    side: str
    time_ns: int
    """Stamp of the frame that brought it."""
    tick: int
    """Since the monitor began."""
    during: str
    """Test that ran; empty between tests."""
    mode: CommandMode


class Watcher:
    """Follows one unit on one bus.

    One thread hands over frames; another may look at what was found, without a lock.

    Parameters
    ----------
    actuator : Actuator
        Its data.
    bus_map : BusMap
        Which message and signal plays which role.
    unit : KnownUnit
        What is known of it; `take_over` exchanges it.
    tests : Iterable[StoredTest]
        Tests that the computer may run.
    hours : float
        Mean time between false alarms, h.
    on_alarm : Callable[[Heard], None]
        Called for the first of several alarms of one sum that follow each other closely.

    Raises
    ------
    ConfigurationError
        The bus's ticks cannot be told from single frames; hours or severities out of range.
    """

    def __init__(
        self,
        actuator: Actuator,
        bus_map: BusMap,
        unit: KnownUnit,
        tests: Iterable[StoredTest],
        hours: float,
        on_alarm: Callable[[Heard], None],
    ) -> None:
        self._actuator, self._map, self._hours = actuator, bus_map, hours
        self._rate = actuator.controller.rate
        self._on_alarm = on_alarm
        self._live = LiveTicks(bus_map, mode=None)
        self._decoder = LiveDecoder(bus_map)
        self._tests = {test.id: test for test in tests}
        self._status_ids, self._environment = _roles(bus_map)
        self._told: dict[str, float] = {}
        self._made_for = Environment()
        self._other = False
        self._monitor: FreeMotionMonitor | None = None
        self._fresh = True
        self._missing = 0
        self._breaks = 0
        self._last: dict[int, int] = {}
        self._persistence = Persistence(self._rate)
        self._sums = [0.0] * len(SIDES)
        self._threshold = 1.0
        self._status: BitStatus | None = None
        self.unit = unit
        self.serial = unit.serial
        """As the bus says, else as what is known of the unit does."""
        self.said_serial: int | None = None
        """As the bus says; None before it did."""
        self.trace = Trace()
        self.ticks = 0
        """Since the beginning, lost ones too."""
        self.pushed = 0
        """Ticks that the monitor took with their spool, beyond those in which it settled."""
        self.alarms = 0
        """Raised; those that belong to the one before are not counted."""
        self.again = 0
        """Those that belong to the one before."""
        self.passing = 0
        """Alarms of the sums in free motion that did not last, or have not yet."""
        self._build()

    @property
    def lost(self) -> int:
        """Ticks whose telemetry did not come, or was damaged."""
        return self._live.lost

    @property
    def breaks(self) -> int:
        """Silences of more than a second."""
        return self._live.breaks

    @property
    def conflicts(self) -> int:
        """Counter values that came with different payloads: a second sender."""
        return self._live.conflicts

    @property
    def mode(self) -> CommandMode:
        """What the commands are."""
        return self._live.mode

    @property
    def environment(self) -> Environment:
        """Oil and supply that the monitor was made for."""
        return self._made_for

    def take_over(self, unit: KnownUnit) -> None:
        """Go on with what is known of the unit now; the monitor begins anew."""
        self.unit = unit
        self.serial = self.said_serial if self.said_serial is not None else unit.serial
        self._build()

    def take(self, frame: Frame) -> None:
        """Take a frame, in order of arrival."""
        key = (frame.can_id, frame.extended)
        if key in self._status_ids:
            content = self._decoder.decode(frame)
            if isinstance(content, BitStatus):
                self._hear(content)
        elif key in self._environment and not (frame.error or frame.remote):
            values = checked_values(self._environment[key], frame.data)
            if values is not None:
                self._told |= values
                self._other = self._other_environment()
        for tick in self._live.take(frame):
            self._push(tick, frame.time_ns)

    def test(self) -> RunningTest | None:
        """Return what the computer says of its built-in test; None before it said anything."""
        status = self._status
        if status is None:
            return None
        stored = self._tests.get(status.test_id or 0)
        duration = stored.duration if stored else None
        running = status.state is BitState.RUNNING
        left = max(duration - status.elapsed, 0.0) if running and duration is not None else None
        return RunningTest(
            name=_name(status, stored),
            number=status.test_id or None,
            phase=status.state.name.lower(),
            elapsed_s=status.elapsed,
            duration_s=duration,
            left_s=left,
        )

    def residuals(self) -> Residuals | None:
        """Return what the monitor finds; None while it settles."""
        monitor = self._monitor
        if monitor is None or not monitor.settled:
            return None
        spool, pressure = monitor.monitor.reading.residual.tolist()
        sums, self._sums = self._sums, [0.0] * len(SIDES)
        shares = [min(value / self._threshold, 1.0) for value in sums]
        return Residuals(
            spool=known(spool),
            pressure=known(pressure),
            against=self.unit.source,
            spool_above=shares[0],
            spool_below=shares[1],
            pressure_above=shares[2],
            pressure_below=shares[3],
        )

    def _hear(self, status: BitStatus) -> None:
        before, self._status = self._status, status
        if status.serial is not None:
            self.said_serial = self.serial = status.serial
        began = status.state is BitState.RUNNING
        if (
            self._monitor is not None
            and began
            and (before is None or before.state is not BitState.RUNNING)
        ):
            self._monitor.settle()

    def _push(self, tick: LiveTick, time_ns: int) -> None:
        self.ticks += 1
        live, monitor = self._live, self._monitor
        self.trace.take(self.ticks / self._rate, live.mode, tick.command, tick[1:])
        if monitor is None or self._other:
            self._build()
            monitor = self._monitor
            if monitor is None:
                return
        lost = math.isnan(tick.spool)
        self._missing = self._missing + 1 if lost else 0
        if live.breaks != self._breaks or self._missing == LONG_LOSS:
            self._breaks, self._fresh = live.breaks, True
        if self._fresh and not lost:
            self._fresh = False
            monitor.reset(tick.spool)
        monitor.follow(live.mode)
        reading = monitor.push(tick)
        if not monitor.settled:
            return
        self.pushed += not lost
        sums = self._sums
        for place, value in enumerate(reading.cusum.ravel().tolist()):
            sums[place] = max(sums[place], value)
        if reading.alarmed.any():
            lasts = self._persistence.take(self.ticks)
            tested = self._status is not None and self._status.state is BitState.RUNNING
            if not (lasts or tested):
                self.passing += 1
                return
            for place, raised in enumerate(reading.alarmed.ravel().tolist()):
                if raised:
                    self._raise(place, time_ns)

    def _raise(self, place: int, time_ns: int) -> None:
        self._sums[place] = self._threshold
        last = self._last.get(place)
        self._last[place] = self.ticks
        if last is not None and self.ticks - last < QUIET_S * self._rate:
            self.again += 1
            return
        self.alarms += 1
        signal, side = SIDES[place]
        status, during = self._status, ""
        if status is not None and status.state is BitState.RUNNING:
            during = _name(status, self._tests.get(status.test_id or 0))
        self._on_alarm(Heard(signal, side, time_ns, self.ticks, during, self._live.mode))

    def _build(self) -> None:
        """Make the monitor for the environment that the bus told, or that of the file in time."""
        told = self._environment_told()
        waits = bool(self._environment) and None in (told.supply_pressure, told.oil_temperature)
        if waits and self.ticks < PATIENCE_S * self._rate and self.ticks:
            return
        actuator, effects = self.unit.unit(self._actuator)
        noise, channels = self.unit.noise, stated_channels(self._map.stated, actuator)
        least = usual_noise(channels)
        monitor = Monitor(
            actuator,
            self.unit.faults,
            told,
            mode=self._live.mode,
            hours=self._hours,
            # A fit may take some of the noise for its own.
            noise=None if noise is None else (max(noise[0], least[0]), max(noise[1], least[1])),
            offsets=self.unit.offsets,
            effects=effects,
            channels=channels,
        )
        self._made_for, self._other = told, False
        self._threshold = monitor.design.threshold
        undecided = undecided_spool(actuator, self.unit.faults[2])
        made = FreeMotionMonitor(monitor, undecided, self.unit.offsets[0])
        # Before the first tick it is only tried: whether the numbers are in their ranges.
        self._monitor = made if self.ticks else None
        self._fresh = True

    def _environment_told(self) -> Environment:
        supply, drain, oil = (self._told.get(f"environment.{key}") for key in KEYS)
        return Environment(supply, drain, oil)

    def _other_environment(self) -> bool:
        told, made = self._environment_told(), self._made_for
        for key, least in zip(KEYS, NOTICED, strict=True):
            now, then = getattr(told, key), getattr(made, key)
            if now is not None and (then is None or abs(now - then) > least):
                return True
        return False


def _name(status: BitStatus, stored: StoredTest | None) -> str:
    return stored.name if stored else (f"number {status.test_id}" if status.test_id else "")


def _roles(
    bus_map: BusMap,
) -> tuple[frozenset[tuple[int, bool]], Mapping[tuple[int, bool], MessageMap]]:
    """Identifiers of the status messages, and messages of the environment by identifier."""
    status, environment = set(), {}
    for message in bus_map.messages.values():
        sections = {role.name.split(".")[0] for role in message.roles}
        if "status" in sections:
            status.add((message.can_id, message.extended))
        if "environment" in sections:
            environment[message.can_id, message.extended] = message
    return frozenset(status), environment
