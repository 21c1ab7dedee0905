"""Faults beside the three progressive ones: null bias, hysteresis, backlash, torque-motor gain.

Each has a limit in the actuator file. One that is more likely beyond its limit than not (simple
acceptance, JCGM 106:2012, 8.2) makes a verdict DEGRADED, never FAULT by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import Actuator
from ehadiag.identify.result import Identification
from ehadiag.model.parameters import parameter

__all__ = ["OtherFault", "chance_beyond", "degraded_by", "notes_on_other_faults", "other_faults"]

BEYOND = 0.5
"""Chance of being beyond the limit from which a fault counts as beyond it."""
DOUBT = 0.025
"""Chance from which a note says that it may be."""
TWO_SIDED_95 = NormalDist().inv_cdf(0.975)
SHOWN = {
    "null_bias": ("mA", 1e-3),
    "hysteresis": ("%", 0.01),
    "backlash": ("µm", 1e-6),
    "torque_motor_gain": ("%", 0.01),
}
"""Unit in which each is shown to people, and its SI value."""


@dataclass(frozen=True, slots=True)
class OtherFault:
    """An effect of the unit that has a limit; numbers in SI.

    Attributes
    ----------
    name : str
        As in the registry of parameters.
    meaning : str
        In two words.
    unit : str
        SI unit; 1 for a share.
    value : float
        As estimated.
    std : float
        Its standard deviation.
    interval95 : tuple[float, float]
        Cut at the parameter's bounds.
    limit : float
        Largest size of either sign.
    chance : float
        That it is beyond the limit.
    """

    name: str
    meaning: str
    unit: str
    value: float
    std: float
    interval95: tuple[float, float]
    limit: float
    chance: float

    @property
    def beyond(self) -> bool:
        """Whether it is more likely beyond its limit than not."""
        return self.chance >= BEYOND

    @property
    def shown_unit(self) -> str:
        """Engineering unit."""
        return SHOWN[self.name][0]

    def shown(self, value: float) -> float:
        """Return a value in the engineering unit."""
        return value / SHOWN[self.name][1]


def other_faults(identification: Identification, actuator: Actuator) -> tuple[OtherFault, ...]:
    """Return those that were estimated, in the order of the actuator file's limits."""
    limits = actuator.limits
    of_file = {
        "null_bias": limits.null_bias * actuator.controller.IM,
        "hysteresis": limits.hysteresis,
        "backlash": limits.backlash,
        "torque_motor_gain": limits.torque_motor_gain,
    }
    out = []
    for name, limit in of_file.items():
        found = identification.nuisances.get(name)
        if found is None:
            continue
        item, half = parameter(name), TWO_SIDED_95 * found.std
        out.append(
            OtherFault(
                name=name,
                meaning=item.short,
                unit=item.unit,
                value=found.value,
                std=found.std,
                interval95=(
                    max(item.lower, found.value - half),
                    min(item.upper, found.value + half),
                ),
                limit=limit,
                chance=chance_beyond(found.value, found.std, limit),
            )
        )
    return tuple(out)


def chance_beyond(value: float, std: float, limit: float) -> float:
    """Chance that a normal variable is at or beyond a limit of either sign."""
    if std <= 0.0:
        return float(abs(value) >= limit)
    density = NormalDist(value, std)
    return density.cdf(-limit) + 1.0 - density.cdf(limit)


def degraded_by(
    others: Sequence[OtherFault], verdict: Verdict, reasons: tuple[str, ...]
) -> tuple[Verdict, tuple[str, ...]]:
    """Verdict with the other faults counted: they make HEALTHY DEGRADED, and nothing worse."""
    beyond = tuple(
        f"{item.meaning} {item.shown(item.value):.3g} {item.shown_unit} beyond the limit "
        f"{item.shown(item.limit):.3g} {item.shown_unit}"
        for item in others
        if item.beyond
    )
    if beyond and verdict is Verdict.HEALTHY:
        verdict = Verdict.DEGRADED
    return verdict, (*reasons, *beyond)


def notes_on_other_faults(others: Sequence[OtherFault]) -> tuple[str, ...]:
    """Which of them may be beyond its limit, though more likely it is not."""
    return tuple(
        f"{item.meaning} {item.shown(item.value):.3g} {item.shown_unit} may be beyond the limit "
        f"{item.shown(item.limit):.3g} {item.shown_unit}: chance {item.chance:.0%}"
        for item in others
        if DOUBT < item.chance < BEYOND
    )
