"""The decoded content of a single frame: a status, a sample or a request."""

from __future__ import annotations

from dataclasses import dataclass

from ehadiag.core.recording import BitReason, BitState

__all__ = ["CHANNELS", "BitStatus", "Request", "Sample"]

CHANNELS = frozenset(("current", "spool", "pressure", "position"))


@dataclass(frozen=True, slots=True)
class BitStatus:
    """One valid `BitStatus` message."""

    state: BitState
    reason: BitReason = BitReason.NONE
    test_id: int | None = 0
    elapsed: float = 0.0
    """s."""
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class Sample:
    """One valid telemetry message: A, m, Pa, m; the last known value of what it does not bring."""

    current: float
    spool: float
    pressure: float
    position: float
    brought: frozenset[str] = CHANNELS
    """Channels that this very message brings."""


@dataclass(frozen=True, slots=True)
class Request:
    """One valid `BitRequest` message; code `start`, `abort`, or empty for an unknown number."""

    code: str
    test_id: int
