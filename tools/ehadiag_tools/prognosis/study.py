"""Measures the prognosis of remaining life on simulated units, beside its rivals."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.prognosis.forecast import Fleet, forecast, learn_fleet
from ehadiag.prognosis.lives import Life, lives_of
from ehadiag_tools.prognosis.noise import TABLE, measure, read_table
from ehadiag_tools.prognosis.rivals import Guess, Rival, bayesian_line, line, particle_filter
from ehadiag_tools.prognosis.units import LAWS, LIMIT, Unit, make_unit

__all__ = ["main"]

Array = NDArray[np.float64]
OURS = "ehadiag"
SHARES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Of the last life, at which remaining life is asked for."""
LAMBDA, ALPHA = 0.5, 0.2
TRAINING = 20
"""Units of a fleet whose whole lives are known; none of those that are judged."""
FIRST_TRAINING = 10_000
BOOTSTRAPS = 2000
NOMINAL = 0.8
KEYS = ("near", "horizon", "error")


@dataclass(frozen=True, slots=True)
class Score:
    """One method on one unit."""

    covered: tuple[bool | None, ...]
    """At each share of the life; None: no number."""
    error: float
    """Mean of the median's error, of the life; 1 where there is no number."""
    near: bool
    """Within alpha of the true remaining life at lambda."""
    horizon: float
    """Share of the life before its end from which the median stays within alpha of the life."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, in Markdown."""
    parser = argparse.ArgumentParser(prog="tools/prognosis", description=__doc__)
    parser.add_argument("--units", type=int, default=200, metavar="N")
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    parser.add_argument(
        "--measure-noise", type=int, metavar="N", help="diagnose N simulated tests, write the table"
    )
    given = parser.parse_args(arguments)
    if given.measure_noise:
        rows = list(measure(given.measure_noise, given.seed))
        with TABLE.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        print(f"wrote {TABLE}")
        return 0
    _print(study(given.units, given.seed), given)
    return 0


def study(number: int, seed: int) -> dict[str, dict[str, list[Score]]]:
    """Score each method on each unit: by law, then by method."""
    noise = read_table()
    rivals: dict[str, Rival] = {"straight line": line, "Bayesian line": bayesian_line}
    particles = particle_filter()
    if particles is None:
        print("progpy is not installed: left out", file=sys.stderr)
    else:
        rivals["progpy particle filter"] = particles
    out: dict[str, dict[str, list[Score]]] = {}
    for index, law in enumerate(LAWS):
        trained = [_lives(make_unit(law, FIRST_TRAINING + i, noise, seed)) for i in range(TRAINING)]
        lives = [life for unit in trained for life in unit if len(life.age) > 1]
        fleet = learn_fleet(lives, float(np.median([life.age[-1] for life in lives])), seed)
        units = [make_unit(law, i, noise, seed) for i in range(index, number, len(LAWS))]
        out[law] = {OURS: [_ours(unit, fleet, seed) for unit in units]}
        for name, rival in rivals.items():
            out[law][name] = [_theirs(unit, rival, lives, seed) for unit in units]
    return out


def _lives(unit: Unit) -> list[Life]:
    (found,) = lives_of(unit.entries, unit.events, unit.name, "hours").values()
    return found


def _until(unit: Unit, share: float) -> Life:
    """Return the last life as the history says it at a share of it."""
    now = unit.born + share * (unit.end - unit.born)
    entries = [item for item in unit.entries if (item.usage.hours or 0.0) <= now]
    (found,) = lives_of(entries, unit.events, unit.name, "hours").values()
    return found[-1]


def _ours(unit: Unit, fleet: Fleet, seed: int) -> Score:
    def guess(life: Life) -> Guess | None:
        (left,) = forecast(unit.name, "hours", life, fleet, (LIMIT,), seed).remaining
        if left.low is None or left.median is None or left.high is None:
            return None
        return Guess(left.low, left.median, left.high)

    return _score(unit, [(_until(unit, share), guess) for share in SHARES])


def _theirs(unit: Unit, rival: Rival, fleet: Sequence[Life], seed: int) -> Score:
    rng = np.random.default_rng((seed, 1))

    def guess(life: Life) -> Guess | None:
        return rival(life, fleet, LIMIT, rng) if len(life.age) else None

    return _score(unit, [(_until(unit, share), guess) for share in SHARES])


