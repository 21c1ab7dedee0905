"""`tools/foreign_buses`: recordings played again on foreign buses, beside the default one.

    tools/foreign_buses tests/data/logs
    tools/foreign_buses LOGS UNITS --calibrated FOLDER --results FILE

A folder holds recordings on the default bus and `truth.csv` with the columns file, Kintas, FSS and
FDJ. Where a row names a unit X, FOLDER/X.toml is its actuator file, made by `ehadiag calibrate`;
recordings `X-new-…`, which that was made of, are left out. Results are kept in a file of JSON
lines, so that a run that was broken off goes on where it stood.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehadiag.assess.verdict import Verdict
from ehadiag.model.parameters import FAULT_NAMES
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.rigs.buses import BUSES
from ehadiag_tools.rigs.replay import DAQ, DEFAULT, Replay, perform_replay
from ehadiag_tools.rigs.rerecord import Disturbance
from ehadiag_tools.simulator.recorded_units import read_rows

__all__ = ["main"]

JITTERS_MS = (0.0, 0.2, 0.5, 1.0)
MOST_LEAD_IN_S = 10.0
HEADINGS = ("bus", "jitter", "verdicts", "wrong", "mean", "largest", "intervals that hold")
Found = tuple[Replay, dict[str, Any]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, or that of the error."""
    given = _parser().parse_args(arguments)
    return carry_out("foreign_buses", given.results, lambda: _perform(given))


def _perform(given: argparse.Namespace) -> None:
    cases = [case for folder in given.folder for case in _cases(folder, given)]
    runs = [run for case in cases for run in _runs(case, given)]
    # Those of the default bus, then the others in any order: a part of them is a sample.
    usual = [place for place, run in enumerate(runs) if run.bus == DEFAULT]
    drawn = np.random.default_rng(given.seed).permutation(len(runs)).tolist()
    others = [place for place in drawn if runs[place].bus != DEFAULT]
    order = (usual + others)[: given.at_most]
    mixed = [runs[place] for place in order]
    records = perform_all(perform_replay, mixed, given.results, given.jobs, "recordings")
    found = dict(zip(order, records, strict=True))
    _show([(runs[place], found[place]) for place in sorted(found)], verbose=given.verbose)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="foreign_buses",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, nargs="+", help="recordings and their truth.csv")
    parser.add_argument("--calibrated", type=Path, help="folder of the units' actuator files")
    parser.add_argument("--only", action="append", metavar="NAME", help="one recording, by name")
    parser.add_argument("--bus", action="append", choices=[*(item.name for item in BUSES), DAQ])
    parser.add_argument(
        "--jitter", action="append", type=float, metavar="MS", help="half-normal (0 0.2 0.5 1)"
    )
    parser.add_argument(
        "--lead-in", type=float, metavar="S", help="instead of one drawn from 0 … 10 s for each"
    )
    parser.add_argument("--drift", type=float, default=100.0, help="ppm (%(default)g)")
    parser.add_argument("--batch", type=float, default=0.0, help="ms (%(default)g)")
    parser.add_argument("--lost", type=float, default=0.0, help="share of the frames")
    parser.add_argument("--unordered", action="store_true", help="log sorted by its stamps")
    parser.add_argument(
        "--rate", type=float, default=2000.0, help="of the decoded signals, Hz (%(default)g)"
    )
    parser.add_argument("--results", type=Path, default=Path("foreign-buses.jsonl"))
    parser.add_argument("--jobs", type=int, default=1, help="processes (%(default)d)")
    parser.add_argument(
        "--at-most",
        type=int,
        metavar="N",
        help="those on the default bus, then a sample",
    )
    parser.add_argument("--seed", type=int, default=1, help="(%(default)d)")
    parser.add_argument("-v", "--verbose", action="store_true", help="what is wrong, and why")
    return parser


def _cases(folder: Path, given: argparse.Namespace) -> Iterable[Replay]:
    """Recordings of a folder as they are; without those of units that are not calibrated."""
    for row in read_rows(folder / "truth.csv"):
        path, actuator = folder / row["file"], ""
        if given.only and path.stem not in given.only:
            continue
        if row.get("unit"):
            unit = given.calibrated / f"{row['unit']}.toml" if given.calibrated else None
            if unit is None or not unit.is_file() or "-new-" in path.name:
                continue
            actuator = str(unit)
        a, b, c = (float(row[name]) for name in FAULT_NAMES)
        yield Replay(str(path), (a, b, c), actuator, DEFAULT, Disturbance(), given.rate, given.seed)


def _runs(case: Replay, given: argparse.Namespace) -> Iterable[Replay]:
    """One recording on the default bus, then on each bus with each jitter."""
    yield case
    name = [*Path(case.recording).stem.encode()]
    buses = given.bus or [*(item.name for item in BUSES), DAQ]
    for bus, jitter in itertools.product(buses, given.jitter or JITTERS_MS):
        rng = np.random.default_rng([given.seed, *name, *bus.encode(), round(1e3 * jitter)])
        drawn = round(float(rng.uniform(0.0, MOST_LEAD_IN_S)), 3)
        how = Disturbance(
            jitter,
            drawn if given.lead_in is None else given.lead_in,
            given.drift,
            given.batch,
            given.lost,
            kept=not given.unordered,
        )
        seed = int(rng.integers(1 << 31))
        yield Replay(case.recording, case.severities, case.actuator, bus, how, case.rate, seed)


def _show(found: Sequence[Found], *, verbose: bool) -> None:
    """One line for each bus and jitter."""
    usual = {run.recording: got["verdict"] for run, got in found if run.bus == DEFAULT}
    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    names = [DEFAULT, *(item.name for item in BUSES), DAQ]
    rows = {(run.bus, run.how.jitter_ms) for run, _ in found}
    for bus, jitter in sorted(rows, key=lambda row: (names.index(row[0]), row[1])):
        part = [item for item in found if (item[0].bus, item[0].how.jitter_ms) == (bus, jitter)]
        print("| " + " | ".join([bus, f"{jitter:g} ms", *_cells(part, usual)]) + " |")
    for run, got in found if verbose else ():
        name = f"{Path(run.recording).stem} on {run.bus}, {run.how.jitter_ms:g} ms"
        where = f"{name}, lead-in {run.how.lead_in_s:g} s"
        if got["verdict"] != usual[run.recording] or not all(got["covered"]):
            error = "" if got["error"] is None else f" {100 * got['error']:.3f} % {got['covered']}"
            print(f"{where}: {got['verdict']}{error} {got['why']}")
            print(*(f"    {note}" for note in got["notes"]), sep="\n")


def _cells(part: Sequence[Found], usual: dict[str, str]) -> list[str]:
    """Verdicts that agree with the default bus, wrong ones, mean and greatest error, coverage.

    Errors and coverage are of the recordings that got a verdict.
    """
    told = [
        (run, got)
        for run, got in part
        if got["verdict"] != Verdict.NOT_TESTED.name and got["error"] is not None
    ]
    same = sum(got["verdict"] == usual[run.recording] for run, got in part)
    wrong = sum(got["verdict"] != usual[run.recording] for run, got in told)
    errors = np.array([got["error"] for _, got in told])
    covered = [item for _, got in told for item in got["covered"]]
    size = [f"{100 * errors.mean():.3f} %", f"{100 * errors.max():.3f} %"] if told else ["", ""]
    return [f"{same} of {len(part)}", f"{wrong}", *size, f"{sum(covered)} of {len(covered)}"]
