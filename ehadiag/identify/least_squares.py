"""Refinement of the severities by robust least squares.

Constant errors of the sensors are estimated with the severities; oil and supply, which the bus says
in steps, in the last round.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.criteria import ESTIMATION, REFINEMENT
from ehadiag.identify.linearisation import (
    CoordinateCross,
    Derivatives,
    LinearModel,
    ParameterDensity,
    capped_cost,
    linearised_on_cross,
)
from ehadiag.identify.posterior import (
    FEW_UNKNOWNS_SCHEDULE,
    SearchSchedule,
    bounded_step,
    no_interruption,
    search_posterior,
)
from ehadiag.identify.signals import median_of
from ehadiag.model.parameter import Parameter
from ehadiag.model.registry import ResidualModel
from ehadiag.model.severities import SEARCH_STDS

SEARCH_OPTIMUM_STD = np.array(SEARCH_STDS)


class Refinement(msgspec.Struct, frozen=True, eq=False):
    """Optimum of the robust least squares; k parameters, N ticks."""

    parameters: tuple[Parameter, ...]
    """What was estimated."""
    x: Array
    """The optimum, in units of `scale`; shape (k,)."""
    scale: Array
    """Shape (k,)."""
    cost: float
    """Capped sum of squares there."""
    residuals: Array
    """Weighted, there; 0 where no sample; shape (signals, N)."""
    jacobian: Array
    """Derivative of the residuals by x; 0 in rows left out; shape (k, signals, N)."""
    considered: Array
    """Change of the residuals by a standard deviation of each considered parameter that is held;
    shape (c, signals, N)."""
    used: NDArray[np.bool_]
    """Rows that took part; shape (signals, N)."""
    weighted: NDArray[np.bool_]
    """Rows that have a sample; shape (signals, N)."""
    evaluations: int
    """Runs of the model."""
    converged: bool
    """Whether the search came to rest."""
    anchored: int
    """How often the model was re-anchored at the optimum."""
    step: Array
    """The last one, in units of `scale`, that by oil and supply of the day aside; shape (k,)."""
    information: Array | None = None
    """What was known beforehand: inverse covariance, in units of `scale`; shape (k, k)."""
    daily: Array = msgspec.field(default_factory=lambda: np.zeros((0, 0, 0)))
    """As `considered`, of those that the last round moved; shape (d, signals, N)."""

    @property
    def values(self) -> dict[str, float]:
        """Estimates by name, SI."""
        values = (self.x * self.scale).tolist()
        return {item.name: value for item, value in zip(self.parameters, values, strict=True)}

    @property
    def normal(self) -> Array:
        """JᵀJ of the rows that took part, in units of `scale`, shape (k, k)."""
        rows = self.jacobian.reshape(len(self.jacobian), -1)  # 0 where none took part
        return products(rows)


def products(rows: Array) -> Array:
    """Products of few long rows with each other, shape (k, k) for rows of shape (k, n).

    Of a matrix and itself numpy asks another function of BLAS, which takes four times as long for
    rows of this kind: hence the copy.
    """
    return np.asarray(rows @ rows.copy().T)


def refine_severities(
    model: Derivatives,
    start: Mapping[str, float],
    spread: Array | float = SEARCH_OPTIMUM_STD,
    between: Callable[[], None] = no_interruption,
    schedule: SearchSchedule = FEW_UNKNOWNS_SCHEDULE,
) -> Refinement:
    """Narrow a density about a start, values by name (0 where not named).

    spread: of the severities about it, shape (c,), or of each of them. between, schedule: see
    `search_posterior`.
    """
    begin = start_density(model, start, spread)
    nothing = np.zeros((len(begin.x), len(begin.x)))
    found = search_posterior(model, begin, begin, nothing, linearised_on_cross, schedule, between)
    return refinement_by_lines(model, found.density.x, found.linear, settled=found.settled)


def start_density(
    model: Derivatives, start: Mapping[str, float], spread: Array | float
) -> ParameterDensity:
    """Lay a density about a start, see `refine_severities`."""
    x = np.array([start.get(item.name, 0.0) for item in model.estimated]) / model.scale
    curved = model.curved
    return ParameterDensity(
        np.clip(x, model.lower, model.upper),
        np.diag(np.broadcast_to(spread, curved.shape) / model.scale[curved]),
    )


def refinement_by_lines(
    model: Derivatives, x: Array, linear: LinearModel, *, settled: bool
) -> Refinement:
    """Evaluate an optimum close to the middle of the last round.

    Its residuals are the middle's, moved by the lines where these hold: no run of the model.
    """
    shift = np.tensordot(x - linear.at, linear.jacobian, 1)
    shift[linear.scatter >= ESTIMATION.max_row_scatter] = 0.0
    residuals = linear.middle + shift
    # The last round counts re-anchorings and considered parameters.
    return _refinement(model, x, linear, residuals, anchored=0, settled=settled)


def refinement_at(
    model: Derivatives,
    x: Array,
    linear: LinearModel,
    *,
    settled: bool,
    information: Array | None = None,
) -> Refinement:
    """Evaluate an optimum; linear: the model about it, over the width of its density."""
    (residuals,), daily, anchored = model.at(x)
    found = _refinement(model, x, linear, residuals, anchored=anchored, settled=settled)
    held = model.held_effects(residuals)
    found = replace(found, considered=held, information=information, daily=daily)
    return _without_jumps(found, linear)


def _refinement(
    model: Derivatives,
    x: Array,
    linear: LinearModel,
    residuals: Array,
    *,
    anchored: int,
    settled: bool,
) -> Refinement:
    """Refinement by the residuals at an optimum and the lines about it."""
    weighted = model.model.batch.weight > 0.0
    used = (
        (linear.scatter < ESTIMATION.max_row_scatter)
        & (residuals**2 < ESTIMATION.residual_cap)
        & weighted
    )
    return Refinement(
        parameters=model.estimated,
        x=x,
        scale=model.scale,
        cost=capped_cost(residuals),
        residuals=residuals,
        jacobian=np.where(used, linear.jacobian, 0.0),
        considered=np.zeros((0, *residuals.shape)),
        used=used,
        weighted=weighted,
        evaluations=model.evaluations,
        converged=settled,
        anchored=anchored,
        step=x - linear.at,
    )


def _without_jumps(found: Refinement, linear: LinearModel) -> Refinement:
    """Leave out rows that a break-away moves within the density: a slope through its jump is no
    information on how sure the optimum is.
    """
    used = found.used & (linear.scatter < ESTIMATION.max_informative_scatter)
    return replace(found, used=used, jacobian=np.where(used, found.jacobian, 0.0))


def median_offsets(model: ResidualModel, residuals: Array) -> dict[str, float]:
    """Median residual of each signal as the constant error of its sensor, SI by name.

    For a model that runs free: re-anchoring would take most of an offset away. A signal that is
    left out has none.
    """
    out = {}
    for item in model.unknowns.free:
        if item.adds_to is not None and item.adds_to < len(model.batch.weight):
            weight = model.batch.weight[item.adds_to]
            used = weight > 0.0
            shares = residuals[item.adds_to][used] / weight[used]
            out[item.name] = float(median_of(shares)) if used.any() else 0.0
    return out


LAST_ROUND_WEIGHINGS = 3
"""Weighings of a last round, 1: oil half a step colder than the bus says shifts many residuals."""


def last_round(model: Derivatives, density: ParameterDensity, *, settled: bool) -> Refinement:
    """Linearise the model over a density once more, and step with oil and supply free.

    model: of all of the tests, re-anchored on the spool; settled: whether the rounds before
    converged. The residuals are those of `model` moved by the lines. It has converged only where
    its own step, but for what oil and supply add, is at most a deviation.
    """
    cross = CoordinateCross.about(model, density)
    runs, daily, anchored = model.at(*cross.points)
    linear = cross.lines(model, runs)
    found = refined_by_step(model, linear, daily, anchored, settled=settled)
    found = _without_jumps(replace(found, considered=model.held_effects(runs[0])), linear)
    step = _last_round_step(model, linear, daily[:0])[0] - linear.at
    most = near_spread(found) / FEW_UNKNOWNS_SCHEDULE.width
    rests = bool(np.all(np.abs(step * found.scale)[model.curved] <= most))
    return replace(found, step=step, converged=settled and rests)


def refined_by_step(
    model: Derivatives,
    linear: LinearModel,
    daily: Array,
    anchored: int,
    *,
    settled: bool = True,
) -> Refinement:
    """Step by the lines, with oil and supply free: the residuals are moved by both.

    daily, anchored: of `Derivatives.at`.
    """
    x, shift = _last_round_step(model, linear, daily, weighings=LAST_ROUND_WEIGHINGS)
    moved = replace(linear, residuals=linear.residuals + shift, middle=linear.middle + shift)
    found = refinement_by_lines(model, x, moved, settled=settled)
    return replace(found, daily=daily, anchored=anchored)


class NearRules(NamedTuple):
    """Refinement from an estimate that is nearly right (`rest_near`)."""

    look_std: float = 5e-4
    """Width of a look at an earlier estimate, 1: a wear of up to 0.002 since then is within
    four."""
    max_rounds: int = 3
    """Rounds, 1: a fourth would take as long as what a search saves (`tools/study cube --wear`)."""
    max_jumped_rows: int = 2
    """Rows that jump where no break-away does, 1: one a tick later moves three samples and more."""
    min_jump_scatter: float = 0.3
    """Scatter about a line from which a row jumps, in variances: half a deviation. With 1 five of
    104 refinements ended up to 1.6 deviations from a search's estimate."""
    max_step: float = 0.5
    """Step of a round at rest, in deviations; with 1 one of 98 refinements ended 1.6 away."""


