"""Studies of verdicts: on calibrated units that wear, and on broken hardware.

A calibrated unit is random, recorded with known truth, or has a valve of another construction than
the paper's, of which each effect is a switch that is on by even chance: a filter in series (m = 2),
chambers by position, lands that differ one by one, oil that yields at the spool's ends.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path

import msgspec
import numpy as np
from scipy.stats import binomtest

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.calibration.unit_models import Calibrated
from ehadiag.core.actuator import (
    Actuator,
    Discrepancy,
    ExponentOrRange,
    default_actuator,
    load_actuator,
)
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_sim.broken_hardware import HARDWARE_FAULTS, simulate_broken
from ehadiag_sim.conditions import Faults, UnmodelledEffects
from ehadiag_tools.accuracy.figures import (
    NOT_TESTED,
    accuracy_table,
    cramer_rao,
    is_answered,
    is_wrong,
    outcome,
    percent_errors,
)
from ehadiag_tools.simulator.units import (
    COARSE_STEP,
    Unit,
    add_group,
    random_unit,
    read_truth,
    record,
    unit_with,
)
from ehadiag_tools.study import Options, Record, Study, grouped, markdown
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import Recording
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import bundled_tests, resolve_test

TESTS = ("open", "closed")
SOUND, WORN = 0.20, 0.30
"""Largest severity of a sound unit, 1; least of the largest one of a worn unit."""
Worn = tuple[Record, Recording]
"""A recording of a worn unit behind what its record says of it, `faults` at least."""


def judged(
    new: Sequence[Recording],
    sheet: Actuator,
    worn: Sequence[Worn],
    statements: Mapping[str, ExponentOrRange] | None = None,
    *,
    bounds: bool = False,
) -> Record:
    """Calibrate a unit as new on data of its type, and diagnose it worn; fractions of 1.

    Once with each statement of the clogging's exponent, unless given that of the data. A range is
    calibrated with its largest exponent: statements of the same one share a calibration.
    """
    tests = bundled_tests().values()
    calibrations: dict[float, Calibrated] = {}
    tested, spent = [], 0.0
    for name, said in (statements or {"": sheet.servovalve.clogging_exponent}).items():
        stated = with_exponent(sheet, said)
        largest = stated.servovalve.clogging_range[1]
        if largest not in calibrations:
            begin = time.process_time()
            calibrations[largest] = calibrate(new, stated, tests)
            spent += time.process_time() - begin
        actuator = calibrations[largest].actuator
        for about, recording in worn:
            item = {**about, "m": name, "calibrated": actuator is not None}
            if actuator is None:
                reasons = list(calibrations[largest].reasons)
                item |= {"verdict": NOT_TESTED, "value": [], "reasons": reasons}
            else:
                found = diagnose([recording], with_exponent(actuator, said), tests)
                item |= outcome(found)
                if bounds and item["value"]:
                    item["bound"] = cramer_rao(found.experiments, about["faults"]).tolist()
            tested.append(item)
    learned = [_learned(item) for item in calibrations.values()]
    return {"calibration_s": spent, "learned": learned, "tested": tested}


def _learned(found: Calibrated) -> str:
    tried = "; ".join(f"{item.words} {item.excess:.2f}" for item in found.tried)
    calibration = found.actuator.calibration if found.actuator else None
    if calibration is None:
        return f"residuals over noise: {tried}; refused: {'; '.join(found.reasons)}"
    effects = ", ".join(calibration.effects)
    return f"residuals over noise: {tried}; learned: {calibration.fit.excess:.2f}, {effects}"


def with_exponent(actuator: Actuator, exponent: ExponentOrRange) -> Actuator:
    """Return data of an actuator with another statement of the clogging's exponent."""
    valve = msgspec.structs.replace(actuator.servovalve, clogging_exponent=exponent)
    return msgspec.structs.replace(actuator, servovalve=valve)


@dataclass(frozen=True, slots=True)
class AlarmCase:
    """One unit: its number, the seed, recordings after the calibration, groups of effects."""

    unit: int
    seed: int
    recordings: int
    groups: tuple[str, ...]


