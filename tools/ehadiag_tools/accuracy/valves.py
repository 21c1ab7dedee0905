"""Study of valves of another construction than the paper's, with the clogging's law stated or not.

Each effect is a switch that is on by even chance: a filter in series (m = 2), chambers by position,
lands that differ one by one, oil that yields at the spool's ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from ehadiag.assess.diagnosis import diagnose
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.calibration.unit_models import Calibrated
from ehadiag.core.actuator import Discrepancy, ExponentOrRange, default_actuator
from ehadiag_sim.conditions import Faults, UnmodelledEffects
from ehadiag_tools.accuracy.figures import NOT_TESTED, accuracy_table, is_answered, outcome
from ehadiag_tools.accuracy.recorded import with_exponent
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, random_unit, record
from ehadiag_tools.study import Options, Record, Study, grouped, markdown
from firmware_iface.recording import Recording
from firmware_iface.stored_test import bundled_tests

SERIES = 2.0
"""Exponent of a filter in series."""
SWITCHES = ("series", "chambers", "lands", "ends")
MIN_PRESSURE_MARGIN = 1.5
"""Least force of the first stage over the spool's friction, 1: a valve that its clogged filter
leaves less does not move."""


@dataclass(frozen=True, slots=True)
class ValveCase:
    """Unit of a seed, and the test of it when worn."""

    case: int
    seed: int
    test: str


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
        stated = with_exponent(sheet, said)
        largest = stated.servovalve.clogging_range[1]
        if largest not in calibrated:
            calibrated[largest] = calibrate(new, stated, tests.values())
        answers[name] = _answer(calibrated[largest], said, worn)
    truth = [faults.Kintas, faults.FSS, faults.FDJ]
    return {"faults": truth, "switches": _switches(unit), "answers": answers}


def _answer(found: Calibrated, said: ExponentOrRange, worn: Recording) -> Record:
    if found.actuator is None:
        return {"verdict": NOT_TESTED, "value": [], "reasons": list(found.reasons), "left": None}
    actuator = with_exponent(found.actuator, said)
    calibration = found.actuator.calibration
    left = calibration.fit.excess if calibration else 0.0
    return {**outcome(diagnose([worn], actuator, bundled_tests().values())), "left": left}


def _cases(options: Options) -> list[ValveCase]:
    tests = ("open", "closed")
    return [ValveCase(case, options.seed, tests[case % 2]) for case in range(options.cases)]


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Errors and coverage of what was answered, in percent; where it was not, by switch."""
    answers = [
        {**item, **answer, "exponent": name}
        for item in records
        for name, answer in item["answers"].items()
    ]
    yield from accuracy_table(answers, "exponent")
    refused = sum(item["left"] is None for item in answers)
    yield f"\n{refused} of {len(answers)} without a calibration. Units without an answer, of all"
    yield "with or without each switch:\n"
    yield from markdown(
        ("exponent", *(f"{switch}: on, off" for switch in SWITCHES)),
        (
            (name, *(", ".join(_refusals(part, switch, on) for on in (True, False))
                     for switch in SWITCHES))
            for (name,), part in grouped(answers, "exponent").items()
        ),
    )  # fmt: skip


def _refusals(part: Sequence[Record], switch: str, on: bool) -> str:
    those = [item for item in part if (switch in item["switches"]) is on]
    return f"{sum(not is_answered(item) for item in those)} of {len(those)}"


VALVES = Study(
    "valves",
    "Valves of another construction: filter in series, chambers, lands, spool ends; the clogging's"
    " exponent stated, unknown or wrong.",
    _cases, perform, _report, counted="units",
)  # fmt: skip
