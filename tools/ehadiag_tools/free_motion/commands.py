"""Random commands of many kinds of motion.

The monitor's threshold comes from `KINDS`; `HELD_OUT` were written after them, and nothing of the
monitor was ever set on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

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
        make = (FURTHER | HELD_OUT).get(chosen)
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


FURTHER: dict[str, Callable[[np.random.Generator, Segment], Array]] = {
    "multisine": _multisine, "binary": _binary, "walk": _walk, "sawtooth": _sawtooth,
    "approach": _approach, "trapezoid": _trapezoid, "creep": _creep, "taps": _taps,
    "beats": _beats, "hops": _hops,
}  # fmt: skip
KINDS = (
    "hold", "steps", "ramps", "sines", "chirps", "noise", "triangles", "doublets", "stairs",
    "manoeuvres", "gusts", "dither", *FURTHER,
)  # fmt: skip
"""Kinds of motion; a piece has one, broken by holds."""


def _turbulence(rng: np.random.Generator, s: Segment) -> Array:
    """What answers gusts of Dryden's lateral spectrum, through a lag of 30 ms."""
    lag = even_in_octaves(rng, (0.03, 1.0)) * s.rate
    noise = lfilter([1.0 + 1.7 * lag, -1.7 * lag], [1.0], rng.standard_normal(s.ticks))
    slow, answer = np.exp(-1.0 / np.array([lag, 0.03 * s.rate]))
    gusts = lfilter([1.0], np.poly([slow, slow, answer]), noise)
    wave: Array = gusts * (rng.uniform(0.03, 0.3) * s.largest / gusts.std())
    return s.last + wave - wave[0]


def _multistep(rng: np.random.Generator, s: Segment) -> Array:
    """A pilot's 3-2-1-1 through the lag of the stick, and rest."""
    unit, lag = rng.uniform(0.05, 0.6) * s.rate, math.exp(-1.0 / (rng.uniform(0.01, 0.1) * s.rate))
    turn = np.searchsorted([3.0, 5.0, 6.0, 7.0], np.arange(s.ticks) / unit, side="right")
    steps = np.array([1.0, -1.0, 1.0, -1.0, 0.0])[turn] * rng.uniform(-0.5, 0.5) * s.largest
    return s.last + lfilter([1.0 - lag], [1.0, -lag], steps)


def _sampled(rng: np.random.Generator, s: Segment) -> Array:
    """A slower computer's commands: a smooth wave, held between its samples."""
    width = int(rng.uniform(0.02, 0.25) * s.rate)
    hertz = even_in_octaves(rng, (0.1, 1.5))
    time = np.arange(s.ticks) // width * width / s.rate
    return s.last + rng.uniform(-0.6, 0.6) * s.largest * np.sin(2 * np.pi * hertz * time)


def _trim(rng: np.random.Generator, s: Segment) -> Array:
    """Slow short ways of a trim, far between."""
    speed = even_in_octaves(rng, (0.01, 0.2)) * s.largest / s.rate
    on = np.arange(s.ticks) % int(rng.uniform(1.0, 4.0) * s.rate) < rng.uniform(0.1, 0.8) * s.rate
    return s.last + np.cumsum(on) * speed * rng.choice((-1.0, 1.0))


def _bursts(rng: np.random.Generator, s: Segment) -> Array:
    """Oscillations that die away, as of flutter."""
    hertz = even_in_octaves(rng, (2.0, 20.0))
    time = np.arange(s.ticks) % int(rng.uniform(0.5, 3.0) * s.rate) / s.rate
    size = rng.uniform(0.1, 0.9) * s.largest / (1.0 + hertz / CORNER_HZ)
    return s.last + size * np.exp(-time * rng.uniform(1.0, 8.0)) * np.sin(2 * np.pi * hertz * time)


def _landing(rng: np.random.Generator, s: Segment) -> Array:
    """A slow change with ever busier corrections, a flare, and the surface back in the middle."""
    share = np.arange(s.ticks) / s.ticks
    busy = 0.15 * share * np.sin(2 * np.pi * s.ticks / s.rate * rng.uniform(0.5, 2.0) * share**1.5)
    flare = rng.uniform(0.1, 0.6) * np.exp(-(((share - 0.7) / 0.06) ** 2))
    path = s.last + s.largest * (rng.uniform(-0.3, 0.3) * share + busy + flare)
    return np.where(share < 0.85, path, path * np.maximum(0.0, 1.0 - (share - 0.85) * 10.0))


def _levels(rng: np.random.Generator, s: Segment) -> Array:
    """One of some levels at a time, left at a limited rate, as by a switch."""
    dwell = int(even_in_octaves(rng, (0.1, 1.5)) * s.rate)
    levels = rng.integers(-2, 3, s.ticks // dwell + 1).repeat(dwell)[: s.ticks]
    width = int(rng.uniform(0.01, 0.3) * s.rate)
    ways: Array = np.convolve(levels, np.full(width, 1.0 / width))[: s.ticks]
    return s.last + rng.uniform(0.05, 0.4) * s.largest * ways


def _sweeps(rng: np.random.Generator, s: Segment) -> Array:
    """A frequency that rises evenly and falls again, with pauses."""
    time = np.arange(s.ticks) / s.rate
    hertz = rng.uniform(2.0, 20.0) * np.abs(np.sin(np.pi * time / rng.uniform(2.0, 8.0)))
    on = np.sin(2 * np.pi * time / rng.uniform(1.0, 4.0)) > -0.3
    wave = np.sin(2 * np.pi * np.cumsum(hertz) / s.rate) / (1.0 + hertz / CORNER_HZ)
    return s.last + rng.uniform(0.1, 0.9) * s.largest * on * wave


def _deadband(rng: np.random.Generator, s: Segment) -> Array:
    """A wave of which the small part is left out: rests, and moves to either side."""
    wave = np.sin(2 * np.pi * even_in_octaves(rng, (0.1, 5.0)) * np.arange(s.ticks) / s.rate)
    left = np.sign(wave) * np.maximum(0.0, np.abs(wave) - rng.uniform(0.2, 0.8))
    return s.last + rng.uniform(-0.8, 0.8) * s.largest * left


def _ringing(rng: np.random.Generator, s: Segment) -> Array:
    """Steps through a lightly damped loop."""
    turn, damping = 2 * np.pi * even_in_octaves(rng, (0.5, 6.0)) / s.rate, rng.uniform(0.1, 0.7)
    radius = math.exp(-damping * turn)
    poles = [1.0, -2.0 * radius * math.cos(turn * math.sqrt(1.0 - damping**2)), radius**2]
    dwell = int(rng.uniform(0.5, 3.0) * s.rate)
    steps = rng.uniform(-0.4, 0.4, s.ticks // dwell + 1).repeat(dwell)[: s.ticks]
    return s.last + s.largest * lfilter([sum(poles)], poles, steps)


HELD_OUT: dict[str, Callable[[np.random.Generator, Segment], Array]] = {
    "turbulence": _turbulence, "multistep": _multistep, "sampled": _sampled, "trim": _trim,
    "bursts": _bursts, "landing": _landing, "levels": _levels, "sweeps": _sweeps,
    "deadband": _deadband, "ringing": _ringing,
}  # fmt: skip
"""Kinds of motion that nothing was set on."""
