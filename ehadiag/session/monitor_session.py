"""Sessions of the monitoring model on a bus: by itself, and during a built-in test."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Self

import msgspec

from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H, LEAST_MONITORED, date_text
from ehadiag.live import Alarm, BusState, BusTraffic, Ending, Residuals, SignalTrace, Snapshot
from ehadiag.monitor.change_test import LEAST
from ehadiag.session.alarm_outlets import AlarmCommand, AlarmLog, AlarmRecorder, utc_now_text
from ehadiag.session.bus_monitor import ENVIRONMENT_KEYS, BusMonitor, MonitorAlarm
from ehadiag.session.unit_state import UnitState, new_unit_state
from firmware_iface.bus_map import BusMap
from firmware_iface.errors import BusLostError, ConfigurationError, EhadiagError, printable
from firmware_iface.live_decode import LiveTick
from firmware_iface.recording import CommandMode, Environment
from firmware_iface.stored_test import StoredTest
from firmware_iface.transport.base import RECEIVE_POLL_S, TransportState
from firmware_iface.transport.frames import Frame

if TYPE_CHECKING:
    from ehadiag.result import Result
    from firmware_iface.live_decode import BitStatus
    from firmware_iface.signals.recordings import DecodedItem
    from firmware_iface.transport.base import FrameSource


class AlarmOutlets(msgspec.Struct, frozen=True):
    """Where alarms go, beside the screen; the context finishes them."""

    log: AlarmLog = msgspec.field(default_factory=AlarmLog)
    surroundings: AlarmRecorder = msgspec.field(default_factory=AlarmRecorder)
    command: AlarmCommand = msgspec.field(default_factory=AlarmCommand)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.surroundings.close()
        self.command.close()
        self.log.close()


class MonitorSummary(msgspec.Struct, frozen=True):
    """What came of watching a bus."""

    alarms: tuple[Alarm, ...]
    """The latest alarms, newest last."""
    alarm_count: int
    """Number of alarms; repeated ones are not counted."""
    repeated: int
    """Number of alarms that followed one of the same sum closely."""
    ticks: int
    """Ticks from the first to the last one, lost ones too."""
    monitored: int
    """Ticks that were compared with the model."""
    lost: int
    """Ticks whose telemetry was lost or damaged."""
    bus_lost: str
    """Why the bus failed; empty where it did not."""
    begun: str | None = None
    """Time of the first frame, UTC, ISO 8601; None: not known."""
    environment_left_out: float = 0.0
    """Share of the messages with oil or supply that were left out: second sender, or out of range,
    1."""
    enough: bool = False
    """Whether `least_monitored` of the ticks were monitored."""
    result: Result | None = None
    """Severities by free motion, without verdict; `reasons`: why some have no number."""

    @property
    def share(self) -> float:
        """Share of the ticks that were monitored, 1."""
        return self.monitored / self.ticks if self.ticks else 0.0


class DecodedSource:
    """Decoded signals in the place of a bus: one item after another, as fast as they come.

    items: see `firmware_iface.signals.recordings.DecodedItem`; name: of the source; tick_ns: length
    of a tick, ns; begin_ns: time of the first one.
    """

    state, detail, overflow = TransportState.OPEN, "", 0

    def __init__(
        self, items: Iterator[DecodedItem], name: str, tick_ns: int, begin_ns: int = 0
    ) -> None:
        self._items, self.name, self._tick_ns, self._now = items, name, tick_ns, begin_ns
        self.at_end = False

    def receive(self, _timeout: float) -> DecodedItem | None:
        """Return the next item, None at the end."""
        try:
            item = _checked_item(next(self._items))
        except StopIteration:
            self.at_end = True
            return None
        self._now += self._tick_ns * isinstance(item, tuple)
        return item

    def now_ns(self) -> int:
        """Time of the latest tick's end, ns."""
        return self._now


def _checked_item(item: DecodedItem) -> DecodedItem:
    """Return an item of plain numbers; ConfigurationError: it is no decoded item."""
    try:
        if isinstance(item, CommandMode):
            return item
        if isinstance(item, Environment):
            values = (getattr(item, key) for key in ENVIRONMENT_KEYS)
            supply, drain, oil = (None if value is None else float(value) for value in values)
            return Environment(supply, drain, oil)
        if isinstance(item, tuple):
            return LiveTick(*map(float, item))
    except (TypeError, ValueError, OverflowError):
        pass
    raise ConfigurationError(
        f"decoded item {printable(repr(item)[:80])}: need a Tick of five numbers,"
        " a CommandMode or an Environment"
    )


