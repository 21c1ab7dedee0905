"""Entries and events of a health history, made up."""

from __future__ import annotations

from collections.abc import Sequence

from ehadiag.history.records import Effect, Entry, Event, Severity, Source, Usage

NAMES = ("Kintas", "FSS", "FDJ")


def an_entry(
    serial: int | None = 7,
    hours: float | None = None,
    values: Sequence[float] = (0.1, 0.2, 0.3),
    std: float = 2e-4,
    samples: str | None = None,
    **changes: object,
) -> Entry:
    fields: dict[str, object] = {
        "appended": "2026-03-01T12:00:00.000Z",
        "tested": None,
        "actuator": "reference-31",
        "serial": serial,
        "test": "open",
        "verdict": "HEALTHY",
        "reasons": (),
        "usage": Usage(hours),
        "sources": (Source("a.blf", "00", samples),) if samples else (Source("a.blf", None, None),),
        "severities": tuple(
            Severity(name, value, std, value - 2 * std, value + 2 * std, False, True)
            for name, value in zip(NAMES, values, strict=True)
        ),
        "covariance": tuple(
            tuple(std**2 if i == j else 0.0 for j in range(3)) for i in range(3)
        ),
        "effects": (Effect("null_bias", 1e-4, 1e-6, False),),
        "version": "0",
        "simulated": False,
        "result": '{"schema": "x"}',
    }  # fmt: skip
    return Entry(**(fields | changes))  # type: ignore[arg-type]


def an_event(text: str = "filter changed", hours: float | None = None, **changes: object) -> Event:
    fields: dict[str, object] = {
        "appended": "2026-03-02T12:00:00.000Z",
        "when": "2026-03-02T12:00:00.000Z",
        "serial": 7,
        "actuator": None,
        "usage": Usage(hours),
        "text": text,
        "resets": (),
    }
    return Event(**(fields | changes))  # type: ignore[arg-type]
