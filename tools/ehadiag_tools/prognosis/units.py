"""Study of the prognosis of remaining life on simulated units that wear by a law.

They are diagnosed with the noise of real diagnoses. The forecast, which contains none of the laws
but `steady`, was chosen on `TUNED`; `HELD_OUT` were simulated for the first time when it was
finished.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pandas
from numpy.typing import NDArray

from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, MaintenanceEvent, SourceRecord, Usage
from ehadiag.prognosis.averaging import CHANCES, Fleet, learn_fleet
from ehadiag.prognosis.forecast import forecast
from ehadiag.prognosis.lives import Life, lives_of
from ehadiag_tools.study import Options, Record, Study, case_of, markdown

Array = NDArray[np.float64]
GRID_H, LONGEST_H = 2.0, 20_000.0
"""Step of a simulated life, h, and its longest length."""
RATE = 1.0 / 3000.0
"""Growth of the severity of a usual unit, 1/h."""
HOURS = GRID_H * np.arange(1, int(LONGEST_H / GRID_H) + 1)


def steady(rng: np.random.Generator) -> Array:
    """Wiener process with drift; drifts differ by a lognormal factor."""
    growth = _rate(rng) * GRID_H + 0.1 * np.sqrt(RATE * GRID_H) * _normal(rng)
    return np.cumsum(growth)


def speeding_up(rng: np.random.Generator) -> Array:
    """Gamma process whose mean grows by the 1.5th power of the hours; scales differ."""
    clock = np.diff(np.r_[0.0, HOURS * RATE] ** 1.5)
    spread = 0.12
    rate = 0.6 * np.exp(0.25 * rng.standard_normal())
    return np.cumsum(rng.gamma(clock / spread**2, rate * spread**2))


def clogging(rng: np.random.Generator) -> Array:
    """Growth in proportion to what is there, with a rate that wanders."""
    rate = 1.5 * RATE * np.exp(0.2 * rng.standard_normal())
    exponent = np.cumsum(rate * GRID_H + 0.08 * np.sqrt(RATE * GRID_H) * _normal(rng))
    return 0.1 * np.expm1(np.maximum.accumulate(np.minimum(exponent, 9.0)))


def season(rng: np.random.Generator) -> Array:
    """A rate that swings by 80 % over a year of 900 h."""
    swing = 1.0 + 0.8 * np.sin(2.0 * np.pi * (HOURS / 900.0 + rng.random()))
    return np.cumsum(_rate(rng) * GRID_H * swing * np.exp(0.2 * _normal(rng)))


def shocks(rng: np.random.Generator) -> Array:
    """Slow growth, and shocks of exponential size every 250 h on average."""
    jumps = rng.poisson(GRID_H / 250.0, len(HOURS)) * rng.exponential(0.05, len(HOURS))
    return np.cumsum(0.4 * _rate(rng) * GRID_H + jumps)


def routes(rng: np.random.Generator) -> Array:
    """Two routes, one wears four times as fast; a change every 600 h on average."""
    fast = (rng.random() < 0.5) ^ (np.cumsum(rng.random(len(HOURS)) < GRID_H / 600.0) % 2 == 1)
    return np.cumsum(_rate(rng) * GRID_H * np.where(fast, 1.7, 0.42))


def sigmoid(rng: np.random.Generator) -> Array:
    """Slow, fast, slow: a logistic curve through the middle of a life."""
    middle, width = 1500.0 * np.exp(0.25 * rng.standard_normal()), rng.uniform(250.0, 450.0)
    curve = rng.uniform(0.85, 1.1) / (1.0 + np.exp(-(HOURS - middle) / width))
    return _never_falling(curve - curve[0] + 1e-5 * HOURS + _wander(rng, 0.02))


def paris(rng: np.random.Generator) -> Array:
    """A crack by Paris' law: the rate is a power, 1.3 to 1.8, of the length."""
    power, begin = rng.uniform(1.3, 1.8), 0.02
    first, last = begin ** (1.0 - power), (begin + 0.75) ** (1.0 - power)
    share = HOURS / (2000.0 * np.exp(0.25 * rng.standard_normal()))
    left = np.maximum(first - (first - last) * share, 0.3 * last)
    grown = left ** (-1.0 / (power - 1.0)) - begin
    return np.maximum.accumulate(grown * np.exp(_wander(rng, 0.05)))


