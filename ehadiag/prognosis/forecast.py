"""Remaining life of one severity: hours or cycles to each level, or why there is no number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.prognosis.belief import Belief, Posterior, learnt, posterior, starting_belief
from ehadiag.prognosis.lives import RESOLVED, Increments, Life, increments_of
from ehadiag.prognosis.wear import PROCESSES, Process

__all__ = ["Fleet", "Forecast", "Remaining", "forecast", "learn_fleet"]

LEAST_DIAGNOSES = 3
LEAST_INCREMENTS = 2
"""Of growth beyond noise, in the present life; one is enough beside a fleet."""
FLEET = 5
"""Lives from which the others are a fleet."""
MOST_LIVES = 40
"""Of the fleet that are looked at: those with most growth seen."""
DRAWS = 400
PASSAGES = 10
"""Of each law drawn."""
INTERVAL = (0.1, 0.5, 0.9)
"""Quantiles that are told."""
WIDEST = 20.0
"""Largest ratio of the interval's ends that is a number to plan with."""
UNLIKELY = 1e-4
"""Chance of any such change in a life below which wear did not make it."""
NO_WEAR = "no wear falls; if something was done, append it as an event"
FALLEN = 0.02
"""Net fall of a severity in a life, beyond its noise, from which on it is none of wear's."""
STRANGE = 8.0
"""Rate of an increment over the fleet's median, in median deviations, from which on a life is tried
before others learn from it."""


@dataclass(frozen=True, slots=True)
class Remaining:
    """Hours or cycles until a severity reaches a level."""

    level: float
    low: float | None
    """From now; 10 % quantile. None: no number."""
    median: float | None
    high: float | None
    """90 % quantile."""
    why: str
    """Why there is no number; empty where there is one."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What the history says about the future of one severity of one unit."""

    name: str
    unit: str
    """`hours` or `cycles`."""
    at: float | None
    """Hours or cycles of the unit at the last diagnosis; None without any."""
    value: float | None
    """The severity then."""
    diagnoses: int
    """Of the present life."""
    fleet: int
    """Lives of other units, and earlier ones of this, that the wear was learnt from."""
    process: str | None
    """Chosen by evidence; None without a number."""
    odds: float | None
    """How many times as likely the chosen process makes what was seen as the other one."""
    remaining: tuple[Remaining, ...]
    """One for each level."""
    alarm: str
    """A change that no wear explains; empty where there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """What other lives say of the wear of a severity."""

    lives: int
    beliefs: dict[str, Belief]
    """By process."""


def learn_fleet(lives: Sequence[Life], scale: float, seed: int = 0) -> Fleet:
    """Learn each process's laws from the lives of a fleet.

    Parameters
    ----------
    lives : Sequence[Life]
        Of one severity.
    scale : float
        Age at which the clock stands at 1, hours or cycles.
    seed : int
        Of the draws.

    Returns
    -------
    Fleet
        Only lives that show growth count.
    """
    shown = [life for life in lives if len(increments_of([life]))]
    shown = sorted(shown, key=lambda life: -len(life.age))[:MOST_LIVES]
    strange = _strange(shown)
    usual = [life for life, is_strange in zip(shown, strange, strict=True) if not is_strange]
    fleet = _learnt(usual, scale, seed)
    if len(usual) == len(shown):
        return fleet
    rng = np.random.default_rng(seed)
    sound = [
        life
        for life, is_strange in zip(shown, strange, strict=True)
        if not (is_strange and _is_alarming(life, fleet, rng))
    ]
    return fleet if len(sound) == len(usual) else _learnt(sound, scale, seed)


def _learnt(lives: Sequence[Life], scale: float, seed: int) -> Fleet:
    seen, start = increments_of(lives), starting_belief(scale)
    beliefs = {name: learnt(item, seen, start, seed) for name, item in PROCESSES.items()}
    return Fleet(len(lives), beliefs)


def _strange(lives: Sequence[Life]) -> list[bool]:
    """Whether a life has a rate far from the fleet's, so that it may hold what wear did not do."""
    seen = increments_of(lives)
    rates = (seen.high - seen.low) / (seen.end - seen.start)
    if not len(rates):
        return []
    off = np.abs(rates - np.median(rates))
    far = off > STRANGE * max(float(np.median(off)), 1e-3 * abs(float(np.median(rates))))
    return [bool(far[seen.life == index].any()) for index in range(len(lives))]


