"""Models that a calibration tries, and the evidence by which it chooses among them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from ehadiag.core.actuator import Actuator, SecondStage
from ehadiag.identify.experiment import Experiment, share_offsets
from ehadiag.identify.nuisance.estimate import Estimated, estimate
from ehadiag.identify.nuisance.knowledge import severities_below
from ehadiag.identify.nuisance.prior import Known, nuisances_of
from ehadiag.identify.refine.first_part import CONSIDERED
from ehadiag.identify.refine.posterior import robust_cost
from ehadiag.identify.spans import lay_out
from ehadiag.model.parameters import FAULTS, OFFSETS, REGISTRY, Parameter, parameter

__all__ = [
    "BUDGET",
    "EFFECTS",
    "ONE_START",
    "SECOND_STAGES",
    "SLOW",
    "SMOOTH",
    "TWO_STARTS",
    "Learned",
    "Model",
    "learn",
    "simple_models",
]

SECOND_STAGES = ("linear", "orifice")
"""Kinds that the monitoring model has."""
SMOOTH = 8
"""Plays of a smooth hysteresis: more of them do the same within the noise."""
BUDGET = 4000
ONE_START = 1
"""Budget of a search that ends after its first start."""
TWO_STARTS = 800
"""The same after two, unless the first one explains the recordings."""
DATUM = Known(0.0, 0.05 / math.sqrt(3.0))
"""A data sheet's usual ±5 %."""
REACH = 0.1
"""Relative error of a datum beyond which it is not looked for."""
DATA = ("KSF", "KF", "GP", "GQ", "CS", "MJ", "CJ")
"""Data in which units differ; GM is the torque motor's gain among the nuisances."""
FRICTIONS = ("FSS0", "FDJ0")
"""Data that pass for a fault: learned where the severities are taken for 0."""
EFFECTS = {
    "filter_time": Known(5e-5, 5e-5),
    "sampling_lead": Known(5e-5, 5e-5),
    "spool_gain": Known(0.0, 0.003),
    "pressure_gain": Known(0.0, 0.003),
    "load": Known(0.0, 30.0),
    "load_spring": Known(5e3, 1e4),
    "jack_stribeck": Known(1e-2, 1e-2),
    "spool_stribeck": Known(1e-2, 1e-2),
    "friction_way": Known(0.0, 0.03),
    "torque_even": Known(0.0, 0.02),
    "torque_odd": Known(0.0, 0.03),
    "hysteresis_skew": Known(0.0, 2.0),
    "spool_bend": Known(0.0, 0.005),
    "spool_bow": Known(0.0, 0.01),
    "driver_lag": Known(1e-4, 2e-4),
    "land_shift": Known(0.0, 1e-6),
    "land_even": Known(0.0, 0.02),
    "land_odd": Known(0.0, 0.02),
    "land_lap": Known(0.0, 1e-6),
    "pressure_bend": Known(0.0, 0.001),
    "pressure_bow": Known(0.0, 0.001),
}
"""What is added where the rest does not explain the recordings: usual sizes (PHY-31 to 36)."""
SLOW = ("jack_stribeck", "spool_stribeck")
"""Those with which a run of the model takes several times as long."""
OIL = {"bulk_modulus": Known(0.0, 0.15)}
"""Of an orifice stage: entrained air lowers the bulk modulus (PHY-39)."""
NEARLY_NEW = Known(0.02, 0.05)
"""A severity of a unit that is said to be as new."""


