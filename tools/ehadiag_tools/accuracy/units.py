"""Study of random units with effects of the installation that are unknown, or calibrated."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.acceptance import objections_to_estimate
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.core.actuator import Actuator, default_actuator, with_tolerance
from ehadiag.identify.experiment import (
    Experiment,
    build_experiment,
    lay_out_spans,
    share_offsets,
    unknowns_of,
)
from ehadiag.identify.identification_session import NuisanceMode, identify
from ehadiag.identify.linearisation import Derivatives
from ehadiag.identify.prior import basic_nuisances_of, prior_information, unit_prior
from ehadiag.model.registry import FAULT_NAMES, FAULTS, SENSOR_OFFSETS
from ehadiag.model.residual_models import SimdModel
from ehadiag_sim.conditions import Faults
from ehadiag_sim.plant_dynamics import DEFAULT_STEP_S
from ehadiag_tools.accuracy.cases import TESTS
from ehadiag_tools.accuracy.figures import NOT_TESTED, accuracy_table
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, add_group, record, unit_with
from ehadiag_tools.study import Options, Record, Study, grouped
from firmware_iface.recording import Recording
from firmware_iface.stored_test import bundled_tests, resolve_test

DATA = ("known", "tolerance", "calibrated", "textbook")
"""The unit's data are those of its file; differ by a tolerance; are learned from it as new; are
those of its file and there is no effect, so that the Cramér–Rao bound is known."""
TOLERANCE = 0.05
"""Tolerance of the data sheet, 1; that of the units' ten values."""


@dataclass(frozen=True, slots=True)
class UnitCase:
    """Settings of one identification: unit `case` of a seed; what is known of it, see `DATA`.

    Nuisances: auto, all or none; groups of effects: see `random_unit`.
    """

    test: str
    case: int
    seed: int
    nuisances: str = "auto"
    data: str = "known"
    groups: tuple[str, ...] = ()


def perform_unit(case: UnitCase) -> Record:
    """Draw a unit, record it, identify, and compare with the truth; fractions of 1."""
    unit, faults = draw_unit(case)
    actuator, reasons = _knowledge(case)
    experiments = []
    for name in TESTS[case.test]:
        recording = record_worn(case, unit, name, faults)
        experiments.append(_experiment(recording, name, actuator))
    begin = time.process_time()
    result = identify(
        experiments, nuisances=NuisanceMode(case.nuisances), prior=unit_prior(actuator)
    )
    spent = time.process_time() - begin
    objections = objections_to_estimate(result, actuator.calibration)
    textbook = case.data == "textbook" and len(experiments) == 1
    return {
        "faults": faults,
        "value": [item.value for item in result.estimates],
        "interval95": [list(item.interval95) for item in result.estimates],
        "verdict": NOT_TESTED if reasons or objections else "answered",
        "refused": list(reasons),
        "attempts": result.attempts,
        "evaluations": result.evaluations,
        "processor_s": spent,
        "bound": bound_of(experiments[0], faults).tolist() if textbook else None,
    }


def _experiment(recording: Recording, name: str, actuator: Actuator) -> Experiment:
    assert recording.samples is not None
    return build_experiment(recording.samples, recording.environment, resolve_test(name), actuator)


def draw_unit(case: UnitCase) -> tuple[Unit, list[float]]:
    """Unit and severities of a case."""
    rng = np.random.default_rng([case.seed, case.case])
    unit = Unit()
    if case.data != "textbook":
        unit = unit_with(rng, case.groups, case.case, data=case.data != "known")
    return unit, rng.uniform(0.0, 1.0, 3).tolist()


def record_worn(case: UnitCase, unit: Unit, name: str, faults: Sequence[float]) -> Recording:
    """Record a stored test of a unit with severities."""
    place = ("open", "closed").index(name)
    sheet = case.data in ("tolerance", "calibrated")
    noise = _noise(case.seed, case.case, *([0] if sheet else []), place)
    step = COARSE_STEP if sheet else DEFAULT_STEP_S
    return record(unit, resolve_test(name), Faults(*faults), seed=noise, step=step)