NEAR = NearRules()


def rest_near(model: Derivatives, start: Mapping[str, float], spread: Array) -> Refinement | None:
    """Refine from values so near the optimum that the second or third round finds it at rest.

    model, start, spread: as of `refine_severities`. A round takes half a block: seven runs, and one
    of oil or supply. None where rounds go on, or where a break-away is within the width of one:
    there the optimum depends on where a round comes from.
    """
    effects: Array | float = 0.0
    for turn in range(NEAR.max_rounds):
        density = start_density(model, start, spread)
        cross = CoordinateCross.about(model, density)
        runs, daily, anchored = model.at(*cross.points, days=slice(turn, turn + 1))
        daily += effects
        effects = daily
        linear = cross.lines(model, runs)
        found = refined_by_step(model, linear, daily, anchored)
        jumps = found.weighted & (linear.scatter > NEAR.min_jump_scatter)
        if np.count_nonzero(jumps) > NEAR.max_jumped_rows:
            return None
        step = np.abs((found.x - density.x) * model.scale)[model.curved]
        start, spread = found.values, near_spread(found)
        most = NEAR.max_step / FEW_UNKNOWNS_SCHEDULE.width * spread
        if turn > 0 and np.all(step <= most):
            found = replace(found, considered=model.held_effects(runs[0]))
            return _without_jumps(found, linear)
    return None


