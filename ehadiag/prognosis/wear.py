"""Laws of wear as one state-space model, many parameter sets at once.

Each law makes growth steady: on a clock of its own, and on a severity scale of its own. Severity
on that scale and its rate are the state of a Kalman filter; first passages of a level are drawn
from the filtered state. Equations and literature: docs/explanation/remaining-life.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.prognosis.lives import Life

Array = NDArray[np.float64]
SETS_PER_LAW = 48
"""Number of parameter sets of a law: the study's score changes by less than 1 % beyond it."""
SEVERITY_GRID = np.linspace(-0.05, 1.05, 441)
"""Severities, 1, at which a scale is tabulated; noise goes a little beyond 0 and 1."""
GRID_STEP = float(SEVERITY_GRID[1] - SEVERITY_GRID[0])
MIN_SLOWING = 0.02
"""Rate at a ceiling over that without one, 1: so that each level has a finite scale."""
MAX_CLOCK = 1e6
"""Clock, scales of age, beyond which a passage counts as none."""
WALK_STEPS = 48
"""Number of steps of a simulated path with a walking rate."""
BISECTIONS = 8
"""Number of halvings for a passage: to 1 % of its time, half of the least half interval."""

LAW_NAMES = (
    "Wiener", "gamma", "inverse Gaussian", "power", "Paris", "logistic", "two phases",
    "walking rate",
)  # fmt: skip


class Laws(msgspec.Struct, frozen=True):
    """Parameter sets of all laws; shape (sets,) each."""

    law: NDArray[np.int64]
    """Place in `LAW_NAMES`."""
    power: Array
    """Of the clock, `(age / scale)**power`."""
    knee: Array
    """Clock at which the second phase begins."""
    gain: Array
    """Rate of the second phase over the first."""
    exponent: Array
    """Of the feedback: the rate is `(1 + severity / begin)**exponent` times that as new."""
    begin: Array
    ceiling: Array
    """Severity at which growth ends."""
    spread: Array
    """Deviation of the growth over one unit of the clock, over the mean rate."""
    walk: Array
    """Deviation of the rate's change over one unit of the clock, over the mean rate."""
    table: Array
    """Scale at `SEVERITY_GRID`, shape (grid, sets)."""


@cache
def draw_laws() -> Laws:
    """Return the parameter sets: an even cover of what each law may be, always the same."""
    count = SETS_PER_LAW
    number = np.arange(1, count + 1)
    # Additive recurrence with the generalised golden ratio (Roberts 2018): evenly spread.
    cover = np.mod(0.5 + number * 1.2207440846057596 ** -np.arange(1.0, 5.0)[:, None], 1.0)

    def log_range(low: float, high: float, which: int) -> Array:
        return np.asarray(low * (high / low) ** cover[which])

    one, none = np.ones(count), np.zeros(count)
    plain = {
        "power": one, "knee": one, "gain": one, "exponent": none, "begin": one,
        "ceiling": np.full(count, np.inf), "spread": log_range(0.02, 0.6, 0), "walk": none,
    }  # fmt: skip
    curved = {"power": log_range(0.5, 2.0, 1), "exponent": cover[2], "begin": 0.3 * one}
    drawn: dict[str, dict[str, Array]] = {
        "Wiener": {},
        "gamma": curved,
        "inverse Gaussian": curved,
        "power": {"power": log_range(0.4, 3.5, 1)},
        "Paris": {"exponent": 3.0 * cover[1], "begin": log_range(0.01, 0.5, 2)},
        "logistic": {"exponent": one, "begin": log_range(0.005, 0.3, 1),
                     "ceiling": log_range(0.78, 1.6, 2)},
        "two phases": {"knee": log_range(0.15, 1.5, 1), "gain": log_range(0.2, 8.0, 2)},
        "walking rate": {"walk": log_range(0.2, 3.0, 1), "spread": log_range(0.01, 0.3, 0)},
    }  # fmt: skip
    columns = [plain | drawn[name] for name in LAW_NAMES]
    joined = {key: np.concatenate([item[key] for item in columns]) for key in plain}
    severity = np.maximum(SEVERITY_GRID[:, None], 0.0)
    rate = (1.0 + severity / joined["begin"]) ** joined["exponent"]
    slowness = 1.0 / (rate * np.maximum(1.0 - severity / joined["ceiling"], MIN_SLOWING))
    steps = 0.5 * GRID_STEP * (slowness[1:] + slowness[:-1])
    table = np.concatenate([np.zeros((1, len(joined["power"]))), np.cumsum(steps, axis=0)])
    law = np.repeat(np.arange(len(LAW_NAMES)), count)
    return Laws(law=law, table=table, **joined)


