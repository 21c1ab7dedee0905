"""What is shown of an identification: severities, effects, and what keeps it from explaining."""

from __future__ import annotations

import math
from typing import TypeVar

import msgspec

from ehadiag.core.conventions import display_unit

AT_BOUND, NOT_SHOWN = "at_bound", "not_shown"
"""Flags: the estimate stands at a bound; the test does not show this severity."""


class Severity(msgspec.Struct, frozen=True, kw_only=True):
    """Severity of one progressive fault: 0 as new, 1 at the limit of damage.

    Numbers are None where nothing was identified; `value` and `interval` are then NaN.
    """

    name: str
    """As in the registry of parameters."""
    first: float | None = None
    """After the first approximation."""
    search: float | None = None
    """After the genetic search."""
    estimate: float | None = None
    """After the refinement: the result."""
    std: float | None = None
    """Standard deviation of the estimate."""
    interval95: tuple[float, float] | None = None
    """95 % interval, cut at the bounds."""
    flags: tuple[str, ...] = ()
    """`at_bound`: the estimate stands at 0 or 1; `not_shown`: the test does not show this fault."""
    meaning: str = ""
    """In two words."""
    advice: str = ""
    """What to do about it, as the end of "Plan to …"."""
    source: str = ""
    """Where it is from: a stage of the identification, or the result that was read."""

    @property
    def value(self) -> float:
        """The estimate; NaN where nothing was identified."""
        return math.nan if self.estimate is None else self.estimate

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval; NaN where nothing was identified."""
        return (math.nan, math.nan) if self.interval95 is None else self.interval95

    @property
    def at_bound(self) -> bool:
        """Whether the estimate stands at 0 or 1."""
        return AT_BOUND in self.flags

    @property
    def shown(self) -> bool:
        """Whether the test shows this severity at all."""
        return NOT_SHOWN not in self.flags


class Effect(msgspec.Struct, frozen=True, kw_only=True):
    """An effect of the unit or its installation, estimated beside the severities; SI."""

    name: str
    """As in the registry of parameters."""
    value: float | None = None
    unit: str = ""
    """SI unit; 1 for a share."""
    std: float | None = None
    """Standard deviation of the value."""
    interval95: tuple[float, float] | None = None
    """95 % interval, cut at the parameter's bounds."""
    limit: float | None = None
    """Largest size of either sign in a sound unit; None: it has no limit."""
    beyond: bool | None = None
    """Whether it is more likely beyond its limit than not; None without a limit."""
    chance: float | None = None
    """Chance that it is beyond its limit, 0 … 1; None without a limit."""
    at_bound: bool = False
    """Whether the estimate stands at a bound."""
    prior_std: float | None = None
    """Standard deviation of what was known of it beforehand; None where nothing was."""
    source: str = ""
    """What was known beforehand: `usual size`, `tolerance`, `probe`, `calibration`, or nothing."""
    meaning: str = ""
    """In two words."""

    @property
    def shown_unit(self) -> str:
        """Engineering unit."""
        return display_unit(self.unit, self.limit or self.value or 0.0)[1]

    def shown(self, value: float) -> float:
        """Return a number in the engineering unit."""
        return value * display_unit(self.unit, self.limit or self.value or 0.0)[0]

    @property
    def significant(self) -> bool:
        """Whether its 95 % interval leaves 0 out."""
        low, high = self.interval95 or (0.0, 0.0)
        return low > 0.0 or high < 0.0


Estimate = TypeVar("Estimate", Severity, Effect)


def without_interval(item: Estimate) -> Estimate:
    """Return an estimate without deviation and interval: the best fit of what is unexplained."""
    return msgspec.structs.replace(item, std=None, interval95=None)


class Suspect(msgspec.Struct, frozen=True, kw_only=True):
    """One parameter that would explain part of what the model leaves."""

    name: str
    """As in the registry of parameters."""
    meaning: str
    """In two words."""
    value: float
    """That it would take, SI."""
    unit: str
    """SI unit; 1 for a share."""
    share: float
    """Of what is unexplained that it would explain, 0 … 1."""


NO_SINGLE_CAUSE = (
    "no single effect or datum explains most of it: broken hardware, another actuator, or a unit"
    " whose data differ in several places"
)


class Culprit(msgspec.Struct, frozen=True, kw_only=True):
    """Where the model fails, and what may be the cause."""

    signal: str
    """On which most is unexplained."""
    test: str
    """In which stored test."""
    start: float
    """s in the test, from which on most is unexplained."""
    end: float
    """s in the test."""
    suspects: tuple[Suspect, ...]
    """What would explain most comes first; may be empty."""
    advice: str
    """What to check first; empty: nothing alone explains most."""

    @property
    def lines(self) -> tuple[str, ...]:
        """What to tell people, a sentence each."""
        where = (
            f"most is unexplained on the {self.signal} signal, {self.start:.1f} … {self.end:.1f} s "
            f"of test {self.test!r}"
        )
        would = tuple(
            f"{item.meaning} {item.value:.3g}{'' if item.unit == '1' else ' ' + item.unit} "
            f"({item.name}) would explain {item.share:.0%} of it"
            for item in self.suspects
        )
        return (where, *would) if self.advice else (where, *would, NO_SINGLE_CAUSE)
