"""Models of a unit that a calibration fits, their results, and the criteria of a unit as new."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from ehadiag.assess.blocks import block_with_most
from ehadiag.assess.verdict import Levels
from ehadiag.core.actuator import Actuator, SecondStage
from ehadiag.estimate import Severity
from ehadiag.identify.estimates import estimate_covariance, is_noise
from ehadiag.identify.experiment import (
    Experiment,
    lay_out_spans,
    residuals_by_experiment,
    share_offsets,
)
from ehadiag.identify.nuisance_estimate import NuisanceEstimate, estimate_nuisances
from ehadiag.identify.nuisance_search import NuisanceSearchSettings
from ehadiag.identify.partial_refinement import considered_instants
from ehadiag.identify.posterior import cauchy_cost
from ehadiag.identify.prior import (
    FAULT_OF_DATUM,
    JointPrior,
    ParameterPrior,
    basic_nuisances_of,
    faults_below_zero,
)
from ehadiag.model.parameter import Parameter
from ehadiag.model.registry import FAULTS, SENSOR_OFFSETS, parameter
from firmware_iface.recording import Recording
from firmware_iface.stored_test import StoredTest


class CalibratedValue(msgspec.Struct, frozen=True):
    """One thing that was learned of the unit; SI."""

    name: str
    symbol: str
    meaning: str
    unit: str
    start: float
    """Of the actuator file that it began with."""
    value: float
    std: float
    shown: bool
    """Whether the recordings show it: else little is known but its usual size."""


class TriedModel(msgspec.Struct, frozen=True):
    """A model that was tried."""

    words: str
    excess: float
    """Cost of its residuals, in open loop if there was one, over that of noise alone."""
    criterion: float
    """Bayesian information criterion, less the best one's."""


class Calibrated(msgspec.Struct, frozen=True, eq=False):
    """A calibration, or why there is none."""

    recordings: tuple[Recording, ...]
    tests: tuple[StoredTest | None, ...]
    start: Actuator
    actuator: Actuator | None
    """The unit's data with its `calibration`; None where it was refused."""
    reasons: tuple[str, ...]
    """Why it was refused."""
    notes: tuple[str, ...]
    severities: tuple[Severity, ...]
    values: tuple[CalibratedValue, ...]
    tried: tuple[TriedModel, ...]
    experiments: tuple[Experiment, ...]
    """What was learned from, with the unit's own constants; empty where nothing was."""
    seed: int
    evaluations: int
    elapsed: float
    """s."""


SECOND_STAGES = ("linear", "orifice")
"""Kinds that the monitoring model has."""
PLAYS_OF_SMOOTH_HYSTERESIS = 8
"""Plays of a smooth hysteresis: more of them do the same within the noise."""


class SearchRules(msgspec.Struct, frozen=True):
    """Budgets of the searches of a calibration, and what leads to another search."""

    max_runs: int = 4000
    max_runs_one_start: int = 1
    """Number of model runs of a search that ends after its first start."""
    max_runs_two_starts: int = 800
    """Number of model runs after two starts, unless the first explains the recordings."""
    searches_per_model: int = 3
    """Number of searches with one model, until two have come to the same place."""
    searches_as_new: int = 3
    """Number of searches with all recordings, until two have come to the same place."""
    searches_of_update: int = 4
    """Number of searches of an update, until one explains the recordings."""
    max_excess_share_moved: float = 0.6
    """Share of the excess with chambers that do not move, 1, below which the unit's do."""
    searches_of_chambers: int = 2
    """Number of searches with all recordings of a unit with chambers by position."""
    max_same_excess_ratio: float = 1.1
    """Ratio of the excesses of two searches, 1, up to which both came to the optimum."""
    max_same_cost_difference: float = 30.0
    """Cost by which searches that came to the same place differ."""
    max_excess_repeated: float = 3.0
    """Residuals over noise, 1, up to which another search with the model may explain them."""
    min_excess_slow: float = 1.5
    """Residuals over noise, 1, up to which no slow search is made for a little more."""
    max_spool_excess_other_stage: float = 1.5
    """Spool residuals over noise, 1, up to which the other second stage may explain the rest."""
    max_skew_of_one_play: float = -1.0
    """Skew of a smooth hysteresis, 1, up to which it may be one play: the widest play counts 2.4
    times the narrowest. Units of one play had -1.8 to -12."""
    min_effect_gain: float = 0.03
    """Share of the remaining cost, 1, that an effect must take away to be tried."""
    min_hysteresis_effects: float = 3e-3
    """Hysteresis, full width over rated current, below which effects of closed loop are
    break-aways."""


