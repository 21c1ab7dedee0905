"""Residuals and alarms for the live view of `ehadiag bit`; the verdict does without them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from ehadiag.cli.watch.alarm_log import now_text
from ehadiag.cli.watch.known import KnownUnit, as_new
from ehadiag.cli.watch.watcher import Heard, Watcher
from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import EhadiagError
from ehadiag.core.false_alarms import HOURS_BETWEEN
from ehadiag.core.stored_test import StoredTest
from ehadiag.live.snapshot import Alarm, Residuals
from firmware_iface.mapping.bus_map import BusMap

if TYPE_CHECKING:
    from firmware_iface.transport.frames import Frame

__all__ = ["InTest"]


class InTest:
    """Runs the monitoring model beside a test with what was known of the unit before it.

    One thread hands over frames; another may look. Whatever is wrong here, the test goes on: `why`
    says it.

    Parameters
    ----------
    actuator : Actuator
        Its data.
    bus_map : BusMap
        Which message and signal plays which role.
    tests : Iterable[StoredTest]
        Tests that the computer may run.
    find : Callable[[int], KnownUnit | None] | None
        Looks up what is known of a unit once the bus has said its serial number; None: nothing is
        looked up.
    """

    def __init__(
        self,
        actuator: Actuator,
        bus_map: BusMap,
        tests: Iterable[StoredTest],
        find: Callable[[int], KnownUnit | None] | None = None,
    ) -> None:
        self._find = find
        self._found: KnownUnit | None = None
        self._watcher: Watcher | None = None
        self._alarms: tuple[int, tuple[Alarm, ...]] = 0, ()
        self.why = ""
        """Why there are no residuals; empty where there are."""
        try:
            self._watcher = Watcher(
                actuator, bus_map, as_new(actuator), tests, HOURS_BETWEEN, self._take_alarm
            )
        except EhadiagError as error:
            self._end(error)

    @property
    def serial(self) -> int | None:
        """Serial number that the bus says; None before it did."""
        return None if self._watcher is None else self._watcher.said_serial

    @property
    def alarms(self) -> tuple[int, tuple[Alarm, ...]]:
        """How many there were, and all of them: a test is too short for many."""
        return self._alarms

    @property
    def residuals(self) -> Residuals | None:
        """What the monitor finds; None while it settles, and where `why` says why."""
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
        if self._find is not None and watcher.said_serial is not None:
            find, self._find = self._find, None
            # A long history takes its time; frames do not wait for it.
            threading.Thread(
                target=self._look_up,
                args=(find, watcher.said_serial),
                name="ehadiag-known",
                daemon=True,
            ).start()

    def _look_up(self, find: Callable[[int], KnownUnit | None], serial: int) -> None:
        try:
            self._found = find(serial)
        except EhadiagError as error:
            self.why = f"earlier diagnoses are not looked at: {error}"

    def _take_alarm(self, heard: Heard) -> None:
        count, before = self._alarms
        alarm = Alarm(time=now_text(), signal=heard.signal, side=heard.side, during=heard.during)
        # One object: a thread that looks sees both or neither.
        self._alarms = count + 1, (*before, alarm)

    def _end(self, error: EhadiagError) -> None:
        self._watcher, self.why = None, f"no residuals: {error}"