def run_in_then_fast(rng: np.random.Generator) -> Array:
    """Run-in, a long quiet time, then three to six times as fast."""
    knee = rng.uniform(900.0, 1700.0)
    rate = 0.45 * _rate(rng) * np.where(knee > HOURS, 1.0, rng.uniform(3.0, 6.0))
    return 0.08 * -np.expm1(-HOURS / 120.0) + np.cumsum(rate * GRID_H) + _wander(rng, 0.005)


def wandering_rate(rng: np.random.Generator) -> Array:
    """A rate whose logarithm is an Ornstein-Uhlenbeck process of 400 h."""
    return np.cumsum(_rate(rng) * GRID_H * np.exp(0.6 * _correlated(rng, 400.0)))


def standing(rng: np.random.Generator) -> Array:
    """Growth that stands still for half of the time, in pauses of 300 h on average."""
    moving = np.cumsum(rng.random(len(HOURS)) < GRID_H / 300.0) % 2 == 0
    return np.cumsum(1.8 * _rate(rng) * GRID_H * moving)


def filter_changed(rng: np.random.Generator) -> Array:
    """Growth with the square root of the hours, in lives that a change of the filter ends."""
    return _never_falling(0.6 * np.sqrt(HOURS * _rate(rng)) + _wander(rng, 0.02))


def mixed_fleet(rng: np.random.Generator) -> Array:
    """Every third part is of another supplier: three times as fast, and speeding up."""
    if rng.random() < 1.0 / 3.0:
        return np.asarray((HOURS * 1.6 * _rate(rng)) ** 1.7 + _wander(rng, 0.01))
    return np.asarray(0.8 * HOURS * _rate(rng) + _wander(rng, 0.01))


def running_away(rng: np.random.Generator) -> Array:
    """Hyperbolic growth: the rate is infinite at an age of 1200 to 2600 h."""
    end = rng.uniform(1200.0, 2600.0)
    return np.asarray(0.06 * (1.0 / np.maximum(1.0 - HOURS / end, 0.02) - 1.0)) + _wander(rng, 5e-3)


def bathtub(rng: np.random.Generator) -> Array:
    """Saturating run-in, then growth by the cube of the hours."""
    age = HOURS / (2200.0 * np.exp(0.2 * rng.standard_normal()))
    return 0.3 * -np.expm1(-4.0 * age) + 0.5 * age**3 + _wander(rng, 0.005)


def summers(rng: np.random.Generator) -> Array:
    """Wear in the warm half of a year of 1500 h, little in the cold one."""
    warm = np.maximum(np.sin(2.0 * np.pi * (HOURS / 1500.0 + rng.random())), 0.0)
    return np.cumsum(_rate(rng) * GRID_H * (0.15 + 2.6 * warm))


def heavy_shocks(rng: np.random.Generator) -> Array:
    """Shocks with a Pareto tail every 150 h on average, and next to no growth between."""
    hit = rng.random(len(HOURS)) < GRID_H / 150.0
    return np.cumsum(0.2 * _rate(rng) * GRID_H + hit * 0.015 * (1.0 + rng.pareto(1.8, len(HOURS))))


def three_routes(rng: np.random.Generator) -> Array:
    """Three routes that wear as 1 to 3 to 6; a unit stays for 1000 h on average."""
    turn = np.cumsum(rng.random(len(HOURS)) < GRID_H / 1000.0)
    factors = np.array([0.35, 1.05, 2.1])[rng.integers(0, 3, int(turn[-1]) + 1)]
    return np.cumsum(_rate(rng) * GRID_H * factors[turn])


def gompertz(rng: np.random.Generator) -> Array:
    """Gompertz' curve: an early and steep rise, a long tail."""
    rate = 1.0 / rng.uniform(500.0, 900.0)
    curve = rng.uniform(0.9, 1.2) * np.exp(-rng.uniform(4.0, 7.0) * np.exp(-rate * HOURS))
    return _never_falling(curve - curve[0] + 1e-5 * HOURS + _wander(rng, 0.01))


def loaded_crack(rng: np.random.Generator) -> Array:
    """A crack whose rate is the length to the power 1.1, under a load that wanders."""
    load = np.exp(0.5 * _correlated(rng, 300.0))
    clock = np.cumsum(GRID_H * load) / (1800.0 * np.exp(0.25 * rng.standard_normal()))
    first, last = 0.03**-0.1, 0.78**-0.1
    return np.maximum(first - (first - last) * clock, 0.5 * last) ** -10.0 - 0.03


def run_in_then_steady(rng: np.random.Generator) -> Array:
    """A run-in of 0.15 to 0.3, then steady growth."""
    run_in = rng.uniform(0.15, 0.3) * -np.expm1(-HOURS / rng.uniform(150.0, 400.0))
    return run_in + 0.6 * _rate(rng) * HOURS + _wander(rng, 0.01)


