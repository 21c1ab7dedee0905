"""False alarms of the monitor in hours of random motion, and how soon it finds a fault that grew.

    tools/free_motion --motion-hours 12 --jobs 2
    tools/free_motion --delays --jobs 2

The monitored unit is the detailed simulator, moved at random in current and in position mode from
rest, a minute at a time. False alarms: its severities are drawn anew for each minute, and the
monitor knows them. Delays: one severity is more than the monitor knows. An interval of a rate is
Garwood's (Biometrika 28, 1936), 95 %.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import joblib
import numpy as np
from scipy.stats import chi2

from ehadiag.cli.watch.persistence import Persistence
from ehadiag.cli.watch.watcher import QUIET_S
from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import CommandMode
from ehadiag.monitor import FreeMotionMonitor, Monitor, undecided_spool
from ehadiag_sim.plant.conditions import Faults
from ehadiag_tools.free_motion.motion import STEP, free_motion

__all__ = ["Case", "Outcome", "garwood", "main", "watch"]

MINUTE_S = 60.0
WORST = 0.7
"""Severities of the false-alarm study are drawn evenly from 0 … this."""
BASE = 0.3
"""Severities that the monitor knows in the study of delays."""
GROWTHS = (0.05, 0.1, 0.2)
NAMES = ("Kintas", "FSS", "FDJ")
SIGNALS = ("spool above", "spool below", "pressure above", "pressure below")


@dataclass(frozen=True, slots=True)
class Case:
    """One minute of motion."""

    mode: CommandMode
    known: tuple[float, float, float]
    """Severities that the monitor is told."""
    true: tuple[float, float, float]
    seed: int
    hours: float
    """Between false alarms, as asked of the monitor."""
    seconds: float = MINUTE_S
    step: float = STEP
    """Of the simulator, s."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the monitor said in one minute."""

    alarms: tuple[tuple[int, int], ...]
    """Tick and sum (see `SIGNALS`) of each alarm of the sums."""
    lasting: tuple[int, ...]
    """Ticks of the alarms that `ehadiag monitor` raises: of what lasts, ten seconds apart."""
    resting: float
    """Share of ticks in which the pressure said nothing."""
    cost_s: float
    """Processor time."""


def watch(case: Case) -> Outcome:
    """Move the simulated unit for a minute and push all of it into a monitor.

    Parameters
    ----------
    case : Case
        Which minute.

    Returns
    -------
    Outcome
        Its alarms.
    """
    began = time.process_time()
    actuator = default_actuator()
    faults = Faults(*case.true)
    rows = free_motion(actuator, faults, case.mode, case.seconds, case.seed, case.step)
    inner = Monitor(actuator, case.known, mode=case.mode, hours=case.hours)
    monitor = FreeMotionMonitor(inner, undecided_spool(actuator, case.known[2]))
    alarms, resting, persistence = [], 0, Persistence(actuator.controller.rate)
    lasting: list[int] = []
    for tick, row in enumerate(rows.tolist()):
        reading = monitor.push(tuple(row))
        resting += bool(np.isnan(reading.residual[1]))
        if monitor.settled and reading.alarmed.any():
            alarms += [(tick, int(item)) for item in np.flatnonzero(reading.alarmed)]
            apart = not lasting or tick - lasting[-1] >= QUIET_S * actuator.controller.rate
            if persistence.take(tick) and apart:
                lasting.append(tick)
    cost = time.process_time() - began
    return Outcome(tuple(alarms), tuple(lasting), resting / len(rows), cost)