def _score(unit: Unit, asked: Sequence[tuple[Life, object]]) -> Score:
    whole = unit.end - unit.born
    covered: list[bool | None] = []
    errors, within = [], []
    near = False
    for share, (life, guess) in zip(SHARES, asked, strict=True):
        assert callable(guess)
        found = guess(life)
        if found is None:
            covered.append(None)
            errors.append(1.0)
            within.append(False)
            continue
        true = unit.end - life.born - life.age[-1]
        covered.append(bool(found.low <= true <= found.high))
        off = abs(found.median - true)
        errors.append(min(off / whole, 1.0))
        within.append(off <= ALPHA * whole)
        near |= share == LAMBDA and off <= ALPHA * true
    steady = 0
    while steady < len(within) and within[-1 - steady]:
        steady += 1
    horizon = 1.0 - SHARES[-steady] if steady else 0.0
    return Score(tuple(covered), float(np.mean(errors)), near, horizon)


def _print(found: dict[str, dict[str, list[Score]]], given: argparse.Namespace) -> None:
    print(f"{given.units} units, seed {given.seed}; fleet of {TRAINING} further units a law\n")
    print("| law | method | numbers | coverage | coverage at λ | α-λ | horizon | error |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    methods = list(next(iter(found.values())))
    whole = {name: [score for law in found.values() for score in law[name]] for name in methods}
    for law, scores in (*found.items(), ("all", whole)):
        for name in methods:
            print(f"| {law} | {name} | {' | '.join(_cells(scores[name]))} |")
    print("\nDifference of the units' mean, ours less the other's, with its 95 % interval:\n")
    print("| law | other | coverage off 80 % | α-λ | horizon | error |")
    print("| --- | --- | --- | --- | --- | --- |")
    for law, scores in (*found.items(), ("all", whole)):
        for name in methods[1:]:
            cells = [_difference(scores, name, COVERAGE)]
            cells += [_difference(scores, name, _mean_of(key)) for key in KEYS]
            print(f"| {law} | {name} | {' | '.join(cells)} |")


def _cells(scores: Sequence[Score]) -> tuple[str, ...]:
    told = [item for score in scores for item in score.covered if item is not None]
    at = [score.covered[SHARES.index(LAMBDA)] for score in scores]
    halfway = [item for item in at if item is not None]
    return (
        f"{len(told) / (len(scores) * len(SHARES)):.1%}",
        f"{np.mean(told):.1%}",
        f"{np.mean(halfway):.1%}",
        f"{np.mean([score.near for score in scores]):.1%}",
        f"{np.mean([score.horizon for score in scores]):.3f}",
        f"{np.mean([score.error for score in scores]):.4f}",
    )


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of many units: numerator and denominator of each, and what their ratio tells."""

    parts: Callable[[Sequence[Score]], Array]
    told: Callable[[Array], Array]


def _mean_of(key: str) -> Figure:
    def mean(scores: Sequence[Score]) -> Array:
        values = np.array([float(getattr(score, key)) for score in scores])
        return np.column_stack([values, np.ones_like(values)])

    return Figure(mean, lambda shares: shares)


def _counts(scores: Sequence[Score]) -> Array:
    return np.array(
        [(sum(map(bool, item.covered)), len(item.covered) - item.covered.count(None))
         for item in scores],
        dtype=np.float64,
    )  # fmt: skip


COVERAGE = Figure(_counts, lambda shares: np.abs(shares - NOMINAL))
"""How far the share of intervals that hold the truth is from what they claim."""


def _difference(scores: Mapping[str, Sequence[Score]], other: str, figure: Figure) -> str:
    """Ours less the other's, with its 95 % interval by bootstrap over units."""
    ours, theirs = (figure.parts(scores[name]) for name in (OURS, other))
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(ours), size=(BOOTSTRAPS, len(ours)))

    def gap(chosen: NDArray[np.intp]) -> Array:
        a, b = (figure.told(_ratio(part[chosen])) for part in (ours, theirs))
        return a - b

    found = float(gap(np.arange(len(ours))[None, :])[0])
    low, high = np.quantile(gap(drawn), (0.025, 0.975))
    return f"{found:+.3f} ({low:+.3f} … {high:+.3f})"


def _ratio(parts: Array) -> Array:
    sums: Array = parts.sum(axis=1)
    return sums[:, 0] / np.maximum(sums[:, 1], 1.0)


if __name__ == "__main__":
    raise SystemExit(main())
