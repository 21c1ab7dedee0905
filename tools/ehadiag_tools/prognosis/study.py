"""Study of the prognosis of remaining life on simulated units, against its rivals."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ehadiag.prognosis.averaging import Fleet, learn_fleet
from ehadiag.prognosis.forecast import forecast
from ehadiag.prognosis.lives import Life, lives_of
from ehadiag_tools.prognosis.laws import HELD_OUT, LAWS, TUNED
from ehadiag_tools.prognosis.rivals import QUANTILES, age_alone, similar_lives
from ehadiag_tools.prognosis.units import LIMIT, WornUnit, read_noise, simulate_unit
from ehadiag_tools.study import Options, Record, Study, markdown

SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares of the last life at which remaining life is forecast, 1."""
SETS = {"tuned": tuple(TUNED), "held-out": tuple(HELD_OUT), "all": tuple(LAWS)}
CENSORED_SHARE = (0.3, 0.8)
"""Shares of its last life at which a unit of a censored fleet is taken out, 1."""
RIVALS = {"similar lives": similar_lives, "age alone": age_alone}
OURS = "ehadiag"
REPLICATES = 1000
"""Number of resamples of the units, for the interval of a difference."""


@dataclass(frozen=True, slots=True)
class LifeCase:
    """A simulated unit, its law of wear, its fleet, seed of all."""

    unit: int
    law: str
    fleet: int
    censored: bool
    seed: int


def perform(case: LifeCase) -> Record:
    """Forecast a unit's remaining life at each of `SHARES`.

    For each method the quantiles of the remaining life over the life's length, None where there is
    no number, beside the true one; and whether the forecast's check raised an alarm.
    """
    unit = simulate_unit(case.law, case.unit, read_noise(), case.seed)
    lives, fleet = _fleet(case.law, case.fleet, case.censored, case.seed)
    length = unit.end - unit.born
    out: Record = {"true": [], "alarm": [], OURS: [], **{name: [] for name in RIVALS}}
    for share in SHARES:
        life, earlier = _lives_until(unit, share)
        if len(life.age) < 2:
            continue
        own = learn_fleet([*lives, *earlier], fleet.scale, case.seed) if earlier else fleet
        found = forecast(unit.name, "hours", life, own, (LIMIT,), case.seed)
        (left,) = found.remaining
        numbers = None if left.median is None else [left.low, left.median, left.high]
        out["true"].append((unit.end - life.born - life.age[-1]) / length)
        out["alarm"].append(bool(found.alarm))
        out[OURS].append(None if numbers is None else (np.array(numbers) / length).tolist())
        for name, rival in RIVALS.items():
            guess = rival(life, [*lives, *earlier], LIMIT)
            out[name].append(None if guess is None else (guess / length).tolist())
    return out


@cache
def _fleet(law: str, size: int, censored: bool, seed: int) -> tuple[list[Life], Fleet]:
    """Lives of further units of a law, and what is learned from them."""
    noise, lives = read_noise(), []
    for number in range(size):
        unit = simulate_unit(law, 10_000 + number, noise, seed)
        share = np.random.default_rng((seed, number)).uniform(*CENSORED_SHARE) if censored else 1.0
        life, earlier = _lives_until(unit, float(share))
        lives += [item for item in (*earlier, life) if len(item.age) > 1]
    scale = float(np.median([life.age[-1] for life in lives])) if lives else 1000.0
    return lives, learn_fleet(lives, scale, seed)


def _lives_until(unit: WornUnit, share: float) -> tuple[Life, list[Life]]:
    """Last life as the history has it at a share of it, and the earlier ones."""
    now = unit.born + share * (unit.end - unit.born)
    entries = [item for item in unit.entries if (item.usage.hours or 0.0) <= now]
    found = lives_of(entries, unit.events, unit.name, "hours").values()
    none = np.empty(0)
    lives = next(iter(found), [Life(0, none, none, none, 0.0)])
    return lives[-1], lives[:-1]


