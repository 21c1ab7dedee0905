"""Times that a result reports besides the identification's own: reading, total, after the test."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Spent"]


@dataclass(frozen=True, slots=True)
class Spent:
    """Seconds."""

    read: float = 0.0
    """Acquiring or reading the recording; 0 where it was at hand."""
    after_test: float | None = None
    """From the word that a live test is complete to the verdict."""