def _noise(*key: int) -> int:
    return int(np.random.SeedSequence(key).generate_state(1)[0])


def _knowledge(case: UnitCase) -> tuple[Actuator, tuple[str, ...]]:
    """What the identification is given of a unit, and why its calibration was refused."""
    if case.data in ("known", "textbook") or case.nuisances == NuisanceMode.NONE.value:
        return default_actuator(), ()
    if case.data == "tolerance":
        return with_tolerance(default_actuator(), TOLERANCE), ()
    return _calibrated(case.seed, case.case, case.groups)


@lru_cache(maxsize=64)
def _calibrated(seed: int, case: int, groups: tuple[str, ...]) -> tuple[Actuator, tuple[str, ...]]:
    """Return the unit's own data, or those of its type and why it was refused."""
    unit, _ = draw_unit(UnitCase("open", case, seed, data="calibrated", groups=groups))
    new = [
        record(unit, resolve_test(name), seed=_noise(seed, case, 1, place), step=COARSE_STEP)
        for place, name in enumerate(("open", "closed"))
    ]
    found = calibrate(new, default_actuator(), bundled_tests().values())
    return found.actuator or default_actuator(), found.reasons


def _unit_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--test", action="append", choices=list(TESTS), help="may be repeated (open and closed)")
    add("--data", action="append", choices=DATA, help="what is known; may be repeated (known)")
    kinds = [item.value for item in NuisanceMode]
    add("--nuisances", action="append", choices=kinds, help="may be repeated (auto)")
    add_group(parser)


def _unit_cases(options: Options) -> list[UnitCase]:
    groups = tuple(sorted(set(options.group)))
    return [
        UnitCase(test, case, options.seed, nuisances, data, groups)
        for data in options.data or ["known"]
        for test in options.test or ["open", "closed"]
        for nuisances in options.nuisances or ["auto"]
        for case in range(options.cases)
    ]


def _unit_report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    yield from accuracy_table(records, "test", "data", "nuisances", of_all=True)
    yield "\nModel runs and processor time of an identification, mean:\n"
    for key, part in grouped(records, "test", "data", "nuisances").items():
        runs, spent = (
            np.mean([item[name] for item in part]) for name in ("evaluations", "processor_s")
        )
        yield f"- {', '.join(key)}: {runs:.0f}, {1e3 * spent:.0f} ms"


def bound_of(experiment: Experiment, faults: Sequence[float]) -> NDArray[np.float64]:
    """Least deviation of each severity that an unbiased estimate with all unknowns can have.

    Ticks where a break-away moves within the differences have no derivative and are left out.
    """
    experiments = share_offsets([experiment])
    basic = basic_nuisances_of(experiment.constants.OIL)
    unknowns = unknowns_of(experiments, (*FAULTS, *SENSOR_OFFSETS, *basic))
    model = Derivatives(SimdModel(lay_out_spans(experiments), unknowns), experiment.noise)
    truth = dict(zip(FAULT_NAMES, faults, strict=True))
    x = np.array([truth.get(item.name, 0.0) for item in model.estimated]) / model.scale
    slope = model.trusted_slope(x)
    rows = (slope.jacobian * slope.smooth).reshape(len(x), -1)
    spread = np.linalg.inv(rows @ rows.T + prior_information(model, {}))
    return np.asarray((np.sqrt(np.diag(spread)) * model.scale)[: len(FAULTS)])


UNITS = Study(
    "units",
    "Random units: offsets, gain, null bias, hysteresis, backlash unknown; data known, with a"
    " tolerance, or calibrated.",
    _unit_cases, perform_unit, _unit_report, _unit_options, counted="units of each row",
)  # fmt: skip