@dataclass(frozen=True, slots=True)
class Model:
    """One class of actuator.

    Attributes
    ----------
    second_stage : str
    plays : int
        Of the hysteresis.
    beside : tuple[str, ...]
        Names of the further effects that are estimated.
    """

    second_stage: str = "linear"
    plays: int = 1
    beside: tuple[str, ...] = ()

    @property
    def rich(self) -> bool:
        """Whether further effects are estimated."""
        return bool(self.beside)

    @property
    def words(self) -> str:
        """What it is, for tables."""
        hysteresis = "one play" if self.plays == 1 else "smooth hysteresis"
        words = f"{self.second_stage} second stage, {hysteresis}"
        if len(self.beside) == len(EFFECTS):
            return f"{words}, all effects"
        return f"{words}, {len(self.beside)} effects" if self.beside else words

    def of(self, actuator: Actuator) -> Actuator:
        """Return an actuator's data with this class of second stage."""
        if actuator.second_stage.kind == self.second_stage:
            return actuator
        stage: SecondStage = msgspec.structs.replace(actuator.second_stage, kind=self.second_stage)
        return msgspec.structs.replace(actuator, second_stage=stage)

    @property
    def known(self) -> dict[str, Known]:
        """What is known of any unit beforehand."""
        data = {f"datum_{name}": DATUM for name in (*DATA, *FRICTIONS)}
        oil = OIL if self.second_stage == "orifice" else {}
        return {**data, **oil, **{name: EFFECTS[name] for name in self.beside}}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is estimated beside the severities, or the frictions as new in their place."""
        data = [parameter(f"datum_{name}") for name in DATA]
        return (
            *OFFSETS,
            *nuisances_of(REGISTRY),
            *(replace(item, lower=-REACH, upper=REACH) for item in data),
            *(parameter(name) for name in OIL if self.second_stage == "orifice"),
            *(parameter(name) for name in self.beside),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What recordings say if a model holds.

    Attributes
    ----------
    model : Model
    experiments : list[Experiment]
        Of its class of actuator.
    estimated : Estimated
    criterion : float
        Bayesian information criterion (Schwarz, Annals of Statistics 6(2), 1978): less is better.
    """

    model: Model
    experiments: list[Experiment]
    estimated: Estimated
    criterion: float


def simple_models(start: Actuator) -> list[Model]:
    """Models of either second stage with one play, that of the start file first."""
    first = start.second_stage.kind
    return [Model(kind) for kind in sorted({*SECOND_STAGES, first}, key=lambda kind: kind != first)]


def learn(
    model: Model,
    build: Callable[[Actuator], list[Experiment]],
    start: Actuator,
    *,
    new: bool,
    nearly_new: bool = False,
    hint: Mapping[str, float] | None = None,
    hint_of_open: bool = False,
    budget: int = BUDGET,
    brief: bool = False,
    seed: int,
    tell: Callable[[float], None] | None = None,
) -> Learned:
    """Estimate all that a model has.

    Parameters
    ----------
    model : Model
        The class of actuator.
    build : Callable[[Actuator], list[Experiment]]
        Experiments from an actuator's data.
    start : Actuator
        Data of the unit's type.
    new : bool
        Take the severities for 0 and estimate the frictions as new; else the severities.
    nearly_new : bool
        Look for small severities.
    hint : Mapping[str, float] | None
        Values by name beside which the optimum probably lies.
    hint_of_open : bool
        Whether these are of the open-loop recordings alone.
    budget : int
        Runs of the model after which no further start is made.
    brief : bool
        Stop early where nothing explains the recordings.
    seed : int
        The same seed gives the same answer.
    tell : Callable[[float], None] | None
        Called with the share of the budget that is spent.

    Returns
    -------
    Learned
        The optimum, explained or not.
    """
    experiments = share_offsets(
        [
            replace(item, constants=item.constants._replace(NPL=float(model.plays)))
            for item in build(model.of(start))
        ]
    )
    frictions = tuple(parameter(f"datum_{name}") for name in FRICTIONS)
    others = frictions if new else severities_below(start, dict.fromkeys(FRICTIONS, REACH))
    free = (*others, *model.parameters)
    small = dict.fromkeys((item.name for item in FAULTS), NEARLY_NEW) if nearly_new else {}
    found = estimate(
        experiments,
        free,
        known={**model.known, **small},
        considered=CONSIDERED,
        hint=hint,
        hint_of_open=hint_of_open,
        budget=budget,
        seed=seed,
        tell=tell,
        give_up=brief,
    )
    return Learned(model, experiments, found, _criterion(found, len(free)))


def _criterion(found: Estimated, count: int) -> float:
    weight = lay_out(found.experiments).weight
    there = weight > 0.0
    cost = float(robust_cost(found.refined.residuals[None])[0])
    return cost - 2.0 * float(np.log(weight[there]).sum()) + count * math.log(there.sum())