def changed_use(rng: np.random.Generator) -> Array:
    """Steady growth whose rate changes once, by a lognormal factor."""
    factor = np.exp(0.6 * rng.standard_normal())
    when = rng.uniform(400.0, 2000.0)
    return np.cumsum(_rate(rng) * GRID_H * np.where(when > HOURS, 1.0, factor))


def two_suppliers(rng: np.random.Generator) -> Array:
    """Half of the parts slow down, by the power 0.6 of the hours; the others speed up, by 1.8."""
    power = 0.6 if rng.random() < 0.5 else 1.8
    return _never_falling((HOURS * _rate(rng)) ** power + _wander(rng, 0.015))


def worn_through(rng: np.random.Generator) -> Array:
    """A coating: beyond a severity of 0.3 to 0.5 growth is two to four times as fast."""
    through, factor = rng.uniform(0.3, 0.5), rng.uniform(2.0, 4.0)
    slow = _rate(rng) * HOURS + _wander(rng, 0.01)
    return np.where(slow < through, slow, through + factor * (slow - through))


def flushed(rng: np.random.Generator) -> Array:
    """A filter that now and then loses a tenth of its dirt: falls without an event."""
    out, level, rate = np.empty(len(HOURS)), 0.0, 1.4 * _rate(rng)
    flush = rng.random(len(HOURS)) < GRID_H / 500.0
    for k in range(len(HOURS)):
        level = 0.9 * level if flush[k] else level + rate * GRID_H
        out[k] = level
    return out


def coupled(rng: np.random.Generator) -> Array:
    """Growth in proportion to another wear, which is steady or slows down."""
    other = (HOURS / 2000.0) ** rng.uniform(0.6, 1.2) * np.exp(0.2 * _correlated(rng, 200.0))
    return np.cumsum(_rate(rng) * GRID_H * (0.25 + 1.1 * other))


def logarithmic(rng: np.random.Generator) -> Array:
    """Growth that slows down as its logarithm, with an age that differs between units."""
    age = HOURS / (500.0 * np.exp(0.3 * rng.standard_normal()))
    return _never_falling(0.4 * np.log1p(age) + _wander(rng, 0.015))


def _rate(rng: np.random.Generator) -> float:
    """Rate of a life: they differ by a lognormal factor."""
    return float(0.8 * RATE * np.exp(0.3 * rng.standard_normal()))


def _normal(rng: np.random.Generator) -> Array:
    return rng.standard_normal(len(HOURS))


def _wander(rng: np.random.Generator, spread: float) -> Array:
    """Wiener process with a deviation after 1000 h."""
    return np.cumsum(spread * np.sqrt(GRID_H / 1000.0) * _normal(rng))


def _never_falling(path: Array) -> Array:
    return np.maximum.accumulate(np.maximum(path, 0.0))


def _correlated(rng: np.random.Generator, memory: float) -> Array:
    """Stationary Ornstein-Uhlenbeck process of deviation 1."""
    from scipy.signal import lfilter  # noqa: PLC0415

    keep = float(np.exp(-GRID_H / memory))
    start = [keep * rng.standard_normal()]
    out, _ = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], _normal(rng), zi=start)
    return np.asarray(out)


Law = Callable[[np.random.Generator], Array]
TUNED: Mapping[str, tuple[str, Law]] = MappingProxyType({
    "steady": ("FSS", steady),
    "speeding up": ("FDJ", speeding_up),
    "clogging": ("Kintas", clogging),
    "season": ("FSS", season),
    "shocks": ("FDJ", shocks),
    "routes": ("FSS", routes),
    "sigmoid": ("FDJ", sigmoid),
    "Paris": ("FDJ", paris),
    "run-in then fast": ("FSS", run_in_then_fast),
    "gaps": ("FSS", routes),
    "wandering rate": ("FDJ", wandering_rate),
    "standing still": ("FSS", standing),
    "filter changed": ("Kintas", filter_changed),
    "mixed fleet": ("FSS", mixed_fleet),
    "running away": ("FDJ", running_away),
    "bathtub": ("FSS", bathtub),
})  # fmt: skip
"""Severity and law, by name; the forecast was chosen on them. Diagnoses of `gaps` are missing for
long times."""
HELD_OUT: Mapping[str, tuple[str, Law]] = MappingProxyType({
    "summers": ("FSS", summers),
    "heavy shocks": ("FDJ", heavy_shocks),
    "three routes": ("FSS", three_routes),
    "Gompertz": ("FDJ", gompertz),
    "loaded crack": ("FDJ", loaded_crack),
    "run-in then steady": ("FSS", run_in_then_steady),
    "changed use": ("FDJ", changed_use),
    "two suppliers": ("FSS", two_suppliers),
    "worn through": ("FDJ", worn_through),
    "flushed": ("Kintas", flushed),
    "coupled": ("FSS", coupled),
    "logarithmic": ("Kintas", logarithmic),
})  # fmt: skip
LAWS: Mapping[str, tuple[str, Law]] = MappingProxyType({**TUNED, **HELD_OUT})

