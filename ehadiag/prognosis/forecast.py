"""Remaining life of a unit: hours, cycles or days until each severity reaches a level."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.prognosis.averaging import (
    CHANCES,
    Fleet,
    OwnLife,
    filter_own,
    passage_of,
    surprises,
)
from ehadiag.prognosis.lives import Life


class ForecastRules(msgspec.Struct, frozen=True):
    """What a forecast needs, and what raises an alarm."""

    min_diagnoses: int = 3
    """Number of diagnoses in the present life; beside a fleet of five lives two are enough."""
    min_lives: int = 5
    """Number of lives that make a fleet."""
    min_growth_stds: float = 5.0
    """Least growth in the present life, in deviations of its noise, that a forecast can use."""
    max_interval_ratio: float = 50.0
    """Ratio of the outer quantiles, 1; a wider interval is no number to plan with."""
    alarm_rate: float = 1e-3
    """Share of the diagnoses of ordinary wear that raise a false alarm, 1."""
    tail_chance: float = 0.05
    """Share of the surprises (see `surprises`), 1, that form their tail, taken as exponential."""
    min_surprises: int = 40
    """Least number of surprises; draws of a normal density make up for missing ones."""
    min_fall: float = 0.02
    """Net fall of a severity in a life, 1, above which it raises an alarm, if above its noise."""


RULES = ForecastRules()
NOTE_NO_WEAR = "no wear falls; if something was done, append it as an event"
INTERVAL_CHANCES = (0.1, 0.5, 0.9)


class RemainingLife(msgspec.Struct, frozen=True):
    """Hours, cycles or days until a severity reaches a level."""

    level: float
    low: float | None
    """10 % quantile, from now, negative in the past. None: no number."""
    median: float | None
    high: float | None
    """90 % quantile."""
    why: str
    """Why there is no number; empty where there is one."""
    quantiles: tuple[float, ...] = ()
    """At 1, 2 … 99 %; infinite where the level may never be reached. Empty: no number."""

    @property
    def reached(self) -> bool:
        """Whether the last diagnosis has reached the level."""
        return self.high == 0.0 and not self.quantiles

    def chance_within(self, time: float) -> float | None:
        """Chance that the level is reached within hours, cycles or days from now; 0: by now."""
        if self.median is None:
            return None
        if not self.quantiles:
            return 1.0
        return float(np.interp(time, self.quantiles, CHANCES, left=0.0, right=1.0))


class Forecast(msgspec.Struct, frozen=True):
    """The future of one severity of one unit."""

    name: str
    unit: str
    """`hours`, `cycles` or `days`."""
    at: float | None
    """Hours, cycles or days of the unit at the last diagnosis; None without any."""
    value: float | None
    """Severity at the last diagnosis."""
    diagnoses: int
    """Number of diagnoses in the present life."""
    fleet: int
    """Number of lives, of other units or earlier ones of this, that the wear was learnt from."""
    process: str | None
    """Law of the highest weight; None without a number."""
    weights: dict[str, float]
    """Weight of each law, for the last level; empty without a number."""
    remaining: tuple[RemainingLife, ...]
    """One for each level."""
    note: str
    """Which levels are extrapolated; empty: lives were seen to reach all of them."""
    alarm: str
    """A change that no wear explains; empty where there is none."""
    elapsed: float = 0.0
    """Hours, cycles or days since the last diagnosis."""

    @property
    def too_few(self) -> bool:
        """Whether a number needs more diagnoses."""
        return self.diagnoses < _needed(self.fleet)


def forecast(
    name: str,
    unit: str,
    life: Life,
    fleet: Fleet,
    levels: Sequence[float],
    seed: int = 0,
    elapsed: float = 0.0,
) -> Forecast:
    """Forecast one severity of one unit.

    unit: `hours`, `cycles` or `days`; life: the present one; fleet: what other lives say; levels:
    severities whose times are asked for; seed: of the draws; the same seed gives the same digits;
    elapsed: hours, cycles or days since the last diagnosis, in which the level may have been
    reached. Returns a number for each level, or why there is none.
    """
    found = Forecast(
        name=name,
        unit=unit,
        at=float(life.born + life.age[-1]) if len(life.age) else None,
        value=float(life.value[-1]) if len(life.age) else None,
        diagnoses=len(life.age),
        fleet=fleet.lives,
        process=None,
        weights={},
        remaining=(),
        note="",
        alarm="",
        elapsed=elapsed,
    )
    if why := _objection_to_data(life, fleet, unit):
        return replace(found, remaining=_no_numbers(life, levels, why))
    if fall := _fall(life, unit):
        return replace(found, alarm=fall, remaining=_no_numbers(life, levels, "see the alarm"))
    remaining, weights, own = [], {}, filter_own(life, fleet)
    for level in levels:
        if life.value[-1] >= level:
            remaining.append(RemainingLife(level, 0.0, 0.0, 0.0, ""))
            continue
        passage = passage_of(own, fleet, level, seed)
        weights = passage.weights
        remaining.append(_remaining(passage.quantiles, level, elapsed, unit))
    return replace(
        found,
        process=max(weights, key=lambda key: weights[key]) if weights else None,
        weights=weights,
        remaining=tuple(remaining),
        note=_extrapolation(life, fleet, levels),
        alarm=_surprise(own, fleet, unit),
    )


def _remaining(
    quantiles: NDArray[np.float64], level: float, elapsed: float, unit: str
) -> RemainingLife:
    """Interval of a passage; quantiles: from the last diagnosis, `elapsed` before now."""
    low, median, high = (float(np.interp(q, CHANCES, quantiles)) for q in INTERVAL_CHANCES)
    if not math.isfinite(high):
        why = "the wear that was seen need not ever reach this level"
        return RemainingLife(level, None, None, None, why)
    if high > RULES.max_interval_ratio * max(low, 1e-9):
        why = f"anything from {low:.0f} to {high:.0f} {unit}: too wide"
        return RemainingLife(level, None, None, None, why)
    low, median, high = low - elapsed, median - elapsed, high - elapsed
    return RemainingLife(level, low, median, high, "", tuple((quantiles - elapsed).tolist()))


def _no_numbers(life: Life, levels: Sequence[float], why: str) -> tuple[RemainingLife, ...]:
    """Return 0 for each level that is reached already, and no number for the others."""
    return tuple(
        RemainingLife(level, 0.0, 0.0, 0.0, "")
        if len(life.age) and life.value[-1] >= level
        else RemainingLife(level, None, None, None, why)
        for level in levels
    )


def _needed(lives: int) -> int:
    """Number of diagnoses that a forecast needs with so many lives in the fleet."""
    return RULES.min_diagnoses - (lives >= RULES.min_lives)


def _objection_to_data(life: Life, fleet: Fleet, unit: str) -> str:
    """Why the data cannot carry a number; empty if they may."""
    number = len(life.age)
    needed = _needed(fleet.lives)
    since = f"since {life.born:g} {unit}" if life.born else "of the unit"
    if number < needed:
        return f"{number or 'no'} diagnos{'is' if number == 1 else 'es'} {since}, needs {needed}"
    noise = float(np.hypot(life.std[0], life.std[-1]))
    if abs(life.value[-1] - life.value[0]) < RULES.min_growth_stds * noise:
        return (
            f"{number} diagnoses over {life.age[-1] - life.age[0]:g} {unit} show no growth"
            " beyond their noise"
        )
    return ""


def _extrapolation(life: Life, fleet: Fleet, levels: Sequence[float]) -> str:
    """Which levels are beyond the highest severity seen."""
    seen = max(fleet.highest, float(life.value.max()))
    beyond = [f"{level:g}" for level in levels if level > 1.1 * seen]
    return (
        f"no life was seen beyond {seen:.2g}: {', '.join(beyond)} is extrapolated" if beyond else ""
    )


def _fall(life: Life, unit: str) -> str:
    """Name a net fall of a severity; wear never falls."""
    fallen = float(life.value[0] - life.value[-1])
    noise = float(np.hypot(life.std[0], life.std[-1]))
    if fallen <= max(RULES.min_fall, RULES.min_growth_stds * noise):
        return ""
    begin, end = (float(life.born + life.age[at]) for at in (0, -1))
    return f"{-fallen:+.3f} between {begin:g} and {end:g} {unit}: {NOTE_NO_WEAR}"


def _surprise(own: OwnLife, fleet: Fleet, unit: str) -> str:
    """Name the least expected change, if ordinary wear hardly ever makes one as unexpected."""
    life, (mine, others) = own.life, surprises(own, fleet)
    worst = int(np.argmax(np.abs(mine)))
    rest = np.abs(np.r_[np.delete(mine, worst), others])
    if len(rest) < RULES.min_surprises:
        normal = np.abs(np.random.default_rng(0).standard_normal(RULES.min_surprises - len(rest)))
        rest = np.r_[rest, normal]
    begin = float(np.quantile(rest, 1.0 - RULES.tail_chance))
    excess = float(np.mean(rest[rest >= begin] - begin))
    bound = begin + max(excess, 0.2 * begin) * math.log(RULES.tail_chance / RULES.alarm_rate)
    if abs(mine[worst]) <= bound:
        return ""
    low, high = worst, worst + 1
    change = float(life.value[high] - life.value[low])
    what = f"{change:+.3f} between {life.born + life.age[low]:g} and {life.born + life.age[high]:g}"
    if change < 0.0:
        return f"{what} {unit}: {NOTE_NO_WEAR}"
    return (
        f"{what} {unit}: {abs(mine[worst]):.0f} deviations from what was expected, ordinary wear"
        f" stays within {bound:.0f} in {1.0 - RULES.alarm_rate:.1%} of diagnoses"
    )
