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
    "Known",
    "belief_of",
    "beside",
    "information_of",
    "nuisances_of",
    "small_effects",
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


def nuisances_of(registry: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Nuisances that an identification may free beside the constant errors of the sensors."""
    return tuple(item for item in registry if item.name in BASIC)


def belief_of(model: Derivatives, known: Mapping[str, Known]) -> Belief:
    """Belief with which the search begins: what is known, else the usual sizes."""
    usual = [_usual(item) for item in model.estimated]
    given = [known.get(item.name) for item in model.estimated]
    mean = [k.mean if k else u.mean for k, u in zip(given, usual, strict=True)]
    spread = np.array([k.std if k else u.std for k, u in zip(given, usual, strict=True)])
    x = np.clip(np.array(mean) / model.scale, model.lower, model.upper)
    return Belief(x, np.diag((spread / model.scale)[model.curved]))


def beside(model: Derivatives, belief: Belief, values: Mapping[str, float]) -> Belief:
    """Belief about values by name, 0 where not named: narrower than `belief`."""
    x = np.array([values.get(item.name, 0.0) for item in model.estimated]) / model.scale
    return Belief(np.clip(x, model.lower, model.upper), NEARBY * belief.root)


def small_effects(model: Derivatives, belief: Belief) -> Belief:
    """Belief of an actuator that is nearly the textbook's: nuisances about 0, severities anywhere.

    With hardly any hysteresis the noise of closed loop keeps the spool breaking away, and a search
    from the usual sizes ends where hysteresis that is not there smoothes that.
    """
    faults = np.array([item.kind is Kind.FAULT for item in model.estimated])
    x = np.where(faults, belief.x, 0.0)
    shares = np.where(faults, 1.0, SMALL)[model.curved]
    return Belief(np.clip(x, model.lower, model.upper), belief.root * shares[:, None])


def information_of(model: Derivatives, known: Mapping[str, Known]) -> NDArray[np.float64]:
    """Reciprocal variance of each coordinate: of what is known, and a little of the usual sizes.

    The latter keeps finite what no recording shows, shape (k,).
    """
    out = np.zeros(len(model.estimated))
    for k, item in enumerate(model.estimated):
        if item.adds_to is None or item.name in known:
            out[k] = (model.scale[k] / known.get(item.name, _usual(item)).std) ** 2
    return out


def _usual(item: Parameter) -> Known:
    if item.kind is Kind.FAULT:
        return Known(CENTRE_OF_SEVERITY, SPREAD_OF_SEVERITY)
    if item.lower >= 0.0:
        return Known(CENTRE * item.scale, SPREAD * item.scale)
    return Known(0.0, SPREAD_BOTH_WAYS * item.scale)
