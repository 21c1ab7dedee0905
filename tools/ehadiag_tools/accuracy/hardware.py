"""`tools/hardware`: verdicts on broken hardware, and the processor time that they take.

Every kind of broken hardware that the simulator plays (docs/reference/broken-hardware.md), sizes
drawn anew in every case. Even cases are of actuators as new (severities 0 to 0.2), odd ones have
severities uniform in the cube. Nothing broken may be HEALTHY unless its kind may be hidden, and no
verdict may be of a wrong class. Results are kept in a file of JSON lines, so that a run that was
broken off goes on where it stood.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ehadiag.assess.diagnosis import Diagnosis, diagnose
from ehadiag.assess.verdict import Levels, Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import bundled_tests, resolve_test
from ehadiag_sim.faults.hardware import KINDS, broken
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.accuracy.resume import carry_out, perform_all
from ehadiag_tools.simulator.units import COARSE_STEP

__all__ = ["HardwareRun", "main", "perform_broken", "row_of", "wrong_class"]

TESTS = ("open", "closed")
HEADINGS = (
    "test", "kind", "HEALTHY", "DEGRADED", "FAULT", "NOT TESTED", "not allowed",
    "median, s", "longest, s",
)  # fmt: skip
MARGIN = 0.02
"""Of a severity about a level, within which either class will do."""
AS_NEW = 0.2
"""Largest severity of an actuator as new."""


@dataclass(frozen=True, slots=True)
class HardwareRun:
    """Settings of one diagnosis; what it gives depends on nothing else but the code."""

    test: str
    kind: str
    case: int
    seed: int


def perform_broken(run: HardwareRun) -> dict[str, Any]:
    """Break hardware, record a test, diagnose it; processor time of the diagnosis alone."""
    _warm(run.test)
    recording, faults = _broken(run)
    begin = time.process_time()
    found = _diagnosed(recording)
    spent = time.process_time() - begin
    estimates = found.identification.estimates if found.identification else ()
    return {
        **asdict(run),
        "faults": faults,
        "verdict": found.verdict.name,
        "reasons": list(found.reasons),
        "interval95": [list(item.interval95) for item in estimates],
        "not_allowed": _is_not_allowed(found, faults, run.kind),
        "processor_s": spent,
    }


def wrong_class(found: Diagnosis, faults: Sequence[float]) -> bool:
    """Whether a verdict is of another class than the truth, although the intervals exclude that.

    Another nuisance than the faults may make it DEGRADED.
    """
    levels, worst = Levels(), max(faults)
    if found.verdict is Verdict.HEALTHY:
        return worst > levels.advisory + MARGIN
    if found.verdict is Verdict.NOT_TESTED or found.identification is None:
        return False
    tops = [item.interval95[1] for item in found.identification.estimates]
    lows = [item.interval95[0] for item in found.identification.estimates]
    if found.verdict is Verdict.FAULT:
        return worst < levels.limit - MARGIN and max(lows) > levels.limit
    if worst > levels.limit + MARGIN:
        return max(tops) < levels.limit
    return worst < levels.advisory - MARGIN and max(lows) > levels.advisory


def row_of(records: Sequence[dict[str, Any]], test: str, kind: str) -> list[str]:
    """Cells of the table for the records of one kind."""
    count = Counter(record["verdict"] for record in records)
    times = [record["processor_s"] for record in records]
    return [
        test,
        kind,
        *(str(count[verdict.name]) for verdict in Verdict),
        str(sum(record["not_allowed"] for record in records)),
        f"{np.median(times):.2f}",
        f"{max(times):.2f}",
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; exit code 0, 1 if a verdict was not allowed, or that of the error."""
    options = _parser().parse_args(argv)
    return carry_out("hardware", options.results, lambda: _perform(options))


def _perform(options: argparse.Namespace) -> int:
    if options.cases < 1 or options.jobs < 1:
        raise ConfigurationError("--cases and --jobs: need at least 1")
    runs = [
        HardwareRun(test, kind, case, options.seed)
        for test in options.test or TESTS
        for kind in options.kind or KINDS
        for case in range(options.cases)
    ]
    records = perform_all(perform_broken, runs, options.results, options.jobs, "broken hardware")
    _print_table(records)
    if options.reasons:
        _print_reasons(records)
    return int(any(record["not_allowed"] for record in records))


def _print_table(records: Sequence[dict[str, Any]]) -> None:
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault((record["test"], record["kind"]), []).append(record)
    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    for (test, kind), group in groups.items():
        print("| " + " | ".join(row_of(group, test, kind)) + " |")
    print("| " + " | ".join(row_of(records, "both", "all")) + " |", flush=True)


def _print_reasons(records: Sequence[dict[str, Any]]) -> None:
    for record in records:
        faults = ", ".join(f"{value:.2f}" for value in record["faults"])
        mark = " NOT ALLOWED" if record["not_allowed"] else ""
        print(
            f"{record['test']} {record['kind']} case {record['case']} ({faults}): "
            f"{record['verdict']}{mark}, {record['processor_s']:.2f} s"
        )
        for reason in record["reasons"]:
            print(f"  - {reason}")


def _broken(run: HardwareRun) -> tuple[Recording, list[float]]:
    """Record the case; also its true severities."""
    place = list(KINDS).index(run.kind)
    rng = np.random.default_rng([run.seed, TESTS.index(run.test), place, run.case])
    faults = rng.uniform(0.0, 1.0 if run.case % 2 else AS_NEW, 3).tolist()
    recording = broken(
        run.kind,
        rng,
        default_actuator(),
        resolve_test(run.test),
        Faults(*faults),
        step=COARSE_STEP,
    )
    return recording, faults


def _diagnosed(recording: Recording) -> Diagnosis:
    return diagnose([recording], default_actuator(), bundled_tests().values())


@cache
def _warm(test: str) -> None:
    """Load what is compiled, once in a process, so that no case is charged with it."""
    for kind in ("clogged-nozzle", "scaled-position"):
        _diagnosed(_broken(HardwareRun(test, kind, 0, 0))[0])


def _is_not_allowed(found: Diagnosis, faults: Sequence[float], kind: str) -> bool:
    if found.verdict is Verdict.HEALTHY and not KINDS[kind].hidden:
        return True
    return wrong_class(found, faults)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hardware", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--test", action="append", choices=TESTS, help="may be repeated (both)")
    add("--kind", action="append", choices=list(KINDS), help="may be repeated (all)")
    add("--cases", type=int, default=20, help="of each kind and test (%(default)d)")
    add("--seed", type=int, default=1, help="of the cases (%(default)d)")
    add("--reasons", action="store_true", help="list every case with its reasons, too")
    add(
        "--results",
        type=Path,
        default=Path("build/hardware.jsonl"),
        help="what is done (%(default)s)",
    )
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (%(default)d)")
    return parser
