"""What is known of each parameter before a recording is seen, and which are easily confused.

All that the search knows of the actuator stands here; the search itself is generic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.derivatives import Derivatives
from ehadiag.identify.refine.linearisation import Belief
from ehadiag.model.parameters import Kind, Parameter

__all__ = [
    "ALIAS",
    "Joint",
    "Known",
    "belief_of",
    "beside",
    "information_of",
    "nuisances_of",
    "small_effects",
    "usual",
]

ALIAS = "null_bias"
"""What a constant error of the spool's sensor passes for: only the pressure tells them apart, and
where it saturates the search may stop at a wrong pair."""
CENTRE_OF_SEVERITY, SPREAD_OF_SEVERITY = 0.4, 0.3
CENTRE, SPREAD = 0.5, 0.4
"""Of a nuisance that is never negative: mean and deviation, in units of its scale."""
SPREAD_BOTH_WAYS = 0.5
"""Deviation of one that may have either sign."""
NEARBY = 0.1
"""Spread about a hint, in spreads of what is believed without one."""
SMALL = 0.2
"""Spread of nuisances about 0, likewise."""
BASIC = ("null_bias", "torque_motor_gain", "hysteresis", "backlash")
"""Nuisances that `--nuisances` frees: those of section 8's basic set."""


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of a parameter beforehand: a normal density, in its unit.

    Attributes
    ----------
    mean, std : float
    """

    mean: float
    std: float


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """What is known of several parameters together: a normal density, in their units.

    Attributes
    ----------
    names : tuple of str
    mean : shape (m,)
    covariance : shape (m, m)
        Positive definite.
    """

    names: tuple[str, ...]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def covariance_among(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Covariance of parameters in this order, 0 of those of which nothing is known."""
        out = np.zeros((len(names), len(names)))
        mine = [k for k, name in enumerate(names) if name in self.names]
        places = [self.names.index(names[k]) for k in mine]
        out[np.ix_(mine, mine)] = self.covariance[np.ix_(places, places)]
        return out


def nuisances_of(registry: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Nuisances that an identification may free beside the constant errors of the sensors."""
    return tuple(item for item in registry if item.name in BASIC)


def belief_of(model: Derivatives, known: Mapping[str, Known], joint: Joint | None = None) -> Belief:
    """Belief with which the search begins: what is known, else the usual sizes."""
    mean, covariance = _density(model, known, joint)
    x = np.clip(mean, model.lower, model.upper)
    root = np.linalg.cholesky(covariance[np.ix_(model.curved, model.curved)])
    return Belief(x, np.asarray(root, dtype=np.float64))


def beside(model: Derivatives, belief: Belief, values: Mapping[str, float]) -> Belief:
    """Belief about values by name, 0 where not named: narrower than `belief`."""
    x = np.array([values.get(item.name, 0.0) for item in model.estimated]) / model.scale
    return Belief(np.clip(x, model.lower, model.upper), NEARBY * belief.root)


def small_effects(model: Derivatives, belief: Belief) -> Belief:
    """Belief about a unit with hardly any effects: all but the severities are close to 0.

    The second place from which a search begins. With hardly any hysteresis the noise of closed loop
    keeps the spool breaking away, and a search from the usual sizes ends where hysteresis that is
    not there smoothes that.
    """
    faults = np.array([item.kind is Kind.FAULT for item in model.estimated])
    x = np.where(faults, belief.x, 0.0)
    shares = np.where(faults, 1.0, SMALL)[model.curved]
    return Belief(np.clip(x, model.lower, model.upper), belief.root * shares[:, None])


def information_of(
    model: Derivatives, known: Mapping[str, Known], joint: Joint | None = None
) -> NDArray[np.float64]:
    """Inverse covariance of what is known, and a little of the usual sizes, shape (k, k).

    The latter keeps finite what no recording shows. A constant error of a sensor of which nothing
    is known may have any size.
    """
    _, covariance = _density(model, known, joint)
    named = {*known, *(joint.names if joint else ())}
    shown = [
        k for k, item in enumerate(model.estimated) if item.adds_to is None or item.name in named
    ]
    out = np.zeros_like(covariance)
    out[np.ix_(shown, shown)] = np.linalg.inv(covariance[np.ix_(shown, shown)])
    return out


def _density(
    model: Derivatives, known: Mapping[str, Known], joint: Joint | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and covariance of all coordinates, in units of the model's scales."""
    each = [known.get(item.name) or usual(item) for item in model.estimated]
    mean = np.array([item.mean for item in each])
    covariance = np.diag([item.std**2 for item in each])
    if joint is not None:
        names = [item.name for item in model.estimated]
        mine = [k for k, name in enumerate(names) if name in joint.names]
        mean[mine] = [joint.mean[joint.names.index(names[k])] for k in mine]
        covariance[np.ix_(mine, mine)] = joint.covariance_among([names[k] for k in mine])
    return mean / model.scale, covariance / np.outer(model.scale, model.scale)


def usual(item: Parameter) -> Known:
    """What is known of a parameter of any unit: its usual size."""
    if item.kind is Kind.FAULT:
        return Known(CENTRE_OF_SEVERITY, SPREAD_OF_SEVERITY)
    if item.lower >= 0.0:
        return Known(CENTRE * item.scale, SPREAD * item.scale)
    return Known(0.0, SPREAD_BOTH_WAYS * item.scale)
