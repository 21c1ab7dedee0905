"""One session of `ehadiag monitor`: reads the bus until the end, and says what happens."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ehadiag.cli.watch.alarm_log import AlarmLog, now_text
from ehadiag.cli.watch.call import AlarmCommand
from ehadiag.cli.watch.known import KnownUnit
from ehadiag.cli.watch.surroundings import Surroundings
from ehadiag.cli.watch.watcher import Heard, Watcher
from ehadiag.core.errors import BusLostError
from ehadiag.live.snapshot import Alarm, Bus, Ending, Snapshot
from ehadiag.live.traffic import Traffic

if TYPE_CHECKING:
    from firmware_iface.transport.interface import FrameSource

__all__ = ["Outlets", "WatchSession"]

POLL_S = 0.05
SHOWN = 8
"""Alarms that a snapshot holds."""


@dataclass(frozen=True, slots=True)
class Outlets:
    """Where alarms go, beside the screen."""

    log: AlarmLog
    surroundings: Surroundings
    command: AlarmCommand

    def close(self) -> None:
        """Finish recordings, calls and log."""
        self.surroundings.close()
        self.command.close()
        self.log.close()


class WatchSession:
    """Reads frames, hands them to the watcher, and its alarms to the outlets.

    Parameters
    ----------
    actuator_name : str
        For people.
    traffic : Traffic
        Counts the frames.
    outlets : Outlets
        Where alarms go.
    find : Callable[[int], KnownUnit | None] | None
        Looks up what is known of a unit once the bus has said its serial number; None: nothing is
        looked up.
    """

    def __init__(
        self,
        actuator_name: str,
        traffic: Traffic,
        outlets: Outlets,
        find: Callable[[int], KnownUnit | None] | None = None,
    ) -> None:
        self._actuator_name, self._traffic, self._outlets = actuator_name, traffic, outlets
        self._find = find
        self._alarms: tuple[int, tuple[Alarm, ...]] = 0, ()
        self._bus = Bus(name="", state="connecting")
        self._source: FrameSource | None = None
        self._silent = False
        self._notes: list[str] = []
        self.watcher: Watcher | None = None
        """Set before `run`."""
        self.lost_bus = ""
        """Why the bus failed; empty where it did not."""
        self.tell: Callable[[], None] = lambda: None
        """Called when something happened that readers of snapshots should see at once."""
        self.ended = False
        """Whether there is nothing more to watch."""

    def alarm(self, heard: Heard) -> None:
        """Bring an alarm to log, recording and command; InputOutputError where that fails."""
        outlets, watcher = self._outlets, self._the_watcher
        recorded = outlets.surroundings.record(heard.time_ns)
        event = outlets.log.write(
            "alarm",
            signal=heard.signal,
            side=heard.side,
            during=heard.during or None,
            mode=heard.mode.name.lower(),
            tick=heard.tick,
            frame_ns=heard.time_ns,
            serial=watcher.serial,
            actuator=self._actuator_name,
            recorded=recorded or None,
        )
        alarm = Alarm(
            time=event["time"],
            signal=heard.signal,
            side=heard.side,
            during=heard.during,
            recorded=recorded,
        )
        count, newest = self._alarms
        # One object: a thread that looks sees both or neither.
        self._alarms = count + 1, (*newest, alarm)[-SHOWN:]
        outlets.command.call(event)
        self.tell()

    def run(self, source: FrameSource, stop: threading.Event, end_s: float | None) -> None:
        """Watch until stopped, until the time is up, or until the bus or log ends.

        Parameters
        ----------
        source : FrameSource
            Where frames come from.
        stop : threading.Event
            Ends the session.
        end_s : float | None
            Time that it may take, s.

        Raises
        ------
        InputOutputError
            Log or recording cannot be written.
        """
        watcher, outlets, self._source = self._the_watcher, self._outlets, source
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
                frame = source.receive(POLL_S)
                if frame is None:
                    outlets.surroundings.idle()
                    if source.at_end:
                        break
                else:
                    self._traffic.take(len(frame.data), extended=frame.extended)
                    outlets.surroundings.take(frame)
                    watcher.take(frame)
                    if self._find is not None and watcher.said_serial is not None:
                        self._look_up(watcher.said_serial)
                if end_s is not None and source.now_ns() - begin >= end_s * 1e9:
                    break
        except BusLostError as error:
            self.lost_bus = str(error)
        self.ended = True
        outlets.log.write(
            "end",
            alarms=watcher.alarms,
            again=watcher.again,
            passing=watcher.passing,
            ticks=watcher.ticks,
            monitored=watcher.pushed,
            lost=watcher.lost,
            breaks=watcher.breaks,
            conflicts=watcher.conflicts,
            frames=self._traffic.frames,
            dropped=source.overflow,
            bus_lost=self.lost_bus or None,
        )

    def look(self, number: int) -> Snapshot:
        """Return a snapshot; another thread may call it."""
        watcher, (count, alarms) = self._the_watcher, self._alarms
        return Snapshot(
            number=number,
            time=now_text(),
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
            working="" if self.ended else f"watching; severities: {watcher.unit.source}",
            ending=self._ending() if self.ended else None,
            notes=tuple(self._notes),
        )

    @property
    def _the_watcher(self) -> Watcher:
        assert self.watcher is not None
        return self.watcher

    def _look_up(self, serial: int) -> None:
        """Exchange what is known of the unit for what a history says of this one, once."""
        find, self._find = self._find, None
        watcher, unit = self._the_watcher, find(serial) if find else None
        if unit is None:
            self._notes.append(f"the history has no diagnosis of serial number {serial}")
            self._outlets.log.write("unit", serial=serial, known=None)
            return
        watcher.take_over(unit)
        severities = {item.name: item.estimate for item in unit.severities}
        self._outlets.log.write("unit", serial=serial, known=unit.source, severities=severities)

    def _bus_now(self) -> Bus:
        source, watcher = self._source, self._the_watcher
        if source is None:
            return self._bus
        rate, load, silent = self._traffic.measure()
        state, detail = source.state.value, source.detail
        if self.lost_bus:
            state, detail = "failed", self.lost_bus
        elif silent and state == "open":
            state = "silent"
        if watcher.conflicts:
            detail = "; ".join(
                filter(None, (detail, f"{watcher.conflicts} conflicts: two senders"))
            )
        self._bus = Bus(
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
        watcher = self._the_watcher
        reasons = [self.lost_bus] if self.lost_bus else []
        if watcher.alarms:
            reasons.append(f"{watcher.alarms} alarms: the unit is not as it was")
            return Ending(verdict="ALARM", reasons=tuple(reasons))
        if not watcher.pushed:
            return Ending(verdict="NOT MONITORED", reasons=(*reasons, nothing_heard(self._traffic)))
        return Ending(verdict="NO ALARM", reasons=tuple(reasons))


def nothing_heard(traffic: Traffic) -> str:
    """Say why nothing was monitored."""
    if not traffic.frames:
        return "the bus was silent"
    return f"{traffic.frames} frames, but no ticks to monitor among them: see ehadiag check-bus"
