"""Remaining life of one unit: all its severities, from the health history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ehadiag.history.counted import counted
from ehadiag.model.parameters import FAULT_NAMES
from ehadiag.prognosis.forecast import Forecast, forecast, learn_fleet
from ehadiag.prognosis.lives import UNITS, Life, lives_of

if TYPE_CHECKING:
    from ehadiag.history.records import Entry, Event, Usage

__all__ = ["Prognosis", "prognosis_of"]


@dataclass(frozen=True, slots=True)
class Prognosis:
    """Forecasts of one unit."""

    serial: int
    actuator: str | None
    """None: the history does not know the unit."""
    unit: str
    """`hours` or `cycles`."""
    diagnoses: int
    """That count, of this unit."""
    used: int
    """Of these, those of the same actuator as the last that say hours (or cycles)."""
    levels: tuple[float, ...]
    forecasts: tuple[Forecast, ...]
    seed: int


def prognosis_of(
    serial: int,
    entries: Sequence[Entry],
    events: Sequence[Event],
    levels: Sequence[float],
    unit: str | None = None,
    seed: int = 0,
) -> Prognosis:
    """Forecast each severity of a unit.

    Parameters
    ----------
    serial : int
        Of the unit.
    entries : Sequence[Entry]
        All diagnoses of the history, in the order in which they were appended. Units of the same
        actuator are the fleet; simulated ones are none of a real unit's.
    events : Sequence[Event]
        All maintenance events.
    levels : Sequence[float]
        That are to be reached, 0 … 1, rising.
    unit : str | None
        `hours` or `cycles`; None: the one that more of the unit's diagnoses say.
    seed : int
        Of the draws; the same seed gives the same digits.

    Returns
    -------
    Prognosis
        One forecast for each severity, each with a number or why there is none.
    """
    counting = counted(entries)
    mine = [item for item in counting if item.serial == serial]
    if unit is None:
        told = {name: sum(_amount(item.usage, name) is not None for item in mine) for name in UNITS}
        unit = max(UNITS, key=lambda name: told[name])
    actuator = mine[-1].actuator if mine else None
    simulated = mine[-1].simulated if mine else False
    alike = [i for i in counting if i.actuator == actuator and i.simulated == simulated]
    forecasts = []
    for name in FAULT_NAMES:
        lives = lives_of(alike, events, name, unit)
        own = lives.pop(serial, [])
        none = np.empty(0)
        present = own[-1] if own else Life(serial, none, none, none, 0.0)
        others = [*own[:-1], *(life for several in lives.values() for life in several)]
        ages = [life.age[-1] for life in (present, *others) if len(life.age)]
        fleet = learn_fleet(others, float(np.median(ages)) if ages else 1.0, seed)
        forecasts.append(forecast(name, unit, present, fleet, levels, seed))
    used = sum(_amount(item.usage, unit) is not None for item in mine if item in alike)
    return Prognosis(serial, actuator, unit, len(mine), used, tuple(levels), tuple(forecasts), seed)


def _amount(usage: Usage, unit: str) -> float | None:
    return usage.hours if unit == "hours" else usage.cycles