def _on_scale(laws: Laws, severity: Array, sets: NDArray[np.int64] | slice) -> tuple[Array, Array]:
    """Severity on the scale of parameter sets, and the scale's slope there."""
    place = np.clip((severity - SEVERITY_GRID[0]) / GRID_STEP, 0.0, len(SEVERITY_GRID) - 1.000001)
    below = place.astype(np.int64)
    if isinstance(sets, slice):
        low, high = laws.table[below], laws.table[below + 1]
        share = (place - below)[..., None]
    else:
        low, high = laws.table[below, sets], laws.table[below + 1, sets]
        share = place - below
    return low + share * (high - low), (high - low) / GRID_STEP


def _clock(laws: Laws, age: Array) -> Array:
    """Clock of every parameter set at ages over the scale; shape (..., sets)."""
    at = np.exp(np.log(np.maximum(age, 1e-9))[..., None] * laws.power)  # faster than a power
    return np.asarray(at + (laws.gain - 1.0) * np.maximum(at - laws.knee, 0.0))


def _age(laws: Laws, clock: Array, sets: NDArray[np.int64]) -> Array:
    """Age over the scale at a clock of some parameter sets."""
    knee, gain = laws.knee[sets], laws.gain[sets]
    at = np.where(clock > knee, knee + (clock - knee) / gain, clock)
    return np.asarray(np.minimum(at, MAX_CLOCK) ** (1.0 / laws.power[sets]))


class Filtered(msgspec.Struct, frozen=True, eq=False):
    """What the filter knows after each diagnosis; shape (diagnoses, lives, sets) each."""

    level: NDArray[np.float32]
    """Severity on the scale of the set."""
    rate: NDArray[np.float32]
    level_variance: NDArray[np.float32]
    covariance: NDArray[np.float32]
    rate_variance: NDArray[np.float32]
    score: NDArray[np.float32]
    """Log density of the diagnoses so far."""
    surprise: NDArray[np.float32]
    """Of the diagnosis, in deviations of what was predicted."""
    usual_rate: Array
    """Mean rate of other lives, shape (lives, sets)."""


def mean_rates(laws: Laws, life: Life, until: int, scale: float) -> Array:
    """Return the rate of a life on the clock and scale of each set, up to a diagnosis."""
    ends = [0, until]
    value, _ = _on_scale(laws, life.value[ends], slice(None))
    clock = _clock(laws, life.age[ends] / scale)
    return np.asarray((value[1] - value[0]) / np.maximum(clock[1] - clock[0], 1e-9))


