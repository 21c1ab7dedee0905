"""Names what probably keeps the model from explaining a recording: signal, time, effect or datum.

Every parameter of the registry is tried beside those that were estimated: one Gauss-Newton step
from the estimate (a score test, C. R. Rao, Proc. Cambridge Phil. Soc. 44, 1948), then the model
itself at shares of that step, all in a few blocks of runs. What explains most is the suspect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.recording import Environment
from ehadiag.identify.experiment import Experiment, share_offsets
from ehadiag.identify.result import Identification
from ehadiag.identify.spans import by_experiment, lay_out, unknowns_of
from ehadiag.model.parameters import REGISTRY, Kind, Parameter
from ehadiag.model.plant import REFERENCE_TEMPERATURE, relative_viscosity
from ehadiag.model.simd.model import SimdModel

__all__ = ["Culprit", "Suspect", "culprit_of"]

SIGNALS = ("spool", "pressure")
STEP = 0.2
"""Width of the differences, in units of the parameters' scales."""
SHARES = (0.0, 0.4, 1.0)
"""Of the Gauss-Newton step that are tried."""
RANGE = (0.25, 0.6)
"""Shares of a parameter's bounds that are tried on a unit as new."""
AS_NEW = 0.1
"""Severities of a unit as new."""
LOOKED_AT, ROUNDS = 4, 2
"""How many suspects are looked at closer, and by how many steps."""
TAIL = 3.0
RIDGE = 1e-6
MOST_SUSPECTS = 3
LEAST_SHARE = 0.1
"""Of what is unexplained that a suspect must explain."""
CLEAR_SHARE = 0.6
"""Of what is unexplained from which a suspect is believed."""
STILL_LSB, MOVES_LSB, STILL_S = 4.0, 40.0, 0.5
"""A signal that stays within so much for so long, while the model moves by more, stands still."""
REVERSED = -0.5
"""Gain of a signal against the model from which it is wired the wrong way round."""
EFFORT = (0.1, 0.9)
"""Shares of what is unexplained that lie before the begin and the end of the time that is named."""


@dataclass(frozen=True, slots=True)
class Suspect:
    """One parameter that would explain part of what is left.

    Attributes
    ----------
    name : str
        In the registry of parameters.
    meaning : str
        In two words.
    value : float
        That it would take, SI.
    unit : str
        SI unit; 1 for a share.
    share : float
        Of what is unexplained that it would explain, 0 … 1.
    """

    name: str
    meaning: str
    value: float
    unit: str
    share: float


@dataclass(frozen=True, slots=True)
class Culprit:
    """Where the model fails, and what may be the cause.

    Attributes
    ----------
    signal : str
        On which most is unexplained.
    test : str
        In which stored test.
    start : float
        s in the test, from which on most is unexplained.
    end : float
        s in the test.
    suspects : tuple[Suspect, ...]
        What would explain most comes first; may be empty.
    advice : str
        What to look at next.
    """

    signal: str
    test: str
    start: float
    end: float
    suspects: tuple[Suspect, ...]
    advice: str

    @property
    def lines(self) -> tuple[str, ...]:
        """What to tell people, a sentence each."""
        where = (
            f"most is unexplained on the {self.signal} signal, {self.start:.1f} … {self.end:.1f} s "
            f"of test {self.test!r}"
        )
        would = tuple(
            f"{item.meaning} {item.value:.3g}{'' if item.unit == '1' else ' ' + item.unit} "
            f"({item.name}) would explain {item.share:.0%} of it"
            for item in self.suspects
        )
        return (where, *would, f"to look at: {self.advice}")


def culprit_of(
    experiments: Sequence[Experiment], identification: Identification, environment: Environment
) -> Culprit:
    """Look for what would explain recordings that the estimate does not.

    environment: of the first recording, for the oil's temperature.
    """
    shared = share_offsets(experiments)
    free = tuple(item for item in REGISTRY if not item.name.startswith("position_"))
    model = SimdModel(lay_out(shared), unknowns_of(shared, free))
    values = identification.values
    x = np.array([values.get(item.name, 0.0) for item in free])
    base = model.residuals(x[None, :])[0][0]
    suspects = _suspects(model, x, base, set(values))
    row, index, start, end = _place(shared, base)
    signal, experiment = SIGNALS[row], shared[index]
    ticks = slice(sum(item.ticks for item in shared[:index]), None)
    modelled = _modelled(model, base, row, ticks.start, experiment.ticks)
    advice = _of_signals(experiment, modelled) or _advice(suspects, environment)
    return Culprit(signal, experiment.test.name, start, end, suspects, advice)