def _is_alarming(life: Life, fleet: Fleet, rng: np.random.Generator) -> bool:
    """Whether the likelier process raises an alarm on a life."""
    seen = increments_of([life])
    found = {
        key: posterior(item, seen, fleet.beliefs[key], DRAWS // 4, rng).evidence
        for key, item in PROCESSES.items()
    }
    chosen = max(found, key=lambda key: found[key])
    return bool(_alarm(PROCESSES[chosen], seen, fleet.beliefs[chosen], life, "", rng))


def forecast(
    name: str,
    unit: str,
    life: Life,
    fleet: Fleet,
    levels: Sequence[float],
    seed: int = 0,
) -> Forecast:
    """Forecast one severity of one unit.

    Parameters
    ----------
    name : str
        Of the severity.
    unit : str
        `hours` or `cycles`.
    life : Life
        The present one.
    fleet : Fleet
        What other lives say.
    levels : Sequence[float]
        That are to be reached.
    seed : int
        Of the draws; the same seed gives the same digits.

    Returns
    -------
    Forecast
        With a number for each level, or why there is none.
    """
    rng = np.random.default_rng(seed)
    seen = increments_of([life])
    empty = Forecast(
        name=name,
        unit=unit,
        at=float(life.born + life.age[-1]) if len(life.age) else None,
        value=float(life.value[-1]) if len(life.age) else None,
        diagnoses=len(life.age),
        fleet=fleet.lives,
        process=None,
        odds=None,
        remaining=(),
        alarm="",
    )
    why = _too_little(life, seen, fleet, unit)
    if why:
        return replace(empty, remaining=_none(life, levels, why))
    found = {
        key: posterior(item, seen, fleet.beliefs[key], DRAWS, rng)
        for key, item in PROCESSES.items()
    }
    total = {key: fleet.beliefs[key].evidence + item.evidence for key, item in found.items()}
    chosen, other = sorted(total, key=lambda key: -total[key])
    odds = math.exp(min(total[chosen] - total[other], 700.0))
    alarm = _alarm(PROCESSES[chosen], seen, fleet.beliefs[chosen], life, unit, rng)
    empty = replace(empty, process=chosen, odds=odds, alarm=alarm)
    if alarm:
        return replace(empty, remaining=_none(life, levels, "see the alarm"))
    belief = fleet.beliefs[chosen]
    passages = _Passages(PROCESSES[chosen], found[chosen], seen, belief.scale, life, rng)
    return replace(empty, remaining=tuple(_remaining(passages, level, unit) for level in levels))


class _Passages:
    """Draws of how long until a level is reached."""

    def __init__(
        self,
        process: Process,
        found: Posterior,
        seen: Increments,
        scale: float,
        life: Life,
        rng: np.random.Generator,
    ) -> None:
        picked = rng.choice(len(found.laws), len(found.laws), p=found.weights)
        self._laws = [found.laws[index] for index in picked]
        self._process, self._seen, self._scale = process, seen, scale
        self.age = float(life.age[-1])
        self.value, self.std = float(life.value[-1]), float(life.std[-1])
        self._rng = rng

    def draw(self, level: float) -> NDArray[np.float64]:
        """Hours or cycles from now, infinite for never."""
        out = []
        for law in self._laws:
            now = self._rng.normal(self.value, self.std, PASSAGES)
            clock = (self.age / self._scale) ** law.power
            passed = self._process.passage(self._seen, law, self._scale, now, level, self._rng)
            with np.errstate(over="ignore"):
                end = self._scale * (clock + passed) ** (1.0 / law.power)
            out.append(np.where(np.isnan(end), np.inf, end) - self.age)
        return np.concatenate(out)


def _remaining(passages: _Passages, level: float, unit: str) -> Remaining:
    if passages.value >= level:
        return Remaining(level, 0.0, 0.0, 0.0, "")
    drawn = passages.draw(level)
    low, median, high = (float(np.quantile(drawn, q, method="lower")) for q in INTERVAL)
    if not math.isfinite(high):
        return Remaining(
            level, None, None, None, "the wear that was seen need not ever reach this level"
        )
    if high > WIDEST * max(low, 1e-9):
        return Remaining(
            level, None, None, None, f"anything from {low:.3g} to {high:.3g} {unit}: too wide"
        )
    return Remaining(level, low, median, high, "")


def _none(life: Life, levels: Sequence[float], why: str) -> tuple[Remaining, ...]:
    """No number, but for levels that are reached already."""
    return tuple(
        Remaining(level, 0.0, 0.0, 0.0, "")
        if len(life.age) and life.value[-1] >= level
        else Remaining(level, None, None, None, why)
        for level in levels
    )


def _too_little(life: Life, seen: Increments, fleet: Fleet, unit: str) -> str:
    """Why the data cannot carry a number; empty if they may."""
    number, known = len(life.age), fleet.lives >= FLEET
    since = f"since {life.born:g} {unit}" if life.born else "of the unit"
    if number < LEAST_DIAGNOSES:
        return f"{number or 'no'} diagnos{'is' if number == 1 else 'es'} {since}, needs 3"
    needed = 1 if known else LEAST_INCREMENTS
    if len(seen) < needed:
        return (
            f"{number} diagnoses over {life.age[-1] - life.age[0]:g} {unit} show no growth"
            " beyond their noise" + ("" if not len(seen) else " more than once")
        )
    return ""


def _alarm(
    process: Process,
    seen: Increments,
    belief: Belief,
    life: Life,
    unit: str,
    rng: np.random.Generator,
) -> str:
    """Tell of the change that wear explains least, if it does not explain it at all."""
    fallen = float(life.value[0] - life.value[-1])
    if fallen > max(FALLEN, RESOLVED * float(np.hypot(life.std[0], life.std[-1]))):
        begin, end = (float(life.born + life.age[at]) for at in (0, -1))
        return f"{-fallen:+.3f} between {begin:g} and {end:g} {unit}: {NO_WEAR}"
    rates = (seen.high - seen.low) / (seen.end - seen.start)
    suspect = int(np.argmax(np.abs(rates - np.median(rates))))
    everyone = np.arange(len(seen))
    others, tried = seen.pick(everyone[everyone != suspect]), seen.pick(everyone[[suspect]])
    found = posterior(process, others, belief, DRAWS // 4, rng)
    if not math.isfinite(found.evidence):
        found = posterior(PROCESSES["Wiener"], others, belief, DRAWS // 4, rng)
        process = PROCESSES["Wiener"]
    chances = np.array([process.chances(others, tried, law, belief.scale) for law in found.laws])
    low, high = (float(found.weights @ chances[:, side]) for side in (0, 1))
    if min(low, high) >= UNLIKELY / len(seen):
        return ""
    change = float(tried.high[0] - tried.low[0])
    begin, end = (float(life.born + at[0]) for at in (tried.start, tried.end))
    what = f"{change:+.3f} between {begin:g} and {end:g} {unit}"
    if change < 0.0:
        return f"{what}: {NO_WEAR}"
    return f"{what}: no wear explains such a change (chance {min(low, high):.0e})"
