"""The objective that every search minimises: capped squares of a model's weighted residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.model.interface import ResidualModel

__all__ = ["SEARCH_CAP", "Objective"]

SEARCH_CAP = 25.0
"""Largest square of one weighted residual: a break-away that went the other way costs no more."""


class Objective:
    """A function of a population within bounds; counts its evaluations.

    Parameters
    ----------
    model : ResidualModel
        All of its unknowns are searched; they have finite bounds.
    cap : float
        Largest square of one weighted residual that counts.
    """

    def __init__(self, model: ResidualModel, cap: float = SEARCH_CAP) -> None:
        self.model = model
        self.cap = cap
        self.lower = model.unknowns.lower
        self.upper = model.unknowns.upper

    @property
    def evaluations(self) -> int:
        """Evaluations so far."""
        return self.model.evaluations

    def __call__(self, population: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of each row, shape (n,) for a population of shape (n, k)."""
        return self.model.costs(population, self.cap)
