"""Searches variants of a stored test for better observable severities, within motion limits.

A variant has segments that are longer or shorter, larger or smaller, faster or slower.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.design.score import SCORED_SEVERITIES, Score, play_stored_test, score, typical_effects
from firmware_iface.stored_test import (
    COMMAND_UNITS,
    Line,
    SearchWindows,
    Sine,
    StoredTest,
    TimeWindow,
)


class VariantRules(msgspec.Struct, frozen=True):
    """Bounds of the variants of a test, and the search among them."""

    length_factors: tuple[float, float] = (0.5, 2.0)
    """Least and largest factor of a segment's length, 1."""
    amplitude_factors: tuple[float, float] = (0.25, 4.0)
    """Least and largest factor of a segment's amplitude, 1."""
    frequency_factors: tuple[float, float] = (0.25, 4.0)
    """Least and largest factor of a sine's frequency, 1."""
    max_frequency: float = 0.25
    """Frequency of the fastest sine over the control rate, 1: a period has at least four ticks."""
    generation: int = 12
    """Number of variants in a generation of the search."""
    initial_std: float = 0.3
    """Deviation of the logarithms of the factors at the beginning, 1."""


VARIANTS = VariantRules()
PENALTY_BEYOND_LIMITS = 1e3
"""Figure, 1, of a test beyond its limits, plus the excess, which leads the search back."""


class VariantSpace(msgspec.Struct, frozen=True, eq=False):
    """Variants of a test as points: logarithms of factors, 0 for the test itself."""

    test: StoredTest
    """The test itself."""
    lower: NDArray[np.float64]
    """Bounds of the points, shape (k,)."""
    upper: NDArray[np.float64]
    """The same, shape (k,)."""
    largest: float
    """Largest command, in the test's unit."""

    def variant(self, point: Sequence[float] | NDArray[np.float64]) -> StoredTest:
        """Return the test at a point; its windows move with the segments that they lie in.

        point: shape (k,). Returns a valid test.
        """
        factors = iter(np.exp(np.asarray(point, dtype=np.float64)).tolist())
        tick = 1.0 / self.test.rate
        old, new = [0.0], [0.0]
        segments: list[Line | Sine] = []
        for part in self.test.segment:
            begin, length = new[-1], (part.end - part.start) * next(factors)
            end = round(begin + max(round(length / tick), 1) * tick, 9)
            larger = next(factors)
            if isinstance(part, Line):
                times = np.array([time for time, _ in part.points])
                moved = begin + (times - part.start) * (end - begin) / (part.end - part.start)
                on_ticks = np.round(np.round(moved / tick) * tick, 9)
                values = [self._held(value * larger) for _, value in part.points]
                segments.append(Line(tuple(zip(on_ticks.tolist(), values, strict=True))))
            else:
                frequency = min(
                    part.frequency * next(factors), VARIANTS.max_frequency * self.test.rate
                )
                segments.append(
                    Sine(
                        begin, end, self._held(part.amplitude * larger), _rounded_number(frequency)
                    )
                )
            old.append(part.end)
            new.append(end)
        return msgspec.structs.replace(
            self.test,
            segment=tuple(segments),
            windows=_moved_windows(self.test.windows, old, new),
        )

    def _held(self, value: float) -> float:
        return _rounded_number(min(max(value, -self.largest), self.largest))


def variant_space(test: StoredTest, rated_current: float) -> VariantSpace:
    """Return the variants of a test, within the factors of `VARIANTS`.

    A current command does not go beyond the rated current (A).
    """
    bounds = []
    for part in test.segment:
        bounds += [VARIANTS.length_factors, VARIANTS.amplitude_factors]
        if isinstance(part, Sine):
            bounds.append(VARIANTS.frequency_factors)
    lower, upper = np.log(np.array(bounds)).T
    unit = COMMAND_UNITS[test.mode][test.unit]
    largest = float("inf") if test.closed_loop else rated_current / unit
    return VariantSpace(test, lower, upper, largest)


