"""Data-class fields with a range, and the check of it."""

from __future__ import annotations

import math
from dataclasses import field, fields
from typing import Any

from ehadiag.core.errors import ConfigurationError

__all__ = ["check_ranges", "number", "within"]


def number(default: float, low: float, high: float, what: str = "") -> Any:
    """Field of a frozen data class with a default and a range; `what` names it in errors."""
    return field(default=default, metadata={"range": (low, high), "what": what})


def check_ranges(item: Any, kind: str) -> None:
    """Check each field that `number` made.

    Parameters
    ----------
    item : Any
        Data class whose fields have ranges.
    kind : str
        What its fields are, for error messages ("fault").

    Raises
    ------
    ConfigurationError
        A value that is not finite or outside its range; the text names `kind` and field.
    """
    for entry in fields(item):
        if "range" in entry.metadata:
            low, high = entry.metadata["range"]
            what = entry.metadata["what"] or f"{kind} {entry.name}"
            within(what, getattr(item, entry.name), low, high)


def within(what: str, value: float, low: float, high: float) -> None:
    """Raise ConfigurationError unless `value` is finite and from `low` to `high`."""
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigurationError(f"{what}: {value:g} is outside {low:g} … {high:g}")