def filter_lives(
    laws: Laws, lives: Sequence[Life], scale: float, usual: Array, deviation: Array
) -> Filtered:
    """Filter severity and rate of lives by every parameter set.

    laws: parameter sets; lives: each of at least one diagnosis; scale: age at which the clock
    stands at 1, hours or cycles; usual, deviation: mean rate of lives, and its standard deviation
    over them, shape (lives, sets). A life's rows after its last diagnosis repeat it.
    """
    count = np.array([len(life.age) for life in lives])
    longest = int(count.max())

    places = np.minimum(np.arange(longest), count[:, None] - 1)

    def padded(name: str) -> Array:
        rows = zip(lives, places, strict=True)
        return np.array([getattr(life, name)[place] for life, place in rows])

    values, stds, ages = padded("value"), padded("std"), padded("age") / scale
    diffusion, walk = (laws.spread * usual) ** 2, (laws.walk * usual) ** 2
    kept = np.empty((7, longest, *usual.shape), dtype=np.float32)

    def seen(at: int) -> tuple[Array, Array, Array, Array]:
        """Each life's diagnosis on the scale, the scale's slope there, its noise, the clock."""
        value, slope = _on_scale(laws, values[:, at], slice(None))
        return value, slope, (stds[:, at, None] * slope) ** 2, _clock(laws, ages[:, at])

    level, _, pzz, clock = seen(0)
    rate, paa = usual.copy(), deviation**2
    pza, score, surprise = np.zeros((3, *usual.shape))
    kept[:, 0] = level, rate, pzz, pza, paa, score, surprise
    for at in range(1, longest):
        before = clock
        value, slope, noise, clock = seen(at)
        h = np.maximum(clock - before, 1e-12)
        ahead = level + rate * h
        a = pzz + h * (2.0 * pza + h * paa + diffusion + walk * h * h / 3.0)
        b = pza + h * (paa + 0.5 * walk * h)
        c = paa + walk * h
        total = a + noise
        off = value - ahead
        there = (count > at)[:, None]
        gain, rate_gain, unexpected = a / total, b / total, off / np.sqrt(total)
        density = -0.5 * (unexpected * unexpected + np.log(2.0 * np.pi * total / (slope * slope)))
        news = [
            ahead + gain * off, rate + rate_gain * off, a - gain * a, b - gain * b,
            c - rate_gain * b, score + density, unexpected,
        ]  # fmt: skip
        if not there.all():
            olds = [level, rate, pzz, pza, paa, score, surprise]
            news = [np.where(there, new, old) for new, old in zip(news, olds, strict=True)]
        level, rate, pzz, pza, paa, score, surprise = news
        kept[:, at] = level, rate, pzz, pza, paa, score, surprise
    return Filtered(kept[0], kept[1], kept[2], kept[3], kept[4], kept[5], kept[6], usual)


def draw_passages(
    laws: Laws,
    sets: NDArray[np.int64],
    state: tuple[Array, ...],
    ages: Array,
    levels: Array,
    scale: float,
    rng: np.random.Generator,
) -> Array:
    """Draw the time from each state to a level.

    laws: parameter sets; sets: that of each draw, shape (draws,); state: severity on the scale,
    rate, their variances and covariance in the order of `Filtered`, and the usual rate; shape
    (draws,) each; ages: of each draw, hours or cycles; levels: severity that is to be reached;
    scale: age at which the clock stands at 1. Returns hours or cycles; infinite for never.
    """
    level, rate, pzz, pza, paa, usual = state
    pzz, paa = np.maximum(pzz, 0.0), np.maximum(paa, 0.0)
    first = rng.standard_normal(len(sets))
    now = level + np.sqrt(pzz) * first
    slant = pza / np.sqrt(np.maximum(pzz, 1e-30))
    left = np.sqrt(np.maximum(paa - slant**2, 0.0))
    speed = rate + slant * first + left * rng.standard_normal(len(sets))
    far = np.maximum(_on_scale(laws, levels, sets)[0] - now, 1e-9)
    diffusion = np.maximum((laws.spread[sets] * usual) ** 2, 1e-18)
    walk, law = laws.walk[sets] * np.abs(usual), laws.law[sets]
    passed = np.full(len(sets), np.inf)
    name = np.array(LAW_NAMES)[law]
    walking = walk > 0.0
    monotone = ((name == "gamma") | (name == "inverse Gaussian")) & (speed > 0.0)
    plain = ~walking & ~monotone
    passed[plain] = _wiener_passage(far[plain], speed[plain], diffusion[plain], rng)
    for kind, draw in (("gamma", _gamma_passage), ("inverse Gaussian", _inverse_gaussian_passage)):
        mine = monotone & (name == kind)
        passed[mine] = draw(far[mine], speed[mine], diffusion[mine], rng)
    passed[walking] = _walking_passage(
        far[walking], speed[walking], diffusion[walking], walk[walking], usual[walking], rng
    )
    at = np.maximum(ages / scale, 1e-9) ** laws.power[sets]
    clock = at + (laws.gain[sets] - 1.0) * np.maximum(at - laws.knee[sets], 0.0)
    end = scale * _age(laws, np.minimum(clock + passed, MAX_CLOCK), sets)
    return np.where(clock + passed >= MAX_CLOCK, np.inf, np.maximum(end - ages, 0.0))