class CalibrationCriteria(msgspec.Struct, frozen=True):
    """What a calibration needs, and what it may leave."""

    min_recordings: int = 2
    """Number of recordings: one alone has nothing to be checked against."""
    max_severity: float = 0.05
    """Severity above which a unit is not as new, 1."""
    margin_stds: float = 2.0
    """Deviations by which a severity must be beyond it, or stay below twice of it."""
    max_excess: float = 5.0
    """Residuals over noise, 1, up to which the best model may leave something, which widens what
    is learned and every interval after it (`ehadiag.identify.prior`)."""
    max_datum_error: float = 0.1
    """Relative error of a datum, 1, beyond which it is not searched."""
    max_flow_gain_error: float = 0.15
    """Relative error of the first stage's flow gain, 1, beyond which a unit is not as new: units of
    one type differ by -8 to +10 %."""
    max_std_ratio: float = 0.7
    """Deviation over the one known beforehand, 1; above it the recordings do not show a value."""


SEARCHES = SearchRules()
CRITERIA = CalibrationCriteria()
DATUM_PRIOR = ParameterPrior(0.0, 0.05 / math.sqrt(3.0))
"""A data sheet's usual ±5 %."""
LEARNED_DATA = ("KSF", "KF", "GP", "GQ", "CS", "MJ", "CJ")
"""Data in which units differ; GM is the torque motor's gain among the nuisances."""
FRICTION_DATA = ("FSS0", "FDJ0")
"""Data that pass for a fault: learned where the severities are taken for 0."""
FURTHER_EFFECTS = {
    "filter_time": ParameterPrior(5e-5, 5e-5),
    "sampling_lead": ParameterPrior(5e-5, 5e-5),
    "spool_gain": ParameterPrior(0.0, 0.003),
    "pressure_gain": ParameterPrior(0.0, 0.003),
    "load": ParameterPrior(0.0, 30.0),
    "load_spring": ParameterPrior(5e3, 1e4),
    "jack_stribeck": ParameterPrior(1e-2, 1e-2),
    "spool_stribeck": ParameterPrior(1e-2, 1e-2),
    "friction_way": ParameterPrior(0.0, 0.03),
    "torque_even": ParameterPrior(0.0, 0.02),
    "torque_odd": ParameterPrior(0.0, 0.03),
    "hysteresis_skew": ParameterPrior(0.0, 2.0),
    "spool_bend": ParameterPrior(0.0, 0.005),
    "spool_bow": ParameterPrior(0.0, 0.01),
    "driver_lag": ParameterPrior(1e-4, 2e-4),
    "land_shift": ParameterPrior(0.0, 1e-6),
    "land_even": ParameterPrior(0.0, 0.02),
    "land_odd": ParameterPrior(0.0, 0.02),
    "land_lap": ParameterPrior(0.0, 1e-6),
    "pressure_bend": ParameterPrior(0.0, 0.001),
    "pressure_bow": ParameterPrior(0.0, 0.001),
}
"""What is added where the rest does not explain the recordings: usual sizes (PHY-31 to 36)."""
SLOW_EFFECTS = ("jack_stribeck", "spool_stribeck")
"""Those with which a run of the model takes several times as long."""
OIL_EFFECTS = {"bulk_modulus": ParameterPrior(0.0, 0.15)}
"""Of an orifice stage: entrained air lowers the bulk modulus (PHY-39)."""
CHAMBER_DATA = {
    "datum_GQF": ParameterPrior(0.0, 0.06),
    "datum_volume_of_one_chamber": DATUM_PRIOR,
    "land_shift": FURTHER_EFFECTS["land_shift"],
    "first_stage_null": ParameterPrior(0.0, 5e-7),
    "driver_lag": ParameterPrior(1e-5, 1e-5),
}
"""What is learned with chambers by position. The first stage's flow gain differs by -8 to +10 %
from unit to unit. Four lands whose underlaps differ act on the pressure, to first order in their
differences, by their mean (GP) and by the middle of the supply's and the return's. Oil at the
spool's ends follows within 5 to 20 µs, as the current behind a lag does."""
NEARLY_NEW_PRIOR = ParameterPrior(0.02, 0.05)
"""A severity of a unit that is said to be as new."""