def near_spread(found: Refinement) -> Array:
    """Width of the severities' density for a round about an optimum, see `refine_severities`."""
    std = np.hypot(deviations(found.normal) * found.scale, ESTIMATION.discrepancy_std)
    severities = np.array([item.adds_to is None for item in found.parameters])
    return np.minimum(FEW_UNKNOWNS_SCHEDULE.width * std[severities], SEARCH_OPTIMUM_STD)


def deviations(normal: Array) -> Array:
    """Standard deviations of the estimates by their information."""
    return np.sqrt(
        np.diag(np.linalg.inv(normal + REFINEMENT.min_information * np.eye(len(normal))))
    )


def refined_with_day(model: Derivatives, found: Refinement, linear: LinearModel) -> Refinement:
    """Move an optimum by oil and supply of the day; linear: the model about the optimum."""
    if not len(found.daily):
        return found
    at = replace(linear, x=found.x, residuals=found.residuals)
    x, shift = _last_round_step(model, at, found.daily, found.information, settled=True)
    residuals = found.residuals + shift
    return replace(found, x=x, residuals=residuals, cost=capped_cost(residuals))


def _last_round_step(
    model: Derivatives,
    linear: LinearModel,
    daily: Array,
    information: Array | None = None,
    *,
    weighings: int = 1,
    settled: bool = False,
) -> tuple[Array, Array]:
    """Point to which residuals lead, each weighted by the linear model, and their shift.

    linear: model about the point; daily: see `Refinement`, estimated with a density of unit width
    each; the shift of the residuals is theirs; settled: whether the residuals are those of an
    optimum, but for oil and supply of the day.
    """
    count = len(linear.x)
    prior = np.eye(count + len(daily))
    prior[:count, :count] = REFINEMENT.min_information * np.eye(count)
    if information is not None:
        prior[:count, :count] += information
    free = np.full(len(daily), np.inf)
    lower, upper = np.concatenate([model.lower, -free]), np.concatenate([model.upper, free])
    begin = out = np.concatenate([linear.x, np.zeros(len(daily))])
    for _ in range(weighings):
        sums = linear.sums(daily, out - begin)
        if settled:
            sums.gradient[:count] = 0.0
        out = bounded_step(begin, sums.normal + prior, sums.gradient, lower, upper)
    return out[:count], np.tensordot(out[count:], daily, 1)