def _cases(options: Options) -> list[LifeCase]:
    laws = SETS[options.laws]
    return [
        LifeCase(unit, laws[unit % len(laws)], options.fleet, options.censored, options.seed)
        for unit in range(options.cases)
    ]


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--laws", choices=SETS, default="all", help="(%(default)s)")
    parser.add_argument("--fleet", type=int, default=20, help="units of the fleet (%(default)d)")
    parser.add_argument("--censored", action="store_true", help="taken out before the limit")


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    fleet = f"{options.fleet}{' taken out early' if options.censored else ''}"
    yield f"{options.cases} units, laws {options.laws}, seed {options.seed}, fleet of {fleet}\n"
    heads = ("", "questions", "answered", "covered", "too late", "score", "alarms")
    rows: list[tuple[str, ...]] = [("all", *_cells(records, OURS))]
    for law in SETS[options.laws]:
        part = [item for item in records if item["law"] == law]
        rows += [(law, *_cells(part, OURS))] if part else []
    for index, share in enumerate(SHARES):
        rows.append((f"{share:.0%} of the life", *_cells(records, OURS, index)))
    rows += [(name, *_cells(records, name)) for name in RIVALS]
    yield from markdown(heads, rows)
    yield ""
    shown = ("rival", "its score less ours", "95 %", "questions that both answer")
    yield from markdown(shown, ((name, *_paired(records, name)) for name in RIVALS))


def _questions(
    records: Sequence[Record], method: str, place: int | None = None
) -> list[tuple[float, NDArray[np.float64] | None]]:
    out = []
    for record in records:
        first = len(SHARES) - len(record["true"])
        for index, (true, found) in enumerate(zip(record["true"], record[method], strict=True)):
            if place in (None, index + first):
                out.append((true, None if found is None else np.array(found)))
    return out


def _cells(records: Sequence[Record], method: str, place: int | None = None) -> tuple[str, ...]:
    asked = _questions(records, method, place)
    given = [(true, found) for true, found in asked if found is not None]
    if not given:
        return (str(len(asked)), "0.0%", "–", "–", "–", "–")
    covered = np.mean([found[0] <= true <= found[2] for true, found in given])
    late = np.mean([true < found[0] for true, found in given])
    score = np.mean([quantile_score(true, found) for true, found in given])
    alarms = np.mean(
        [
            alarm
            for record in records
            for index, alarm in enumerate(record["alarm"], len(SHARES) - len(record["alarm"]))
            if place in (None, index)
        ]
    )
    return (
        str(len(asked)), f"{len(given) / len(asked):.1%}", f"{covered:.3f}", f"{late:.3f}",
        f"{score:.4f}", f"{alarms:.1%}" if method == OURS else "–",
    )  # fmt: skip


def quantile_score(true: float, found: NDArray[np.float64]) -> float:
    """Continuous ranked probability score by three quantiles: twice their mean pinball loss."""
    levels = np.array(QUANTILES)
    return float(2.0 * np.mean(np.maximum(levels * (true - found), (levels - 1) * (true - found))))


def _paired(records: Sequence[Record], rival: str) -> tuple[str, ...]:
    """Mean difference of scores, and its interval by resampling units."""
    each, number = [], 0
    for record in records:
        pairs = zip(_questions([record], OURS), _questions([record], rival), strict=True)
        off = [
            quantile_score(true, theirs) - quantile_score(true, ours)
            for (true, ours), (_, theirs) in pairs
            if ours is not None and theirs is not None
        ]
        number += len(off)
        each += [off] if off else []
    if not each:
        return ("–", "–", "0")
    sums, counts = np.array([sum(off) for off in each]), np.array([len(off) for off in each])
    picks = np.random.default_rng(0).integers(0, len(each), (REPLICATES, len(each)))
    means = sums[picks].sum(axis=1) / counts[picks].sum(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return (f"{sums.sum() / number:+.4f}", f"{low:+.4f} … {high:+.4f}", str(number))


PROGNOSIS = Study(
    "prognosis",
    "Remaining life of simulated units that wear by laws unknown to the forecast, and rivals.",
    _cases, perform, _report, add_options=_add_options, counted="units",
)  # fmt: skip
