"""Studies of verdicts: false and missed alarms of calibrated units, and broken hardware."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.stats import binomtest

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.core.actuator import default_actuator
from ehadiag_sim.broken_hardware import HARDWARE_FAULTS, simulate_broken
from ehadiag_sim.conditions import Faults
from ehadiag_tools.accuracy.figures import accuracy_table, is_wrong, outcome
from ehadiag_tools.simulator.units import COARSE_STEP, add_group, record, unit_with
from ehadiag_tools.study import Options, Record, Study, grouped, markdown
from firmware_iface.recording import Recording
from firmware_iface.stored_test import bundled_tests, resolve_test

TESTS = ("open", "closed")
SOUND, WORN = 0.20, 0.30
"""Largest severity of a sound unit, 1; least of the largest one of a worn unit."""


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

    def recorded(name: str, faults: Faults | None = None) -> Recording:
        noise = int(rng.integers(2**31))
        return record(unit, resolve_test(name), faults, seed=noise, step=COARSE_STEP)

    new = [recorded(name) for name in TESTS]
    begin = time.process_time()
    found = calibrate(new, default_actuator(), bundled_tests().values())
    spent = time.process_time() - begin
    tested = []
    for k in range(case.recordings if found.actuator else 0):
        assert found.actuator is not None
        faults, name = draw_severities(rng, sound=k % 2 == 0), TESTS[k // 2 % 2]
        recording = recorded(name, Faults(*faults))
        answer = outcome(diagnose([recording], found.actuator, bundled_tests().values()))
        tested.append({"faults": faults, "test": name, **answer})
    return {"refused": list(found.reasons), "tested": tested, "calibration_s": spent}


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
            [_is_wrong(item) for item in tested if _is_sound(item) is sound] for tested in units
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


def _is_wrong(item: Record) -> bool:
    return bool((item["verdict"] == Verdict.HEALTHY.name) is not _is_sound(item))


def _clopper_pearson(events: int, count: int) -> tuple[float, float]:
    if not count:
        return 0.0, 1.0
    interval = binomtest(events, count).proportion_ci(0.95, method="exact")
    return float(interval.low), float(interval.high)


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


def _any_not_allowed(records: Sequence[Record]) -> bool:
    return any(item["not_allowed"] for item in records)


ALARMS = Study(
    "alarms",
    "False and missed alarms of random units that are calibrated once and tested often.",
    _alarm_cases, perform_alarms, alarm_report, _alarm_options, counted="units",
)  # fmt: skip
HARDWARE = Study(
    "hardware",
    "Verdicts on every kind of broken hardware that the simulator plays; 1 if one is not allowed.",
    _hardware_cases, perform_broken, hardware_report, _hardware_options, count=20,
    counted="of each kind and test", failed=_any_not_allowed,
)  # fmt: skip
