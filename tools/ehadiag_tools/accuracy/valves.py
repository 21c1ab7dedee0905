"""Study of valves of another construction than the paper's, with the clogging's law stated or not.

Each effect is a switch that is on by even chance: a filter in series (m = 2), chambers by position,
lands that differ one by one, oil that yields at the spool's ends.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.core.actuator import Actuator, Discrepancy, default_actuator
from ehadiag_sim.conditions import Faults, UnmodelledEffects
from ehadiag_tools.accuracy.figures import holds_truth, percent_errors
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, random_unit, record
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.stored_test import bundled_tests

__all__ = ["VALVES", "ValveCase", "is_wrong", "perform", "random_valve"]

STATEMENTS: dict[str, float | tuple[float, float] | None] = {
    "stated": None,
    "unknown": (0.0, 2.0),
    "wrongly 0": 0.0,
}
"""What the actuator file says of the clogging's exponent; None: the truth."""
MIN_PRESSURE_MARGIN = 1.5
"""Least force of the first stage over the spool's friction, 1: a valve that its clogged filter
leaves less does not move."""


@dataclass(frozen=True, slots=True)
class ValveCase:
    """Unit of a seed, the test of it when worn, and what is said of its filter."""

    case: int
    seed: int
    test: str
    statement: str


def random_valve(rng: np.random.Generator) -> tuple[Unit, Faults]:
    """Draw a unit with orifices and its wear; switches by even chance."""
    unit = random_unit(rng, data=True)
    series, chambers, lands, ends = (rng.random(4) < 0.5).tolist()
    sheet = default_actuator()
    valve = msgspec.structs.replace(sheet.servovalve, clogging_exponent=2.0 if series else 0.0)
    stage = msgspec.structs.replace(
        sheet.second_stage, kind="orifice", volume_of_one_chamber=0.9e-4, by_position=chambers
    )
    strange = UnmodelledEffects(
        underlap_errors=tuple(rng.uniform(-0.08, 0.08, 4).tolist()) if lands else (0.0,) * 4,
        spool_end_volume=float(rng.uniform(2e-9, 2e-8)) if ends else 0.0,
    )
    actuator = msgspec.structs.replace(
        sheet, servovalve=valve, second_stage=stage, discrepancy=Discrepancy()
    )
    force = valve.AS * valve.GPF * valve.XFM
    while True:
        faults = Faults(*rng.random(3).tolist())
        left = (1.0 - 0.8 * faults.Kintas) ** float(sum(valve.clogging_range) / 2.0)
        friction = valve.FSS0 + faults.FSS * (valve.FSS1 - valve.FSS0)
        if force * left > MIN_PRESSURE_MARGIN * friction:
            break
    return replace(
        unit, actuator=actuator, effects=replace(unit.effects, unmodelled=strange)
    ), faults


def _stated(unit: Actuator, statement: str) -> Actuator:
    exponent = STATEMENTS[statement]
    if exponent is None:
        return unit
    valve = msgspec.structs.replace(unit.servovalve, clogging_exponent=exponent)
    return msgspec.structs.replace(unit, servovalve=valve)


def perform(case: ValveCase) -> Record:
    """Calibrate a unit and diagnose it worn; fractions of 1."""
    unit, faults = random_valve(np.random.default_rng([case.seed, case.case]))
    tests = bundled_tests()
    seeds = np.random.SeedSequence([case.seed, case.case]).generate_state(3).tolist()
    sheet = msgspec.structs.replace(
        unit.actuator,
        second_stage=msgspec.structs.replace(unit.actuator.second_stage, by_position=False),
    )
    new = [
        record(unit, tests[name], seed=seed, step=COARSE_STEP)
        for name, seed in zip(("open", "closed"), seeds, strict=False)
    ]
    found = calibrate(new, _stated(sheet, case.statement), tests.values())
    truth = [faults.Kintas, faults.FSS, faults.FDJ]
    if found.actuator is None:
        return {"faults": truth, "refused": list(found.reasons), "verdict": None}
    worn = record(unit, tests[case.test], faults, seed=seeds[2], step=COARSE_STEP)
    diagnosis = diagnose([worn], found.actuator, tests.values())
    if diagnosis.identification is None:
        return {"faults": truth, "refused": list(diagnosis.reasons), "verdict": "NOT_TESTED"}
    estimates = diagnosis.identification.estimates
    return {
        "faults": truth,
        "refused": list(diagnosis.reasons) if diagnosis.verdict is Verdict.NOT_TESTED else [],
        "verdict": diagnosis.verdict.name,
        "value": [item.value for item in estimates],
        "interval95": [list(item.interval95) for item in estimates],
    }


def is_wrong(record: Record, levels: Levels | None = None) -> bool:
    """Whether a verdict is another than the truth's, and the intervals exclude the truth.

    An interval that holds the truth on the other side of a level says that it may be so.
    """
    levels = levels or Levels()
    worst = max(record["faults"])
    true = Verdict.HEALTHY if worst < levels.advisory else Verdict.DEGRADED
    true = Verdict.FAULT if worst >= levels.limit else true
    if record["verdict"] in (None, Verdict.NOT_TESTED.name, true.name):
        return False
    return not bool(holds_truth([record]).all())


def _cases(options: Options) -> list[ValveCase]:
    return [
        ValveCase(case, options.seed, ("open", "closed")[case % 2], statement)
        for statement in options.exponent or list(STATEMENTS)
        for case in range(options.cases)
    ]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--exponent",
        action="append",
        choices=list(STATEMENTS),
        help="what the file says of the clogging's exponent; may be repeated (all)",
    )


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Errors and coverage of what was answered, in percent."""
    headings = (
        "exponent", "units", "not calibrated", "NOT TESTED", "sure and wrong",
        "mean error Kintas", "FSS", "FDJ", "coverage, %",
    )  # fmt: skip
    rows = []
    for statement in dict.fromkeys(item["statement"] for item in records):
        part = [item for item in records if item["statement"] == statement]
        answered = [item for item in part if item["verdict"] not in (None, "NOT_TESTED")]
        error = np.abs(percent_errors(answered)).mean(axis=0) if answered else [np.nan] * 3
        held = f"{100.0 * holds_truth(answered).mean():.1f}" if answered else "–"
        rows.append((
            statement, len(part), sum(item["verdict"] is None for item in part),
            sum(item["verdict"] == "NOT_TESTED" for item in part),
            sum(map(is_wrong, part)), *(f"{value:.2f}" for value in error), held,
        ))  # fmt: skip
    yield from markdown(headings, rows)


VALVES = Study(
    "valves",
    "Valves of another construction: filter in series, chambers, lands, spool ends; the clogging's"
    " exponent stated, unknown or wrong.",
    _cases, perform, _report, _options, counted="units of each row",
)  # fmt: skip