def perform_alarms(case: AlarmCase) -> Record:
    """Calibrate a random unit, then diagnose it many times: truth and verdict of each."""
    rng = np.random.default_rng([case.seed, case.unit])
    unit = unit_with(rng, case.groups, case.unit)

    def recorded(name: str, faults: Sequence[float] = ()) -> Recording:
        noise = int(rng.integers(2**31))
        return record(unit, resolve_test(name), Faults(*faults), seed=noise, step=COARSE_STEP)

    new = [recorded(name) for name in TESTS]
    worn: list[Worn] = []
    for k in range(case.recordings):
        faults, name = draw_severities(rng, sound=k % 2 == 0), TESTS[k // 2 % 2]
        worn.append(({"faults": faults, "test": name}, recorded(name, faults)))
    found = judged(new, default_actuator(), worn)
    return {**found, "tested": [item for item in found["tested"] if item["calibrated"]]}


def draw_severities(rng: np.random.Generator, *, sound: bool) -> list[float]:
    """Severities of a sound unit, or of one that is worn."""
    if sound:
        return [float(value) for value in rng.uniform(0.0, SOUND, 3)]
    while True:
        drawn = rng.uniform(0.0, 1.0, 3)
        if drawn.max() >= WORN:
            return [float(value) for value in drawn]


def _alarm_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--recordings", type=int, default=25, help="of each unit (%(default)d)")
    add_group(parser)


def _alarm_cases(options: Options) -> list[AlarmCase]:
    groups = tuple(sorted(set(options.group)))
    return [
        AlarmCase(unit, options.seed, options.recordings, groups) for unit in range(options.cases)
    ]


def alarm_report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Rates of both kinds of wrong verdict, and errors of the severities by test.

    Recordings of a unit share its calibration, so the interval is that of units (Clopper and
    Pearson, Biometrika 26, 1934): of the share of them with any such verdict.
    """
    units = [item["tested"] for item in records if item["tested"]]
    spent = np.array([item["calibration_s"] for item in records])
    yield (
        f"{len(records) - len(units)} of {len(records)} units were not calibrated; a calibration"
        f" took {np.median(spent):.1f} s of processor time in the median, {spent.max():.1f} at most"
    )
    yield ""
    rows = []
    for label, sound in (("sound, not HEALTHY", True), ("worn, HEALTHY", False)):
        each = [
            [
                (item["verdict"] == Verdict.HEALTHY.name) is not sound
                for item in tested
                if _is_sound(item) is sound
            ]
            for tested in units
        ]
        count, wrong, any_wrong = sum(map(len, each)), sum(map(sum, each)), sum(map(any, each))
        low, high = _clopper_pearson(any_wrong, len(each))
        rate = f"{wrong / max(count, 1):.2%}"
        rows.append((len(each), label, count, wrong, rate, f"{any_wrong}: {low:.2%} … {high:.2%}"))
    yield from markdown(
        ("units", "verdict", "recordings", "of them", "rate", "units with any, 95 % interval"), rows
    )
    tested = [item for unit in units for item in unit]
    counts = Counter((item["verdict"], "sound" if _is_sound(item) else "worn") for item in tested)
    cells = [f"{kind} {name} {count}" for (name, kind), count in sorted(counts.items())]
    yield f"\n{', '.join(cells)}\n"
    yield from accuracy_table(tested, "test")


def _is_sound(item: Record) -> bool:
    return bool(max(item["faults"]) <= SOUND)


def _clopper_pearson(events: int, count: int) -> tuple[float, float]:
    if not count:
        return 0.0, 1.0
    interval = binomtest(events, count).proportion_ci(0.95, method="exact")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True, slots=True)
class RecordedUnit:
    """Folder, name, and how many of the unit's recordings as new are calibrated on; 0: all."""

    folder: str
    unit: str
    new: int
    exponents: tuple[ExponentOrRange, ...] = ()
    """Of the clogging, in place of the actuator file's."""


def perform_recorded(case: RecordedUnit) -> Record:
    """Calibrate a unit and diagnose its worn recordings.

    Data of its type: `sheet-X.toml` beside its recordings, else the reference's.
    """
    folder = Path(case.folder)
    sheet = folder / f"sheet-{case.unit}.toml"
    new: list[Recording] = []
    worn: list[Worn] = []
    for truth in read_truth(folder):
        name = Path(truth.path).stem
        if name.startswith(f"{case.unit}-"):
            recording = read_recording(Path(truth.path))
            if "-new-" in name:
                new.append(recording)
            else:
                worn.append(({"recording": name, "faults": truth.faults}, recording))
    actuator = load_actuator(sheet) if sheet.exists() else default_actuator()
    statements = {str(said): said for said in case.exponents}
    return judged(new[: case.new or None], actuator, worn, statements, bounds=True)


def _recorded_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--recordings", type=Path, required=True, metavar="FOLDER",
        help="with recordings X-new-….blf, and others of X when worn, of units X, and truth.csv"
        " with the columns file, Kintas, FSS, FDJ")  # fmt: skip
    add("--exponent", type=float, nargs="+", action="append", default=[], metavar="M",
        help="of the clogging, or its range, in place of the file's; may be repeated")  # fmt: skip
    add("--new", type=int, default=0, metavar="N", help="calibrate on the first N as new (all)")


