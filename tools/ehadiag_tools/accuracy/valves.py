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
from ehadiag.assess.verdict import Verdict
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.calibration.unit_models import Calibrated
from ehadiag.core.actuator import Discrepancy, ExponentOrRange, default_actuator
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_sim.conditions import Faults, UnmodelledEffects
from ehadiag_tools.accuracy.figures import holds_truth, is_wrong, percent_errors
from ehadiag_tools.accuracy.recorded import with_exponent
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, random_unit, record
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.recording import Recording
from firmware_iface.stored_test import bundled_tests

__all__ = ["VALVES", "ValveCase", "perform", "random_valve", "statements_of"]

SERIES = 2.0
"""Exponent of a filter in series."""
STATEMENTS = ("stated", "unknown", "wrongly 0")
"""What the actuator file says of the clogging's exponent."""
SWITCHES = ("series", "chambers", "lands", "ends")
MIN_PRESSURE_MARGIN = 1.5
"""Least force of the first stage over the spool's friction, 1: a valve that its clogged filter
leaves less does not move."""


@dataclass(frozen=True, slots=True)
class ValveCase:
    """Unit of a seed, the test of it when worn, and what is said of its filter."""

    case: int
    seed: int
    test: str
    statements: tuple[str, ...] = STATEMENTS
    calibrations: int = 2
    """Largest number of them: statements that need another are left out."""


def random_valve(rng: np.random.Generator) -> tuple[Unit, Faults]:
    """Draw a unit with orifices and its wear; switches by even chance."""
    unit = random_unit(rng, data=True)
    series, chambers, lands, ends = (rng.random(4) < 0.5).tolist()
    sheet = default_actuator()
    valve = msgspec.structs.replace(sheet.servovalve, clogging_exponent=SERIES if series else 0.0)
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


def statements_of(unit: Unit) -> dict[str, ExponentOrRange]:
    """What may be said of a unit's exponent; of one without a series filter 0 is not wrong."""
    exponent = unit.actuator.servovalve.clogging_exponent
    out = {"stated": exponent, "unknown": (0.0, SERIES), "wrongly 0": 0.0}
    return {name: said for name, said in out.items() if name != "wrongly 0" or exponent != said}


def _switches(unit: Unit) -> list[str]:
    strange = unit.effects.unmodelled
    states = (
        unit.actuator.servovalve.clogging_exponent == SERIES,
        unit.actuator.second_stage.by_position,
        any(strange.underlap_errors),
        strange.spool_end_volume > 0.0,
    )
    return [name for name, on in zip(SWITCHES, states, strict=True) if on]


def perform(case: ValveCase) -> Record:
    """Calibrate a unit and diagnose it worn, with each statement; fractions of 1.

    A range is calibrated with its largest exponent: one calibration serves both.
    """
    unit, faults = random_valve(np.random.default_rng([case.seed, case.case]))
    tests = bundled_tests()
    seeds = np.random.SeedSequence([case.seed, case.case]).generate_state(3).tolist()
    stage = msgspec.structs.replace(unit.actuator.second_stage, by_position=False)
    sheet = msgspec.structs.replace(unit.actuator, second_stage=stage)
    new = [
        record(unit, tests[name], seed=seed, step=COARSE_STEP)
        for name, seed in zip(("open", "closed"), seeds, strict=False)
    ]
    worn = record(unit, tests[case.test], faults, seed=seeds[2], step=COARSE_STEP)
    calibrated: dict[float, Calibrated] = {}
    answers: dict[str, Record] = {}
    for name, said in statements_of(unit).items():
        if name not in case.statements:
            continue
        stated = with_exponent(sheet, said)
        largest = stated.servovalve.clogging_range[1]
        if largest not in calibrated:
            if len(calibrated) == case.calibrations:
                continue
            calibrated[largest] = calibrate(new, stated, tests.values())
        answers[name] = _answer(calibrated[largest], said, worn)
    truth = [faults.Kintas, faults.FSS, faults.FDJ]
    return {"faults": truth, "switches": _switches(unit), "answers": answers}


def _answer(found: Calibrated, said: ExponentOrRange, worn: Recording) -> Record:
    if found.actuator is None:
        return {"refused": list(found.reasons), "verdict": None}
    actuator = with_exponent(found.actuator, said)
    diagnosis = diagnose([worn], actuator, bundled_tests().values())
    estimates = diagnosis.identification.estimates if diagnosis.identification else ()
    tested = diagnosis.verdict is not Verdict.NOT_TESTED
    calibration = found.actuator.calibration
    return {
        "refused": [] if tested else list(diagnosis.reasons),
        "verdict": diagnosis.verdict.name,
        "left": calibration.fit.excess if calibration else 0.0,
        "value": [item.value for item in estimates],
        "std": [item.std for item in estimates],
        "interval95": [list(item.interval95) for item in estimates],
    }


def _cases(options: Options) -> list[ValveCase]:
    statements = tuple(options.exponent or STATEMENTS)
    every = options.cases if options.every is None else options.every
    return [
        ValveCase(case, options.seed, ("open", "closed")[case % 2], statements, 1 + (case < every))
        for case in range(options.cases)
    ]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--exponent",
        action="append",
        choices=STATEMENTS,
        help="what the file says of the clogging's exponent; may be repeated (all)",
    )
    parser.add_argument(
        "--every",
        type=int,
        metavar="N",
        help="units with every statement; the others with those that one calibration serves (all)",
    )


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Errors and coverage of what was answered, in percent; where it was not, by switch."""
    headings = (
        "exponent", "units", "not calibrated", "NOT TESTED", "sure and wrong",
        *(f"mean error {name}" for name in FAULT_NAMES),
        *(f"coverage {name}, %" for name in FAULT_NAMES),
    )  # fmt: skip
    parts = {
        name: [{**item, **item["answers"][name]} for item in records if name in item["answers"]]
        for name in STATEMENTS
    }
    rows = []
    for name, part in parts.items():
        answered = [item for item in part if item["verdict"] not in (None, "NOT_TESTED")]
        if not part:
            continue
        figures = ["–"] * 6
        if answered:
            errors = np.abs(percent_errors(answered)).mean(axis=0)
            held = 100.0 * holds_truth(answered).mean(axis=0)
            figures = [*(f"{value:.2f}" for value in errors), *(f"{value:.1f}" for value in held)]
        rows.append((
            name, len(part), sum(item["verdict"] is None for item in part),
            sum(item["verdict"] == "NOT_TESTED" for item in part), sum(map(is_wrong, part)),
            *figures,
        ))  # fmt: skip
    yield from markdown(headings, rows)
    yield "\nUnits without an answer, of all with or without each switch\n"
    yield from markdown(
        ("exponent", *(f"{switch}: on, off" for switch in SWITCHES)),
        (
            (name, *(f"{_refusals(part, switch, on=True)}, {_refusals(part, switch, on=False)}"
                     for switch in SWITCHES))
            for name, part in parts.items() if part
        ),
    )  # fmt: skip


def _refusals(part: Sequence[Record], switch: str, *, on: bool) -> str:
    those = [item for item in part if (switch in item["switches"]) is on]
    refused = sum(item["verdict"] in (None, "NOT_TESTED") for item in those)
    return f"{refused} of {len(those)}"


VALVES = Study(
    "valves",
    "Valves of another construction: filter in series, chambers, lands, spool ends; the clogging's"
    " exponent stated, unknown or wrong.",
    _cases, perform, _report, _options, counted="units",
)  # fmt: skip
