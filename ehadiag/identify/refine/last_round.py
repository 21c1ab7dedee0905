"""The last round of a refinement: on all of the tests, and by a finer model.

The vector kernels, which the rounds before run by, know the spool at each quarter of a tick; jack
friction and the servovalve's current gain are a fraction of a deviation off for it. The scalar
model, which knows it as finely as the jack can feel, is run once: what its residuals have more is
as good as a change of what was measured, and derivatives do not feel it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.bounded_step import bounded_step
from ehadiag.identify.refine.derivatives import Derivatives, capped
from ehadiag.identify.refine.least_squares import Refinement, by_lines
from ehadiag.identify.refine.linearisation import Belief, Cross, Linearised
from ehadiag.identify.refine.posterior import robust_weights
from ehadiag.model.laws import ESTIMATED_BEND
from ehadiag.model.scalar.residuals import ScalarModel

__all__ = ["by_a_finer_model", "last_round"]

JUMP = 0.5
"""Change of a residual by the finer model, in units of noise, from which on it is a break-away at
another tick, which is none of the model's errors."""
FARTHEST = 1.0
"""Deviations of a severity beyond which a last round is none, and is not taken."""
FREE = 1e-9
"""Information on what nothing shows."""


def last_round(
    model: Derivatives, belief: Belief, settled: bool, *others: NDArray[np.float64]
) -> tuple[Refinement, list[float]]:
    """Make the model linear over a belief once more, and go where the finer model's residuals lead.

    Parameters
    ----------
    model : Derivatives
        Of all of the tests, re-anchored on the spool.
    belief : Belief
    settled : bool
        Whether the rounds before came to rest.
    others : shape (k,)
        Points whose cost is asked for: they are run in the same blocks.

    Returns
    -------
    Refinement
        Its residuals are those of `model`, moved by the lines.
    list of float
        Cost of the belief's mean and of the other points.
    """
    cross = Cross.about(model, belief)
    sides = cross.points[1:]
    middle, considered, anchored, runs = model.at(belief.x, *sides, *others)
    linear = cross.lines(model, np.concatenate([middle[None], runs[: len(sides)]]))
    finer = replace(linear, residuals=linear.residuals + _finer(model, belief.x, middle))
    x = _stepped(model, linear.x, finer, finer.residuals)
    if np.any(np.abs(x - belief.x)[model.curved] > FARTHEST * np.sqrt((belief.root**2).sum(1))):
        x = belief.x
    found = by_lines(model, x, linear, settled=settled)
    found = replace(
        found, considered=considered, anchored=anchored, evaluations=found.evaluations + 1
    )
    return found, [capped(middle), *map(capped, runs[len(sides) :])]


def by_a_finer_model(model: Derivatives, found: Refinement, linear: Linearised) -> Refinement:
    """Move an optimum by what a finer model's residuals have more.

    linear: the model about the optimum, over the width of what is known.
    """
    change = _finer(model, found.x, found.residuals)
    x = _stepped(model, found.x, linear, change, found.information)
    return replace(found, x=x, evaluations=found.evaluations + 1)


def _finer(
    model: Derivatives, x: NDArray[np.float64], residuals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What a finer model's residuals at a point have more, 0 where a break-away makes it.

    residuals: of the model there, shape (signals, N).
    """
    inner = model.model
    fine = ScalarModel(inner.batch, inner.unknowns, ESTIMATED_BEND)
    change = fine.residuals(model.values(x[None, :]))[0][0] - residuals
    return np.where(np.abs(change) < JUMP, change, 0.0)


def _stepped(
    model: Derivatives,
    x: NDArray[np.float64],
    linear: Linearised,
    residuals: NDArray[np.float64],
    information: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Where residuals lead to from a point, each weighed as the linear model about it says."""
    rows = linear.jacobian.reshape(len(x), -1)
    weighed = rows * robust_weights(linear).ravel()
    normal = weighed @ rows.T + FREE * np.eye(len(x))
    if information is not None:
        normal += information
    return bounded_step(x, normal, weighed @ residuals.ravel(), model.lower, model.upper)