def _recorded_cases(options: Options) -> list[RecordedUnit]:
    files = [Path(truth.path).name for truth in read_truth(options.recordings)]
    names = dict.fromkeys(file.partition("-")[0] for file in files if "-new-" in file)
    if not names:
        raise ConfigurationError(f"{options.recordings}/truth.csv: no recording of a unit as new")
    stated = tuple(tuple(given) if given[1:] else given[0] for given in options.exponent)
    return [RecordedUnit(str(options.recordings), name, options.new, stated) for name in names]


def _recorded_report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Errors with stated deviations in percent; bounds are those with all else known."""
    for unit in records:
        yield f"\nUnit {unit['unit']}: {unit['calibration_s']:.1f} s of processor time"
        yield from (f"- {line}" for line in unit["learned"])
        yield ""
        rows = map(_recorded_row, unit["tested"])
        yield from markdown(("m", "recording", *FAULT_NAMES, "bounds", "verdict"), rows)
    yield "\nErrors of what is answered, by m:\n"
    yield from accuracy_table([item for unit in records for item in unit["tested"]], "m")


def _recorded_row(item: Record) -> tuple[object, ...]:
    cells, bounds = ["–"] * len(FAULT_NAMES), "–"
    if item["value"]:
        (error,) = percent_errors([item])
        cells = [f"{e:+.3f} ± {100.0 * s:.3f}" for e, s in zip(error, item["std"], strict=True)]
        bounds = " ".join(f"{100.0 * value:.3f}" for value in item["bound"])
    verdict = item["verdict"].replace("_", " ")
    if item["verdict"] == NOT_TESTED:
        verdict += f": {'; '.join(item['reasons'])}"
    return item["m"], item["recording"], *cells, bounds, verdict


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


def random_valve(rng: np.random.Generator) -> tuple[Unit, Faults, list[str]]:
    """Draw a unit with orifices, its wear, and the names of switches that are on."""
    unit = random_unit(rng, data=True)
    series, chambers, lands, ends = states = (rng.random(4) < 0.5).tolist()
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
    effects = replace(unit.effects, unmodelled=strange)
    on = [name for name, state in zip(SWITCHES, states, strict=True) if state]
    return replace(unit, actuator=actuator, effects=effects), faults, on


def statements_of(unit: Unit) -> dict[str, ExponentOrRange]:
    """What may be said of a unit's exponent; of one without a series filter 0 is not wrong."""
    exponent = unit.actuator.servovalve.clogging_exponent
    out = {"stated": exponent, "unknown": (0.0, SERIES), "wrongly 0": 0.0}
    return {name: said for name, said in out.items() if name != "wrongly 0" or exponent != said}


def perform_valve(case: ValveCase) -> Record:
    """Calibrate a unit and diagnose it worn, with each statement."""
    unit, faults, on = random_valve(np.random.default_rng([case.seed, case.case]))
    *seeds, last = np.random.SeedSequence([case.seed, case.case]).generate_state(3).tolist()
    stage = msgspec.structs.replace(unit.actuator.second_stage, by_position=False)
    sheet = msgspec.structs.replace(unit.actuator, second_stage=stage)
    new = [
        record(unit, resolve_test(name), seed=seed, step=COARSE_STEP)
        for name, seed in zip(TESTS, seeds, strict=True)
    ]
    worn = record(unit, resolve_test(case.test), faults, seed=last, step=COARSE_STEP)
    about = {"faults": [faults.Kintas, faults.FSS, faults.FDJ], "switches": on}
    return judged(new, sheet, [(about, worn)], statements_of(unit))


def _valve_cases(options: Options) -> list[ValveCase]:
    return [ValveCase(case, options.seed, TESTS[case % 2]) for case in range(options.cases)]


