"""Variants of a test: its segments longer or shorter, larger or smaller, faster or slower."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.core.stored_test import UNITS, Line, Sine, StoredTest, Window, Windows

__all__ = ["Space", "space_of"]

LONGER = (0.5, 2.0)
LARGER = (0.25, 4.0)
FASTER = (0.25, 4.0)
"""Factors by which a segment's length, amplitude and frequency may differ from the test's."""
LARGEST_SHARE = 0.25
"""Of the rate: fastest sine, so that a period has some ticks."""
DIGITS = 4
"""Significant digits of what a test file gets."""


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """Variants of a test as points: logarithms of factors, 0 for the test itself.

    Attributes
    ----------
    test : StoredTest
        The test itself.
    lower : NDArray[np.float64]
        Bounds of the points, shape (k,).
    upper : NDArray[np.float64]
        The same, shape (k,).
    largest : float
        Largest command, in the test's unit.
    """

    test: StoredTest
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    largest: float

    def variant(self, point: Sequence[float] | NDArray[np.float64]) -> StoredTest:
        """Return the test at a point; its windows move with the segments that they lie in.

        Parameters
        ----------
        point : Sequence[float] | NDArray[np.float64]
            Shape (k,).

        Returns
        -------
        StoredTest
            A valid test.
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
                frequency = min(part.frequency * next(factors), LARGEST_SHARE * self.test.rate)
                segments.append(
                    Sine(begin, end, self._held(part.amplitude * larger), _plain(frequency))
                )
            old.append(part.end)
            new.append(end)
        return msgspec.structs.replace(
            self.test,
            segment=tuple(segments),
            windows=_moved(self.test.windows, old, new),
        )

    def _held(self, value: float) -> float:
        return _plain(min(max(value, -self.largest), self.largest))


def space_of(test: StoredTest, rated_current: float) -> Space:
    """Return the variants of a test.

    Parameters
    ----------
    test : StoredTest
        Where the space has its middle.
    rated_current : float
        A; a current command does not go beyond, a position not beyond the largest factor.

    Returns
    -------
    Space
        All variants within the factors.
    """
    bounds = []
    for part in test.segment:
        bounds += [LONGER, LARGER]
        if isinstance(part, Sine):
            bounds.append(FASTER)
    lower, upper = np.log(np.array(bounds)).T
    unit = UNITS[test.mode][test.unit]
    largest = float("inf") if test.closed_loop else rated_current / unit
    return Space(test, lower, upper, largest)


def _moved(windows: Windows, old: list[float], new: list[float]) -> Windows:
    """Windows whose ends go where the segments' ends went, in proportion between."""

    def there(spans: Sequence[Window]) -> tuple[Window, ...]:
        ends = np.round(np.interp(np.array(spans), old, new), 4)
        return tuple((begin, min(end, new[-1])) for begin, end in ends.tolist())

    return Windows(**{name: there(getattr(windows, name)) for name in windows.__struct_fields__})


def _plain(value: float) -> float:
    """A number of few digits."""
    return float(f"{value:.{DIGITS}g}")
