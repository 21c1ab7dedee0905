"""Verdicts, their levels and exit codes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from statistics import NormalDist
from typing import TYPE_CHECKING

from ehadiag.core.errors import ConfigurationError

if TYPE_CHECKING:  # the command line needs levels and codes long before it loads the compiler
    from ehadiag.identify.result import Estimate, Identification

__all__ = ["Levels", "Rule", "Verdict", "chance_above", "judge"]


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


class Rule(StrEnum):
    """What a verdict goes by."""

    INTERVAL = "interval"
    """The chance that a severity is at or above a level (JCGM 106:2012, section 8)."""
    ESTIMATE = "estimate"
    """The estimates alone."""


@dataclass(frozen=True, slots=True)
class Levels:
    """Levels of a severity, 0 … 1, and the rule by which they are held against it.

    Attributes
    ----------
    advisory : float
        DEGRADED at or above.
    limit : float
        FAULT at or above.
    rule : Rule
        What a verdict goes by.

    Raises
    ------
    ConfigurationError
        Not 0 < advisory < limit <= 1.
    """

    advisory: float = 0.25
    limit: float = 0.75
    rule: Rule = Rule.INTERVAL

    def __post_init__(self) -> None:
        if not 0.0 < self.advisory < self.limit <= 1.0:
            raise ConfigurationError(
                f"levels: need 0 < advisory < limit <= 1, not {self.advisory:g} and {self.limit:g}"
            )


FALSE_HEALTHY = 0.025
"""Largest chance that a severity is at or above the advisory level for HEALTHY: of the specific
consumer's risk that JCGM 106 speaks of."""
FAULT_CHANCE = 0.5
"""Least chance that a severity is at or above the limit for FAULT."""


def judge(identification: Identification, levels: Levels) -> tuple[Verdict, tuple[str, ...]]:
    """Verdict on estimates that can carry one, and why.

    By the interval rule FAULT goes before NOT TESTED (a severity of which the test says nothing:
    its interval reaches from below the advisory level to above the limit), and that before
    DEGRADED.
    """
    if levels.rule is Rule.ESTIMATE:
        return _by_estimate(identification.estimates, levels)
    verdict, reasons = _by_estimate(identification.estimates, levels, faults_only=True)
    if reasons:
        return verdict, reasons
    blind = [
        f"{item.name} may be anything from {item.interval95[0]:.3f} to {item.interval95[1]:.3f}"
        for item in identification.estimates
        if item.interval95[0] < levels.advisory and item.interval95[1] > levels.limit
    ]
    if blind:
        return Verdict.NOT_TESTED, tuple(blind)
    return _by_chance(identification.estimates, levels)


def _by_estimate(
    estimates: Sequence[Estimate], levels: Levels, *, faults_only: bool = False
) -> tuple[Verdict, tuple[str, ...]]:
    verdict, reasons = Verdict.HEALTHY, []
    for item in estimates:
        if _at_limit(item, levels):
            verdict = Verdict.FAULT
            reasons.append(f"{item.name} {item.value:.3f} at or above the limit {levels.limit:g}")
        elif item.value >= levels.advisory:
            verdict = max(verdict, Verdict.DEGRADED)
            reasons.append(_advisory(item, levels))
    if faults_only and verdict is not Verdict.FAULT:
        return Verdict.HEALTHY, ()
    return verdict, tuple(reasons)


def _at_limit(item: Estimate, levels: Levels) -> bool:
    if levels.rule is Rule.ESTIMATE:
        return item.value >= levels.limit
    return chance_above(item, levels.limit) >= FAULT_CHANCE


def _advisory(item: Estimate, levels: Levels) -> str:
    return f"{item.name} {item.value:.3f} at or above the advisory level {levels.advisory:g}"


def _by_chance(estimates: Sequence[Estimate], levels: Levels) -> tuple[Verdict, tuple[str, ...]]:
    """HEALTHY or DEGRADED, by the chance that any severity is at or above the advisory level.

    Chances are added (Boole's inequality): whatever the severities' correlation, theirs together is
    no greater.
    """
    chances = [chance_above(item, levels.advisory) for item in estimates]
    if sum(chances) <= FALSE_HEALTHY:
        return Verdict.HEALTHY, ()
    worst = max(chances)
    reasons = [
        _advisory(item, levels)
        if item.value >= levels.advisory
        else f"{item.name} {item.value:.3f} may be at or above the advisory level "
        f"{levels.advisory:g}: chance {chance:.1%}"
        for item, chance in zip(estimates, chances, strict=True)
        if item.value >= levels.advisory or chance == worst or chance > FALSE_HEALTHY
    ]
    return Verdict.DEGRADED, tuple(reasons)


def chance_above(item: Estimate, level: float) -> float:
    """Chance that a severity is at or above a level: of a normal density within 0 … 1."""
    if item.std <= 0.0:
        return float(item.value >= level)
    density = NormalDist(item.value, item.std)
    low, at, high = (density.cdf(x) for x in (0.0, level, 1.0))
    return (high - at) / (high - low) if high > low else float(item.value >= level)
