"""Random commands of many kinds of motion.

The monitor's thresholds come from `KINDS`; `HELD_OUT` were written after them, and no threshold was
ever set on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

KINDS = (
    "hold", "steps", "ramps", "sines", "chirps", "noise", "triangles", "doublets", "stairs",
    "manoeuvres", "gusts", "dither",
)  # fmt: skip
"""Kinds of motion; a piece has one, broken by holds."""
Array = NDArray[np.float64]
CORNER_HZ = 2.0
"""Frequency beyond which amplitudes fall, Hz."""


class Segment(NamedTuple):
    """Commands of one kind: how many, rate in Hz, the one before them, the largest, m or A."""

    ticks: int
    rate: float
    last: float
    largest: float


def random_command(
    rng: np.random.Generator, kind: str, ticks: int, rate: float, largest: float
) -> list[float]:
    """Commands of one kind of motion, m or A, at a rate in Hz; one segment of five is a hold."""
    out: list[Array] = []
    last, length = 0.0, 0
    while length < ticks:
        count = int(rng.uniform(0.5, 6.0) * rate)
        chosen = "hold" if rng.uniform() < 0.2 else kind
        segment = Segment(count, rate, last, largest)
        make = HELD_OUT.get(chosen)
        drawn = make(rng, segment) if make else _segment(rng, chosen, *segment)
        piece = np.clip(drawn, -largest, largest)
        out.append(piece)
        last, length = float(piece[-1]), length + count
    commands: list[float] = np.concatenate(out)[:ticks].tolist()
    return commands


def _segment(  # noqa: PLR0911 - one return a kind
    rng: np.random.Generator, kind: str, count: int, rate: float, last: float, largest: float
) -> Array:
    time = np.arange(count) / rate
    share = np.arange(count) / count
    target = rng.uniform(-largest, largest)
    if kind == "hold":
        small = 0.02 * largest * rng.integers(-1, 2)
        return np.full(count, last + small)
    if kind == "steps":
        return np.full(count, target)
    if kind == "ramps":
        return np.linspace(last, target, count)
    if kind == "manoeuvres":
        return last + (target - last) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    if kind == "stairs":
        return last + (target - last) * np.floor(share * rng.integers(3, 9) + 1.0) / 9.0
    if kind == "doublets":
        width = int(rng.uniform(0.05, 0.5) * rate)
        turn = np.arange(count) // width
        return last + 0.5 * target * np.where(turn == 0, 1.0, np.where(turn == 1, -1.0, 0.0))
    if kind == "dither":
        hertz = even_in_octaves(rng, (1.0, 15.0))
        return last + 0.03 * target * np.sin(2 * np.pi * hertz * time)
    if kind in ("sines", "triangles"):
        hertz = even_in_octaves(rng, (0.2, 20.0 if kind == "sines" else 3.0))
        wave = np.sin(2 * np.pi * hertz * time)
        wave = wave if kind == "sines" else np.arcsin(wave) * (2.0 / np.pi)
        return last + target / (1.0 + hertz / CORNER_HZ) * wave
    if kind == "chirps":
        sweep = 0.2 * rng.uniform(5.0, 75.0) ** share
        wave = np.sin(2 * np.pi * np.cumsum(sweep) / rate)
        return last + target / (1.0 + sweep / CORNER_HZ) * wave
    hertz = even_in_octaves(rng, (0.2, 10.0) if kind == "noise" else (0.05, 1.0))
    part, noise, value, second = 2.0 * math.pi * hertz / rate, np.empty(count), 0.0, 0.0
    for k, draw in enumerate(rng.standard_normal(count).tolist()):
        value += part * (draw - value)
        second += min(4.0 * part, 1.0) * (value - second)
        noise[k] = value if kind == "noise" else second
    size = 0.25 * largest / math.sqrt(part / (2.0 - part)) / (1.0 + hertz / CORNER_HZ)
    return last + size * (noise - noise[0])


def even_in_octaves(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    """Draw a number between two ends, each octave as likely."""
    return math.exp(rng.uniform(math.log(ends[0]), math.log(ends[1])))


def _multisine(rng: np.random.Generator, s: Segment) -> Array:
    """Eight sines at once, random in phase."""
    hertz = np.exp(rng.uniform(math.log(0.1), math.log(25.0), (8, 1)))
    phase = rng.uniform(0.0, 2.0 * math.pi, (8, 1))
    size = rng.uniform(0.05, 0.5) * s.largest / (1.0 + hertz / CORNER_HZ)
    waves = size * np.sin(2.0 * math.pi * hertz * np.arange(s.ticks) / s.rate + phase)
    wave: Array = waves.sum(axis=0)
    return s.last + wave - wave[0]


def _binary(rng: np.random.Generator, s: Segment) -> Array:
    """Two values in turn, random in length."""
    ends = rng.exponential(rng.uniform(0.03, 0.5) * s.rate, s.ticks).cumsum()
    turns = (ends.searchsorted(np.arange(s.ticks)) % 2).astype(np.float64)
    return s.last + rng.uniform(-0.4, 0.4) * s.largest * turns


def _walk(rng: np.random.Generator, s: Segment) -> Array:
    """Random walk that is drawn back to the middle."""
    pull = rng.uniform(0.2, 2.0) / s.rate
    size = rng.uniform(0.1, 0.5) * s.largest * math.sqrt(2.0 * pull)
    out, value = np.empty(s.ticks), s.last
    for k, draw in enumerate(rng.standard_normal(s.ticks).tolist()):
        value += size * draw - pull * value
        out[k] = value
    return out


def _sawtooth(rng: np.random.Generator, s: Segment) -> Array:
    """Slow rise and fast return."""
    hertz = even_in_octaves(rng, (0.2, 4.0))
    share = np.arange(s.ticks) * hertz / s.rate % 1.0
    fast = rng.uniform(0.02, 0.3)
    tooth = np.minimum(share / (1.0 - fast), (1.0 - share) / fast)
    return s.last + rng.uniform(-0.8, 0.8) * s.largest * tooth


def _approach(rng: np.random.Generator, s: Segment) -> Array:
    """Exponential approach to a target, as behind a first-order filter."""
    lag = even_in_octaves(rng, (0.02, 2.0)) * s.rate
    target = rng.uniform(-s.largest, s.largest)
    return target + (s.last - target) * np.exp(-np.arange(s.ticks) / lag)


def _trapezoid(rng: np.random.Generator, s: Segment) -> Array:
    """There at a limited s.rate, a while, and back."""
    speed = even_in_octaves(rng, (0.05, 10.0)) * s.largest / s.rate
    target = rng.uniform(-s.largest, s.largest)
    away = np.minimum(np.arange(s.ticks), np.arange(s.ticks)[::-1]) * speed
    return s.last + np.sign(target - s.last) * np.minimum(away, abs(target - s.last))


def _creep(rng: np.random.Generator, s: Segment) -> Array:
    """A motion so slow that the jack sticks and slips."""
    speed = rng.choice((-1.0, 1.0)) * even_in_octaves(rng, (0.002, 0.05)) * s.largest / s.rate
    return s.last + speed * np.arange(s.ticks)


def _taps(rng: np.random.Generator, s: Segment) -> Array:
    """Short pulses of either sign, far between."""
    out = np.full(s.ticks, s.last)
    for _ in range(int(rng.integers(1, 6))):
        begin, width = int(rng.integers(s.ticks)), int(rng.uniform(0.02, 0.3) * s.rate)
        out[begin : begin + width] += rng.uniform(-0.5, 0.5) * s.largest
    return out


def _beats(rng: np.random.Generator, s: Segment) -> Array:
    """A sine whose size comes and goes."""
    hertz, slow = even_in_octaves(rng, (1.0, 12.0)), even_in_octaves(rng, (0.1, 1.0))
    time = np.arange(s.ticks) / s.rate
    size = rng.uniform(0.1, 0.8) * s.largest / (1.0 + hertz / CORNER_HZ)
    return s.last + size * np.sin(2 * np.pi * slow * time) * np.sin(2 * np.pi * hertz * time)


def _hops(rng: np.random.Generator, s: Segment) -> Array:
    """Holds of random length at random places, each reached smoothly."""
    out, at, last = np.empty(s.ticks), 0, s.last
    while at < s.ticks:
        width = int(even_in_octaves(rng, (0.05, 0.6)) * s.rate)
        target = rng.uniform(-s.largest, s.largest)
        share = np.minimum(np.arange(s.ticks - at) / width, 1.0)
        out[at:] = last + (target - last) * 0.5 * (1.0 - np.cos(np.pi * share))
        at += width + int(rng.exponential(0.5) * s.rate)
        last = target
    return out


HELD_OUT: dict[str, Callable[[np.random.Generator, Segment], Array]] = {
    "multisine": _multisine, "binary": _binary, "walk": _walk, "sawtooth": _sawtooth,
    "approach": _approach, "trapezoid": _trapezoid, "creep": _creep, "taps": _taps,
    "beats": _beats, "hops": _hops,
}  # fmt: skip
"""Further kinds of motion, by name."""
