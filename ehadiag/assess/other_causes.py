"""Other faults than the three progressive ones, and the cause of an unexplained recording.

Null bias, hysteresis, backlash and torque-motor gain each have a limit in the actuator file. One
that is more likely beyond its limit than not (simple acceptance, JCGM 106:2012, 8.2) makes a
verdict DEGRADED, never FAULT by itself. Where the model does not explain a recording every
parameter of the registry is tried together with those estimated: one Gauss-Newton step from the
estimate (a score test, C. R. Rao, Proc. Cambridge Phil. Soc. 44, 1948), then, where that promises
something, the model itself at shares of that step. What explains most is the suspect.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np

from ehadiag.assess.verdict import Verdict, is_explained_by_discrepancy_alone
from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import finite
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.criteria import (
    ESTIMATION,
    FIT,
    NOISE_LIMIT,
    NORMAL_HALF_WIDTH_95,
    RECORDING,
    RESPONSE,
    VERDICT,
)
from ehadiag.estimate import Culprit, Effect, Suspect
from ehadiag.identify.experiment import (
    Experiment,
    lay_out_spans,
    residuals_by_experiment,
    share_offsets,
    unknowns_of,
)
from ehadiag.identify.identification_result import Fit, Identification
from ehadiag.identify.prior import UnitPrior, usual_prior
from ehadiag.identify.ring import find_ring
from ehadiag.model.parameter import Parameter, ParameterKind, scaled_to_channels
from ehadiag.model.plant import REFERENCE_TEMPERATURE, relative_viscosity
from ehadiag.model.registry import REGISTRY, parameter
from ehadiag.model.residual_models import SimdModel
from firmware_iface.recording import Environment

PLAYS = ("hysteresis", "backlash")
"""Effects that a spool's friction may pass for."""


def effects_of(
    identification: Identification, prior: UnitPrior, actuator: Actuator
) -> tuple[Effect, ...]:
    """Return every effect that was estimated, in the order of the identification.

    prior: what was known of the unit beforehand; actuator: its data, with its limits. Returns
    values, limits, and what was known of them. None is beyond its limit where more is left than
    noise: a calibrated effect stands for a wrong law of wear then, by up to 14 deviations of a
    torque motor's gain.
    """
    channels = actuator_channels(actuator)
    doubtful = is_explained_by_discrepancy_alone(identification.fit)
    out = []
    for name, found in identification.nuisances.items():
        item = scaled_to_channels(parameter(name), channels)
        half, limit = NORMAL_HALF_WIDTH_95 * found.std, item.limit_of(actuator)
        known = math.isfinite(found.value) and math.isfinite(found.std)
        chance = None
        if limit is not None and known and not doubtful:
            chance = chance_beyond(found.value, found.std, limit)
        std, source = _prior(item, prior)
        out.append(
            Effect(
                name=name,
                value=finite(found.value),
                unit=item.unit,
                std=finite(found.std),
                interval95=(
                    (max(item.lower, found.value - half), min(item.upper, found.value + half))
                    if known
                    else None
                ),
                limit=limit,
                beyond=None if chance is None else chance >= VERDICT.min_chance_fault,
                chance=chance,
                at_bound=found.at_bound,
                prior_std=std,
                source=source,
                meaning=item.short,
            )
        )
    return tuple(out)


def _prior(item: Parameter, prior_of_unit: UnitPrior) -> tuple[float | None, str]:
    """Deviation of what was known of a parameter, and where that is from."""
    joint = prior_of_unit.joint
    if joint is not None and item.name in joint.names:
        place = joint.names.index(item.name)
        return math.sqrt(float(joint.covariance[place, place])), "calibration"
    if item.name in prior_of_unit.priors:
        source = "tolerance" if item.day_std is None else "probe"
        return prior_of_unit.priors[item.name].std, source
    if item.adds_to is not None:
        return None, "nothing"
    return usual_prior(item).std, "usual size"


def with_limits(effects: Sequence[Effect], actuator: Actuator) -> tuple[Effect, ...]:
    """Return the effects that have a limit, in the order of the actuator file's limits."""
    order = actuator.limits.__struct_fields__
    limited = [item for item in effects if item.limit is not None]
    return tuple(sorted(limited, key=lambda item: order.index(parameter(item.name).limit)))


def chance_beyond(value: float, std: float, limit: float) -> float:
    """Chance that a normal variable is at or beyond a limit of either sign."""
    if std <= 0.0:
        return float(abs(value) >= limit)
    density = NormalDist(value, std)
    return density.cdf(-limit) + 1.0 - density.cdf(limit)


