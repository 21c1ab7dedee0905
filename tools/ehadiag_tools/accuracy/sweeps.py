"""`tools/accuracy`: sweeps of identifications with known truth, compared with their targets.

Modes: `sweep` (random cases of the unit cube, corners, edges and faces among them), `paper` (the
paper's eight cases), `efficiency` (the monitoring model as its own plant, against the Cramér-Rao
bound), `repeat` (spread over search seeds on one recording), `solvers` (compact genetic algorithm,
pygad and differential evolution on one objective), `joint` (both tests together against each).
Results are kept in a file of JSON lines, so that a run that was broken off goes on where it stood.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ehadiag.core.errors import ConfigurationError
from ehadiag.model.parameters import FAULT_NAMES
from ehadiag_tools.accuracy.cases import PAPER, random_faults
from ehadiag_tools.accuracy.contest import contest, print_contest
from ehadiag_tools.accuracy.figures import figures_of, percent_errors, print_figures
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.accuracy.runs import PLANTS, TESTS, Run, perform
from ehadiag_tools.simulator.compare_logs import read_truth

__all__ = ["main"]


@dataclass(frozen=True, slots=True)
class Request:
    """What the command line asks for."""

    mode: str
    tests: tuple[str, ...]
    cases: int
    seed: int
    plant: str
    noise_seeds: int
    search_seeds: int
    solver: str
    recordings: Path | None
    results: Path
    jobs: int


def main(argv: Sequence[str] | None = None) -> int:
    """Print tables; exit code 0, or that of the error."""
    options = _parser().parse_args(argv)
    return carry_out("accuracy", options.results, lambda: _perform(options))


def _perform(options: argparse.Namespace) -> None:
    modes: dict[str, Callable[[Request], Any]] = {
        "sweep": sweep,
        "paper": paper,
        "efficiency": efficiency,
        "repeat": repeat,
        "solvers": solvers,
        "joint": joint,
    }
    for name in ("cases", "noise_seeds", "search_seeds", "jobs"):
        if getattr(options, name) < 1:
            raise ConfigurationError(f"--{name.replace('_', '-')}: need at least 1")
    request = Request(
        mode=options.mode,
        tests=tuple(options.test or ("open", "closed")),
        cases=options.cases,
        seed=options.seed,
        plant=options.plant,
        noise_seeds=options.noise_seeds,
        search_seeds=options.search_seeds,
        solver=options.solver,
        recordings=options.recordings,
        results=options.results,
        jobs=options.jobs,
    )
    outcome = modes[request.mode](request)
    if options.json is not None:
        options.json.write_text(json.dumps(outcome, indent=1) + "\n", encoding="utf-8")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="accuracy", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    modes = ("sweep", "paper", "efficiency", "repeat", "solvers", "joint")
    parser.add_argument("mode", nargs="?", choices=modes, default="sweep", help="(%(default)s)")
    add = parser.add_argument
    add("--test", action="append", choices=list(TESTS), help="may be repeated (open and closed)")
    add("--cases", type=int, default=200, help="random cases of sweep, joint (%(default)d)")
    add("--seed", type=int, default=1, help="of the random cases (%(default)d)")
    add("--plant", choices=PLANTS, default="detailed", help="for sweep and paper (%(default)s)")
    add("--noise-seeds", type=int, default=20, help="for paper, efficiency (%(default)d)")
    add("--search-seeds", type=int, default=100, help="for repeat, solvers (%(default)d)")
    add("--solver", default="cga", help="cga or pygad (%(default)s)")
    add("--recordings", type=Path, metavar="FOLDER", help="paper-*.blf of it, not simulations")
    add("--results", type=Path, default=Path("out/accuracy.jsonl"), help="(%(default)s)")
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    add("--json", type=Path, metavar="FILE", help="write the figures there, too")
    return parser


def sweep(request: Request) -> dict[str, Any]:
    """Random cases, one noise seed each."""
    outcome = {}
    for test in request.tests:
        runs = [
            Run(test, faults, noise_seed=index, plant=request.plant, solver=request.solver)
            for index, faults in enumerate(random_faults(request.cases, request.seed))
        ]
        records = _records(request, runs, f"sweep {test}")
        figures = figures_of(records)
        print_figures(f"Sweep, {test}, plant {request.plant}, seed {request.seed}", figures)
        _print_worst(records)
        outcome[test] = asdict(figures)
    return outcome


def paper(request: Request) -> dict[str, Any]:
    """The paper's cases, several noise seeds each; or recordings of them."""
    outcome = {}
    for test in request.tests:
        runs = _paper_runs(request, test, request.noise_seeds)
        records = _records(request, runs, f"paper cases {test}")
        what = "recordings" if request.recordings else f"plant {request.plant}"
        print_figures(f"Paper's cases, {test}, {what}", figures_of(records))
        print(
            "| case | mean, first approximation | the paper's | final | worst run | the paper's |"
        )
        print("| --- |" + " --- |" * 5)
        for case in PAPER:
            mine = [r for r in records if tuple(r["faults"]) == case.faults]
            if case.test != test or not mine:
                continue
            first = np.abs(percent_errors(mine, "first")).mean()
            final = np.abs(percent_errors(mine)).mean(axis=1)
            print(
                f"| {case.test} {case.number} | {first:.4f} | {case.first:.4f} "
                f"| {final.mean():.4f} | {final.max():.4f} | {case.final:.4f} |"
            )
        print()
        outcome[test] = asdict(figures_of(records))
    return outcome