TABLE = Path(__file__).with_name("noise.csv")
"""Truth, estimate and stated deviation of 67 diagnoses of simulated tests."""
LIMIT = 0.75
"""Severity at which a life ends, 1."""
INTERVAL_H = (50.0, 150.0)
"""Shortest and longest time between two diagnoses, h."""


def read_noise() -> dict[str, pandas.DataFrame]:
    """Truth, error and stated deviation of diagnoses, by severity."""
    table = pandas.read_csv(TABLE)
    table["error"] = table.estimate - table.truth
    return {name: part.reset_index(drop=True) for name, part in table.groupby("severity")}


@dataclass(frozen=True, slots=True, eq=False)
class WornUnit:
    """One unit: its history, and when its severity truly is at the limit.

    Its last life lasts from `born` to `end`, hours.
    """

    law: str
    name: str
    entries: tuple[Entry, ...]
    events: tuple[MaintenanceEvent, ...]
    born: float
    end: float


def simulate_unit(
    law: str, serial: int, noise: Mapping[str, pandas.DataFrame], seed: int
) -> WornUnit:
    """Simulate a unit from new until a severity is at the limit in its last life.

    Units with a filter have it changed once or twice before; half of the events do not name what
    they renewed. Units of `gaps` miss a third of their life's diagnoses in a row.
    """
    rng = np.random.default_rng((seed, serial, list(LAWS).index(law)))
    name, path_of = LAWS[law]
    entries: list[Entry] = []
    events: list[MaintenanceEvent] = []
    born = 0.0
    changes = int(rng.integers(1, 3)) if name == "Kintas" else 0
    for number in range(changes + 1):
        path = path_of(rng)
        stop = rng.uniform(0.4, 0.7) if number < changes else LIMIT
        age = _crossing(path, stop)
        at = rng.uniform(*INTERVAL_H)
        gap = rng.uniform(0.1, 0.6) * age if law == "gaps" else np.inf
        while at < age:
            if gap < at < gap + age / 3.0:
                at = gap + age / 3.0
                continue
            level = float(np.interp(at, HOURS, path))
            entries.append(_entry(serial, name, born + at, level, noise[name], rng))
            at += rng.uniform(*INTERVAL_H)
        if number < changes:
            born += age
            resets = ("Kintas",) if rng.random() < 0.5 else ()
            filter_change = ("filter changed", resets)
            events.append(MaintenanceEvent("", "", serial, None, Usage(born), *filter_change))
    return WornUnit(law, name, tuple(entries), tuple(events), born, born + age)


def _crossing(path: Array, level: float) -> float:
    """Age at which a path first reaches a level."""
    index = int(np.argmax(path >= level))
    if path[index] < level:
        return LONGEST_H
    before = path[index - 1] if index else 0.0
    share = float((level - before) / max(path[index] - before, 1e-12))
    return (index + share) * GRID_H


def _entry(
    serial: int,
    name: str,
    hours: float,
    level: float,
    noise: pandas.DataFrame,
    rng: np.random.Generator,
) -> Entry:
    """Diagnosis with the error of one of the table's near this severity."""
    place = rng.choice(np.argsort(np.abs(noise.truth.to_numpy() - level))[:12])
    value = min(max(level + float(noise.error[place] * rng.choice((-1.0, 1.0))), 0.0), 1.0)
    std = float(noise["std"][place])
    severity = Severity(
        name=name, estimate=value, std=std, interval95=(value - 2 * std, value + 2 * std)
    )
    return Entry(
        appended="", tested=None, actuator="reference-31", serial=serial, test="open",
        verdict="HEALTHY", reasons=(), usage=Usage(hours), sources=(SourceRecord("", None, None),),
        severities=(severity,), covariance=((std**2,),), effects=(), version="", simulated=True,
        result="{}",
    )  # fmt: skip