def _wiener_passage(
    far: Array, speed: Array, diffusion: Array, rng: np.random.Generator
) -> Array:  # fmt: skip
    """First passage of a Wiener process with drift: inverse Gaussian, or never."""
    out = np.full(far.shape, np.inf)
    chance = np.exp(np.minimum(2.0 * speed * far / diffusion, 0.0))
    ever = (speed > 0.0) | (rng.random(far.shape) < chance)
    size = np.maximum(np.abs(speed[ever]), 1e-12)
    out[ever] = rng.wald(far[ever] / size, np.maximum(far[ever] ** 2 / diffusion[ever], 1e-12))
    return out


def _gamma_passage(far: Array, speed: Array, diffusion: Array, rng: np.random.Generator) -> Array:
    """First passage of a gamma process: its path between two instants is halved by beta draws."""
    shape, size = speed**2 / diffusion, diffusion / speed
    step = 2.0 * far / speed + diffusion / speed**2
    begin, low = np.zeros((2, *far.shape))
    high = rng.gamma(shape * step, size)
    while np.any(short := high < far):
        begin, low = np.where(short, begin + step, begin), np.where(short, high, low)
        high = np.where(short, high + rng.gamma(shape * step, size), high)
    for _ in range(BISECTIONS):
        step = 0.5 * step
        middle = low + (high - low) * rng.beta(shape * step, shape * step)
        above = middle >= far
        begin = np.where(above, begin, begin + step)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return begin + 0.5 * step


def _inverse_gaussian_passage(
    far: Array, speed: Array, diffusion: Array, rng: np.random.Generator
) -> Array:
    """First passage of an inverse Gaussian process: that of a Wiener process by its level.

    So it is the maximum of a Wiener process over the severity in place of time.
    """
    variance = far * diffusion / speed**3
    end = far / speed + np.sqrt(variance) * rng.standard_normal(far.shape)
    root = np.sqrt(end * end - 2.0 * variance * np.log1p(-rng.random(far.shape)))
    return np.asarray(0.5 * (end + root))


def _walking_passage(
    far: Array, speed: Array, diffusion: Array, walk: Array, usual: Array,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """First passage of simulated paths whose rate is a random walk, held between 0 and a bound."""
    pace = np.maximum(np.maximum(speed, 0.2 * np.abs(usual)), 1e-12)
    step, out = far / pace / 16.0, np.full(far.shape, np.inf)
    path = np.array([far, speed, diffusion, walk, step, np.zeros_like(far), np.zeros_like(far)])
    left = np.arange(len(far))
    for _ in range(WALK_STEPS):
        if not len(left):
            break
        far, speed, diffusion, walk, step, at, grown = path
        noise = rng.standard_normal((2, len(left)))
        speed = np.abs(speed + walk * np.sqrt(step) * noise[0])
        growth = speed * step + np.sqrt(diffusion * step) * noise[1]
        over = grown + growth >= far
        out[left[over]] = (at + step * (far - grown) / growth)[over]
        path[1], path[4], path[5], path[6] = speed, step * 1.07, at + step, grown + growth
        path, left = path[:, ~over], left[~over]
    return out
