"""Predictions of a passage by all laws and similar lives, weighted and widened by their past.

A question is: a life at one of its diagnoses, and a level. The same question is put to earlier
diagnoses of the other lives and of the life itself, at the same ratio of level to severity, where
the answer is known by now. How well each law answered there weighs it (stacking); how far the
weighted answer was off widens or moves the interval (conformal calibration).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.prognosis.lives import Life
from ehadiag.prognosis.wear import (
    LAW_NAMES,
    Filtered,
    Laws,
    draw_laws,
    draw_passages,
    filter_lives,
    mean_rates,
)

Array = NDArray[np.float64]
POOL_NAME = "all laws"
MIN_SEVERITY = 1e-3
"""Severity, 1, below which a ratio to it means little: three deviations of a usual diagnosis."""
LIBRARY_NAMES = ("similar lives", "similar lives, own pace")


class AveragingRules(msgspec.Struct, frozen=True):
    """Settings of the average; chosen on the study's tuned laws (`tools/study prognosis`)."""

    max_lives: int = 40
    """Number of lives that are learned from, drawn evenly from all: 100 do not better the score."""
    max_diagnoses: int = 32
    """Number of diagnoses of a life that are filtered, evenly spaced."""
    min_lives: int = 3
    """Number of lives for a library of similar ones, and for rates of their own."""
    draws: int = 48
    """Number of passages drawn by each expert for a question."""
    evidence_power: float = 0.5
    """Power of the density of a life's diagnoses: laws are wrong, so their evidence counts less."""
    even_lives: float = 2.0
    """Lives that an even prior over the parameter sets stands for."""
    even_questions: float = 0.6
    """Questions that even weights of the experts stand for."""
    even_misses: float = 3.0
    """Lives that the experts' own statement of their misses stands for."""
    early: float = 1.4
    """Lower half of that statement over the upper one, 1: what speeds up is commoner."""
    stated_alone: float = 0.7
    """Both halves of it without a fleet, 1: there the other rules named `alone` hold."""
    unseen_quantile: float = 0.25
    """Quantile of the highest severities of the lives up to which the way counts as passed, 1."""
    later: float = 0.35
    """Least logarithm of the upper half of an interval without a fleet, and that over the logarithm
    of the way that few lives have passed with one, 1: growth may slow down."""
    swing_alone: float = 0.7
    """Least logarithm of each half without a fleet over the swing of the life's rate, 1: what rose
    and fell will do so again, as by the season."""
    swing_parts: int = 6
    """Number of parts of a life whose rates are compared for it."""
    law_power: float = 0.3
    """Power of a law's evidence in its weight, 1: the laws' disagreement stays in the interval."""
    level_shares: tuple[float, ...] = (1.0, 0.75, 0.5)
    """Levels of the past questions over the highest possible one, 1."""
    level_power: float = 6.0
    """Power of a past question's level, by which it counts among those of its life."""
    run_on_share: float = 0.6
    """Severity over the asked level from which a life that ended is run on to it, 1."""
    run_on_powers: tuple[float, float] = (-1.0, 3.0)
    """Least and largest power of the severity by which it is run on."""
    max_miss: float = 2.0
    """Half intervals that a past answer is off at most, 1; a normal deviate passes them in 1 %."""
    max_log_time: float = 8.0
    """Largest logarithm of remaining time over age, 1; a factor of 3000 stands for never."""


AVERAGING_RULES = AveragingRules()


class Fleet(msgspec.Struct, frozen=True, eq=False):
    """What other lives of a severity say."""

    lives: int
    """That show growth."""
    scale: float
    """Age at which the clock stands at 1, hours or cycles."""
    seen: tuple[Life, ...]
    """Those that are learned from."""
    highest: float
    """Highest severity of them, 1."""
    laws: Laws
    filtered: Filtered | None
    """None without lives."""
    rates: Array
    """Mean rate of each life by each parameter set, shape (lives, sets)."""
    shares: Array
    """How much of each life each parameter set explains, shape (lives, sets)."""


class Passage(msgspec.Struct, frozen=True):
    """Distribution of the time to a level."""

    quantiles: Array
    """At `CHANCES`, hours or cycles; infinite for never."""
    weights: dict[str, float]
    """Of each law, and of the similar lives."""
    misses: float
    """Lives by which the interval was calibrated."""


