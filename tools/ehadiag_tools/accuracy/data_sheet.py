"""`tools/data_sheet`: accuracy on units whose data differ from their file, calibrated and not.

The units of `tools/nuisances`, and besides ten data-sheet values ±5 % (PHY-37). Each unit is
diagnosed from one recording of it worn, with `--tolerance 0.05`, and once more with the file that
`ehadiag calibrate` makes of one open- and one closed-loop recording of it as new.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ehadiag.assess.acceptance import objections_to_estimate
from ehadiag.calibration.unit import calibrate
from ehadiag.core.actuator import Actuator, default_actuator, with_tolerance
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.nuisance.knowledge import knowledge_of
from ehadiag.identify.session import Nuisances, identify
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.accuracy.nuisances import HEADINGS, row_of
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.simulator.units import COARSE_STEP, Unit, add_group, record, unit_with

__all__ = ["LINES", "SheetRun", "main", "perform_sheet"]

LINES = {
    f"{test}, {state}": (test, state)
    for state in ("tolerance", "calibrated")
    for test in ("open", "closed")
}
"""Stored test and what is known of the unit."""
TOLERANCE = 0.05


@dataclass(frozen=True, slots=True)
class SheetRun:
    """Settings of one identification."""

    line: str
    """One of `LINES`."""
    case: int
    seed: int
    nuisances: str
    """auto, or none: the severities alone, with the data sheet."""
    groups: tuple[str, ...] = ()
    """Of `random_unit`, beside the data."""


def perform_sheet(run: SheetRun) -> dict[str, Any]:
    """Draw a unit, record it, identify, and compare with the truth; fractions of 1."""
    unit, faults = _drawn(run.seed, run.case, run.groups)
    name, state = LINES[run.line]
    actuator = default_actuator()
    reasons: tuple[str, ...] = ()
    if run.nuisances != Nuisances.NONE.value:
        if state == "tolerance":
            actuator = with_tolerance(actuator, TOLERANCE)
        else:
            actuator, reasons = _calibrated(run.seed, run.case, run.groups)
    recording = _recorded(unit, name, faults, (run.seed, run.case, 0))
    assert recording.samples is not None
    test = resolve_test(name)
    begin = time.process_time()
    experiment = build_experiment(recording.samples, recording.environment, test, actuator)
    result = identify(
        [experiment], nuisances=Nuisances(run.nuisances), knowledge=knowledge_of(actuator)
    )
    return {
        **asdict(run),
        "faults": faults,
        "value": [item.value for item in result.estimates],
        "std": [item.std for item in result.estimates],
        "interval95": [list(item.interval95) for item in result.estimates],
        "not_tested": bool(reasons or objections_to_estimate(result, actuator.calibration)),
        "refused": list(reasons),
        "evaluations": result.evaluations,
        "attempts": result.attempts,
        "processor_s": time.process_time() - begin,
    }


def _drawn(seed: int, case: int, groups: tuple[str, ...]) -> tuple[Unit, list[float]]:
    rng = np.random.default_rng([seed, case])
    unit = unit_with(rng, groups, case)
    return unit, rng.uniform(0.0, 1.0, 3).tolist()


def _recorded(unit: Unit, name: str, faults: Sequence[float], noise: tuple[int, ...]) -> Recording:
    seed = int(np.random.SeedSequence([*noise, name == "closed"]).generate_state(1)[0])
    return record(unit, resolve_test(name), Faults(*faults), seed=seed, step=COARSE_STEP)


@lru_cache(maxsize=64)
def _calibrated(seed: int, case: int, groups: tuple[str, ...]) -> tuple[Actuator, tuple[str, ...]]:
    """Return the unit's own data, or those of its type and why it was refused."""
    unit, _ = _drawn(seed, case, groups)
    new = [_recorded(unit, name, (0.0, 0.0, 0.0), (seed, case, 1)) for name in ("open", "closed")]
    begin = time.process_time()
    found = calibrate(new, default_actuator(), bundled_tests().values())
    spent = time.process_time() - begin
    words = "; ".join(found.reasons) or "calibrated"
    print(f"  unit {case}: {words}, {spent:.1f} s of processor time", file=sys.stderr)
    return found.actuator or default_actuator(), found.reasons


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, or that of the error."""
    options = _parser().parse_args(argv)
    return carry_out("data_sheet", options.results, lambda: _print_table(options))


def _print_table(options: argparse.Namespace) -> None:
    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    groups = tuple(sorted(set(options.group)))
    for line in options.line or list(LINES):
        for nuisances in options.nuisances or ["auto", "none"]:
            runs = [
                SheetRun(line, case, options.seed, nuisances, groups)
                for case in range(options.cases)
            ]
            label = f"{line}, nuisances {nuisances}"
            records = perform_all(perform_sheet, runs, options.results, options.jobs, label)
            print("| " + " | ".join(row_of(line, nuisances, records)) + " |", flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="data_sheet", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--line", action="append", choices=list(LINES), help="may be repeated (all)")
    add(
        "--nuisances",
        action="append",
        choices=[Nuisances.AUTO.value, Nuisances.NONE.value],
        help="may be repeated (both)",
    )
    add_group(parser)
    add("--cases", type=int, default=200, help="units of each line (%(default)d)")
    add("--seed", type=int, default=1, help="of the random units (%(default)d)")
    add(
        "--results",
        type=Path,
        default=Path("build/data_sheet.jsonl"),
        help="what is done (%(default)s)",
    )
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (%(default)d)")
    return parser