def _moved_windows(windows: SearchWindows, old: list[float], new: list[float]) -> SearchWindows:
    """Windows whose ends go where the segments' ends went, in proportion between."""

    def there(spans: Sequence[TimeWindow]) -> tuple[TimeWindow, ...]:
        ends = np.round(np.interp(np.array(spans), old, new), 4)
        return tuple((begin, min(end, new[-1])) for begin, end in ends.tolist())

    return SearchWindows(
        **{name: there(getattr(windows, name)) for name in windows.__struct_fields__}
    )


def _rounded_number(value: float) -> float:
    """A number of four significant digits, as in a test file."""
    return float(f"{value:.4g}")


class MotionLimits(msgspec.Struct, frozen=True):
    """Largest motion, pressure and duration of a test."""

    travel: float
    """Of the jack from its middle, m."""
    rate: float
    """Of the jack, m/s."""
    pressure: float
    """Differential, Pa."""
    duration: float
    """s."""

    def excess(self, travel: float, rate: float, pressure: float, duration: float) -> float:
        """By how much the worst is exceeded, as a share; 0 where nothing is."""
        shares = (
            travel / self.travel,
            rate / self.rate,
            pressure / self.pressure,
            duration / self.duration,
        )
        return max(max(shares) - 1.0, 0.0)


class Proposal(msgspec.Struct, frozen=True, eq=False):
    """A test that was found."""

    test: StoredTest
    score: Score
    scored: int
    """Tests that were looked at."""
    better: bool
    """Whether it is better than the test that the search began with, or that one exceeded limits.
    """


def propose(
    test: StoredTest,
    actuator: Actuator,
    limits: MotionLimits,
    *,
    budget: int = 200,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Proposal | None:
    """Search the variants of a test for the lowest figure; None where all exceed the limits.

    An evolution strategy with diagonal adaptation from the best quarter of each generation
    (cross-entropy method, R. Rubinstein, Methodology and Computing in Applied Probability 1, 1999).

    test: where the search begins; actuator: data of the actuator; limits: what no test may exceed;
    budget: tests to look at; seed: the same seed gives the same test; progress: called after each
    test with the share of the budget that is spent. Returns None where all tests that were looked
    at exceed the limits.
    """
    space = variant_space(test, actuator.controller.IM)
    rng = np.random.default_rng(seed)
    mean, spread = np.zeros(len(space.lower)), np.full(len(space.lower), VARIANTS.initial_std)
    first = _figure(space, mean, actuator, limits)
    best, lowest, scored = mean, first, 1
    while scored + VARIANTS.generation <= budget:
        points = np.clip(
            mean + spread * rng.standard_normal((VARIANTS.generation, len(mean))),
            space.lower,
            space.upper,
        )
        points[0] = best
        figures = [lowest]
        for point in points[1:]:
            figures.append(_figure(space, point, actuator, limits))
            scored += 1
            if progress is not None:
                progress(scored / budget)
        order = np.argsort(figures)
        if figures[order[0]] < lowest:
            best, lowest = points[order[0]], figures[order[0]]
        chosen = points[order[: VARIANTS.generation // 4]]
        mean = 0.5 * (mean + chosen.mean(axis=0))
        spread = 0.7 * spread + 0.3 * chosen.std(axis=0)
    if lowest >= PENALTY_BEYOND_LIMITS:
        return None
    found = space.variant(best)
    return Proposal(found, score(found, actuator), scored, lowest < first)


def _figure(
    space: VariantSpace, point: NDArray[np.float64], actuator: Actuator, limits: MotionLimits
) -> float:
    """Figure of a variant; of one beyond its limits one larger than any."""
    test = space.variant(point)
    # As new the jack goes farthest and fastest: what is too much there is not scored.
    new = play_stored_test(test, actuator, (0.0,) * len(SCORED_SEVERITIES[0]), typical_effects())
    excess = limits.excess(new.travel, new.rate, new.pressure, test.duration)
    if excess > 0.0:
        return PENALTY_BEYOND_LIMITS * (1.0 + excess)
    found = score(test, actuator)
    excess = limits.excess(found.travel, found.rate, found.pressure, test.duration)
    return PENALTY_BEYOND_LIMITS * (1.0 + excess) if excess > 0.0 else found.figure
