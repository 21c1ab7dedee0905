"""Search for many parameters at once: a belief that is sharpened by linearising over its own width.

Iterated posterior linearisation (García-Fernández, Svensson, Morelande, Särkkä, IEEE Trans. Signal
Processing 63(20), 2015): the model is made linear over the spread of what is believed, the linear
problem gives a sharper belief, and so on until the spread is that of the noise. While the belief is
wide, samples that break-aways make jump have a large scatter and count little; so the search sees
the smooth outline first and the fine structure last, each sample in its own time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.refine.bounded_step import bounded_step
from ehadiag.identify.refine.derivatives import Derivatives
from ehadiag.identify.refine.linearisation import Belief, Linearised

__all__ = [
    "FEW",
    "LAST",
    "MANY",
    "PATIENT",
    "TAIL",
    "Pace",
    "Sharpened",
    "nothing",
    "robust_cost",
    "robust_weights",
    "sharpen",
]

TAIL = 3.0
"""Deviations beyond which a residual counts little (Cauchy's weight)."""
LEAST_RATIO_OF_LINEAR = 0.05
"""By which a belief may become narrower in a round where the model is linear over it: there is
nothing to look past."""
LINEAR_SCATTER, LINEAR_SHARE = 0.1, 0.01
"""Scatter, in variances of the noise; share of samples with more of it, up to which it is so."""
FLAT_ROUNDS, FLAT_PLACES = 6, 3
"""Rounds of which so many end with the same objective: no more is to be gained. Between them a
break-away may come at another tick."""
HELD_BACK = 0.1
"""Share of the belief's information that a round's step is held back by."""
HELD_BACK_WHERE_LINEAR = 1e-3
"""The same where the model is linear over it: a belief that became too narrow on its way would
creep."""
FREE = 1e-9
MEAN_STEP = 0.25
"""Last step of a mean of rounds, in widths of the belief, below which it has come to rest: where
the cost has steps as wide as the belief no round alone does."""


def nothing() -> None:
    """Let a search go on."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a belief is sharpened.

    Attributes
    ----------
    least_ratio, most_ratio : float
        By which it may become narrower, and wider, in a round, in any direction.
    settled_ratio, settled_step : float
        Of a round after which nothing changes: ratio of the widths, step in units of them.
    most_rounds : int
    whole_rounds : int
        Rounds that are taken whole. Of the first after them half is taken, of the next a third, and
        so on (Robbins, Monro, Annals of Mathematical Statistics 22(3), 1951): where the cost has
        steps as wide as the belief, round follows round about its mean for ever.
    flat : float
        By how much the objective differs where it is the same (a parameter one deviation off costs
        1), so that the search ends, and at the best place seen; 0: it does not go by the objective.
    width : float
        Of the belief, in deviations of what the linear problem leaves.
    """

    least_ratio: float
    most_ratio: float
    settled_ratio: float
    settled_step: float
    most_rounds: int
    whole_rounds: int
    flat: float
    width: float = 2.0


MANY = Pace(
    0.5, 1.0, settled_ratio=0.85, settled_step=0.5, most_rounds=24, whole_rounds=1000, flat=10.0
)
"""For many unknowns."""
PATIENT = replace(MANY, least_ratio=0.85, most_rounds=70, whole_rounds=70, width=3.0)
"""The same, where break-aways lead a faster search astray. Of 54 starts on nine recordings that are
hard (closed loop, little hysteresis) 38 came to the optimum, with 700 runs each; with a ratio of
0.75 19, with 480 runs; of 0.65 9, with 360; of 0.9 42, with 970."""
LAST = replace(MANY, most_rounds=12, flat=4.0)
"""The same, of a last look, which begins beside the optimum."""
FEW = Pace(0.2, 1.5, settled_ratio=0.6, settled_step=0.1, most_rounds=9, whole_rounds=6, flat=0.0)
"""For few ones, which are told apart at once: until the estimate is that of any search before."""


@dataclass(frozen=True, slots=True, eq=False)
class Sharpened:
    """What a search ends with.

    Attributes
    ----------
    belief : Belief
    linear : Linearised
        The model about it, of the last round.
    settled : bool
        Whether the belief came to rest.
    """

    belief: Belief
    linear: Linearised
    settled: bool


def sharpen(
    model: Derivatives,
    known: Belief,
    begin: Belief,
    information: NDArray[np.float64],
    linearise: Callable[[Derivatives, Belief], Linearised],
    pace: Pace = MANY,
    between: Callable[[], None] = nothing,
) -> Sharpened:
    """Sharpen a belief until the noise stops it.

    Parameters
    ----------
    model : Derivatives
        That runs free: re-anchored on the spool it jumps more.
    known : Belief
        Its mean is what was known before the recording.
    begin : Belief
        Where the search begins.
    information : shape (k, k)
        What was known: inverse covariance, 0 where nothing.
    linearise : callable
        How the model is made linear over a belief.
    pace : Pace
    between : callable
        Called before each round, some 16 to 32 runs of the model; what it raises ends the search.
    """
    belief, rounds, settled = begin, 0, False
    course = _Course(known, information, pace.flat)
    while not settled and rounds < pace.most_rounds:
        between()
        linear = linearise(model, belief)
        rounds += 1
        if pace.flat:
            course.passed(belief.x, linear.middle)
            if course.is_flat:
                return Sharpened(replace(belief, x=course.x), linear, True)
        share = 1.0 / (1 + max(rounds - pace.whole_rounds, 0))
        belief, ratio, step = _narrowed(model, linear, known, belief, information, pace, share)
        settled = ratio > pace.settled_ratio and step < pace.settled_step
    if not settled and share < 1.0:
        settled = ratio > pace.settled_ratio and share * step < MEAN_STEP
    if pace.flat:
        course.passed(belief.x, model.many(belief.x[None, :])[0])
        belief = replace(belief, x=course.x)
    return Sharpened(belief, linear, settled)


class _Course:
    """Places that a search came through, and the objective there: cost and what was known.

    Parameters
    ----------
    known, information
        See `sharpen`.
    flat : float
        See `Pace`.
    """

    def __init__(self, known: Belief, information: NDArray[np.float64], flat: float) -> None:
        self._known, self._information, self._flat = known, information, flat
        self._course: list[float] = []
        self._unit = 1.0
        self.x = known.x
        """The best place."""

    def passed(self, x: NDArray[np.float64], residuals: NDArray[np.float64]) -> None:
        """Take down a place and the residuals there, shape (signals, N)."""
        off = x - self._known.x
        objective = float(robust_cost(residuals) + off @ self._information @ off)
        if not self._course or objective < min(self._course):
            self.x = x
            self._unit = objective / max(int(np.count_nonzero(residuals)), 1)
        self._course.append(objective)

    @property
    def is_flat(self) -> bool:
        """Whether the search came to the same objective again and again of late."""
        late = sorted(self._course[-FLAT_ROUNDS:])[:FLAT_PLACES]
        return len(late) == FLAT_PLACES and late[-1] - late[0] < self._flat * max(self._unit, 1.0)


def robust_cost(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cauchy's cost of weighted residuals, shape (…, signals, N): shape (…)."""
    return np.asarray(TAIL**2 * np.log1p((residuals / TAIL) ** 2).sum(axis=(-2, -1)))


def robust_weights(linear: Linearised) -> NDArray[np.float64]:
    """Weight of each residual: less where it scatters, and less where it is large."""
    variance = 1.0 + linear.scatter
    return np.asarray(1.0 / (variance + linear.residuals**2 / TAIL**2))


def _is_linear(linear: Linearised) -> bool:
    """Whether next to no sample leaves the line by more than its noise."""
    return float(np.mean(linear.scatter > LINEAR_SCATTER)) < LINEAR_SHARE


def _narrowed(
    model: Derivatives,
    linear: Linearised,
    known: Belief,
    belief: Belief,
    information: NDArray[np.float64],
    pace: Pace,
    share: float,
) -> tuple[Belief, float, float]:
    """Belief after a share of a round; also the ratio by which it would narrow most, and the step,
    of the whole of it."""
    weights = robust_weights(linear).ravel()
    rows = linear.jacobian.reshape(len(belief.x), -1)
    weighed = rows * weights
    normal = weighed @ rows.T + information
    gradient = weighed @ linear.residuals.ravel() + information @ (linear.x - known.x)
    curved = model.curved
    inverse_root = np.linalg.inv(belief.root)
    held = FREE * np.eye(len(belief.x))
    is_linear = _is_linear(linear)
    back = HELD_BACK_WHERE_LINEAR if is_linear and pace.flat else HELD_BACK
    held[np.ix_(curved, curved)] += back * inverse_root.T @ inverse_root
    x = bounded_step(linear.x, normal + held, gradient, model.lower, model.upper)
    # What is left unexplained widens the belief.
    variance = (1.0 + linear.scatter).ravel()
    excess = float((linear.residuals.ravel() ** 2 * weights).sum() / (variance * weights).sum())
    spread = np.linalg.inv(normal + held * FREE)[np.ix_(curved, curved)]
    spread *= pace.width**2 * max(excess, 1.0)
    squares, axes = np.linalg.eigh(inverse_root @ spread @ inverse_root.T)
    ratios = np.sqrt(np.maximum(squares, 0.0))
    least = LEAST_RATIO_OF_LINEAR if is_linear else pace.least_ratio
    kept = np.clip(ratios, least, pace.most_ratio)
    step = float(np.abs(inverse_root @ (x - belief.x)[curved]).max())
    taken = x + (1.0 - share) * (belief.x - x)
    return Belief(taken, belief.root @ (axes * kept**share)), float(ratios.min()), step
