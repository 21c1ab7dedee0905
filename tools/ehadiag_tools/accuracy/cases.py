"""Cases to identify: the paper's, with its figures, and seeded random ones in the unit cube."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

__all__ = ["PAPER", "Faults3", "PaperCase", "random_faults"]

Faults3 = tuple[float, float, float]
"""Kintas, FSS, FDJ, each 0 … 1."""
SPECIAL_EVERY = 4
"""One in so many cases lies on the surface of the cube, until each of its parts was visited."""


@dataclass(frozen=True, slots=True)
class PaperCase:
    """One case of the paper's Tables 1 and 2 (PHY-40); errors in percent."""

    test: str
    number: int
    faults: Faults3
    first: float
    """Mean error after the first approximation."""
    final: float
    """Mean error after the genetic algorithm."""


PAPER: tuple[PaperCase, ...] = (
    PaperCase("open", 1, (0.3, 0.3, 0.3), 0.7147, 0.1937),
    PaperCase("open", 2, (0.3, 0.6, 0.3), 7.7791, 0.4891),
    PaperCase("open", 3, (0.6, 0.6, 0.3), 9.6052, 0.2816),
    PaperCase("open", 4, (0.6, 0.6, 0.6), 9.5992, 0.2754),
    PaperCase("closed", 1, (0.3, 0.3, 0.3), 0.3005, 0.2943),
    PaperCase("closed", 2, (0.3, 0.6, 0.3), 4.5653, 0.2479),
    PaperCase("closed", 3, (0.6, 0.6, 0.3), 5.1306, 0.3380),
    PaperCase("closed", 4, (0.6, 0.6, 0.6), 2.2902, 0.2346),
)


def random_faults(count: int, seed: int) -> list[Faults3]:
    """Points of the unit cube; a longer list begins with the shorter one of the same seed.

    Among them, one in four, are all corners, a point on each edge and on each face: 26 in all.
    """
    rng = np.random.default_rng(seed)
    surface: list[list[float]] = []
    faces: tuple[float | None, ...] = (0.0, 1.0, None)
    for place in itertools.product(faces, repeat=3):
        if place != (None, None, None):
            free = rng.random(3)
            surface.append([float(r) if v is None else v for v, r in zip(place, free, strict=True)])
    order = iter(rng.permutation(len(surface)))
    out: list[Faults3] = []
    for index in range(count):
        inside = rng.random(3)
        special = next(order, None) if index % SPECIAL_EVERY == 0 else None
        a, b, c = inside if special is None else surface[special]
        out.append((float(a), float(b), float(c)))
    return out