def garwood(count: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a Poisson mean of which so many were seen."""
    low = 0.0 if count == 0 else float(chi2.ppf(0.025, 2 * count)) / 2.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="free_motion", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--motion-hours", type=float, default=0.2, metavar="H", help="of motion (default 0.2)"
    )
    parser.add_argument(
        "--hours", type=float, default=0.5, metavar="H", help="between false alarms (default 0.5)"
    )
    parser.add_argument("--delays", action="store_true", help="study delays instead")
    parser.add_argument(
        "--pieces", type=int, default=2, metavar="N", help="of motion, for each delay (default 2)"
    )
    parser.add_argument(
        "--piece", type=float, default=MINUTE_S, metavar="S", help="length of one (default 60)"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    parser.add_argument(
        "--step",
        type=float,
        default=STEP * 1e6,
        metavar="US",
        help="of the simulator, µs (%(default)g)",
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default 1)")
    arguments = parser.parse_args(argv)
    if arguments.delays:
        _delays(arguments)
    else:
        _false_alarms(arguments)
    return 0


def _false_alarms(arguments: argparse.Namespace) -> None:
    minutes = max(round(arguments.motion_hours * 3600.0 / arguments.piece), 1)
    rng = np.random.default_rng(arguments.seed)
    cases = []
    for number in range(minutes):
        known = tuple(float(value) for value in rng.uniform(0.0, WORST, 3))
        mode = CommandMode.POSITION if number % 2 else CommandMode.CURRENT
        severities = (known[0], known[1], known[2])
        seed = arguments.seed + number
        cases.append(
            Case(
                mode,
                severities,
                severities,
                seed,
                arguments.hours,
                arguments.piece,
                arguments.step / 1e6,
            )
        )
    found = _run(cases, arguments.jobs)
    for mode in (*CommandMode, None):
        chosen = [b for a, b in zip(cases, found, strict=True) if mode in (None, a.mode)]
        if chosen:
            hours = len(chosen) * arguments.piece / 3600.0
            _tell(mode.name.lower() if mode else "both", chosen, hours, arguments.hours)
    spent = sum(item.cost_s for item in found)
    each = spent / minutes * 3600.0 / arguments.piece
    print(f"seed {arguments.seed}; processor time {spent:.0f} s, {each:.0f} s an hour of motion")
    for case, outcome in zip(cases, found, strict=True):
        if outcome.alarms:
            told = ", ".join(f"{value:.2f}" for value in case.known)
            sums = ", ".join(sorted({SIGNALS[which] for _, which in outcome.alarms}))
            spans = f"{outcome.alarms[0][0]} … {outcome.alarms[-1][0]}"
            print(f"  seed {case.seed} {case.mode.name.lower()} ({told}): {sums}; ticks {spans}")


def _tell(label: str, found: Sequence[Outcome], length: float, hours: float) -> None:
    alarms = sum(len(item.lasting) for item in found)
    pieces = sum(bool(item.alarms) for item in found)
    low, high = garwood(alarms)
    resting = float(np.mean([item.resting for item in found]))
    print(
        f"{label:8s} {length:6.2f} h: {alarms} alarms, {alarms / length:.2f}/h"
        f" [{low / length:.2f}, {high / length:.2f}], stated {1.0 / hours:.2f}/h;"
        f" sums alarm in {pieces} of {len(found)} pieces; pressure rests {resting:.0%}"
    )


def _delays(arguments: argparse.Namespace) -> None:
    kinds = list(itertools.product(CommandMode, range(len(NAMES)), GROWTHS))
    cases = []
    for mode, fault, growth in kinds:
        for number in range(arguments.pieces):
            true = [BASE] * len(NAMES)
            true[fault] += growth
            cases.append(
                Case(
                    mode,
                    (BASE, BASE, BASE),
                    (true[0], true[1], true[2]),
                    arguments.seed + number,
                    arguments.hours,
                    arguments.piece,
                    arguments.step / 1e6,
                )
            )
    found = _run(cases, arguments.jobs)
    length = f"{arguments.pieces} × {arguments.piece:g} s"
    print(f"s to the first alarm of a sum; to that of what lasts; {length} of motion each")
    for place, (mode, fault, growth) in enumerate(kinds):
        part = found[place * arguments.pieces : (place + 1) * arguments.pieces]
        sums = [_first(item.alarms[0][0] if item.alarms else None) for item in part]
        raised = [_first(item.lasting[0] if item.lasting else None) for item in part]
        print(
            f"{mode.name.lower():8s} {NAMES[fault]:6s} +{growth:.2f}:"
            f" {', '.join(sums)}; {', '.join(raised)}"
        )
    spent = sum(item.cost_s for item in found)
    print(f"seed {arguments.seed}; processor time {spent:.0f} s")


def _first(tick: int | None) -> str:
    return "none" if tick is None else f"{tick / 1e3:.2f}"


def _run(cases: Sequence[Case], jobs: int) -> list[Outcome]:
    work = joblib.Parallel(n_jobs=jobs, return_as="generator")
    found: list[Outcome] = []
    for outcome in work(joblib.delayed(watch)(case) for case in cases):
        found.append(outcome)
        raised = sum(len(item.lasting) for item in found)
        print(f"\r{len(found)} of {len(cases)} pieces, {raised} alarms", end="", file=sys.stderr)
    print(file=sys.stderr)
    return found
