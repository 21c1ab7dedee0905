"""Verdicts, their levels and exit codes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

from ehadiag.core.errors import ConfigurationError

if TYPE_CHECKING:  # the command line needs levels and codes long before it loads the compiler
    from ehadiag.identify.result import Identification

__all__ = ["Levels", "Verdict", "judge"]


class Verdict(IntEnum):
    """State of an actuator; the value is the exit code of the command line."""

    HEALTHY = 0
    DEGRADED = 10
    FAULT = 20
    NOT_TESTED = 30

    def __str__(self) -> str:
        """Return the name, as in the JSON result."""
        return self.name

    def __format__(self, specification: str) -> str:
        """Format the name."""
        return format(self.name, specification)


@dataclass(frozen=True, slots=True)
class Levels:
    """Levels of a severity, 0 … 1.

    Raises
    ------
    ConfigurationError: not 0 < advisory < limit <= 1.
    """

    advisory: float = 0.25
    """DEGRADED at or above."""
    limit: float = 0.75
    """FAULT at or above."""

    def __post_init__(self) -> None:
        if not 0.0 < self.advisory < self.limit <= 1.0:
            raise ConfigurationError(
                f"levels: need 0 < advisory < limit <= 1, not {self.advisory:g} and {self.limit:g}"
            )


def judge(identification: Identification, levels: Levels) -> tuple[Verdict, tuple[str, ...]]:
    """Verdict on estimates that can carry one, and why."""
    verdict, reasons = Verdict.HEALTHY, []
    for item in identification.estimates:
        if item.value >= levels.limit:
            verdict = Verdict.FAULT
            reasons.append(f"{item.name} {item.value:.3f} at or above the limit {levels.limit:g}")
        elif item.value >= levels.advisory:
            verdict = max(verdict, Verdict.DEGRADED)
            reasons.append(
                f"{item.name} {item.value:.3f} at or above the advisory level {levels.advisory:g}"
            )
    return verdict, tuple(reasons)
