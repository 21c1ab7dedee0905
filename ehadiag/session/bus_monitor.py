"""Monitors one unit on one bus, in every mode, through tests and between them.

During a test the sums of the residuals alarm at once; free motion is tested for changes that last,
with a name for what changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING

import msgspec

from ehadiag.assess.acceptance import objections_to_environment
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import finite
from ehadiag.core.conversion import stated_channels
from ehadiag.estimate import Severity
from ehadiag.live import Residuals, RunningTest, SignalTrace
from ehadiag.monitor.change_test import LEAST, Cause, ChangeTest
from ehadiag.monitor.plan import default_noise
from ehadiag.monitor.score_bank import ScoreBank
from ehadiag.monitor.streaming import FreeMotionMonitor, Monitor, undecided_spool, undecided_travel
from ehadiag.session.unit_state import UnitState
from firmware_iface.alignment.grid import StretchTicks
from firmware_iface.bus_map import BusMap, MessageMap
from firmware_iface.errors import ConfigurationError
from firmware_iface.live_decode import (
    BitStatus,
    LiveDecoder,
    LiveTick,
    LiveTicks,
    checked_values,
    counter_key,
)
from firmware_iface.recording import BitState, CommandMode, Environment
from firmware_iface.slow_values import SlowValueWatch
from firmware_iface.stored_test import StoredTest

if TYPE_CHECKING:
    from firmware_iface.signals.recordings import DecodedItem
    from firmware_iface.transport.frames import Frame

CUSUM_SIDES = (("spool", "above"), ("spool", "below"), ("pressure", "above"), ("pressure", "below"))
"""Signal and side of the four sums, in the order of `Reading.alarmed`."""
ENVIRONMENT_KEYS = ("supply_pressure", "return_pressure", "oil_temperature")


class MonitorAlarm(msgspec.Struct, frozen=True):
    """An alarm as the monitor raises it."""

    signal: str
    """`spool` or `pressure` of a sum that alarmed during a test, else empty."""
    side: str
    causes: tuple[Cause, ...]
    """Of a change in free motion, the most likely one first."""
    time_ns: int
    """Time stamp of the frame that led to it, ns."""
    tick: int
    """Number of the tick since the monitor began."""
    during: str
    """Name of the running test; empty between tests."""
    mode: CommandMode


class BusMonitor:
    """Follows one unit on one bus.

    One thread hands over frames, or decoded ticks; another may look at what was found, without a
    lock.

    unit: its state before; `take_over` exchanges it; tests: tests that the computer may run; hours:
    mean time between false alarms, h; least: least change of a severity worth an alarm, 1; None:
    free motion is not tested for changes; on_alarm: called for each alarm that repeats none.
    ConfigurationError: the bus's ticks cannot be told from single frames; hours, least or
    severities out of range.
    """

    def __init__(
        self,
        actuator: Actuator,
        bus_map: BusMap,
        unit: UnitState,
        tests: Iterable[StoredTest],
        hours: float,
        on_alarm: Callable[[MonitorAlarm], None],
        least: float | None = LEAST,
    ) -> None:
        self._actuator, self._map, self._hours = actuator, bus_map, hours
        self._least = least
        self._rate = actuator.controller.rate
        self._on_alarm = on_alarm
        self._live = _ticks_of(bus_map, whole=least is None)
        self._decoder = LiveDecoder(bus_map)
        self._tests = {test.id: test for test in tests}
        self._status_ids, self._environment = _role_messages(bus_map)
        self._environment_values: dict[str, float] = {}
        self._environment_watches = {
            key: SlowValueWatch(item) for key, item in self._environment.items()
        }
        self._averaged: dict[str, list[float]] = {}
        self._environment_span = round(0.5 * self._rate)
        self._made_for = Environment()
        self._monitor: FreeMotionMonitor | None = None
        self._changes: ChangeTest | None = None
        self._fresh = True
        self._missing = 0
        self._breaks = 0
        self._time_ns = 0
        self._last: dict[int, int] = {}
        self._sums = [0.0] * len(CUSUM_SIDES)
        self._threshold = 1.0
        self._status: BitStatus | None = None
        self._stranger = ""
        self.unit = unit
        self.serial = unit.serial
        """Serial number on the bus, else that of the unit's state."""
        self.bus_serial: int | None = None
        """Serial number on the bus; None before it came."""
        self.trace = SignalTrace()
        self.ticks = 0
        """Number of ticks since the beginning, lost ones too."""
        self.pushed = 0
        """Number of ticks with a spool position after the monitor had settled."""
        self.environment_count = 0
        """Number of messages with oil or supply."""
        self.environment_left_out = 0
        """Number of those in which two senders are seen: the file's values hold in their place; or
        with values out of range: the last ones in range hold."""
        self._environment_conflicts = 0
        self.alarms = 0
        """Number of alarms, without repeated ones."""
        self.repeated = 0
        """Number of alarms that repeat one of the same sum or change."""
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
        """Counter values with different payloads, and frames of an environment in conflict."""
        return self._live.conflicts + self._environment_conflicts

    @property
    def mode(self) -> CommandMode:
        """Mode of the commands."""
        return self._live.mode

    @property
    def environment(self) -> Environment:
        """Oil and supply of the monitor."""
        return self._made_for

    def take_over(self, unit: UnitState) -> None:
        """Exchange the state of the unit; the monitor begins anew."""
        self.unit, self._stranger = unit, ""
        self.serial = self.bus_serial if self.bus_serial is not None else unit.serial
        self._build()

    def take(self, frame: Frame) -> None:
        """Take a frame, in order of arrival."""
        key = (frame.can_id, frame.extended)
        if key in self._status_ids:
            content = self._decoder.decode(frame)
            if isinstance(content, BitStatus):
                self.take_status(content)
        elif key in self._environment and not (frame.error or frame.remote):
            values = checked_values(self._environment[key], frame.data)
            if values is not None:
                self._take_environment(frame, values)
        for tick in self._live.take(frame):
            self._push(tick, frame.time_ns)
        self._time_ns = frame.time_ns

    def take_decoded(self, item: DecodedItem, time_ns: int) -> None:
        """Take a decoded tick, or what holds from the next one on, at this time (ns)."""
        if isinstance(item, Environment):
            self.environment_count += 1
            self._believe(
                {
                    f"environment.{key}": value
                    for key in ENVIRONMENT_KEYS
                    if (value := getattr(item, key)) is not None
                }
            )
        elif isinstance(item, CommandMode):
            self._live.mode = item
        else:
            tick = LiveTick(*item)
            self._live.lost += math.isnan(tick.spool)
            self._push(tick, time_ns)

    def take_status(self, status: BitStatus) -> None:
        """Take the state of the test: of the bus's own messages, or as another protocol says it."""
        before, self._status = self._status, status
        if status.serial is not None:
            if self.serial not in (None, status.serial) and not self._stranger:
                self._stranger = f"serial number {status.serial} on the bus, not {self.serial}"
                self._end_estimate()
            self.bus_serial = self.serial = status.serial
        began = status.state is BitState.RUNNING
        if (
            self._monitor is not None
            and began
            and (before is None or before.state is not BitState.RUNNING)
        ):
            self._monitor.settle()

    def finish(self) -> None:
        """Take the ticks that wait for further frames, where there are some."""
        if isinstance(self._live, StretchTicks):
            for tick in self._live.flush():
                self._push(tick, self._time_ns)

    def test(self) -> RunningTest | None:
        """Return the built-in test by the computer's status; None before the first status."""
        status = self._status
        if status is None:
            return None
        stored = self._tests.get(status.test_id or 0)
        duration = stored.duration if stored else None
        running = status.state is BitState.RUNNING
        left = max(duration - status.elapsed, 0.0) if running and duration is not None else None
        return RunningTest(
            name=_running_test_name(status, stored),
            number=status.test_id or None,
            phase=status.state.name.lower(),
            elapsed_s=status.elapsed,
            duration_s=duration,
            left_s=left,
        )

    def severities(self) -> tuple[tuple[Severity, ...], tuple[str, ...]]:
        """Return severities by free motion so far, and why some have no number."""
        return ((), ()) if self._changes is None else self._changes.flight.severities()

    def residuals(self) -> Residuals | None:
        """Return residuals and sums; None while the monitor settles."""
        monitor = self._monitor
        if monitor is None or not monitor.settled:
            return None
        spool, pressure = monitor.monitor.reading.residual.tolist()
        sums, self._sums = self._sums, [0.0] * len(CUSUM_SIDES)
        shares = [min(value / self._threshold, 1.0) for value in sums]
        return Residuals(
            spool=finite(spool),
            pressure=finite(pressure),
            against=self.unit.source,
            spool_above=shares[0],
            spool_below=shares[1],
            pressure_above=shares[2],
            pressure_below=shares[3],
        )

    def _take_environment(self, frame: Frame, values: dict[str, float]) -> None:
        """Take oil and supply; of two senders neither is believed, the file's values hold."""
        key = (frame.can_id, frame.extended)
        message, watch = self._environment[key], self._environment_watches[key]
        count = counter_key(message, message.counter, frame.data)
        self.environment_count += 1
        if watch.take(frame.time_ns, count[0] if count else None, frame.data, values):
            self.environment_left_out += 1
            self._environment_conflicts += 1
            self._environment_values.clear()
            self._averaged.clear()
            return
        self._believe(values)

    def _believe(self, values: Mapping[str, float]) -> None:
        found = self._in_range(values)
        self.environment_left_out += len(found) < len(values)
        self._environment_values |= found
        for name, value in found.items():
            self._averaged.setdefault(name, []).append(value)

    def _in_range(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values that the model may be run with; of the two pressures both or neither."""
        found = dict(values)
        held = self._environment_values | found
        for keys in (ENVIRONMENT_KEYS[:2], ENVIRONMENT_KEYS[2:]):
            roles = {f"environment.{key}" for key in keys}
            part = _environment_of({role: held[role] for role in roles & held.keys()})
            if objections_to_environment(part, self._actuator):
                found = {role: found[role] for role in found.keys() - roles}
        return found

    def _push(self, tick: LiveTick, time_ns: int) -> None:
        self.ticks += 1
        live, monitor = self._live, self._monitor
        self.trace.take(self.ticks / self._rate, live.mode, tick.command, tick[1:])
        if monitor is None:
            self._build()
            monitor = self._monitor
            if monitor is None:
                return
        elif self.ticks % self._environment_span == 0:
            self._tune(monitor)
        lost = math.isnan(tick.spool)
        self._missing = self._missing + 1 if lost else 0
        if live.breaks != self._breaks or self._missing == 20:
            self._breaks, self._fresh = live.breaks, True
        if self._fresh and not lost:
            self._fresh = False
            monitor.reset(tick.spool)
            if self._changes is not None:
                self._changes.reset()
        self._test_change(tick, time_ns)
        monitor.follow(live.mode)
        reading = monitor.push(tick)
        if not monitor.settled:
            return
        self.pushed += not lost
        sums = self._sums
        for place, value in enumerate(reading.cusum.ravel().tolist()):
            sums[place] = max(sums[place], value)
        if reading.alarmed.any():
            if not self._is_test_running():
                return
            for place, raised in enumerate(reading.alarmed.ravel().tolist()):
                if raised:
                    self._raise(place, time_ns)

    def _is_test_running(self) -> bool:
        return self._status is not None and self._status.state is BitState.RUNNING

    def _test_change(self, tick: LiveTick, time_ns: int) -> None:
        """Test free motion for a change."""
        changes = self._changes
        if changes is None:
            return
        found = changes.follow(self._live.mode) or changes.push(tick)
        if found is None:
            return
        if found.repeated:
            self.repeated += 1
            return
        self._alarm("", "", found.causes, time_ns)

    def _raise(self, place: int, time_ns: int) -> None:
        self._sums[place] = self._threshold
        last = self._last.get(place)
        self._last[place] = self.ticks
        # Within ten seconds of an alarm of one sum another one only repeats it.
        if last is not None and self.ticks - last < 10.0 * self._rate:
            self.repeated += 1
            return
        self._alarm(*CUSUM_SIDES[place], (), time_ns)

    def _alarm(self, signal: str, side: str, causes: tuple[Cause, ...], time_ns: int) -> None:
        self.alarms += 1
        status, during = self._status, ""
        if status is not None and self._is_test_running():
            during = _running_test_name(status, self._tests.get(status.test_id or 0))
        self._on_alarm(
            MonitorAlarm(signal, side, causes, time_ns, self.ticks, during, self._live.mode)
        )

    def _build(self) -> None:
        """Make the monitor for the environment on the bus, after a time for the file's."""
        environment = _environment_of(self._environment_values)
        waits = bool(self._environment) and None in (
            environment.supply_pressure,
            environment.oil_temperature,
        )
        # After a second those of the actuator's file hold.
        if waits and self.ticks < 1.0 * self._rate and self.ticks:
            return
        actuator, effects = self.unit.unit(self._actuator)
        channels = stated_channels(self._map.stated, actuator)
        calibration = actuator.calibration
        # What the model leaves of the unit as new is none of its changes.
        share = 1.0 if calibration is None else math.sqrt(1.0 + calibration.fit.left)
        least = default_noise(channels)
        measured = self.unit.noise or least
        monitor = Monitor(
            actuator,
            self.unit.faults,
            environment,
            mode=self._live.mode,
            hours=self._hours,
            # A fit may take some of the noise for its own.
            noise=(share * max(measured[0], least[0]), share * max(measured[1], least[1])),
            offsets=self.unit.offsets,
            effects=effects,
            channels=channels,
        )
        self._made_for = environment
        self._threshold = monitor.design.threshold
        friction = self.unit.faults[2]
        made = FreeMotionMonitor(
            monitor, undecided_spool(actuator, friction), self.unit.offsets[0],
            undecided_travel(actuator, friction),
        )  # fmt: skip
        # Before the first tick it only checks the ranges of the numbers.
        self._monitor = made if self.ticks else None
        self._changes = None
        if self._least is not None:
            bank = ScoreBank(
                actuator, self.unit.faults, mode=self._live.mode, offsets=self.unit.offsets,
                effects=effects, channels=channels,
            )  # fmt: skip
            self._changes = ChangeTest(bank, self._rate, self._hours, self._least)
            self._changes.tune(environment)
            self._end_estimate()
        self._fresh = True

    def _end_estimate(self) -> None:
        """State no severities where the monitor's offsets and effects are not this unit's."""
        why = self._stranger if self.unit.known else "the unit has no diagnosis"
        if why and self._changes is not None:
            self._changes.flight.begin_anew(why)

    def _tune(self, monitor: FreeMotionMonitor) -> None:
        """Take oil and supply on the bus, averaged since the last time."""
        means = {name: sum(values) / len(values) for name, values in self._averaged.items()}
        self._environment_values |= self._in_range(means)
        self._averaged.clear()
        environment = _environment_of(self._environment_values)
        if environment == self._made_for:
            return
        self._made_for = environment
        monitor.monitor.tune(environment)
        if self._changes is not None:
            self._changes.tune(environment)


def _environment_of(values: Mapping[str, float]) -> Environment:
    supply, drain, oil = (values.get(f"environment.{key}") for key in ENVIRONMENT_KEYS)
    return Environment(supply, drain, oil)


def _ticks_of(bus_map: BusMap, *, whole: bool) -> LiveTicks | StretchTicks:
    """Return what puts frames together into ticks.

    whole: single ticks are needed; a bus that does not tell them raises ConfigurationError.
    """
    try:
        return LiveTicks(bus_map, mode=None)
    except ConfigurationError:
        if whole:
            raise
        return StretchTicks(bus_map)


def _running_test_name(status: BitStatus, stored: StoredTest | None) -> str:
    return stored.name if stored else (f"number {status.test_id}" if status.test_id else "")


def _role_messages(
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