def _cost(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cauchy's cost over that of nothing left, summed over signals and time."""
    return np.asarray(TAIL**2 * np.log1p((residuals / TAIL) ** 2))


def _suspects(
    model: SimdModel, x: NDArray[np.float64], base: NDArray[np.float64], estimated: set[str]
) -> tuple[Suspect, ...]:
    free = model.unknowns.free
    own = [k for k, item in enumerate(free) if item.name in estimated]
    tried = [k for k in range(len(free)) if k not in own]
    points, costs = _stepped(model, x, base, own, tried)
    far, far_costs = _far(model, x, own, tried)
    better = far_costs < costs
    points = np.where(better[:, None], far, points)
    costs = np.where(better, far_costs, costs)
    first = np.argsort(costs)[:LOOKED_AT]
    points, costs = points[first], costs[first]
    for _ in range(ROUNDS):
        points, costs = _improved(model, points, [[*own, tried[place]] for place in first])
    before = float(_cost(base).sum())
    order = np.argsort(costs)
    out = (
        _suspect(free[k], points[place, k], 1.0 - costs[place] / before)
        for place in order
        for k in (tried[first[place]],)
    )
    return tuple(item for item in out if item.share >= LEAST_SHARE)[:MOST_SUSPECTS]


def _stepped(
    model: SimdModel,
    x: NDArray[np.float64],
    base: NDArray[np.float64],
    own: list[int],
    tried: list[int],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and costs after one step with each of the tried parameters, shape (tried, k)."""
    sides = _sides(model, x)
    slopes = _slopes(model.residuals(x + np.diag(sides))[0], base, sides)
    steps = np.array([_step(slopes, base, [*own, k]) for k in tried])
    return _best_share(model, np.repeat(x[None, :], len(tried), axis=0), steps)


def _far(
    model: SimdModel, x: NDArray[np.float64], own: list[int], tried: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The best of some values all over the range of each tried parameter, on a unit as new."""
    lower, upper = model.unknowns.lower, model.unknowns.upper
    new = np.array([AS_NEW if item.kind is Kind.FAULT else 0.0 for item in model.unknowns.free])
    offsets = [k for k in own if model.unknowns.free[k].adds_to is not None]
    new[offsets] = x[offsets]
    points = np.repeat(new[None, :], len(tried) * 2 * len(RANGE), axis=0)
    points = points.reshape(len(tried), -1, len(new))
    for place, k in enumerate(tried):
        points[place, :, k] = [side * r for r in RANGE for side in (lower[k], upper[k])]
    costs = _cost(model.residuals(points.reshape(-1, len(new)))[0]).sum(axis=(1, 2))
    costs = costs.reshape(len(tried), -1)
    best = costs.argmin(axis=1)
    places = np.arange(len(tried))
    return points[places, best], costs[places, best]


def _improved(
    model: SimdModel, points: NDArray[np.float64], chosen: Sequence[list[int]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One Gauss-Newton step of each point, in its chosen coordinates."""
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
        steps[place, pick] = _step(slopes, run[0], list(range(len(pick))))
    return _best_share(model, points, steps)


def _sides(model: SimdModel, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Differences from a point that stay within the bounds, SI."""
    scale = np.array([item.scale for item in model.unknowns.free])
    return np.where(x + STEP * scale <= model.unknowns.upper, STEP, -STEP) * scale


def _slopes(
    runs: NDArray[np.float64], base: NDArray[np.float64], sides: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivatives over the parameters' scales, shape (k, signals * N)."""
    return ((runs - base) / (np.sign(sides) * STEP)[:, None, None]).reshape(len(runs), -1)


def _step(
    slopes: NDArray[np.float64], base: NDArray[np.float64], chosen: list[int]
) -> NDArray[np.float64]:
    """Gauss-Newton step in the chosen coordinates, in units of the scales; 0 in the others."""
    left, rows = base.ravel(), slopes[chosen]
    weighed = rows / (1.0 + (left / TAIL) ** 2)
    normal = weighed @ rows.T
    normal += RIDGE * np.diag(np.diag(normal) + 1.0)
    out = np.zeros(len(slopes))
    out[chosen] = -np.linalg.solve(normal, weighed @ left)
    return out


def _best_share(
    model: SimdModel, points: NDArray[np.float64], steps: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Best of some shares of each step, and its cost."""
    scale = np.array([item.scale for item in model.unknowns.free])
    lower, upper = model.unknowns.lower, model.unknowns.upper
    there = np.stack([np.clip(points + s * steps * scale, lower, upper) for s in SHARES])
    costs = _cost(model.residuals(there.reshape(-1, points.shape[1]))[0]).sum(axis=(1, 2))
    costs = costs.reshape(len(SHARES), -1)
    best, places = costs.argmin(axis=0), np.arange(len(points))
    return there[best, places], costs[best, places]


def _suspect(item: Parameter, value: float, share: float) -> Suspect:
    return Suspect(item.name, item.short, float(value), item.unit, float(share))


def _place(
    experiments: Sequence[Experiment], residuals: NDArray[np.float64]
) -> tuple[int, int, float, float]:
    """Row, experiment, begin and end (s) of where most is unexplained."""
    parts = [_cost(part) for part in by_experiment(experiments, residuals)]
    sums = np.array([part.sum(axis=1) for part in parts])
    index, row = divmod(int(sums.argmax()), sums.shape[1])
    grown = np.cumsum(parts[index][row])
    start, end = np.searchsorted(grown, np.array(EFFORT) * grown[-1]) * experiments[index].tick
    return row, index, float(start), float(end)


def _modelled(
    model: SimdModel, residuals: NDArray[np.float64], row: int, first: int, count: int
) -> tuple[int, NDArray[np.float64]]:
    """Row of a signal, and what the model made of it at the estimate; NaN without a sample."""
    part = slice(first, first + count)
    measured = (model.batch.spool, model.batch.pressure)[row][part]
    weight = model.batch.weight[row, part]
    with np.errstate(divide="ignore", invalid="ignore"):
        return row, np.where(weight > 0.0, measured - residuals[row, part] / weight, np.nan)


def _of_signals(experiment: Experiment, modelled: tuple[int, NDArray[np.float64]]) -> str:
    """What the worst signal shows by itself; empty if nothing."""
    row, model = modelled
    name, lsb = SIGNALS[row], experiment.channels[1 + row].grain
    measured = (experiment.spool, experiment.pressure)[row]
    since = _stands_still(measured, model, lsb, round(STILL_S / experiment.tick))
    if since is not None:
        return (
            f"the {name} sensor stands still from {since * experiment.tick:.1f} s on: "
            f"dead or frozen, or the {'spool' if row == 0 else 'jack'} is seized"
        )
    seen = np.isfinite(measured) & np.isfinite(model)
    one, other = measured[seen] - measured[seen].mean(), model[seen] - model[seen].mean()
    if float(one @ other) < REVERSED * float(other @ other):
        return f"the {name} sensor reads with the wrong sign, or the torque motor is reversed"
    return ""


def _stands_still(
    measured: NDArray[np.float64], model: NDArray[np.float64], lsb: float, least: int
) -> int | None:
    """First tick from which to the end a signal stands still while the model moves."""
    seen = np.flatnonzero(np.isfinite(measured) & np.isfinite(model))
    if seen.size < least:
        return None
    back = measured[seen][::-1]
    wide = np.maximum.accumulate(back) - np.minimum.accumulate(back) > STILL_LSB * lsb
    count = int(wide.argmax()) if wide.any() else len(back)
    if count < least or float(np.ptp(model[seen[-count:]])) < MOVES_LSB * lsb:
        return None
    return int(seen[-count])


def _advice(suspects: Sequence[Suspect], environment: Environment) -> str:
    if not suspects or suspects[0].share < CLEAR_SHARE:
        return (
            "no single effect or datum explains most of it: broken hardware, another actuator, or "
            "a unit whose data differ in several places: calibrate it as new"
        )
    first = suspects[0]
    item = next(entry for entry in REGISTRY if entry.name == first.name)
    if first.name == "oil_viscosity":
        return f"oil temperature looks {_warmer(first.value, environment):+.0f} K off its probe"
    if first.name == "supply_pressure":
        return f"supply pressure looks {first.value / 1e6:+.2g} MPa off its probes"
    if first.name in ("spool_gain", "pressure_gain"):
        side = "high" if first.value > 0.0 else "low"
        return f"the {first.meaning.split()[0]} sensor reads {abs(first.value):.0%} too {side}"
    if item.kind is Kind.DATUM:
        return f"{first.meaning} looks {first.value:+.0%} off the actuator file: calibrate"
    size = f"{first.value:+.1%}" if item.unit == "1" else f"{first.value:+.2g} {item.unit}"
    return f"{first.meaning} looks {size}: estimate it (--nuisances all), or calibrate"


def _warmer(value: float, environment: Environment) -> float:
    """By how many kelvin the oil is warmer than its probe says, for that error of viscosity."""
    probe = environment.oil_temperature
    probe = REFERENCE_TEMPERATURE if probe is None else probe
    grid = np.linspace(-54.0, 135.0, 379)
    viscosity = np.array([relative_viscosity(float(t)) for t in grid])
    wanted = (1.0 + value) * relative_viscosity(probe)
    return float(np.interp(-wanted, -viscosity, grid)) - probe
