"""`tools/paper_tables`: the paper's Tables 1 and 2 beside this project's results, and pictures.

From simulated tests (12-bit converters, 0.5 LSB noise, several noise seeds), or from a folder of
recordings with their truth.csv. The paper states neither noise nor quantisation.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.errors import ConfigurationError
from ehadiag.model.parameters import FAULT_NAMES
from ehadiag_tools.accuracy.cases import PAPER, PaperCase
from ehadiag_tools.accuracy.figures import percent_errors
from ehadiag_tools.accuracy.pictures import draw_all
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.accuracy.runs import Run, perform
from ehadiag_tools.simulator.compare_logs import read_truth

__all__ = ["main"]

STAGES = {"first": "first approximation", "search": "genetic search", "value": "final"}
TITLES = {"open": "Table 1, open loop", "closed": "Table 2, closed loop"}


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables and write the pictures; exit code 0, or that of the error."""
    parser = argparse.ArgumentParser(
        prog="paper_tables",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--seeds", type=int, default=5, help="noise seeds of each simulated case (%(default)d)")
    add("--recordings", type=Path, metavar="FOLDER", help="recordings and their truth.csv instead")
    add("--out", type=Path, default=Path("docs/img"), help="folder of the pictures (%(default)s)")
    add("--no-pictures", action="store_true", help="tables only")
    add("--results", type=Path, default=Path("out/accuracy.jsonl"), help="(%(default)s)")
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    options = parser.parse_args(argv)
    return carry_out("paper_tables", options.results, lambda: _perform(options))


def _perform(options: argparse.Namespace) -> None:
    if options.seeds < 1 or options.jobs < 1:
        raise ConfigurationError("--seeds and --jobs: need at least 1")
    runs = _runs(options.recordings, options.seeds)
    records = perform_all(perform, runs, options.results, options.jobs, "paper's tables")
    source = str(options.recordings) if options.recordings else "simulated"
    for test in TITLES:
        print_table(test, records, source)
    if not options.no_pictures:
        prefix = "recordings" if options.recordings else "simulated"
        for path in draw_all(runs, records, options.out, prefix):
            print(f"wrote {path}")


def print_table(test: str, records: Sequence[dict[str, Any]], source: str) -> None:
    """Print mean absolute errors (%) of each constant after each stage, and the paper's."""
    mine = [record for record in records if record["test"] == test]
    if not mine:
        return
    print(f"{TITLES[test]}: mean absolute error in percent, {source}\n")
    header = " | ".join([*FAULT_NAMES, "mean", "worst run", "the paper's mean"])
    print(f"| case (Kintas, FSS, FDJ) | runs | stage | {header} |")
    print("| --- |" + " --- |" * 8)
    for faults in dict.fromkeys(tuple(record["faults"]) for record in mine):
        case = _paper_case(test, faults)
        of_case = [record for record in mine if tuple(record["faults"]) == faults]
        label = ", ".join(f"{value:g}" for value in faults)
        for stage, name in STAGES.items():
            error = np.abs(percent_errors(of_case, stage))
            published = "–"
            if case is not None and stage != "search":
                published = f"{case.first if stage == 'first' else case.final:.4f}"
            print(f"| {label} | {len(of_case)} | {name} | {_cells(error)} | {published} |")
    shared = [record for record in mine if _paper_case(test, record["faults"]) is not None]
    if shared:
        error = np.abs(percent_errors(shared))
        paper = float(np.mean([case.final for case in PAPER if case.test == test]))
        label = "the paper's cases"
        print(f"| {label} | {len(shared)} | final | {_cells(error)} | {paper:.4f} |")
        print(f"\nThe paper's final mean is {paper / error.mean():.0f} times ours.\n")
    print(flush=True)


def _cells(error: NDArray[np.float64]) -> str:
    """Mean of each constant, of all, and the largest mean of one run."""
    case = error.mean(axis=1)
    return " | ".join(f"{value:.4f}" for value in [*error.mean(axis=0), case.mean(), case.max()])


def _paper_case(test: str, faults: Sequence[float]) -> PaperCase | None:
    return next((c for c in PAPER if c.test == test and c.faults == tuple(faults)), None)


def _runs(folder: Path | None, seeds: int) -> list[Run]:
    if folder is None:
        return [
            Run(case.test, case.faults, noise_seed=seed) for case in PAPER for seed in range(seeds)
        ]
    runs = []
    for row in read_truth(folder / "truth.csv"):
        if row.test in TITLES:
            faults = (row.faults.Kintas, row.faults.FSS, row.faults.FDJ)
            runs.append(Run(row.test, faults, recordings=(str(folder / row.file),)))
    if not runs:
        raise ConfigurationError(f"{folder / 'truth.csv'}: no recording of {', '.join(TITLES)}")
    return runs