class UnitModel(msgspec.Struct, frozen=True):
    """One class of actuator.

    plays: of the hysteresis; beside: names of the further effects that are estimated; by_position:
    whether the chambers' volumes follow the jack's travel; of orifices only.
    """

    second_stage: str = "linear"
    plays: int = 1
    beside: tuple[str, ...] = ()
    by_position: bool = False

    @property
    def rich(self) -> bool:
        """Whether further effects are estimated."""
        return bool(self.beside)

    @property
    def words(self) -> str:
        """What it is, for tables."""
        hysteresis = "one play" if self.plays == 1 else "smooth hysteresis"
        chambers = ", chambers by position" if self.by_position else ""
        words = f"{self.second_stage} second stage{chambers}, {hysteresis}"
        if len(self.beside) == len(FURTHER_EFFECTS):
            return f"{words}, all effects"
        return f"{words}, {len(self.beside)} effects" if self.beside else words

    def of(self, actuator: Actuator) -> Actuator:
        """Return an actuator's data with this class of second stage."""
        stage: SecondStage = actuator.second_stage
        by_position = self.by_position or stage.by_position
        if (stage.kind, stage.by_position) == (self.second_stage, by_position):
            return actuator
        stage = msgspec.structs.replace(stage, kind=self.second_stage, by_position=by_position)
        return msgspec.structs.replace(actuator, second_stage=stage)

    @property
    def known(self) -> dict[str, ParameterPrior]:
        """What is known of any unit beforehand."""
        data = {f"datum_{name}": DATUM_PRIOR for name in (*LEARNED_DATA, *FRICTION_DATA)}
        oil = OIL_EFFECTS if self.second_stage == "orifice" else {}
        oil = {**oil, **CHAMBER_DATA} if self.by_position else oil
        return {**data, **oil, **{name: FURTHER_EFFECTS[name] for name in self.beside}}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is estimated beside the severities, or the frictions as new in their place."""
        data = [parameter(f"datum_{name}") for name in LEARNED_DATA]
        return (
            *SENSOR_OFFSETS,
            *basic_nuisances_of(float(self.second_stage == "orifice")),
            *(
                replace(item, lower=-CRITERIA.max_datum_error, upper=CRITERIA.max_datum_error)
                for item in data
            ),
            *(parameter(name) for name in OIL_EFFECTS if self.second_stage == "orifice"),
            *(parameter(name) for name in CHAMBER_DATA if self.by_position),
            *(parameter(name) for name in self.beside),
        )


class LearnedModel(msgspec.Struct, frozen=True, eq=False):
    """What recordings say if a model holds.

    experiments: of its class of actuator; criterion: Bayesian information criterion (Schwarz,
    Annals of Statistics 6(2), 1978): less is better.
    """

    model: UnitModel
    experiments: list[Experiment]
    estimated: NuisanceEstimate
    criterion: float


def simple_models(start: Actuator) -> list[UnitModel]:
    """Models of either second stage with one play, that of the start file first."""
    first = start.second_stage.kind
    return [
        UnitModel(kind) for kind in sorted({*SECOND_STAGES, first}, key=lambda kind: kind != first)
    ]


def learn_model(
    model: UnitModel,
    build: Callable[[Actuator], list[Experiment]],
    start: Actuator,
    *,
    new: bool,
    nearly_new: bool = False,
    hint: Mapping[str, float] | None = None,
    hint_of_open: bool = False,
    joint: JointPrior | None = None,
    budget: int = SEARCHES.max_runs,
    brief: bool = False,
    seed: int,
    tell: Callable[[float], None] | None = None,
) -> LearnedModel:
    """Estimate all that a model has.

    build: experiments from an actuator's data; start: data of the unit's type; new: take the
    severities for 0 and estimate the frictions as new; else the severities; nearly_new: look for
    small severities; hint: values by name beside which the optimum probably lies; hint_of_open:
    whether these are of the open-loop recordings alone; joint: what is known of several parameters
    together; budget: runs of the model after which no further start is made; brief: stop early
    where nothing explains the recordings; tell: called with the share of the budget that is spent.
    Returns the optimum, explained or not.
    """
    experiments = share_offsets(
        [
            replace(item, constants=item.constants._replace(NPL=float(model.plays)))
            for item in build(model.of(start))
        ]
    )
    frictions = tuple(parameter(f"datum_{name}") for name in FRICTION_DATA)
    others = (
        frictions
        if new
        else faults_below_zero(start, dict.fromkeys(FRICTION_DATA, CRITERIA.max_datum_error))
    )
    if model.by_position:  # a clean filter: what passes for its clogging is the flow gain
        others = tuple(item for item in others if item.name != FAULT_OF_DATUM["GQF"])
    free = (*others, *model.parameters)
    small = dict.fromkeys((item.name for item in FAULTS), NEARLY_NEW_PRIOR) if nearly_new else {}
    found = estimate_nuisances(
        experiments,
        NuisanceSearchSettings(
            free,
            priors={**model.known, **small},
            joint=joint,
            hint=hint,
            hint_of_open=hint_of_open,
            budget=budget,
            seed=seed,
            progress=tell,
            give_up=brief,
        ),
        considered_instants(free),
    )
    return LearnedModel(model, experiments, found, _criterion(found, len(free)))


def _criterion(found: NuisanceEstimate, count: int) -> float:
    weight = lay_out_spans(found.experiments).weight
    there = weight > 0.0
    cost = float(cauchy_cost(found.refined.residuals[None])[0])
    return cost - 2.0 * float(np.log(weight[there]).sum()) + count * math.log(there.sum())


def is_explained(learned: LearnedModel) -> bool:
    """Whether nothing is left, or no more than what a calibration may leave."""
    return learned.estimated.excess <= CRITERIA.max_excess


def learned_severities(found: NuisanceEstimate) -> tuple[Severity, ...]:
    """Severities where they were estimated, with their deviations: 0 of less friction than new."""
    values, names = found.refined.values, [item.name for item in found.refined.parameters]
    std = np.sqrt(np.diag(estimate_covariance(found.refined) + found.covariance)).tolist()
    return tuple(
        Severity(
            name=item.name,
            estimate=max(values[item.name], 0.0),
            std=std[names.index(item.name)],
            meaning=item.short,
            source="calibration",
        )
        for item in FAULTS
        if item.name in values
    )


def objections_to_as_new(found: NuisanceEstimate) -> list[str]:
    """Why a unit is not as new; empty where it is."""
    out = []
    flow = found.refined.values.get("datum_GQF", 0.0)
    if abs(flow) > CRITERIA.max_flow_gain_error:
        out.append(
            f"not as new: the first stage's flow gain is {flow:+.1%} off the actuator file's GQF: a"
            " clogged filter, or another type of valve"
        )
    for item in learned_severities(found):
        std = item.std or 0.0
        if item.value > CRITERIA.max_severity:
            out.append(f"not as new: {item.name} {item.value:.3f} ± {std:.3f}")
        elif item.value + CRITERIA.margin_stds * std > 2.0 * CRITERIA.max_severity:
            out.append(
                f"the recordings do not show whether the unit is as new: {item.name} "
                f"{item.value:.3f} ± {std:.3f}"
            )
    return out


def objections_to_healthy(found: NuisanceEstimate) -> list[str]:
    """Why a unit is not healthy; empty where it is."""
    advisory = Levels().advisory
    return [
        f"not healthy: {item.name} {item.value:.3f} ± {item.std or 0.0:.3f}"
        for item in learned_severities(found)
        if item.value + CRITERIA.margin_stds * (item.std or 0.0) >= advisory
    ]


def objections_to_model(best: LearnedModel, recordings: Sequence[Recording] = ()) -> list[str]:
    """Why the best model cannot be learned from, and of which recordings it leaves something."""
    residuals = best.estimated.refined.residuals
    reasons = [
        f"no model explains the recordings: the residuals are {best.estimated.excess:.1f} times"
        " the noise: other recordings than of one sound unit as new, another type of unit, or"
        " an effect that no model has",
        f"not explained: the {block_with_most(best.experiments, residuals[:2])}",
    ]
    if len(recordings) > 1:
        parts = residuals_by_experiment(best.experiments, residuals)
        bad = [
            recording.source
            for recording, part in zip(recordings, parts, strict=True)
            if not is_noise(part)
        ]
        reasons.append(f"not explained together: {', '.join(bad or ['none alone'])}")
    return reasons
