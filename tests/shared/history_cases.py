"""Entries and events of a health history, made up."""

from __future__ import annotations

from collections.abc import Sequence

from ehadiag.estimate import Effect, Severity
from ehadiag.history.records import Entry, MaintenanceEvent, SourceRecord, Usage

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
        "sources": (SourceRecord("a.blf", "00", samples),) if samples else (SourceRecord("a.blf",
        None, None),),
        "severities": tuple(
            Severity(
                name=name, estimate=value, std=std, interval95=(value - 2 * std, value + 2 * std)
            )
            for name, value in zip(NAMES, values, strict=True)
        ),
        "covariance": tuple(
            tuple(std**2 if i == j else 0.0 for j in range(3)) for i in range(3)
        ),
        "effects": (Effect(name="null_bias", value=1e-4, std=1e-6),),
        "version": "0",
        "simulated": False,
        "result": '{"schema": "x"}',
    }  # fmt: skip
    return Entry(**(fields | changes))  # type: ignore[arg-type]


def an_event(
    text: str = "filter changed", hours: float | None = None, **changes: object
) -> MaintenanceEvent:
    fields: dict[str, object] = {
        "appended": "2026-03-02T12:00:00.000Z",
        "when": "2026-03-02T12:00:00.000Z",
        "serial": 7,
        "actuator": None,
        "usage": Usage(hours),
        "text": text,
        "resets": (),
    }
    return MaintenanceEvent(**(fields | changes))  # type: ignore[arg-type]