CHANCES = np.linspace(0.01, 0.99, 99)
SCORE_TIMES = np.geomspace(0.01, 6.0, 28)
"""Times over a life's length, 1, at which a past answer is scored; later ones count as the last."""
SCORE_STEP, LEAST_SCORE = 0.005, -37.0
SCORES = np.arange(LEAST_SCORE, 8.0, SCORE_STEP)
"""Normal deviates, 1, at which their chance is tabulated."""
SCORE_CHANCES = np.array([0.5 * math.erfc(-z / math.sqrt(2.0)) for z in SCORES])


def _normal_chance(score: NDArray[np.floating]) -> Array:
    """Chance of a normal deviate below these, to half a step of `SCORES`."""
    place = np.clip((score - LEAST_SCORE) * (1.0 / SCORE_STEP), 0.0, len(SCORES) - 1.0)
    return np.asarray(SCORE_CHANCES[np.rint(place).astype(np.int32)])


def _normal_score(chance: Array) -> Array:
    return np.interp(chance, SCORE_CHANCES, SCORES)


def learn_fleet(lives: Sequence[Life], scale: float, seed: int = 0) -> Fleet:
    """Learn from the lives of a fleet.

    lives: of one severity; only those that show growth count; scale: age at which the clock stands
    at 1, hours or cycles; seed: of the choice among many lives.
    """
    rules, laws = AVERAGING_RULES, draw_laws()
    grown = [_thinned(life) for life in lives if _has_grown(life)]
    picked = np.arange(len(grown))
    if len(grown) > rules.max_lives:
        rng = np.random.default_rng(seed)
        picked = np.sort(rng.choice(len(grown), rules.max_lives, replace=False))
    seen = tuple(grown[at] for at in picked)
    highest = max((float(life.value.max()) for life in grown), default=0.0)
    if not seen:
        empty = np.empty((0, len(laws.law)))
        return Fleet(0, scale, (), highest, laws, None, empty, empty)
    rates = np.array([mean_rates(laws, life, len(life.age) - 1, scale) for life in seen])
    usual, deviation = _rate_priors(rates)
    filtered = filter_lives(laws, seen, scale, usual, deviation)
    shares = _explained(filtered.score[-1].astype(np.float64))
    return Fleet(len(grown), scale, seen, highest, laws, filtered, rates, shares)


def _has_grown(life: Life) -> bool:
    """Whether a life has three diagnoses or more and growth beyond noise."""
    if len(life.age) < 3:
        return False
    return bool(life.value[-1] - life.value[0] > 5.0 * np.hypot(life.std[0], life.std[-1]))


def _thinned(life: Life) -> Life:
    if len(life.age) <= AVERAGING_RULES.max_diagnoses:
        return life
    at = np.unique(np.linspace(0, len(life.age) - 1, AVERAGING_RULES.max_diagnoses).astype(int))
    return Life(life.serial, life.age[at], life.value[at], life.std[at], life.born)


def _rate_priors(rates: Array) -> tuple[Array, Array]:
    """Mean and deviation of the rates of all other lives, for each life."""
    number = len(rates)
    if number < AVERAGING_RULES.min_lives:
        usual = np.maximum(np.abs(rates), 1e-9)
        return usual, usual
    others = (rates.sum(axis=0) - rates) / (number - 1)
    square = np.sum(rates**2, axis=0) - rates**2
    return _pooled_rate(others, np.maximum(square / (number - 1) - others**2, 0.0), number - 1)


def _pooled_rate(mean: Array, variance: Array, number: int) -> tuple[Array, Array]:
    """Mean and deviation of a further life's rate, by those of a number of lives."""
    usual = np.maximum(np.abs(mean), 1e-9)
    # One life more with half the mean's deviation: few lives are alike by chance.
    spread = np.sqrt((variance * number + 0.25 * usual**2) / (number + 1))
    return usual, np.maximum(spread, 0.05 * usual)


def _explained(scores: Array) -> Array:
    """Share of each life that each set explains, when the sets' own shares are those of all."""
    density = np.exp(AVERAGING_RULES.evidence_power * (scores - scores.max(axis=1, keepdims=True)))
    count = density.shape[1]
    prior = np.full(count, 1.0 / count)
    shares = np.empty_like(density)
    for _ in range(30):
        shares = density * prior
        shares /= shares.sum(axis=1, keepdims=True)
        total = shares.sum(axis=0) + AVERAGING_RULES.even_lives / count
        prior = total / total.sum()
    return shares