FIGURES = {
    "answered": "{:.1%}", "covered": "{:.3f}", "late": "{:.3f}", "score": "{:.4f}",
    "alarms": "{:.1%}",
}  # fmt: skip
"""Figures of an answer, and how their means are printed."""
SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares of the last life at which remaining life is forecast, 1."""
SETS = {"tuned": tuple(TUNED), "held-out": tuple(HELD_OUT), "all": tuple(LAWS)}
UNITS_PER_FLEET = 4
"""Number of units of a law that are forecast beside the same fleet."""
LATEST = 10.0
"""Remaining life over the life's length, 1, that later quantiles count as: some are infinite."""
CENSORED_SHARE = (0.3, 0.8)
"""Shares of its last life at which a unit of a censored fleet is taken out, 1."""


@dataclass(frozen=True, slots=True)
class LifeCase:
    """A simulated unit, its law of wear, size and number of its fleet, seed of all."""

    unit: int
    law: str
    fleet: int
    group: int
    censored: bool
    seed: int


def perform(case: LifeCase) -> Record:
    """Forecast a unit's remaining life at each of `SHARES`: figures of each answer.

    Whether there is a number, the true end within the interval of 80 % or before it, the score of
    the quantiles over the life's length, and whether the check raised an alarm.
    """
    unit = simulate_unit(case.law, case.unit, read_noise(), case.seed)
    lives, fleet = _fleet(case.law, case.fleet, case.group, case.censored, case.seed)
    length = unit.end - unit.born
    asked = []
    for share in SHARES:
        life, earlier = _lives_until(unit, share)
        if len(life.age) < 2:
            continue
        own = learn_fleet([*lives, *earlier], fleet.scale, case.seed) if earlier else fleet
        found = forecast(unit.name, "hours", life, own, (LIMIT,), case.seed)
        (left,) = found.remaining
        figures: Record = {"share": share, "answered": 0.0, "alarms": float(bool(found.alarm))}
        if left.median is not None:
            quantiles = np.array(left.quantiles or [0.0] * len(CHANCES))
            quantiles = np.minimum(quantiles / length, LATEST)
            true = (unit.end - life.born - life.age[-1]) / length
            low, high = np.interp((0.1, 0.9), CHANCES, quantiles)
            figures |= {
                "answered": 1.0, "covered": float(low <= true <= high), "late": float(true < low),
                "score": quantile_score(true, quantiles),
            }  # fmt: skip
        asked.append(figures)
    return {"asked": asked}


def quantile_score(true: float, found: Array) -> float:
    """Continuous ranked probability score by the quantiles: twice their mean pinball loss."""
    off = true - found
    return float(2.0 * np.mean(np.maximum(CHANCES * off, (CHANCES - 1.0) * off)))


@lru_cache(maxsize=1)
def _fleet(law: str, size: int, group: int, censored: bool, seed: int) -> tuple[list[Life], Fleet]:
    """Lives of further units of a law, and what is learned from them."""
    noise, lives = read_noise(), []
    for number in range(10_000 * (group + 1), 10_000 * (group + 1) + size):
        unit = simulate_unit(law, number, noise, seed)
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
        case_of(LifeCase, options, law=law, unit=place, group=place // UNITS_PER_FLEET)
        for law in laws
        for place in range(-(-options.cases // len(laws)))
    ]


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--laws", choices=SETS, default="all", help="(%(default)s)")
    parser.add_argument("--fleet", type=int, default=20, help="units of the fleet (%(default)d)")
    parser.add_argument("--censored", action="store_true", help="taken out before the limit")


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    fleet = f"fleet of {options.fleet}{' taken out early' if options.censored else ''}"
    yield f"{len(records)} units, laws {options.laws}, seed {options.seed}, {fleet}\n"
    asked = pandas.DataFrame(
        [{"law": record["law"], **item} for record in records for item in record["asked"]],
        columns=["law", "share", *FIGURES],
    )
    parts = [("all", asked), *asked.groupby("law", sort=False)]
    parts += [(f"{share:.0%} of the life", part) for share, part in asked.groupby("share")]
    yield from markdown(
        ("", "questions", "answered", "covered", "too late", "score", "alarms"),
        (
            (name, len(part), *map(str.format, FIGURES.values(), part[[*FIGURES]].mean()))
            for name, part in parts
        ),
    )


PROGNOSIS = Study(
    "prognosis",
    "Remaining life of simulated units that wear by laws unknown to the forecast.",
    _cases, perform, _report, add_options=_add_options, counted="units",
)  # fmt: skip
