"""How rarely a monitor may be wrong, unless it is told otherwise."""

from __future__ import annotations

from typing import Final

__all__ = ["HOURS_BETWEEN"]

HOURS_BETWEEN: Final = 100.0
"""Mean time between false alarms of a monitor as a whole, h."""
