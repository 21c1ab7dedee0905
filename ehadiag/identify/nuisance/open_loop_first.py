"""Explains the open-loop recordings of a unit first: what they leave open is looked over with all.

In closed loop the spool breaks away again and again, and a search from the usual sizes of all
effects ends where the break-aways come at wrong ticks. In open loop they are few, and the search is
easy. What is believed after it, correlations and all, is narrow enough for the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.refine.derivatives import Derivatives
from ehadiag.identify.refine.linearisation import Belief

__all__ = ["carried_over", "open_loop_first"]


def open_loop_first(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return those in open loop where there are some of both kinds, else none."""
    first = [item for item in experiments if not item.test.closed_loop]
    return first if len(first) < len(experiments) else []


def carried_over(part: Derivatives, found: Belief, whole: Derivatives) -> Belief:
    """Return what a part of the recordings says, in the coordinates of a model of all of them.

    Both models have the same parameters. A constant error of a sensor that each recording has for
    itself begins at that of the first.
    """
    values: dict[str, float] = {}
    for item, value in zip(part.estimated, (found.x * part.scale).tolist(), strict=True):
        values.setdefault(item.name, value)
    x = np.array([values[item.name] for item in whole.estimated]) / whole.scale
    widths = part.scale[part.curved] / whole.scale[whole.curved]
    return Belief(np.clip(x, whole.lower, whole.upper), widths[:, None] * found.root)
