"""`tools/alarms`: false and missed alarms of units that were calibrated once and tested often.

The units are those of `tools/data_sheet`. Each is calibrated on one open- and one closed-loop
recording of it as new; every other recording after that is of a sound unit (all severities at most
0.20), the rest of a worn one (at least one of 0.30 or more), both tests in turn, oil and supply
of the day. Recordings of one unit share its calibration, so the interval is that of units: of the
share of them with any such verdict (Clopper and Pearson, Biometrika 26, 1934). A second table has
the errors of the severities, by test.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from ehadiag.assess.diagnosis import Diagnosis, diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.calibration.unit import calibrate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.accuracy.figures import holds_truth, percent_errors, percent_widths
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.simulator.units import COARSE_STEP, add_group, record, unit_with

__all__ = ["AlarmRun", "main", "perform_unit"]

TESTS = ("open", "closed")
SOUND, WORN = 0.20, 0.30
"""Largest severity of a sound unit; least of the largest one of a worn unit."""
HEADINGS = ("units", "what", "recordings", "of them", "rate", "units with any, 95 % interval")

ERROR_HEADINGS = ("test", "recordings", "mean", "p95", "worst", "coverage, %", "mean width")


@dataclass(frozen=True, slots=True)
class AlarmRun:
    """One unit: its number, the seed, recordings after the calibration, groups of effects."""

    unit: int
    seed: int
    recordings: int
    groups: tuple[str, ...]


def perform_unit(run: AlarmRun) -> dict[str, Any]:
    """Calibrate a random unit, then diagnose it as often as asked: truth and verdict of each."""
    rng = np.random.default_rng([run.seed, run.unit])
    unit = unit_with(rng, run.groups, run.unit)
    new = [
        record(unit, resolve_test(name), seed=int(rng.integers(2**31)), step=COARSE_STEP)
        for name in TESTS
    ]
    begin = time.process_time()
    found = calibrate(new, default_actuator(), bundled_tests().values())
    calibrated = time.process_time()
    tested = []
    if found.actuator is not None:
        for k in range(run.recordings):
            faults = _severities(rng, sound=k % 2 == 0)
            name = TESTS[k // 2 % 2]
            recording = record(
                unit,
                resolve_test(name),
                Faults(*faults),
                seed=int(rng.integers(2**31)),
                step=COARSE_STEP,
            )
            done = diagnose([recording], found.actuator, bundled_tests().values())
            tested.append({"faults": faults, "test": name, **_told(done)})
    return {
        **asdict(run),
        "refused": list(found.reasons),
        "tested": tested,
        "calibration_s": calibrated - begin,
        "diagnoses_s": time.process_time() - calibrated,
    }


def _told(done: Diagnosis) -> dict[str, Any]:
    found = done.identification
    estimates = () if found is None else found.estimates
    return {
        "verdict": done.verdict.name,
        "reasons": list(done.reasons),
        "value": [item.value for item in estimates],
        "interval95": [list(item.interval95) for item in estimates],
    }


def _severities(rng: np.random.Generator, *, sound: bool) -> list[float]:
    if sound:
        return [float(value) for value in rng.uniform(0.0, SOUND, 3)]
    while True:
        drawn = rng.uniform(0.0, 1.0, 3)
        if drawn.max() >= WORN:
            return [float(value) for value in drawn]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, or that of the error."""
    options = _parser().parse_args(argv)
    groups = tuple(sorted(set(options.group)))
    runs = [
        AlarmRun(unit, options.seed, options.recordings, groups) for unit in range(options.units)
    ]

    def work() -> None:
        print_table(perform_all(perform_unit, runs, options.results, options.jobs, "units"))

    return carry_out("alarms", options.results, work)


def print_table(records: Sequence[dict[str, Any]]) -> None:
    """Rates of both kinds of wrong verdict, and what they were."""
    calibrated = [record for record in records if record["tested"]]
    print(f"{len(records) - len(calibrated)} of {len(records)} units were not calibrated\n")
    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    for what, sound in (("sound, not HEALTHY", True), ("worn, HEALTHY", False)):
        each = [
            [_is_wrong(item) for item in record["tested"] if _is_sound(item) is sound]
            for record in calibrated
        ]
        count, wrong = sum(map(len, each)), sum(map(sum, each))
        units = sum(any(item) for item in each)
        interval = _interval(units, len(each))
        print(
            f"| {len(each)} | {what} | {count} | {wrong} | {wrong / max(count, 1):.2%} "
            f"| {units}: {interval[0]:.2%} … {interval[1]:.2%} |"
        )
    said = Counter(
        (item["verdict"], "sound" if _is_sound(item) else "worn")
        for record in calibrated
        for item in record["tested"]
    )
    words = [f"{kind} {name} {count}" for (name, kind), count in sorted(said.items())]
    print("\n" + ", ".join(words))
    _print_errors([item for record in calibrated for item in record["tested"]])


def _print_errors(items: Sequence[dict[str, Any]]) -> None:
    """Errors in percent of damage of what is not NOT TESTED, and how often an interval holds."""
    print("\n| " + " | ".join(ERROR_HEADINGS) + " |\n|" + " --- |" * len(ERROR_HEADINGS))
    for test in TESTS:
        told = [item for item in items if item["test"] == test and _is_told(item)]
        if not told:
            continue
        error = np.abs(percent_errors(told))
        print(
            f"| {test} | {len(told)} | {error.mean():.4f} "
            f"| {np.quantile(error.mean(axis=1), 0.95):.4f} | {error.max():.3f} "
            f"| {100.0 * holds_truth(told).mean():.1f} | {percent_widths(told).mean():.3f} |"
        )


def _is_told(item: dict[str, Any]) -> bool:
    return bool(item["value"]) and item["verdict"] != Verdict.NOT_TESTED.name


def _is_sound(item: dict[str, Any]) -> bool:
    return bool(max(item["faults"]) <= SOUND)


def _is_wrong(item: dict[str, Any]) -> bool:
    return bool((item["verdict"] == Verdict.HEALTHY.name) is not _is_sound(item))


def _interval(events: int, count: int) -> tuple[float, float]:
    if not count:
        return 0.0, 1.0
    interval = binomtest(events, count).proportion_ci(0.95, method="exact")
    return float(interval.low), float(interval.high)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="alarms", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--units", type=int, default=200, help="%(default)d")
    add("--recordings", type=int, default=25, help="of each unit (%(default)d)")
    add_group(parser)
    add("--seed", type=int, default=1, help="of the random units (%(default)d)")
    add("--results", type=Path, default=Path("build/alarms.jsonl"), help="done (%(default)s)")
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (%(default)d)")
    return parser