def count_other_faults(
    effects: Sequence[Effect], verdict: Verdict, reasons: tuple[str, ...]
) -> tuple[Verdict, tuple[str, ...]]:
    """Verdict with the effects counted: they make HEALTHY DEGRADED, never worse."""
    beyond = tuple(f"{_size(item)} beyond {_limit(item)}" for item in effects if item.beyond)
    if beyond and verdict is Verdict.HEALTHY:
        verdict = Verdict.DEGRADED
    return verdict, (*reasons, *beyond)


def notes_on_effects(effects: Sequence[Effect]) -> tuple[str, ...]:
    """Which of them may be beyond its limit, though more likely it is not."""
    return tuple(
        f"{_size(item)} may be beyond {_limit(item)}: chance {item.chance:.0%}"
        for item in effects
        if item.chance is not None
        and VERDICT.max_chance_false_healthy < item.chance < VERDICT.min_chance_fault
    )


def note_on_stand_ins(effects: Sequence[Effect], fit: Fit) -> str:
    """Whether a play of a calibrated unit stands for spool friction of another law; else empty.

    It is beyond its limit, while more than noise is left. A torque motor's gain was beyond its own
    with severities that held; hysteresis with them was within 0.2 % of what was learned.
    """
    if not is_explained_by_discrepancy_alone(fit):
        return ""
    for item in effects:
        if item.name not in PLAYS or item.limit is None:
            continue
        chance = chance_beyond(item.value or 0.0, item.std or 0.0, item.limit)
        if chance >= VERDICT.min_chance_fault:
            return (
                f"{_size(item)} would be beyond {_limit(item)}, while more than noise is left:"
                " friction of another law passes for it"
            )
    return ""


def _size(item: Effect) -> str:
    return f"{item.meaning} {item.shown(item.value or 0.0):.3g} {item.shown_unit}"


def _limit(item: Effect) -> str:
    return f"the limit {item.shown(item.limit or 0.0):.3g} {item.shown_unit}"


CULPRIT_SIGNALS = ("spool", "pressure")


DIFFERENCE = 0.2
"""Width of the differences for derivatives, in units of the parameters' scales: with a whole scale
two of 25 causes of unexplained recordings went unnamed, and one was found."""
NAMED = 3
"""Largest number of suspects that are refined and named, 1: of broken hardware the first explains
most of what any does, if there is one."""


def find_culprit(
    experiments: Sequence[Experiment], identification: Identification, environment: Environment
) -> Culprit:
    """Look for what would explain recordings that the estimate does not.

    environment: of the first recording, for the oil's temperature.
    """
    shared = share_offsets(experiments)
    free = tuple(item for item in REGISTRY if not item.name.startswith("position_"))
    model = SimdModel(lay_out_spans(shared), unknowns_of(shared, free))
    values = identification.values
    x = np.array([values.get(item.name, 0.0) for item in free])
    base = model.residuals(x[None, :])[0][0]
    row, index, start, end = _worst_place(shared, base)
    signal, experiment = CULPRIT_SIGNALS[row], shared[index]
    ticks = slice(sum(item.ticks for item in shared[:index]), None)
    modelled = _modelled(model, base, row, ticks.start, experiment.ticks)
    advice = _signal_advice(experiment, modelled)
    # What a broken sensor shows is of no effect.
    suspects = () if advice else _suspects(model, x, base, set(values))
    advice = advice or _ring_advice(shared, values) or _advice(suspects, environment)
    return Culprit(
        signal=signal,
        test=experiment.test.name,
        start=float(start),
        end=float(end),
        suspects=suspects,
        advice=advice,
    )


def _cost(residuals: Array) -> Array:
    """Cauchy's cost of each residual."""
    return np.asarray(
        ESTIMATION.cauchy_scale**2 * np.log1p((residuals / ESTIMATION.cauchy_scale) ** 2)
    )


