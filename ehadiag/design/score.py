"""Scores a test: how well it shows each severity while all else of the unit is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.stored_test import StoredTest
from ehadiag.design.play import Played, play
from ehadiag.identify.nuisance.knowledge import knowledge_of
from ehadiag.identify.nuisance.prior import information_of, nuisances_of, usual
from ehadiag.identify.refine.derivatives import Derivatives
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.model.parameters import FAULTS, OFFSETS, REGISTRY
from ehadiag.model.simd.model import SimdModel

__all__ = ["POINTS", "Bound", "Score", "bound_of", "score", "usual_effects"]

POINTS = ((0.05, 0.05, 0.05), (0.3, 0.3, 0.3), (0.6, 0.6, 0.6))
"""Severities at which a test is scored: nearly as new, degraded, worn."""
ALIKE = 0.9
"""Correlation of two estimates from which the test hardly tells the two apart."""
HELD = 0.7
"""Share of what was known before from which a test shows nothing of a parameter."""


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """The Cramér-Rao bound at one point, all other unknowns free.

    Attributes
    ----------
    severities : tuple[float, ...]
        The point.
    std : NDArray[np.float64]
        Smallest deviation of an unbiased estimate of each severity, shape (k,).
    alone : NDArray[np.float64]
        The same if the severities and the sensors' offsets were all that is unknown, shape (k,).
    alike : tuple[tuple[str, str, float], ...]
        A severity, what it is hardly told apart from, and the correlation of the two.
    unseen : tuple[str, ...]
        Parameters of which the test shows nothing.
    """

    severities: tuple[float, ...]
    std: NDArray[np.float64]
    alone: NDArray[np.float64]
    alike: tuple[tuple[str, str, float], ...]
    unseen: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What a test shows, and what it asks of the actuator.

    Attributes
    ----------
    bounds : tuple[Bound, ...]
        At each point.
    figure : float
        Geometric mean of the bounds of all severities at all points.
    travel : float
        Largest distance of the jack from its middle over the points, m.
    rate : float
        Largest speed of the jack, m/s.
    pressure : float
        Largest differential pressure, Pa.
    """

    bounds: tuple[Bound, ...]
    figure: float
    travel: float
    rate: float
    pressure: float


def score(
    test: StoredTest,
    actuator: Actuator,
    points: Sequence[tuple[float, ...]] = POINTS,
) -> Score:
    """Score a test of an actuator.

    Unknown are the severities, the sensors' offsets, the nuisances, and the data that have a
    tolerance in the actuator file. The unit has usual nuisances: what hysteresis hides is not
    there to be seen on one without any.

    Parameters
    ----------
    test : StoredTest
        What is scored.
    actuator : Actuator
        Data of the actuator, with their tolerances.
    points : Sequence[tuple[float, ...]]
        Severities in the order of the registry.

    Returns
    -------
    Score
        The bounds at all points.

    Raises
    ------
    ConfigurationError
        A severity out of its range.
    """
    played = [play(test, actuator, point, usual_effects()) for point in points]
    bounds = tuple(
        bound_of(item, actuator, point) for item, point in zip(played, points, strict=True)
    )
    logs = np.log([bound.std for bound in bounds])
    return Score(
        bounds,
        float(np.exp(logs.mean())),
        max(item.travel for item in played),
        max(item.rate for item in played),
        max(item.pressure for item in played),
    )


def usual_effects() -> dict[str, float]:
    """Nuisances of a usual unit, by name: the middle of what is known of any unit."""
    return {item.name: usual(item).mean for item in nuisances_of(REGISTRY)}


def bound_of(played: Played, actuator: Actuator, point: tuple[float, ...]) -> Bound:
    """Cramér-Rao bound of a test that was played at a point.

    The Fisher information is that of Gaussian noise. Ticks at which a break-away tips between both
    sides of a difference are left out: there the response has no derivative.
    """
    knowledge = knowledge_of(actuator)
    free = (*FAULTS, *OFFSETS, *knowledge.beside(nuisances_of(REGISTRY)))
    experiments = [played.experiment]
    model = Derivatives(
        SimdModel(lay_out(experiments), unknowns_of(experiments, free)), played.experiment.noise
    )
    severities = {item.name: value for item, value in zip(FAULTS, point, strict=True)}
    values = {**usual_effects(), **severities}
    x = np.array([values.get(item.name, 0.0) for item in free]) / model.scale
    slope = model.trusted_slope(x)
    rows = slope.jacobian[:, slope.smooth]
    prior = information_of(model, knowledge.known, knowledge.joint)
    count = len(FAULTS)
    prior[:count, :] = prior[:, :count] = 0.0
    shown = rows @ rows.T
    covariance = np.linalg.pinv(shown + prior, hermitian=True)
    known = count + len(OFFSETS)
    alone = np.linalg.pinv(shown[:known, :known], hermitian=True)
    spread = np.sqrt(np.diag(covariance))
    names = [item.name for item in model.estimated]
    before = np.sqrt(1.0 / np.maximum(np.diag(prior), np.finfo(float).tiny))
    return Bound(
        severities=point,
        std=(spread * model.scale)[:count],
        alone=(np.sqrt(np.diag(alone)) * model.scale[:known])[:count],
        alike=_alike(names, covariance / np.outer(spread, spread)),
        unseen=tuple(
            name
            for k, name in enumerate(names[known:], start=known)
            if spread[k] > HELD * before[k]
        ),
    )


def _alike(
    names: Sequence[str], correlation: NDArray[np.float64]
) -> tuple[tuple[str, str, float], ...]:
    """Pairs of a severity and something else that go together, the closest first."""
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i in range(len(FAULTS))
        for j in range(i + 1, len(names))
        if abs(correlation[i, j]) >= ALIKE
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))
