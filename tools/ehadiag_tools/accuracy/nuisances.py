"""`tools/nuisances`: accuracy on actuators with unknown effects of the installation.

Random units with offsets ±1 % of range, torque-motor gain ±5 %, null bias ±2 % of rated current,
hysteresis 0 to 4 % by one play and backlash 0 to 5 µm, all unknown, nothing calibrated; severities
uniform in the cube. Each line is shown with the nuisance estimation on and off. Results are kept in
a file of JSON lines, so that a run that was broken off goes on where it stood.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ehadiag.assess.acceptance import objections_to_estimate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.session import Nuisances, identify
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.accuracy.figures import holds_truth, percent_errors, percent_widths
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.simulator.units import random_unit, record

__all__ = ["LINES", "UnitRun", "main", "perform_unit", "row_of"]

LINES = {"open": ("open",), "closed": ("closed",), "joint": ("open", "closed")}
"""Stored tests of which an estimate gets one recording each."""
HEADINGS = (
    "line", "nuisances", "cases", "mean", "p95", "worst", "coverage, %", "mean width",
    "NOT TESTED, %", "model runs", "processor, ms",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class UnitRun:
    """Settings of one identification; what it gives depends on nothing else but the code."""

    line: str
    """One of `LINES`."""
    case: int
    seed: int
    nuisances: str


def perform_unit(run: UnitRun) -> dict[str, Any]:
    """Draw a unit, record it, identify, and compare with the truth; fractions of 1."""
    rng = np.random.default_rng([run.seed, run.case])
    unit = random_unit(rng, serial=run.case)
    faults = rng.uniform(0.0, 1.0, 3).tolist()
    experiments: list[Experiment] = []
    for index, name in enumerate(("open", "closed")):
        if name in LINES[run.line]:
            test = resolve_test(name)
            noise = int(np.random.SeedSequence([run.seed, run.case, index]).generate_state(1)[0])
            recording = record(unit, test, Faults(*faults), seed=noise)
            assert recording.samples is not None
            experiments.append(
                build_experiment(recording.samples, recording.environment, test, default_actuator())
            )
    begin = time.process_time()
    result = identify(experiments, nuisances=Nuisances(run.nuisances))
    return {
        **asdict(run),
        "faults": faults,
        "value": [item.value for item in result.estimates],
        "std": [item.std for item in result.estimates],
        "interval95": [list(item.interval95) for item in result.estimates],
        "not_tested": bool(objections_to_estimate(result)),
        "freed": list(result.freed),
        "evaluations": result.evaluations,
        "attempts": result.attempts,
        "processor_s": time.process_time() - begin,
    }


def row_of(line: str, nuisances: str, records: Sequence[dict[str, Any]]) -> list[str]:
    """Cells of the table for one line; errors and widths in percent of damage.

    Errors are of every case, 95th percentile and mean of the cases' mean; coverage and width are
    those of the intervals that are stated, NOT TESTED states none.
    """
    error = np.abs(percent_errors(records))
    stated = [record for record in records if not record["not_tested"]]
    return [
        line,
        nuisances,
        str(len(records)),
        f"{error.mean():.4f}",
        f"{np.quantile(error.mean(axis=1), 0.95):.4f}",
        f"{error.max():.3f}",
        f"{100.0 * holds_truth(stated).mean():.1f}" if stated else "-",
        f"{percent_widths(stated).mean():.3f}" if stated else "-",
        f"{100.0 * (1.0 - len(stated) / len(records)):.1f}",
        f"{np.mean([record['evaluations'] for record in records]):.0f}",
        f"{1e3 * np.mean([record['processor_s'] for record in records]):.0f}",
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, or that of the error."""
    options = _parser().parse_args(argv)
    return carry_out("nuisances", options.results, lambda: _print_table(options))


def _print_table(options: argparse.Namespace) -> None:
    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    for line in options.line or list(LINES):
        for nuisances in options.nuisances or ["auto", "none"]:
            runs = [UnitRun(line, i, options.seed, nuisances) for i in range(options.cases)]
            label = f"{line}, nuisances {nuisances}"
            records = perform_all(perform_unit, runs, options.results, options.jobs, label)
            print("| " + " | ".join(row_of(line, nuisances, records)) + " |", flush=True)
            if options.worst:
                _print_worst(records, options.worst)


def _print_worst(records: Sequence[dict[str, Any]], count: int) -> None:
    truth = np.array([record["faults"] for record in records])
    error = percent_errors(records)
    std = 100.0 * np.array([record["std"] for record in records])
    for index in np.argsort(-np.abs(error).max(axis=1))[:count]:
        record = records[index]
        print(
            f"  case {record['case']}: truth {np.round(truth[index], 4)}, error "
            f"{np.round(error[index], 3)}, stated {np.round(std[index], 3)}, "
            f"{record['attempts']} attempts, {record['evaluations']} runs"
            + (", NOT TESTED" if record["not_tested"] else "")
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nuisances", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--line", action="append", choices=list(LINES), help="may be repeated (all)")
    add(
        "--nuisances",
        action="append",
        choices=[item.value for item in Nuisances],
        help="may be repeated (auto and none)",
    )
    add("--cases", type=int, default=200, help="units of each line (%(default)d)")
    add("--seed", type=int, default=1, help="of the random units (%(default)d)")
    add("--worst", type=int, default=0, metavar="N", help="list the N worst cases")
    add(
        "--results",
        type=Path,
        default=Path("build/nuisances.jsonl"),
        help="what is done (%(default)s)",
    )
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (%(default)d)")
    return parser
