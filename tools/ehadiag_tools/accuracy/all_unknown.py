"""`tools/all_unknown`: the textbook's unit with all effects unknown, beside the Cramér–Rao bound.

Severities uniform in the cube, no effects, `--nuisances all`: what it costs not to know that there
are none. The bound is that of the same unknowns: severities, the sensors' constant errors, null
bias, gain, hysteresis and backlash, with what is known of any unit beforehand.
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
from numpy.typing import NDArray

from ehadiag.assess.acceptance import objections_to_estimate
from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import resolve_test
from ehadiag.identify.experiment import Experiment, build_experiment, share_offsets
from ehadiag.identify.nuisance.prior import information_of, nuisances_of
from ehadiag.identify.refine.derivatives import Derivatives
from ehadiag.identify.session import Nuisances, identify
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.model.parameters import FAULT_NAMES, FAULTS, OFFSETS, REGISTRY
from ehadiag.model.simd.model import SimdModel
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.accuracy.figures import holds_truth, percent_errors
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.simulator.units import Unit, record

__all__ = ["TextbookRun", "bound_of", "main", "perform_textbook"]

HEADINGS = ("test", "cases", "severity", "mean", "rms", "bound", "rms / bound", "coverage, %")


@dataclass(frozen=True, slots=True)
class TextbookRun:
    """Settings of one identification."""

    test: str
    case: int
    seed: int


def perform_textbook(run: TextbookRun) -> dict[str, Any]:
    """Record the textbook's unit, identify, and compare with the truth; fractions of 1."""
    rng = np.random.default_rng([run.seed, run.case])
    faults = rng.uniform(0.0, 1.0, 3).tolist()
    test, actuator = resolve_test(run.test), default_actuator()
    recording = record(Unit(), test, Faults(*faults), seed=int(rng.integers(2**31)))
    assert recording.samples is not None
    experiment = build_experiment(recording.samples, recording.environment, test, actuator)
    begin = time.process_time()
    result = identify([experiment], nuisances=Nuisances.ALL)
    return {
        **asdict(run),
        "faults": faults,
        "value": [item.value for item in result.estimates],
        "interval95": [list(item.interval95) for item in result.estimates],
        "bound": bound_of(experiment, faults).tolist(),
        "not_tested": bool(objections_to_estimate(result)),
        "processor_s": time.process_time() - begin,
    }


def bound_of(experiment: Experiment, faults: Sequence[float]) -> NDArray[np.float64]:
    """Least deviation of each severity that an unbiased estimate with all unknowns can have.

    Ticks where a break-away moves within the differences have no derivative and are left out.
    """
    experiments = share_offsets([experiment])
    unknowns = unknowns_of(experiments, (*FAULTS, *OFFSETS, *nuisances_of(REGISTRY)))
    model = Derivatives(SimdModel(lay_out(experiments), unknowns), experiment.noise)
    truth = dict(zip(FAULT_NAMES, faults, strict=True))
    x = np.array([truth.get(item.name, 0.0) for item in model.estimated]) / model.scale
    slope = model.trusted_slope(x)
    rows = (slope.jacobian * slope.smooth).reshape(len(x), -1)
    spread = np.linalg.inv(rows @ rows.T + information_of(model, {}))
    return np.asarray((np.sqrt(np.diag(spread)) * model.scale)[: len(FAULTS)])


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, or that of the error."""
    options = _parser().parse_args(argv)
    return carry_out("all_unknown", options.results, lambda: _print_table(options))


def _print_table(options: argparse.Namespace) -> None:
    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    for test in options.test or ["open", "closed"]:
        runs = [TextbookRun(test, case, options.seed) for case in range(options.cases)]
        print_rows(test, perform_all(perform_textbook, runs, options.results, options.jobs, test))


def print_rows(test: str, records: Sequence[dict[str, Any]]) -> None:
    """One row for each severity, in percent of damage."""
    error = np.abs(percent_errors(records))
    held = 100.0 * holds_truth(records).mean(axis=0)
    bound = 100.0 * np.sqrt(np.mean(np.square([record["bound"] for record in records]), axis=0))
    rms = np.sqrt((error**2).mean(axis=0))
    for k, name in enumerate(FAULT_NAMES):
        print(
            f"| {test} | {len(records)} | {name} | {error[:, k].mean():.4f} | {rms[k]:.4f} "
            f"| {bound[k]:.4f} | {rms[k] / bound[k]:.2f} | {held[k]:.1f} |"
        )
    untested = sum(record["not_tested"] for record in records)
    spent = np.mean([record["processor_s"] for record in records])
    print(f"\n{test}: {untested} NOT TESTED, {1e3 * spent:.0f} ms of processor time each\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="all_unknown",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--test", action="append", choices=["open", "closed"], help="may be repeated (both)")
    add("--cases", type=int, default=200, help="of each test (%(default)d)")
    add("--seed", type=int, default=1, help="of severities and noise (%(default)d)")
    add("--results", type=Path, default=Path("build/all_unknown.jsonl"), help="done (%(default)s)")
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (%(default)d)")
    return parser