def _suspects(model: SimdModel, x: Array, base: Array, estimated: set[str]) -> tuple[Suspect, ...]:
    free = model.unknowns.free
    own = [k for k, item in enumerate(free) if item.name in estimated]
    tried = [k for k in range(len(free)) if k not in own]
    sides, before = _sides(model, x), float(_cost(base).sum())
    slopes = _slopes(model.residuals(x + np.diag(sides))[0], base, sides)
    normal, gradient = _normal_equations(slopes, base)
    steps = np.array([_step(normal, gradient, [*own, k]) for k in tried])
    # A refinement makes up to nine times as much of what a step promises.
    promised = FIT.min_suspect_share**2 * before
    promising = np.flatnonzero(-steps @ gradient >= promised)
    if not len(promising):
        return ()
    tried = [tried[place] for place in promising]
    points = np.repeat(x[None, :], len(tried), axis=0)
    points, costs = _best_share(model, points, np.full(len(tried), before), steps[promising])
    first = np.argsort(costs)[:NAMED]
    first = first[costs[first] <= before - promised]
    points, costs = points[first], costs[first]
    for _ in range(2 if len(first) else 0):
        points, costs = _improved(model, points, costs, [[*own, tried[place]] for place in first])
    order = np.argsort(costs)
    out = (
        _suspect(free[k], points[place, k], 1.0 - costs[place] / before)
        for place in order
        for k in (tried[first[place]],)
    )
    return tuple(item for item in out if item.share >= FIT.min_suspect_share)


def _improved(
    model: SimdModel, points: Array, costs: Array, chosen: Sequence[list[int]]
) -> tuple[Array, Array]:
    """One Gauss-Newton step of each point with its cost, in its chosen coordinates."""
    sides = [_sides(model, point) for point in points]
    wanted = [
        np.vstack([point, point + np.diag(side)[pick]])
        for point, side, pick in zip(points, sides, chosen, strict=True)
    ]
    edges = np.cumsum([len(item) for item in wanted])[:-1]
    runs = np.split(model.residuals(np.vstack(wanted))[0], edges)
    steps = np.zeros_like(points)
    for place, (run, side, pick) in enumerate(zip(runs, sides, chosen, strict=True)):
        slopes = _slopes(run[1:], run[0], side[pick])
        steps[place, pick] = _step(*_normal_equations(slopes, run[0]), list(range(len(pick))))
    return _best_share(model, points, costs, steps)


def _sides(model: SimdModel, x: Array) -> Array:
    """Differences from a point that stay within the bounds, SI."""
    scale = np.array([item.scale for item in model.unknowns.free])
    return (
        np.where(
            x + DIFFERENCE * scale <= model.unknowns.upper,
            DIFFERENCE,
            -DIFFERENCE,
        )
        * scale
    )


def _slopes(runs: Array, base: Array, sides: Array) -> Array:
    """Derivatives over the parameters' scales, shape (k, signals * N)."""
    return ((runs - base) / (np.sign(sides) * DIFFERENCE)[:, None, None]).reshape(len(runs), -1)


def _normal_equations(slopes: Array, base: Array) -> tuple[Array, Array]:
    """Normal matrix and gradient of residuals, by Cauchy's weights."""
    left = base.ravel()
    weighed = slopes / (1.0 + (left / ESTIMATION.cauchy_scale) ** 2)
    return weighed @ slopes.T, weighed @ left


def _step(normal: Array, gradient: Array, chosen: list[int]) -> Array:
    """Gauss-Newton step in the chosen coordinates, in units of the scales; 0 in the others."""
    out = np.zeros(len(gradient))
    out[chosen] = -np.linalg.pinv(normal[np.ix_(chosen, chosen)], hermitian=True) @ gradient[chosen]
    return out


def _best_share(
    model: SimdModel, points: Array, before: Array, steps: Array
) -> tuple[Array, Array]:
    """Best of some shares of each step and none, and its cost; before: costs of the points."""
    scale = np.array([item.scale for item in model.unknowns.free])
    lower, upper = model.unknowns.lower, model.unknowns.upper
    there = np.stack([np.clip(points + s * steps * scale, lower, upper) for s in (0.5, 1.0)])
    costs = _cost(model.residuals(there.reshape(-1, points.shape[1]))[0]).sum(axis=(1, 2))
    costs = np.vstack([before, costs.reshape(len(there), -1)])
    best, places = costs.argmin(axis=0), np.arange(len(points))
    return np.concatenate([points[None], there])[best, places], costs[best, places]


def _suspect(item: Parameter, value: float, share: float) -> Suspect:
    return Suspect(
        name=item.name,
        meaning=item.short,
        value=float(value),
        unit=item.unit,
        share=float(share),
    )


