"""Laws of wear of simulated lives; the forecast contains none of them but `steady`.

Each draws the severity of one life on a grid of hours. The forecast was chosen on `TUNED`;
`HELD_OUT` were simulated for the first time when it was finished.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

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