class _Questions(msgspec.Struct, frozen=True):
    """Questions with answers; a row each."""

    life: NDArray[np.int64]
    """Place among the fleet's lives; the number of lives for the life itself."""
    at: NDArray[np.int64]
    """Place of the diagnosis."""
    age: Array
    severity: Array
    level: Array
    answer: Array
    """Time from the diagnosis to the level; NaN where it is not known yet."""


class OwnLife(msgspec.Struct, frozen=True, eq=False):
    """A life whose passage is asked for."""

    life: Life
    filtered: Filtered
    """About the rates of the fleet, else about its own first ones."""


def passage_of(own: OwnLife, fleet: Fleet, level: float, seed: int) -> Passage:
    """Predict the time from a life's last diagnosis to a level.

    own: of at least two diagnoses, the last one below the level; fleet: what other lives say;
    level: severity, 1. Returns its distribution, calibrated.
    """
    rng, rules = np.random.default_rng(seed), AVERAGING_RULES
    life, filtered = own.life, own.filtered
    lives = (*fleet.seen, life)
    asked = _questions(lives, level)
    drawn, likely, names = _draw(asked, lives, fleet, filtered, rng)
    past = ~np.isnan(asked.answer)
    counted = _counts(asked, past)
    truth = np.log(asked.answer[past] / asked.age[past])
    stacked = _stacked(drawn[:, past], likely[:, past], truth, counted[past])
    weights = stacked[:, None] * likely
    weights /= weights.sum(axis=0)
    median, low, high = _middle(drawn, weights)
    off = truth - median[past]
    miss = off / np.where(off > 0.0, high[past] - median[past], median[past] - low[past])
    alone = len(fleet.seen) < rules.min_lives
    halves = (rules.stated_alone, rules.stated_alone) if alone else (rules.early, 1.0)
    calibrated = _calibrated(miss, counted[past], halves)
    middle, lower, upper = float(median[-1]), float(low[-1]), float(high[-1])
    logs = middle + np.where(calibrated > 0.0, upper - middle, middle - lower) * calibrated
    passed = [MIN_SEVERITY, float(life.value.max())]
    if not alone:
        tops = [float(item.value.max()) for item in fleet.seen]
        passed.append(float(np.quantile(tops, rules.unseen_quantile)))
    # Where few lives have passed, growth may speed up in proportion to the severity.
    earlier = max(math.log(level / max(passed)), 0.0)
    later = rules.later * (1.0 if alone else earlier)
    if alone:
        swing = rules.swing_alone * _swing(life)
        earlier, later = max(earlier, swing), max(later, swing)
    least = np.where(CHANCES < 0.5, earlier, later)
    least *= _normal_score(CHANCES) / _normal_score(np.array(0.9))
    apart = logs - np.median(logs)
    logs += np.where(np.abs(apart) < np.abs(least), least - apart, 0.0)
    never = logs > rules.max_log_time - 0.01
    quantiles = np.where(never, np.inf, np.exp(np.minimum(logs, rules.max_log_time)))
    found = {name: float(weight) for name, weight in zip(names, weights[:, -1], strict=True)}
    return Passage(quantiles * float(life.age[-1]), found, float(counted[past].sum()))


def _swing(life: Life) -> float:
    """Lesser of the largest rise and the largest fall of a life's rate, as logarithms."""
    ends = np.linspace(0.0, life.age[-1], AVERAGING_RULES.swing_parts + 1)
    top = np.maximum.accumulate(np.r_[0.0, life.value])
    grown = np.diff(np.interp(ends, np.r_[0.0, life.age], top))
    rate = np.log(np.maximum(grown, life.std.max()))  # less is noise
    rise = np.max(rate - np.minimum.accumulate(rate))
    return float(min(rise, np.max(np.maximum.accumulate(rate) - rate)))