class MonitorSession:
    """Reads frames, hands them to the monitor, and its alarms to the outlets.

    unit: state of the unit before; tests: tests that the computer may run; outlets: where alarms
    go; hours: mean time between false alarms, h; least: least change of a severity worth an alarm,
    1; of_log: whether frames come from a log, whose times alarms then have; bitrate: of the bus,
    bit/s; None: unknown; find: looks up the state of a unit once the bus has its serial number;
    None: nothing is looked up; on_alarm: called for each alarm; least_monitored: share of the ticks
    below which too little was monitored. ConfigurationError: see `BusMonitor`.
    """

    def __init__(
        self,
        actuator: Actuator,
        bus_map: BusMap,
        unit: UnitState,
        tests: Iterable[StoredTest],
        outlets: AlarmOutlets,
        *,
        hours: float = FALSE_ALARM_INTERVAL_H,
        least: float = LEAST,
        of_log: bool = False,
        bitrate: float | None = None,
        find: Callable[[int], UnitState | None] | None = None,
        on_alarm: Callable[[Alarm], None] | None = None,
        least_monitored: float = LEAST_MONITORED,
    ) -> None:
        self._least_monitored = least_monitored
        self._actuator_name, self._outlets = actuator.name, outlets
        self._traffic = BusTraffic(bitrate)
        self._find, self._on_alarm, self._of_log = find, on_alarm, of_log
        self._alarms: tuple[int, tuple[Alarm, ...]] = 0, ()
        self._bus = BusState(name="", state="connecting")
        self._source: FrameSource | DecodedSource | None = None
        self.notes: list[str] = []
        """What the reader of snapshots should know else."""
        self._ended = False
        self._bus_lost = ""
        self._begun: str | None = None
        self._refresh: Callable[[], None] | None = None
        self.watcher = BusMonitor(actuator, bus_map, unit, tests, hours, self._take_alarm, least)

    def _take_alarm(self, raised: MonitorAlarm) -> None:
        """Bring an alarm to log, recording and command; InputOutputError where that fails."""
        outlets, watcher = self._outlets, self.watcher
        recorded = outlets.surroundings.record(raised.time_ns)
        moment = self._moment(raised.time_ns)
        event = outlets.log.write(
            "alarm",
            at=moment,
            signal=raised.signal or None,
            side=raised.side or None,
            causes=[
                {"name": item.name, "size": item.size, "stderr": item.stderr, "text": str(item)}
                for item in raised.causes
            ],
            during=raised.during or None,
            mode=raised.mode.name.lower(),
            tick=raised.tick,
            frame_ns=raised.time_ns,
            serial=watcher.serial,
            actuator=self._actuator_name,
            recorded=recorded or None,
        )
        alarm = Alarm(
            time=moment,
            signal=raised.signal,
            side=raised.side,
            causes=tuple(str(item) for item in raised.causes),
            during=raised.during,
            recorded=recorded,
        )
        count, newest = self._alarms
        # One object: a thread that makes a snapshot sees both or neither.
        self._alarms = count + 1, (*newest, alarm)[-8:]
        outlets.command.call(event)
        if self._on_alarm is not None:
            self._on_alarm(alarm)
        if self._refresh is not None:
            self._refresh()

    def _moment(self, time_ns: int) -> str:
        """Time of a frame: of a log its own, where that is a time of day; else that of now."""
        if not self._of_log:
            return utc_now_text()
        return date_text(time_ns) or f"{time_ns / 1e9:.3f} s"

    def run(
        self,
        source: FrameSource | DecodedSource,
        stop: threading.Event,
        end_s: float | None = None,
        refresh: Callable[[], None] | None = None,
    ) -> MonitorSummary:
        """Watch until stopped, until the time is up, or until the bus or log ends.

        source: where frames or decoded signals come from; end_s: longest duration, s; None: no
        limit; refresh: called after each alarm: readers of snapshots should see it at once. Returns
        alarms and numbers of ticks. InputOutputError: log or recording cannot be written.
        """
        watcher, outlets, self._source = self.watcher, self._outlets, source
        self._refresh = refresh
        outlets.log.write(
            "begin",
            bus=source.name,
            actuator=self._actuator_name,
            known=watcher.unit.source,
            severities={item.name: item.estimate for item in watcher.unit.severities},
        )
        begin = source.now_ns()
        try:
            while not stop.is_set():
                frame = source.receive(RECEIVE_POLL_S)
                if frame is None:
                    outlets.surroundings.idle()
                    if source.at_end:
                        break
                elif not isinstance(frame, Frame):
                    self._begin_at(begin)
                    if isinstance(frame, tuple):
                        self._traffic.take(0)
                    watcher.take_decoded(frame, source.now_ns())
                else:
                    self._begin_at(frame.time_ns)
                    self._traffic.take(len(frame.data), extended=frame.extended)
                    outlets.surroundings.take(frame)
                    watcher.take(frame)
                    if self._find is not None and watcher.bus_serial is not None:
                        self._look_up(watcher.bus_serial)
                if end_s is not None and source.now_ns() - begin >= end_s * 1e9:
                    break
        except BusLostError as error:
            self._bus_lost = str(error)
        watcher.finish()
        self._ended = True
        severities, why = watcher.severities()
        outlets.log.write(
            "end",
            alarms=watcher.alarms,
            again=watcher.repeated,
            ticks=watcher.ticks,
            monitored=watcher.pushed,
            lost=watcher.lost,
            breaks=watcher.breaks,
            conflicts=watcher.conflicts,
            environment_messages=watcher.environment_count,
            environment_left_out=watcher.environment_left_out,
            frames=self._traffic.frames,
            dropped=source.overflow,
            bus_lost=self._bus_lost or None,
            severities={
                item.name: {
                    "estimate": item.estimate,
                    "std": item.std,
                    "interval95": item.interval95,
                }
                for item in severities
            },
            not_stated=why,
        )
        count, newest = self._alarms
        return MonitorSummary(
            newest, count, watcher.repeated, watcher.ticks, watcher.pushed, watcher.lost,
            self._bus_lost, self._begun, self._environment_left_out, self._enough,
        )  # fmt: skip

    def _begin_at(self, time_ns: int) -> None:
        if not self._traffic.frames:
            self._begun = date_text(time_ns) if self._of_log else utc_now_text()

    @property
    def _environment_left_out(self) -> float:
        """Share of the messages with oil or supply that were left out, 1."""
        return self.watcher.environment_left_out / max(self.watcher.environment_count, 1)

    @property
    def _share(self) -> float:
        """Share of the ticks that were monitored, 1."""
        return self.watcher.pushed / max(self.watcher.ticks, 1)

    @property
    def _enough(self) -> bool:
        return self.watcher.pushed > 0 and self._share >= self._least_monitored

    def look(self, number: int) -> Snapshot:
        """Return a snapshot; another thread may call it."""
        watcher, (count, alarms) = self.watcher, self._alarms
        return Snapshot(
            number=number,
            time=utc_now_text(),
            command="monitor",
            actuator=self._actuator_name,
            serial=watcher.serial,
            bus=self._bus_now(),
            test=watcher.test(),
            mode=watcher.mode.name.lower() if watcher.ticks else None,
            signals=watcher.trace.signals(),
            residuals=watcher.residuals(),
            alarms=alarms,
            alarm_count=count,
            severities=watcher.unit.severities,
            working="" if self._ended else f"watching; severities: {watcher.unit.source}",
            ending=self._ending() if self._ended else None,
            notes=tuple(self.notes),
        )

    def _look_up(self, serial: int) -> None:
        """Exchange the state of the unit for that in the history, once."""
        find, self._find = self._find, None
        watcher, unit = self.watcher, find(serial) if find else None
        if unit is None:
            self.notes.append(f"the history has no diagnosis of serial number {serial}")
            self._outlets.log.write("unit", serial=serial, known=None)
            return
        watcher.take_over(unit)
        severities = {item.name: item.estimate for item in unit.severities}
        self._outlets.log.write("unit", serial=serial, known=unit.source, severities=severities)

    def _bus_now(self) -> BusState:
        source, watcher = self._source, self.watcher
        if source is None:
            return self._bus
        rate, load, silent = self._traffic.measure()
        state, detail = source.state.value, source.detail
        if self._bus_lost:
            state, detail = "failed", self._bus_lost
        elif silent and state == "open":
            state = "silent"
        if watcher.conflicts:
            detail = "; ".join(
                filter(None, (detail, f"{watcher.conflicts} conflicts: two senders"))
            )
        self._bus = BusState(
            name=source.name,
            state=state,
            detail=detail,
            frames=self._traffic.frames,
            rate_per_s=rate,
            load=load,
            lost=watcher.lost,
            dropped=source.overflow,
        )
        return self._bus

    def _ending(self) -> Ending:
        watcher = self.watcher
        reasons = [self._bus_lost] if self._bus_lost else []
        if watcher.environment_left_out:
            reasons.append(
                f"{self._environment_left_out:.0%} of the messages with oil and supply left out"
                " for a second sender or out of range: those before or of the actuator's file hold"
            )
        if watcher.alarms:
            reasons.append(f"{watcher.alarms} alarms: the unit is not as it was")
            return Ending(verdict="ALARM", reasons=tuple(reasons))
        if not watcher.pushed:
            decoded = isinstance(self._source, DecodedSource)
            why = not_monitored_reason(self._traffic, decoded=decoded)
            return Ending(verdict="NOT MONITORED", reasons=(*reasons, why))
        if not self._enough:
            reasons.append(
                f"{self._share:.0%} of the ticks only, {self._least_monitored:.0%} are needed"
            )
            return Ending(verdict="NOT MONITORED", reasons=tuple(reasons))
        return Ending(verdict="NO ALARM", reasons=tuple(reasons))


