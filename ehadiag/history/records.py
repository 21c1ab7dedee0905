"""What a health history holds: diagnoses, maintenance events, and what was withdrawn of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ehadiag.core.errors import ConfigurationError

__all__ = ["DIAGNOSIS", "EVENT", "Effect", "Entry", "Event", "Severity", "Source", "Usage"]

DIAGNOSIS, EVENT = "diagnosis", "event"
"""Kinds of what can be withdrawn, and their tables."""


@dataclass(frozen=True, slots=True)
class Usage:
    """How long a unit had been in use.

    Attributes
    ----------
    hours : float | None
        Operating hours since the unit was new, h; None where nobody said.
    cycles : float | None
        Cycles (flights, or what the operator counts) since the unit was new.

    Raises
    ------
    ConfigurationError
        One of them is negative or no number.
    """

    hours: float | None = None
    cycles: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("hours", self.hours), ("cycles", self.cycles)):
            if value is not None and not 0.0 <= value < math.inf:
                raise ConfigurationError(f"{name} {value:g}: need a number of at least 0")

    @property
    def known(self) -> bool:
        """Whether there is any of them."""
        return self.hours is not None or self.cycles is not None


@dataclass(frozen=True, slots=True)
class Source:
    """A recording that a diagnosis was made from."""

    path: str
    """As it was named."""
    sha256: str | None
    """Of the file's bytes, hexadecimal; None where there is no file."""
    samples: str | None
    """Hash of the decoded samples, the same in whatever format they were kept; None without any."""


@dataclass(frozen=True, slots=True)
class Severity:
    """A severity as it was estimated; what is no number is None."""

    name: str
    estimate: float | None
    std: float | None
    low: float | None
    """Lower end of the 95 % interval."""
    high: float | None
    at_bound: bool
    shown: bool
    """Whether the test shows this severity at all."""


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect of the installation that was estimated beside the severities; SI."""

    name: str
    value: float | None
    std: float | None
    at_bound: bool


@dataclass(frozen=True, slots=True)
class Entry:
    """One diagnosis."""

    appended: str
    """When it was appended: UTC, ISO 8601."""
    tested: str | None
    """When the test began: UTC, ISO 8601; None where the recording does not say."""
    actuator: str
    serial: int | None
    test: str | None
    verdict: str
    reasons: tuple[str, ...]
    usage: Usage
    sources: tuple[Source, ...]
    severities: tuple[Severity, ...]
    """Empty where nothing was identified."""
    covariance: tuple[tuple[float, ...], ...] | None
    """Of the severities, in their order."""
    effects: tuple[Effect, ...]
    version: str
    """Of the program that made the diagnosis."""
    simulated: bool
    """Whether the unit was a simulated one, as far as the program knew."""
    result: str
    """The JSON result, one line."""
    number: int = 0
    """In its history, from 1; 0: not appended yet."""
    withdrawn: str | None = None
    """Why it counts no more; None: it counts."""

    @property
    def when(self) -> str:
        """Time of the test, else of the diagnosis; UTC, ISO 8601."""
        return self.tested or self.appended


@dataclass(frozen=True, slots=True)
class Event:
    """What was done to a unit."""

    appended: str
    """When it was appended: UTC, ISO 8601."""
    when: str
    """When it was done: UTC, ISO 8601."""
    serial: int
    actuator: str | None
    """None: whatever actuator has this serial number."""
    usage: Usage
    text: str
    resets: tuple[str, ...]
    """Severities that begin anew; empty: those that fell."""
    number: int = 0
    """In its history, from 1; 0: not appended yet."""
    withdrawn: str | None = None
    """Why it counts no more; None: it counts."""