def _worst_place(
    experiments: Sequence[Experiment], residuals: Array
) -> tuple[int, int, float, float]:
    """Row, experiment, begin and end (s) of where most is unexplained."""
    parts = [_cost(part) for part in residuals_by_experiment(experiments, residuals)]
    sums = np.array([part.sum(axis=1) for part in parts])
    index, row = divmod(int(sums.argmax()), sums.shape[1])
    share = FIT.min_suspect_share
    grown = np.cumsum(parts[index][row])
    start, end = (
        np.searchsorted(grown, np.array([share, 1.0 - share]) * grown[-1]) * experiments[index].tick
    )
    return row, index, float(start), float(end)


def _modelled(
    model: SimdModel, residuals: Array, row: int, first: int, count: int
) -> tuple[int, Array]:
    """Row of a signal, and what the model made of it at the estimate; NaN without a sample."""
    part = slice(first, first + count)
    measured = (model.batch.spool, model.batch.pressure)[row][part]
    weight = model.batch.weight[row, part]
    with np.errstate(divide="ignore", invalid="ignore"):
        return row, np.where(weight > 0.0, measured - residuals[row, part] / weight, np.nan)


def _signal_advice(experiment: Experiment, modelled: tuple[int, Array]) -> str:
    """Advice by the worst signal alone; empty if there is none."""
    row, model = modelled
    name, lsb = CULPRIT_SIGNALS[row], experiment.channels[1 + row].grain
    measured = (experiment.spool, experiment.pressure)[row]
    since = _frozen_since(measured, model, lsb, round(RECORDING.max_sample_gap_s / experiment.tick))
    if since is not None:
        return (
            f"the {name} sensor stands still from {since * experiment.tick:.1f} s on: "
            f"dead or frozen, or the {'spool' if row == 0 else 'jack'} is seized"
        )
    seen = np.isfinite(measured) & np.isfinite(model)
    one, other = measured[seen] - measured[seen].mean(), model[seen] - model[seen].mean()
    if float(one @ other) < -RESPONSE.min_gain * float(other @ other):
        return f"the {name} sensor reads with the wrong sign, or the torque motor is reversed"
    return ""


def _ring_advice(experiments: Sequence[Experiment], values: Mapping[str, float]) -> str:
    """Advice by the frequency of the pressure's ring; empty if it is as expected, or none shows."""
    if experiments[0].constants.OIL == 0.0:
        return ""
    ring = find_ring(experiments, values)
    return ring.words if ring is not None and ring.is_of_other_volume else ""


def _frozen_since(measured: Array, model: Array, lsb: float, least: int) -> int | None:
    """First tick from which to the end a signal stands still while the model moves."""
    seen = np.flatnonzero(np.isfinite(measured) & np.isfinite(model))
    if seen.size < least:
        return None
    back = measured[seen][::-1]
    still = RESPONSE.max_still_lsb * lsb
    wide = np.maximum.accumulate(back) - np.minimum.accumulate(back) > still
    count = int(wide.argmax()) if wide.any() else len(back)
    if count < least or float(np.ptp(model[seen[-count:]])) <= NOISE_LIMIT * still:
        return None
    return int(seen[-count])


def _advice(suspects: Sequence[Suspect], environment: Environment) -> str:
    if not suspects or suspects[0].share < FIT.min_advice_share:
        return ""
    first = suspects[0]
    item = next(entry for entry in REGISTRY if entry.name == first.name)
    if first.name == "oil_viscosity":
        error = _temperature_error(first.value, environment)
        return f"oil temperature looks {error:+.0f} K off its probe"
    if first.name == "supply_pressure":
        return f"supply pressure looks {first.value / 1e6:+.2g} MPa off its probes"
    if first.name in ("spool_gain", "pressure_gain"):
        side = "high" if first.value > 0.0 else "low"
        return f"the {first.meaning.split()[0]} sensor reads {abs(first.value):.0%} too {side}"
    if item.kind is ParameterKind.DATUM:
        return f"{first.meaning} looks {first.value:+.0%} off the actuator file: calibrate"
    size = f"{first.value:+.1%}" if item.unit == "1" else f"{first.value:+.2g} {item.unit}"
    return f"{first.meaning} looks {size}: estimate it (--nuisances all), or calibrate"


def _temperature_error(value: float, environment: Environment) -> float:
    """By how many kelvin the oil is warmer than its probe says, for that error of viscosity."""
    probe = environment.oil_temperature
    probe = REFERENCE_TEMPERATURE if probe is None else probe
    low, high = RECORDING.oil_temperature_range_degc
    grid = np.arange(low, high + 1.0)
    viscosity = np.array([relative_viscosity(float(t)) for t in grid])
    wanted = (1.0 + value) * relative_viscosity(probe)
    return float(np.interp(-wanted, -viscosity, grid)) - probe
