"""Study of the prognosis of remaining life on simulated units."""

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
from ehadiag_tools.prognosis.units import LIMIT, WornUnit, read_noise, simulate_unit
from ehadiag_tools.study import Options, Record, Study, markdown

SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares of the last life at which remaining life is forecast, 1."""
SETS = {"tuned": tuple(TUNED), "held-out": tuple(HELD_OUT), "all": tuple(LAWS)}
CENSORED_SHARE = (0.3, 0.8)
"""Shares of its last life at which a unit of a censored fleet is taken out, 1."""


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

    Of each: the share, the true remaining life over the life's length, whether the check raised an
    alarm, and the quantiles of the forecast; None where there is no number.
    """
    unit = simulate_unit(case.law, case.unit, read_noise(), case.seed)
    lives, fleet = _fleet(case.law, case.fleet, case.censored, case.seed)
    length = unit.end - unit.born
    asked = []
    for share in SHARES:
        life, earlier = _lives_until(unit, share)
        if len(life.age) < 2:
            continue
        own = learn_fleet([*lives, *earlier], fleet.scale, case.seed) if earlier else fleet
        found = forecast(unit.name, "hours", life, own, (LIMIT,), case.seed)
        (left,) = found.remaining
        numbers = None
        if left.median is not None:
            numbers = [value / length for value in (left.low, left.median, left.high)]
        true = (unit.end - life.born - life.age[-1]) / length
        asked.append((share, true, bool(found.alarm), numbers))
    return {"asked": asked}


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
    rows: list[tuple[str, ...]] = [("all", *_cells(records))]
    for law in SETS[options.laws]:
        part = [item for item in records if item["law"] == law]
        rows += [(law, *_cells(part))] if part else []
    for share in SHARES:
        rows.append((f"{share:.0%} of the life", *_cells(records, share)))
    heads = ("", "questions", "answered", "covered", "too late", "score", "alarms")
    yield from markdown(heads, rows)


def _cells(records: Sequence[Record], share: float | None = None) -> tuple[str, ...]:
    """Cells of the answers at a share of the life; None: at all of them."""
    asked = [item for record in records for item in record["asked"] if share in (None, item[0])]
    given = [(true, np.array(found)) for _, true, _, found in asked if found is not None]
    if not given:
        return (str(len(asked)), "0.0%", "–", "–", "–", "–")
    covered = np.mean([found[0] <= true <= found[2] for true, found in given])
    late = np.mean([true < found[0] for true, found in given])
    score = np.mean([quantile_score(true, found) for true, found in given])
    alarms = np.mean([alarm for _, _, alarm, _ in asked])
    return (
        str(len(asked)), f"{len(given) / len(asked):.1%}", f"{covered:.3f}", f"{late:.3f}",
        f"{score:.4f}", f"{alarms:.1%}",
    )  # fmt: skip


def quantile_score(true: float, found: NDArray[np.float64]) -> float:
    """Continuous ranked probability score by three quantiles: twice their mean pinball loss."""
    levels = np.array((0.1, 0.5, 0.9))
    return float(2.0 * np.mean(np.maximum(levels * (true - found), (levels - 1) * (true - found))))


PROGNOSIS = Study(
    "prognosis",
    "Remaining life of simulated units that wear by laws unknown to the forecast.",
    _cases, perform, _report, add_options=_add_options, counted="units",
)  # fmt: skip
