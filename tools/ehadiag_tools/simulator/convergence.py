"""`tools/convergence`: error of the simulator against its integration step, by a stiff solver.

The currents of a whole stored test (closed loop: of one simulated run) drive both.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import numpy as np

from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import POSITION, PRESSURE, SPOOL
from ehadiag.core.errors import ConfigurationError, EhadiagError
from ehadiag.core.stored_test import resolve_test
from ehadiag_sim.plant.conditions import Faults
from ehadiag_sim.plant.dynamics import respond
from ehadiag_sim.plant.simulator import simulate
from ehadiag_tools.simulator.stiff_reference import StiffReference
from ehadiag_tools.simulator.unit_convergence import unit_table

__all__ = ["main"]

STEPS_US = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
LSB = np.array([[SPOOL.lsb], [PRESSURE.lsb], [POSITION.lsb]])


def main(argv: Sequence[str] | None = None) -> int:
    """Print one table per test; exit code 0, or that of the error."""
    parser = argparse.ArgumentParser(prog="convergence", description=__doc__)
    parser.add_argument("--test", action="append", help="stored test (default: open and closed)")
    parser.add_argument(
        "--faults",
        type=float,
        nargs=3,
        default=(0.3, 0.6, 0.3),
        metavar=("KINTAS", "FSS", "FDJ"),
        help="severities (%(default)s)",
    )
    parser.add_argument("--ticks", type=int, help="only the first so many ticks")
    parser.add_argument(
        "--steps", type=float, nargs="+", default=STEPS_US, help="steps, µs (%(default)s)"
    )
    parser.add_argument(
        "--units",
        type=int,
        default=0,
        metavar="N",
        help="instead of the stiff solver: N random units of either stage and friction",
    )
    options = parser.parse_args(argv)
    try:
        if options.ticks is not None and options.ticks < 1:
            raise ConfigurationError(f"--ticks {options.ticks}: need at least 1")
        faults = Faults(*options.faults)
        for name in options.test or ("open", "closed"):
            if options.units:
                unit_table(resolve_test(name), options.units, options.steps, options.ticks)
                continue
            table(name, faults, options.steps, options.ticks)
    except EhadiagError as error:
        print(f"convergence: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def table(name: str, faults: Faults, steps_us: Sequence[float], ticks: int | None) -> None:
    """Print step, error in LSB rms (largest), order against the row above, run time."""
    actuator, test = default_actuator(), resolve_test(name)
    currents = simulate(actuator, test, faults).current[:ticks]
    span = len(currents) / test.rate
    began = time.perf_counter()
    solver = StiffReference(actuator, faults.Kintas, faults.FSS, faults.FDJ)
    reference = solver.respond(currents)
    stiff = time.perf_counter() - began
    print(
        f"Test {name}, Kintas {faults.Kintas:g}, FSS {faults.FSS:g}, FDJ {faults.FDJ:g}: "
        f"{span:g} s, spool broke away {solver.slides[1]} times, jack {solver.slides[2]} times; "
        f"stiff solver {stiff:.1f} s\n"
    )
    print("| step, µs | spool | order | pressure | order | position | run, s | real time / run |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    before: tuple[float, np.ndarray] | None = None
    for step in steps_us:
        respond(actuator, currents[:1], faults, step=step * 1e-6)
        began = time.perf_counter()
        answer = respond(actuator, currents, faults, step=step * 1e-6)
        run = time.perf_counter() - began
        gap = (answer - reference) / LSB
        rms, largest = np.sqrt((gap**2).mean(axis=1)), np.abs(gap).max(axis=1)
        orders = ["–"] * 3
        if before is not None and (rms > 0.0).all():
            ratio = np.log(before[1] / rms) / np.log(before[0] / step)
            orders = [f"{value:.2f}" for value in ratio]
        cells = [f"{a:.4f} ({b:.2f})" for a, b in zip(rms, largest, strict=True)]
        print(
            f"| {step:g} | {cells[0]} | {orders[0]} | {cells[1]} | {orders[1]} | {cells[2]} "
            f"| {run:.2f} | {span / run:.0f} |",
            flush=True,
        )
        before = step, rms
    print()
