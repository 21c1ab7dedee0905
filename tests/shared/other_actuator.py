"""Variants of the reference actuator."""

from __future__ import annotations

import msgspec

from ehadiag import Actuator, default_actuator


def with_data(
    servovalve: dict[str, float] | None = None, jack: dict[str, float] | None = None
) -> Actuator:
    """Return the reference actuator with some keys of its two tables replaced."""
    actuator = default_actuator()
    return msgspec.structs.replace(
        actuator,
        servovalve=msgspec.structs.replace(actuator.servovalve, **(servovalve or {})),
        jack=msgspec.structs.replace(actuator.jack, **(jack or {})),
    )