def efficiency(request: Request) -> dict[str, Any]:
    """Many noise seeds at the paper's cases; nothing mismatched: the model is its own plant."""
    outcome: dict[str, Any] = {}
    print("Rms error / Cramér–Rao bound, the monitoring model as the plant\n")
    print(
        "| case | runs | " + " | ".join(f"{n}: bound, % | rms / bound" for n in FAULT_NAMES) + " |"
    )
    print("| --- | --- |" + " --- |" * 6)
    for test in request.tests:
        for case in PAPER:
            if case.test != test:
                continue
            runs = [
                Run(test, case.faults, noise_seed=seed, plant="monitoring", solver=request.solver)
                for seed in range(request.noise_seeds)
            ]
            records = _records(request, runs, f"efficiency {test} {case.number}")
            bound = 100.0 * np.array(records[0]["bound"])
            rms = np.sqrt((percent_errors(records) ** 2).mean(axis=0))
            cells = [f"{b:.4f} | {r / b:.2f}" for b, r in zip(bound, rms, strict=True)]
            print(f"| {test} {case.number} | {len(records)} | {' | '.join(cells)} |", flush=True)
            outcome[f"{test} {case.number}"] = {"bound": list(bound), "ratio": list(rms / bound)}
    print()
    return outcome


def repeat(request: Request) -> dict[str, Any]:
    """Many search seeds on one recording: largest less smallest estimate."""
    outcome = {}
    print("Spread (largest less smallest) over search seeds, percent\n")
    print(
        "| case | seeds | " + " | ".join(FAULT_NAMES) + " | evaluations |\n| --- |" + " --- |" * 5
    )
    for test in request.tests:
        for base in _paper_runs(request, test, 1):
            runs = [replace(base, search_seed=seed) for seed in range(request.search_seeds)]
            name = f"{test} {next(c.number for c in PAPER if c.faults == base.faults)}"
            records = _records(request, runs, f"repeat {name}")
            value = 100.0 * np.array([record["value"] for record in records])
            spread = value.max(axis=0) - value.min(axis=0)
            mean = np.mean([record["evaluations"] for record in records])
            cells = " | ".join(f"{x:.5f}" for x in spread)
            print(f"| {name} | {len(records)} | {cells} | {mean:.0f} |", flush=True)
            outcome[name] = [float(x) for x in spread]
    print()
    return outcome


def solvers(request: Request) -> dict[str, Any]:
    """Three solvers, one objective, one budget of evaluations."""
    outcome = {}
    for test in request.tests:
        for base in _paper_runs(request, test, 1):
            runs = [replace(base, search_seed=seed) for seed in range(request.search_seeds)]
            name = f"{test} {next(c.number for c in PAPER if c.faults == base.faults)}"
            records = perform_all(contest, runs, request.results, request.jobs, f"solvers {name}")
            outcome[name] = print_contest(name, records)
    return outcome


def joint(request: Request) -> dict[str, Any]:
    """Both tests together against each alone, the same recordings."""
    outcome = {}
    records = {}
    for test in TESTS:
        runs = [
            Run(test, faults, noise_seed=index, plant=request.plant, solver=request.solver)
            for index, faults in enumerate(random_faults(request.cases, request.seed))
        ]
        records[test] = _records(request, runs, f"joint: {test}")
    print(f"Joint estimate against single ones, {request.cases} random cases, percent\n")
    print("| | " + " | ".join(f"{n}: mean | rms" for n in FAULT_NAMES) + " | mean of all |")
    print("| --- |" + " --- |" * 7)
    for test, found in records.items():
        error = percent_errors(found)
        mean, rms = np.abs(error).mean(axis=0), np.sqrt((error**2).mean(axis=0))
        cells = " | ".join(f"{a:.4f} | {b:.4f}" for a, b in zip(mean, rms, strict=True))
        print(f"| {test} | {cells} | {mean.mean():.4f} |")
        outcome[test] = {"mean": list(mean), "rms": list(rms)}
    print()
    return outcome


def _paper_runs(request: Request, test: str, seeds: int) -> list[Run]:
    cases = [case for case in PAPER if case.test == test]
    if request.recordings is None:
        return [
            Run(test, case.faults, noise_seed=seed, plant=request.plant, solver=request.solver)
            for case in cases
            for seed in range(seeds)
        ]
    rows = read_truth(request.recordings / "truth.csv")
    return [
        Run(
            test,
            (row.faults.Kintas, row.faults.FSS, row.faults.FDJ),
            recordings=(str(request.recordings / row.file),),
            solver=request.solver,
        )
        for row in rows
        if row.test == test and row.file.startswith("paper-")
    ]


def _records(request: Request, runs: Sequence[Run], label: str) -> list[dict[str, Any]]:
    return perform_all(perform, runs, request.results, request.jobs, label)


def _print_worst(records: Sequence[dict[str, Any]], count: int = 5) -> None:
    error = percent_errors(records)
    print("Worst cases (largest error of any constant):\n")
    print("| noise seed | truth | errors | stated deviations | outliers, % |\n|" + " --- |" * 5)
    for index in np.argsort(-np.abs(error).max(axis=1))[:count]:
        record = records[index]
        truth = ", ".join(f"{x:.4f}" for x in record["faults"])
        off = ", ".join(f"{x:+.4f}" for x in error[index])
        std = ", ".join(f"{100.0 * x:.4f}" for x in record["std"])
        print(
            f"| {record['noise_seed']} | {truth} | {off} | {std} "
            f"| {100.0 * record['outliers']:.2f} |"
        )
    print(flush=True)