def filter_own(life: Life, fleet: Fleet) -> OwnLife:
    """Filter a life of at least two diagnoses."""
    laws, life = fleet.laws, _thinned(life)
    if len(fleet.seen) >= AVERAGING_RULES.min_lives:
        usual, deviation = _pooled_rate(fleet.rates.mean(axis=0), fleet.rates.var(axis=0),
                                        len(fleet.seen))  # fmt: skip
    else:
        first = min(max(2, len(life.age) // 3), len(life.age) - 1)
        usual = np.maximum(np.abs(mean_rates(laws, life, first, fleet.scale)), 1e-9)
        deviation = usual
    return OwnLife(life, filter_lives(laws, [life], fleet.scale, usual[None], deviation[None]))


def _questions(lives: Sequence[Life], level: float) -> _Questions:
    """Ask each life at up to three diagnoses what the last one is asked; the last row is that."""
    now = lives[-1]
    ratio = level / max(float(now.value[-1]), MIN_SEVERITY)
    rows = []
    for number, life in enumerate(lives):
        top = np.maximum.accumulate(life.value)
        done = set()
        for share in AVERAGING_RULES.level_shares:
            begin = share * min(level, float(top[-1])) / ratio
            at = int(np.searchsorted(top, begin, side="right")) - 1
            if at < 1 or at >= len(life.age) - 1 or at in done:
                continue
            goal = max(float(top[at]), MIN_SEVERITY) * ratio
            if goal > top[-1] or goal <= top[at]:
                continue
            after = int(np.searchsorted(top, goal))
            step = max(float(top[after] - top[after - 1]), 1e-12)
            part = (goal - float(top[after - 1])) / step
            end = life.age[after - 1] + part * (life.age[after] - life.age[after - 1])
            left = max(float(end - life.age[at]), 1e-3 * float(life.age[at]))
            done.add(at)
            rows.append((number, at, life.age[at], life.value[at], goal, left))
    last = len(now.age) - 1
    rows.append((len(lives) - 1, last, now.age[-1], now.value[-1], level, np.nan))
    columns = np.array(rows, dtype=np.float64).T
    return _Questions(columns[0].astype(np.int64), columns[1].astype(np.int64), *columns[2:])


def _counts(asked: _Questions, past: NDArray[np.bool_]) -> Array:
    """How much each question counts: a life by its highest level over the asked one."""
    share = asked.level / asked.level[-1]
    weight = np.where(past, share**AVERAGING_RULES.level_power, 0.0)
    total, highest = np.zeros((2, int(asked.life.max()) + 1))
    np.add.at(total, asked.life, weight)
    np.maximum.at(highest, asked.life, np.where(past, share, 0.0))
    return np.asarray(weight * (highest / np.maximum(total, 1e-12))[asked.life])


def _draw(
    asked: _Questions,
    lives: Sequence[Life],
    fleet: Fleet,
    own: Filtered,
    rng: np.random.Generator,
) -> tuple[Array, Array, list[str]]:
    """Logarithms of drawn times over the age, shape (experts, questions, draws).

    And the likelihood of each expert before each question, over that of the best; the names.
    """
    rules, laws, number = AVERAGING_RULES, fleet.laws, len(fleet.seen)
    count, sets = len(asked.life), len(laws.law)
    mine = asked.life == number
    columns = []
    names = ("level", "rate", "level_variance", "covariance", "rate_variance", "score")
    for name in names:
        column = np.empty((count, sets))
        column[mine] = getattr(own, name)[asked.at[mine], 0]
        if fleet.filtered is not None:
            column[~mine] = getattr(fleet.filtered, name)[asked.at[~mine], asked.life[~mine]]
        columns.append(column)
    usual = np.empty((count, sets))
    usual[mine] = own.usual_rate[0]
    if fleet.filtered is not None:
        usual[~mine] = fleet.filtered.usual_rate[asked.life[~mine]]
    # What the other lives say of the sets, never the life itself.
    total = fleet.shares.sum(axis=0) + rules.even_lives / sets
    others = np.repeat(total[None], count, axis=0)
    others[~mine] -= fleet.shares[asked.life[~mine]]
    prior = np.log(others)
    logs = prior + rules.evidence_power * columns[5]
    groups = [np.flatnonzero(laws.law == law) for law in range(len(LAW_NAMES))]
    groups.append(np.arange(sets))
    out = []
    evidence = []
    even = (np.arange(rules.draws) + 0.5) / rules.draws
    for group in groups:
        part = logs[:, group]
        best = part.max(axis=1, keepdims=True)
        weight = np.cumsum(np.exp(part - best), axis=1)
        evidence.append(best[:, 0] + np.log(weight[:, -1] / len(group)))
        weight /= weight[:, -1:]
        picked = group[np.sum(weight[:, None, :-1] < even[:, None], axis=2)]
        row = np.arange(count)[:, None]
        state = tuple(item[row, picked].ravel() for item in (*columns[:5], usual))
        level, rate, pzz, pza, paa, mean = state
        times = draw_passages(
            laws, picked.ravel(), (level, rate, pzz, pza, paa, mean),
            np.repeat(asked.age, rules.draws), np.repeat(asked.level, rules.draws),
            fleet.scale, rng,
        ).reshape(count, rules.draws)  # fmt: skip
        out.append(times / asked.age[:, None])
    found = [*LAW_NAMES, POOL_NAME]
    best = np.max(evidence[:-1], axis=0)
    likely = np.exp(rules.law_power * (np.array([*evidence[:-1], best]) - best))
    if number >= rules.min_lives:
        out += _draw_similar(asked, lives, rng)
        found += LIBRARY_NAMES
        likely = np.concatenate([likely, np.ones((len(LIBRARY_NAMES), count))])
    with np.errstate(divide="ignore"):
        return np.clip(np.log(np.array(out)), -12.0, rules.max_log_time), likely, found


def _draw_similar(
    asked: _Questions, lives: Sequence[Life], rng: np.random.Generator
) -> list[Array]:
    """Draw what was left of similar lives, as it was and at the pace of the asked one."""
    rules, others, count = AVERAGING_RULES, len(lives) - 1, len(asked.life)
    shares = np.array([0.25, 0.5, 0.75, 1.0])
    points = shares * np.maximum(asked.severity, MIN_SEVERITY)[:, None]
    points = np.column_stack([points, asked.level])
    passed = np.empty((count, len(shares)))
    for row, (number, at) in enumerate(zip(asked.life, asked.at, strict=True)):
        life = lives[number]
        passed[row] = _crossed(life.value[: at + 1], life.age[: at + 1], points[row, :-1])
    apart, left, pace = (np.full((count, others), np.inf) for _ in range(3))
    run_on = partial(_run_on, level=float(asked.level.max()))
    for other, life in enumerate(map(run_on, lives[:-1])):
        # A life that did not get as far is compared at the same ratio of severities.
        scale = np.minimum(asked.level, life.value.max()) / asked.level
        crossed = _crossed(life.value, life.age, points * scale[:, None])
        fits = (crossed[:, -1] > crossed[:, -2]) & (asked.life != other)
        off = np.log(passed / crossed[:, :-1])
        apart[fits, other] = np.sqrt(np.mean(off[fits] ** 2, axis=1))
        left[:, other] = (crossed[:, -1] - crossed[:, -2]) / asked.age
        pace[:, other] = asked.age / crossed[:, -2]
    # A quarter of the lives, two at least, are similar ones.
    near = np.sort(apart, axis=1)[:, min(max(2, others // 4), others - 1)]
    near = np.where(np.isfinite(near), np.maximum(near, 1e-3), 1.0)[:, None]
    weight = np.exp(-0.5 * (apart / near) ** 2) + 1e-12
    total = np.cumsum(weight, axis=1)
    chance = rng.random((count, rules.draws)) * total[:, -1:]
    pick = np.sum(total[:, None, :] < chance[..., None], axis=2)
    jitter = np.exp(0.1 * rng.standard_normal((count, rules.draws)))
    return [np.take_along_axis(column, pick, axis=1) * jitter for column in (left, left * pace)]


def _run_on(life: Life, level: float) -> Life:
    """Run a life that ended near a level on to it: its rate is a power of the severity."""
    rules, top = AVERAGING_RULES, float(life.value[-1])
    if not rules.run_on_share * level <= top < level:
        return life
    rates = np.diff(life.value[-3:]) / np.diff(life.age[-3:])
    if rates.min() <= 0.0:
        rates = np.full(2, (top - life.value[0]) / (life.age[-1] - life.age[0]))
    middles = 0.5 * (life.value[-3:-1] + life.value[-2:])
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.log(rates[1] / rates[0]) / np.log(middles[1] / middles[0])
    power = np.clip(np.nan_to_num(power), *rules.run_on_powers)
    path = np.linspace(top, level, 9)
    slowness = (middles[1] / path) ** power / rates[1]
    steps = np.cumsum(0.5 * (slowness[1:] + slowness[:-1]) * np.diff(path))
    return replace(
        life, age=np.r_[life.age, life.age[-1] + steps], value=np.r_[life.value, path[1:]]
    )


def _crossed(value: Array, ages: Array, levels: Array) -> Array:
    """Ages at which severities were passed first, in a line from 0 to the first diagnosis."""
    top = np.maximum.accumulate(np.maximum(value, 0.0))
    rising = np.concatenate([[0.0], top]) + 1e-12 * np.arange(len(top) + 1)
    found = np.interp(levels, rising, np.concatenate([[0.0], ages]))
    return np.maximum(found, 1e-6 * ages[-1])


def _stacked(drawn: Array, likely: Array, truth: Array, counted: Array) -> Array:
    """Weights of the experts that give the answers the least score together.

    That is the continuous ranked probability score over a life's length, over that of even weights.
    """
    rules, experts = AVERAGING_RULES, len(drawn)
    even = weights = np.full(experts, 1.0 / experts)
    times = np.log(SCORE_TIMES) + np.logaddexp(0.0, truth)[:, None]
    reached = np.array([np.mean(item[..., None] <= times[:, None], axis=1) for item in drawn])
    steps, usual = np.gradient(SCORE_TIMES), 0.0
    for _ in range(30 if len(truth) else 0):
        mixed = weights[:, None] * likely
        mixed /= mixed.sum(axis=0)
        off = np.einsum("en,ent->nt", mixed, reached) - (truth[:, None] <= times)
        usual = usual or max(float(np.average(off**2 @ steps, weights=counted)), 1e-9)
        slope = np.einsum("nt,ent->en", 2.0 * off * steps, reached)
        slope = mixed * (slope - np.sum(mixed * slope, axis=0)) @ counted / usual
        slope += rules.even_questions * (weights - even)
        weights = weights * np.exp(-10.0 * slope / (counted.sum() + rules.even_questions))
        weights /= weights.sum()
    return np.asarray(weights)


def _middle(drawn: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Median and 10 % and 90 % quantiles of the weighted draws of each question."""
    _, number, draws = drawn.shape
    pooled = np.moveaxis(drawn, 1, 0).reshape(number, -1)
    order = np.argsort(pooled, axis=1)
    share = np.take_along_axis(np.repeat(weights.T / draws, draws, axis=1), order, axis=1)
    total = np.cumsum(share, axis=1) - 0.5 * share
    ranked = np.take_along_axis(pooled, order, axis=1)
    low, median, high = np.array(
        [np.interp((0.1, 0.5, 0.9), at, row) for at, row in zip(total, ranked, strict=True)]
    ).T
    # Half an interval is at least 2 %: no answer is known better than between two diagnoses.
    return median, np.minimum(low, median - 0.02), np.maximum(high, median + 0.02)


def _calibrated(miss: Array, counted: Array, halves: tuple[float, float]) -> Array:
    """Quantiles of the misses at `CHANCES`, in half intervals, beside those that were stated.

    halves: lower and upper half of those, 1.
    """
    rules = AVERAGING_RULES
    stated = _normal_score((np.arange(99) + 0.5) / 99) / _normal_score(np.array(0.9))
    stated *= np.where(stated < 0.0, *halves)
    every = np.r_[np.clip(miss, -rules.max_miss, rules.max_miss), stated]
    weight = np.r_[counted, np.full(99, rules.even_misses / 99)]
    order = np.argsort(every)
    at = np.cumsum(weight[order]) - 0.5 * weight[order]
    return np.interp(CHANCES, at / weight.sum(), every[order])


def surprises(own: OwnLife, fleet: Fleet) -> tuple[Array, Array]:
    """Return how unexpected each diagnosis of a life was, and each one of the fleet.

    own: of at least two diagnoses; fleet: what other lives say. Returns deviations of the
    prediction before it, signed; of the life from its second diagnosis.
    """
    mine = _weighted_surprise(own.filtered, np.zeros((1, len(fleet.laws.law))), fleet)[:, 0]
    if fleet.filtered is None:
        return mine, np.empty(0)
    theirs = _weighted_surprise(fleet.filtered, fleet.shares, fleet)
    count = np.array([len(item.age) for item in fleet.seen])
    there = np.arange(1, theirs.shape[0] + 1)[:, None] < count
    return mine, theirs[there]


def _weighted_surprise(filtered: Filtered, own: Array, fleet: Fleet) -> Array:
    """Normal score of each diagnosis's chance, a mean over the sets by their weights before it."""
    rules, sets = AVERAGING_RULES, filtered.score.shape[2]
    prior = np.log(fleet.shares.sum(axis=0) - own + rules.even_lives / sets)
    logs = prior + rules.evidence_power * filtered.score[:-1]
    weight = np.exp(logs - logs.max(axis=2, keepdims=True))
    weight /= weight.sum(axis=2, keepdims=True)
    side = np.where(np.sum(weight * filtered.surprise[1:], axis=2) < 0.0, 1.0, -1.0)
    chance = np.sum(weight * _normal_chance(side[..., None] * filtered.surprise[1:]), axis=2)
    return np.asarray(side * _normal_score(chance))
