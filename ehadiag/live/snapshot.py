"""One look at a running session: bus, test, signals, residuals, severities, verdict.

A session makes four of them a second (`ehadiag.live.publisher`); a screen, a log or a web page
shows them. Names say the unit. Where a value is not known it is None: neither `to_dict` nor
`to_json` ever holds NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import msgspec

from ehadiag.core.printable import printable

__all__ = [
    "SCHEMA",
    "Alarm",
    "Bus",
    "Ending",
    "Residuals",
    "RunningTest",
    "Severity",
    "Signals",
    "Snapshot",
    "known",
]

SCHEMA = "ehadiag.live/1"


def known(value: float | None) -> float | None:
    """Return a number as a snapshot holds it: None for NaN and the infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bus:
    """How the bus is."""

    name: str
    state: str
    """`connecting`, `open`, `silent` (no frame for a second), `degraded`, `failed`, `closed`."""
    detail: str = ""
    """One sentence on a state that is not open."""
    frames: int = 0
    """Received since the session began."""
    rate_per_s: float | None = None
    """Frames in the last second or so."""
    load: float | None = None
    """Share of the bit rate in use, 0 … 1, without stuff bits; None where no bit rate is known."""
    lost: int | None = None
    """Ticks whose telemetry did not come, or was damaged; None where nobody counts them."""
    dropped: int = 0
    """Frames that this program was too slow for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningTest:
    """The built-in test that is under way, or was last."""

    name: str
    number: int | None = None
    phase: str = ""
    """`requested`, `arming`, `running`, `trailing`, …; of a watched bus the state that the
    flight-control computer reports."""
    elapsed_s: float = 0.0
    """Since the test began to run."""
    duration_s: float | None = None
    """None where the test is not known here."""
    left_s: float | None = None
    """Until its end."""


@dataclass(frozen=True, slots=True)
class Signals:
    """The four signals and the command: a short history, the newest value last.

    All tuples are of one length, some ten seconds long and thinned out to some twenty values a
    second; None where a value was lost.
    """

    time_s: tuple[float, ...] = ()
    """Since the session began."""
    command_mA: tuple[float | None, ...] = ()
    """In current mode, else None."""
    command_mm: tuple[float | None, ...] = ()
    """In position mode, else None."""
    current_mA: tuple[float | None, ...] = ()
    spool_mm: tuple[float | None, ...] = ()
    pressure_MPa: tuple[float | None, ...] = ()
    position_mm: tuple[float | None, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Residuals:
    """What a monitor finds: measured less modelled, and the cumulative sums that raise alarms.

    Residuals are in units of noise, None where the sample was lost. Sums are shares of the
    threshold, 0 … 1: the largest since the snapshot before.
    """

    spool: float | None = None
    pressure: float | None = None
    against: str = ""
    """What the model goes by: a diagnosis, a calibration, a unit as new."""
    spool_above: float = 0.0
    spool_below: float = 0.0
    pressure_above: float = 0.0
    pressure_below: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """An alarm of a monitor."""

    time: str
    """UTC, ISO 8601."""
    signal: str
    """`spool` or `pressure`."""
    side: str
    """`above` or `below` what the model says."""
    during: str = ""
    """Name of the test that ran, empty between tests."""
    recorded: str = ""
    """File with the seconds around it; empty where there is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Severity:
    """A severity as far as it is known."""

    name: str
    """`Kintas`, `FSS` or `FDJ`."""
    estimate: float
    """0 … 1, not cut to it."""
    std: float | None = None
    """Standard deviation; None where nothing is said of it yet."""
    source: str = ""
    """Where it is from: the stage of the identification, or the result that was read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """How the session ended."""

    verdict: str
    """`HEALTHY`, `DEGRADED`, `FAULT`, `NOT TESTED`; of a monitor `ALARM` or `NO ALARM`."""
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """One look at a session.

    Texts are as others wrote them (names of actuators and tests); `to_dict` and `to_json` have them
    in one line without control characters. A page still has to escape its own markup.
    """

    number: int
    """Counts the snapshots of a session from 1: a greater one is newer."""
    time: str
    """UTC, ISO 8601."""
    command: str
    """`bit` or `monitor`."""
    actuator: str
    serial: int | None
    bus: Bus
    test: RunningTest | None = None
    mode: str | None = None
    """`current` or `position`: what the flight-control computer says that its commands are."""
    signals: Signals = field(default_factory=Signals)
    residuals: Residuals | None = None
    alarms: tuple[Alarm, ...] = ()
    """The latest, newest last."""
    alarm_count: int = 0
    severities: tuple[Severity, ...] = ()
    working: str = ""
    """What is worked out now, such as a stage of the identification."""
    ending: Ending | None = None
    """The verdict; None before the end."""
    notes: tuple[str, ...] = ()
    """What the reader should know else, one sentence each."""
    schema: str = SCHEMA

    def to_dict(self) -> dict[str, Any]:
        """Return the snapshot as plain dictionaries, lists, texts and numbers.

        Returns
        -------
        dict[str, Any]
            One key for each attribute; texts fit for a terminal.
        """
        tree: dict[str, Any] = _fit(msgspec.to_builtins(self))
        return tree

    def to_json(self) -> bytes:
        """Return the snapshot as one line of JSON without its end.

        Returns
        -------
        bytes
            UTF-8, strict JSON.
        """
        return msgspec.json.encode(self.to_dict())

    @classmethod
    def from_json(cls, line: bytes) -> Snapshot:
        """Read what `to_json` wrote.

        Parameters
        ----------
        line : bytes
            One object.

        Returns
        -------
        Snapshot
            The snapshot.

        Raises
        ------
        ValueError
            It is none.
        """
        try:
            return msgspec.json.decode(line, type=cls)
        except msgspec.MsgspecError as error:
            raise ValueError(f"no snapshot: {error}") from None


def _fit(tree: Any) -> Any:
    """Make all texts of a tree fit for a terminal and JSON."""
    if isinstance(tree, str):
        return printable(tree)
    if isinstance(tree, dict):
        return {key: _fit(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        if tree and not isinstance(tree[0], str | dict | list | tuple):
            return list(tree)  # numbers, and some of them None
        return [_fit(value) for value in tree]
    return tree