def not_monitored_reason(traffic: BusTraffic, *, decoded: bool) -> str:
    """Say why nothing was monitored; decoded: the traffic is ticks of decoded signals."""
    if decoded:
        return f"{traffic.frames} ticks of decoded signals, too few with a spool position to settle"
    if not traffic.frames:
        return "the bus was silent"
    return f"{traffic.frames} frames, but no ticks to monitor among them: see ehadiag check-bus"


class BitMonitor:
    """Monitors a unit during a test, with its state before the test.

    One thread hands over frames; another may look. An error here does not end the test: `why` has
    it.

    tests: tests that the computer may run; find: looks up the state of a unit once the bus has its
    serial number; None: nothing is looked up.
    """

    def __init__(
        self,
        actuator: Actuator,
        bus_map: BusMap,
        tests: Iterable[StoredTest],
        find: Callable[[int], UnitState | None] | None = None,
    ) -> None:
        self._find = find
        self._found: UnitState | None = None
        self._watcher: BusMonitor | None = None
        self._alarms: tuple[int, tuple[Alarm, ...]] = 0, ()
        self.why = ""
        """Why there are no residuals; empty where there are."""
        try:
            self._watcher = BusMonitor(
                actuator,
                bus_map,
                new_unit_state(actuator),
                tests,
                FALSE_ALARM_INTERVAL_H,
                self._take_alarm,
                None,
            )
        except EhadiagError as error:
            self._end(error)

    @property
    def serial(self) -> int | None:
        """Serial number on the bus; None before it came."""
        return None if self._watcher is None else self._watcher.bus_serial

    @property
    def alarms(self) -> tuple[int, tuple[Alarm, ...]]:
        """How many there were, and all of them: a test is too short for many."""
        return self._alarms

    @property
    def trace(self) -> SignalTrace | None:
        """Signals and command as the frames brought them; None where `why` has a reason."""
        return None if self._watcher is None else self._watcher.trace

    @property
    def residuals(self) -> Residuals | None:
        """Residuals and sums; None while the monitor settles, and where `why` has a reason."""
        watcher = self._watcher
        return None if watcher is None else watcher.residuals()

    def take(self, frame: Frame) -> None:
        """Take a frame, in order of arrival."""
        watcher = self._watcher
        if watcher is None:
            return
        try:
            if self._found is not None:
                watcher.take_over(self._found)
                self._found = None
            watcher.take(frame)
        except EhadiagError as error:
            self._end(error)
            return
        if self._find is not None and watcher.bus_serial is not None:
            find, self._find = self._find, None
            # A long history takes its time; frames do not wait for it.
            threading.Thread(
                target=self._look_up,
                args=(find, watcher.bus_serial),
                name="ehadiag-known",
                daemon=True,
            ).start()

    def take_status(self, status: BitStatus) -> None:
        """Take the state of the test where the bus's own messages do not say it."""
        if self._watcher is not None:
            self._watcher.take_status(status)

    def _look_up(self, find: Callable[[int], UnitState | None], serial: int) -> None:
        try:
            self._found = find(serial)
        except EhadiagError as error:
            self.why = f"earlier diagnoses are not looked at: {error}"

    def _take_alarm(self, raised: MonitorAlarm) -> None:
        count, before = self._alarms
        alarm = Alarm(
            time=utc_now_text(), signal=raised.signal, side=raised.side, during=raised.during
        )
        # One object: a thread that looks sees both or neither.
        self._alarms = count + 1, (*before, alarm)

    def _end(self, error: EhadiagError) -> None:
        self._watcher, self.why = None, f"no residuals: {error}"
