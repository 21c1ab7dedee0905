"""Tells a running session in plain lines: only what changed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ehadiag.live.snapshot import Alarm, Severity, Snapshot

__all__ = ["Lines"]

UNTOLD = ("connecting", "closed")
"""States of the bus at both ends of a session, which nobody needs to be told."""


class Lines:
    """Turns snapshots into lines, each said once."""

    def __init__(self) -> None:
        self._said: dict[str, str] = {}
        self._alarms = 0

    def of(self, snapshot: Snapshot) -> Iterator[str]:
        """Give the lines that a snapshot adds to those before."""
        bus = snapshot.bus
        if bus.state not in UNTOLD:
            detail = f": {bus.detail}" if bus.detail else ""
            yield from self._new("bus", f"bus {bus.name} {bus.state}{detail}")
        test = snapshot.test
        if test is not None and test.phase:
            name = f"test {test.name!r}" if test.name else "no test"
            yield from self._new("test", f"{name}: {test.phase}")
        if snapshot.severities:
            yield from self._new("severities", _severities(snapshot.severities))
        fresh = snapshot.alarm_count - self._alarms
        self._alarms = snapshot.alarm_count
        against = ""
        if snapshot.command == "bit" and snapshot.residuals is not None:
            against = f", compared with {snapshot.residuals.against}"
        for alarm in snapshot.alarms[len(snapshot.alarms) - min(fresh, len(snapshot.alarms)) :]:
            yield _alarm(alarm) + against
        for note in snapshot.notes:
            yield from self._new(note, note)
        if snapshot.ending is not None and snapshot.command == "monitor":
            reasons = "; ".join(snapshot.ending.reasons)
            yield from self._new(
                "ending", snapshot.ending.verdict + (f": {reasons}" if reasons else "")
            )

    def _new(self, key: str, text: str) -> Iterator[str]:
        if self._said.get(key) != text:
            self._said[key] = text
            yield text


def _severities(severities: Sequence[Severity]) -> str:
    each = (
        f"{item.name} {item.estimate:.4f}" + ("" if item.std is None else f" ± {item.std:.4f}")
        for item in severities
    )
    return f"{', '.join(each)} ({severities[0].source})"


def _alarm(alarm: Alarm) -> str:
    during = f" during test {alarm.during!r}" if alarm.during else ""
    recorded = f", recorded in {alarm.recorded}" if alarm.recorded else ""
    return f"ALARM {alarm.time}: {alarm.signal} {alarm.side} what the model says{during}{recorded}"
