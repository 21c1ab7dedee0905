"""Data of the converters behind the measured channels, as an actuator file states them."""

from __future__ import annotations

from typing import Annotated

import msgspec

__all__ = ["Converter", "Converters"]


class Converter(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One converter: its range is ±full_scale."""

    full_scale: Annotated[float, msgspec.Meta(gt=0, le=1e9)]
    """Half range, SI unit of the channel."""
    bits: Annotated[int, msgspec.Meta(ge=6, le=24)] = 12
    """Width."""


class Converters(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The four converters; of those that are left out nothing is known."""

    current: Converter | msgspec.UnsetType = msgspec.UNSET
    """Of the servovalve current, A."""
    spool: Converter | msgspec.UnsetType = msgspec.UNSET
    """Of the spool position, m."""
    pressure: Converter | msgspec.UnsetType = msgspec.UNSET
    """Of the differential pressure, Pa."""
    position: Converter | msgspec.UnsetType = msgspec.UNSET
    """Of the jack position, m."""
