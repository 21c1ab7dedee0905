"""`tools/real_units`: recorded units, each calibrated as new and then diagnosed as worn.

A folder holds recordings `X-new-….blf` and `X-worn-….blf` of units X, and `truth.csv` with the
columns file, test, Kintas, FSS, FDJ. Of each worn recording the table has the errors with the
deviations that are stated, in percent of damage, the Cramér-Rao bound of the three severities with
all else known, and whether all three intervals cover the truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis, diagnose
from ehadiag.calibration.unit import calibrate
from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.errors import EhadiagError
from ehadiag.core.stored_test import bundled_tests
from ehadiag.model.parameters import FAULT_NAMES
from ehadiag_tools.accuracy.bound import cramer_rao
from ehadiag_tools.simulator.recorded_units import read_rows
from firmware_iface.logs.reader import read_recording

__all__ = ["main"]

Array = NDArray[np.float64]
HEADINGS = ("recording", *FAULT_NAMES, "bounds", "covered", "verdict")


def main(argv: Sequence[str] | None = None) -> int:
    """Print a table of each unit; exit code 0, or that of the error."""
    options = _parser().parse_args(argv)
    try:
        for unit in options.unit:
            _print_unit(options.recordings, unit, options.new)
    except EhadiagError as error:
        print(f"real_units: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _print_unit(folder: Path, name: str, count: int | None) -> None:
    rows = [row for row in read_rows(folder / "truth.csv") if row["file"].startswith(f"{name}-")]
    begin = time.process_time()
    new = [row["file"] for row in rows if "-new-" in row["file"]][:count]
    found = calibrate(
        [read_recording(folder / file) for file in new],
        default_actuator(),
        bundled_tests().values(),
    )
    spent = time.process_time() - begin
    models = "; ".join(f"{item.words} {item.excess:.2f}" for item in found.tried)
    print(f"\nUnit {name}: {spent:.1f} s of processor time, residuals over noise: {models}\n")
    calibration = found.actuator.calibration if found.actuator else None
    if found.actuator is None or calibration is None:
        print(f"refused: {'; '.join(found.reasons)}")
        return
    print(f"learned: {calibration.fit.excess:.2f}, {', '.join(calibration.effects)}\n")
    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    errors, inside = [], []
    for row in rows:
        if "-worn-" in row["file"]:
            truth = np.array([float(row[fault]) for fault in FAULT_NAMES])
            error, covers = _print_row(folder / row["file"], truth, found.actuator)
            errors.append(error)
            inside.append(covers)
    print(
        f"\nmean {100.0 * np.mean(errors):.3f}, worst {100.0 * np.max(errors):.3f}, coverage "
        f"{100.0 * np.mean(inside):.0f} %",
        flush=True,
    )


def _print_row(path: Path, truth: Array, unit: Actuator) -> tuple[Array, NDArray[np.bool_]]:
    found = diagnose([read_recording(path)], unit, bundled_tests().values())
    identified = found.identification
    if identified is None:
        raise EhadiagError(f"{path.name}: {'; '.join(found.reasons)}")
    error = np.array([item.value for item in identified.estimates]) - truth
    low, high = np.array([item.interval95 for item in identified.estimates]).T
    covers = (low <= truth) & (truth <= high)
    cells = [
        f"{100.0 * miss:+.3f} ± {100.0 * item.std:.3f}"
        for miss, item in zip(error, identified.estimates, strict=True)
    ]
    bounds = " ".join(f"{100.0 * value:.3f}" for value in _bounds(found, truth))
    covered = "yes" if covers.all() else "no"
    verdict = found.verdict.name.replace("_", " ")
    print(
        "| " + " | ".join([path.stem, *cells, bounds, covered, verdict]) + " |",
        flush=True,
    )
    return np.abs(error), covers


def _bounds(found: Diagnosis, truth: Array) -> list[float]:
    """Smallest deviations with the unit's data and effects known, of each severity."""
    values: list[float] = cramer_rao(found.experiments, truth.tolist()).tolist()
    return values


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="real_units", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--recordings", type=Path, required=True, metavar="DIR", help="with truth.csv"
    )
    parser.add_argument("--unit", action="append", required=True, help="name; may be repeated")
    parser.add_argument(
        "--new", type=int, metavar="N", help="calibrate on the first N recordings as new (all)"
    )
    return parser
