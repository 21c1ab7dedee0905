"""Judges what recordings said of a unit: whether it is as new, healthy, and explained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehadiag.assess.verdict import Levels
from ehadiag.calibration.models import Learned
from ehadiag.calibration.result import Severity
from ehadiag.core.recording import Recording
from ehadiag.identify.nuisance.estimate import Estimated
from ehadiag.identify.nuisance.explained import is_noise
from ehadiag.identify.spans import by_experiment
from ehadiag.identify.uncertainty import covariance
from ehadiag.model.parameters import FAULTS

__all__ = [
    "AS_NEW",
    "MOST_LEFT",
    "SURE",
    "WORTH_ANOTHER",
    "is_explained",
    "not_as_new",
    "not_healthy",
    "severities_of",
    "unexplained",
]

AS_NEW = 0.05
"""Severity above which a unit is not as new."""
SURE = 2.0
"""Deviations by which a severity must be beyond it, or stay below twice of it."""
MOST_LEFT = 5.0
"""Residuals over noise up to which the best model may leave something, which widens what is
learned and every interval after it (`ehadiag.identify.nuisance.knowledge`)."""
WORTH_ANOTHER = 3.0
"""The same up to which another search with a model may come to explain them."""


def is_explained(learned: Learned) -> bool:
    """Whether nothing is left, or no more than what a calibration may leave."""
    return learned.estimated.excess <= MOST_LEFT


def severities_of(found: Estimated) -> tuple[Severity, ...]:
    """Severities where they were estimated, with their deviations: 0 of less friction than new."""
    values, names = found.refined.values, [item.name for item in found.refined.parameters]
    std = np.sqrt(np.diag(covariance(found.refined) + found.covariance)).tolist()
    return tuple(
        Severity(item.name, max(values[item.name], 0.0), std[names.index(item.name)])
        for item in FAULTS
        if item.name in values
    )


def not_as_new(found: Estimated) -> list[str]:
    """Why a unit is not as new; empty where it is."""
    out = []
    for item in severities_of(found):
        if item.value > AS_NEW:
            out.append(f"not as new: {item.name} {item.value:.3f} ± {item.std:.3f}")
        elif item.value + SURE * item.std > 2.0 * AS_NEW:
            out.append(
                f"the recordings do not show whether the unit is as new: {item.name} "
                f"{item.value:.3f} ± {item.std:.3f}"
            )
    return out


def not_healthy(found: Estimated) -> list[str]:
    """Why a unit is not healthy; empty where it is."""
    advisory = Levels().advisory
    return [
        f"not healthy: {item.name} {item.value:.3f} ± {item.std:.3f}"
        for item in severities_of(found)
        if item.value + SURE * item.std >= advisory
    ]


def unexplained(best: Learned, recordings: Sequence[Recording] = ()) -> list[str]:
    """Why the best model cannot be learned from, and of which recordings it leaves something."""
    reasons = [
        f"no model explains the recordings: the residuals are {best.estimated.excess:.1f} times"
        " the noise: other recordings than of one sound unit as new, another type of unit, or"
        " an effect that no model has"
    ]
    if len(recordings) > 1:
        parts = by_experiment(best.experiments, best.estimated.refined.residuals)
        bad = [
            recording.source
            for recording, part in zip(recordings, parts, strict=True)
            if not is_noise(part)
        ]
        reasons.append(f"not explained together: {', '.join(bad or ['none alone'])}")
    return reasons
