"""The severities of a diagnosis by the faults' names, as every report shows them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ehadiag.model.parameters import FAULTS

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis

__all__ = ["Fault", "faults_of"]


@dataclass(frozen=True, slots=True)
class Fault:
    """Severity of one progressive fault: 0 as new, 1 at the limit of damage.

    Where nothing could be identified all numbers are NaN and there are no flags.
    """

    name: str
    """As in results, reports and options."""
    meaning: str
    """What it is, in two words."""
    value: float
    """The estimated severity, after the refinement."""
    std: float
    """Its standard deviation."""
    interval: tuple[float, float]
    """95 % interval, cut at the bounds."""
    first: float
    """After the first approximation."""
    search: float
    """After the genetic search."""
    flags: tuple[str, ...]
    """`at_bound`: the estimate stands at 0 or 1; `not_shown`: the test does not show this fault."""


def faults_of(diagnosis: Diagnosis) -> dict[str, Fault]:
    """Return every fault by its name, in the order of the model's registry."""
    if diagnosis.identification is None:
        return {item.name: _unknown(item.name, item.short) for item in FAULTS}
    estimates = {item.name: item for item in diagnosis.identification.estimates}
    out = {}
    for parameter in FAULTS:
        item = estimates[parameter.name]
        out[item.name] = Fault(
            name=item.name,
            meaning=parameter.short,
            value=item.value,
            std=item.std,
            interval=item.interval95,
            first=item.first,
            search=item.search,
            flags=("at_bound",) * item.at_bound + ("not_shown",) * (not item.shown),
        )
    return out


def _unknown(name: str, meaning: str) -> Fault:
    nan = math.nan
    return Fault(name, meaning, nan, nan, (nan, nan), nan, nan, ())