def _valve_report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Errors and coverage of what was answered, in percent; where it was not, by switch."""
    tested = [item for record in records for item in record["tested"]]
    yield from accuracy_table(tested, "m")
    refused = sum(not item["calibrated"] for item in tested)
    yield f"\n{refused} of {len(tested)} without a calibration. Units without an answer, of all"
    yield "with or without each switch:\n"
    rows = []
    for (name,), part in grouped(tested, "m").items():
        cells = []
        for switch, on in product(SWITCHES, (True, False)):
            those = [item for item in part if (switch in item["switches"]) is on]
            cells.append(f"{sum(not is_answered(item) for item in those)} of {len(those)}")
        rows.append((name, *map(", ".join, zip(cells[::2], cells[1::2], strict=True))))
    yield from markdown(("exponent", *(f"{switch}: on, off" for switch in SWITCHES)), rows)


@dataclass(frozen=True, slots=True)
class HardwareCase:
    """Settings of one diagnosis of broken hardware; kind: one of `KINDS`."""

    test: str
    kind: str
    case: int
    seed: int


def perform_broken(case: HardwareCase) -> Record:
    """Break hardware, record a test, diagnose it; processor time of the diagnosis alone."""
    _load_kernels(case.test)
    recording, faults = _broken(case)
    begin = time.process_time()
    found = outcome(diagnose([recording], default_actuator(), bundled_tests().values()))
    record = {"faults": faults, **found, "processor_s": time.process_time() - begin}
    missed = found["verdict"] == Verdict.HEALTHY.name and not HARDWARE_FAULTS[case.kind].hidden
    return {**record, "not_allowed": missed or is_wrong(record)}


def _broken(case: HardwareCase) -> tuple[Recording, list[float]]:
    """Record the case; also its true severities: even cases are sound, odd ones of the cube."""
    place = list(HARDWARE_FAULTS).index(case.kind)
    rng = np.random.default_rng([case.seed, TESTS.index(case.test), place, case.case])
    faults = rng.uniform(0.0, 1.0 if case.case % 2 else SOUND, 3).tolist()
    test = resolve_test(case.test)
    recording = simulate_broken(
        case.kind, rng, default_actuator(), test, Faults(*faults), step=COARSE_STEP
    )
    return recording, faults


@cache
def _load_kernels(test: str) -> None:
    """Load what is compiled, once in a process, so that no case is charged with it."""
    for kind in ("clogged-nozzle", "scaled-position"):
        recording, _ = _broken(HardwareCase(test, kind, 0, 0))
        diagnose([recording], default_actuator(), bundled_tests().values())


def _hardware_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--test", action="append", choices=TESTS, help="may be repeated (both)")
    add("--kind", action="append", choices=list(HARDWARE_FAULTS), help="may be repeated (all)")


def _hardware_cases(options: Options) -> list[HardwareCase]:
    return [
        HardwareCase(test, kind, case, options.seed)
        for test in options.test or TESTS
        for kind in options.kind or HARDWARE_FAULTS
        for case in range(options.cases)
    ]


def hardware_report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Verdicts and times of each kind, and of all."""
    groups = grouped(records, "test", "kind") | {("all", "all"): list(records)}
    verdicts = [verdict.name.replace("_", " ") for verdict in Verdict]
    yield from markdown(
        ("test", "kind", *verdicts, "not allowed", "median, s", "longest, s"),
        ((*key, *_hardware_cells(part)) for key, part in groups.items()),
    )
    for item in (item for item in records if item["not_allowed"]):
        faults = ", ".join(f"{value:.2f}" for value in item["faults"])
        yield (
            f"- {item['test']} {item['kind']} case {item['case']} ({faults}): "
            f"{item['verdict']} NOT ALLOWED: {'; '.join(item['reasons'])}"
        )


def _hardware_cells(records: Sequence[Record]) -> list[str]:
    count = Counter(item["verdict"] for item in records)
    times = [item["processor_s"] for item in records]
    wrong = sum(item["not_allowed"] for item in records)
    counts = [str(count[verdict.name]) for verdict in Verdict]
    return [*counts, str(wrong), f"{np.median(times):.2f}", f"{max(times):.2f}"]


ALARMS = Study(
    "alarms",
    "False and missed alarms of random units that are calibrated once and tested often.",
    _alarm_cases, perform_alarms, alarm_report, _alarm_options, counted="units",
)  # fmt: skip
RECORDED_UNITS = Study(
    "recorded-units",
    "Recorded units with known truth, each calibrated as new and then diagnosed as worn.",
    _recorded_cases, perform_recorded, _recorded_report, _recorded_options, count=None,
)  # fmt: skip
VALVES = Study(
    "valves",
    "Valves of another construction: filter in series, chambers, lands, spool ends; the clogging's"
    " exponent stated, unknown or wrong.",
    _valve_cases, perform_valve, _valve_report, counted="units",
)  # fmt: skip
HARDWARE = Study(
    "hardware",
    "Verdicts on every kind of broken hardware that the simulator plays; 1 if one is not allowed.",
    _hardware_cases, perform_broken, hardware_report, _hardware_options, count=20,
    counted="of each kind and test", failed=lambda item: bool(item["not_allowed"]),
)  # fmt: skip
