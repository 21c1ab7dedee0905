"""Sessions of the local page for its tests: functions that another process can import."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count
from typing import Any

from ehadiag.estimate import Severity
from ehadiag.live import Alarm, BusState, Ending, Residuals, RunningTest, Signals, Snapshot
from firmware_iface.errors import InputOutputError

__all__ = ["fail", "show_everything", "talk"]


def talk(command: str, actuator: str, snapshots: Callable[[Snapshot], None]) -> int:
    """Send snapshots until the session is stopped."""
    bus = BusState(name="none", state="open")
    try:
        for number in count(1):  # however late the stop comes
            snapshots(
                Snapshot(
                    number=number, time="", command=command, actuator=actuator, serial=7, bus=bus
                )
            )
            time.sleep(0.01)
    except KeyboardInterrupt:
        print("abort asked for")
        return 30
    return 0


def fail(_snapshots: Callable[[Snapshot], None]) -> int:
    """Fail as a bus that cannot be opened."""
    raise InputOutputError("no such bus")


def show_everything(text: str, snapshots: Callable[[Snapshot], None]) -> int:
    """Send snapshots with a text in every place."""
    print(text)
    line: Any = tuple(float(item % 9) for item in range(100))
    try:
        for number in count(1):  # however late the stop comes
            snapshots(
                Snapshot(
                    number=number,
                    time="2026-03-01T12:00:00.000Z",
                    command="bit",
                    actuator=text,
                    serial=7,
                    bus=BusState(
                        name=text,
                        state="open",
                        detail=text,
                        frames=number,
                        rate_per_s=2000.0,
                        load=0.2,
                    ),
                    test=RunningTest(
                        name=text, phase="running", elapsed_s=2.0, duration_s=5.5, left_s=3.5
                    ),
                    mode="current",
                    signals=Signals(line, line, line, line, line, line, line),
                    residuals=Residuals(spool=-3.25, pressure=None, against=text, spool_below=1.0),
                    alarms=(Alarm(time=text, signal="spool", side="below", during=text),),
                    alarm_count=1,
                    severities=(Severity(name="FSS", estimate=0.3, std=0.01, source=text),),
                    working=text,
                    notes=(text,),
                    ending=Ending(verdict="DEGRADED", reasons=(text,)),
                )
            )
            time.sleep(0.1)
    except KeyboardInterrupt:
        return 0
    return 0
