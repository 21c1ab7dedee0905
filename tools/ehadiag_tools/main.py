"""`tools/study NAME …`: the studies behind the documentation's figures."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from ehadiag_tools.accuracy.cases import CUBE, PAPER_CASES, UNITS
from ehadiag_tools.accuracy.pictures import PICTURES
from ehadiag_tools.accuracy.verdicts import ALARMS, HARDWARE, RECORDED_UNITS, VALVES
from ehadiag_tools.bench import BENCH
from ehadiag_tools.free_motion.motion import FREE_MOTION
from ehadiag_tools.onboard.study import ONBOARD, ONBOARD_UNITS
from ehadiag_tools.prognosis.units import PROGNOSIS
from ehadiag_tools.rigs.replay import DAQ_RECORDINGS, FOREIGN_BUSES
from ehadiag_tools.simulator.units import RECORDINGS
from ehadiag_tools.soak import SOAK
from ehadiag_tools.study import Study, run_study

STUDIES: tuple[Study[Any], ...] = (
    PAPER_CASES, CUBE, UNITS, RECORDED_UNITS, VALVES, ALARMS, HARDWARE, RECORDINGS,
    FREE_MOTION, FOREIGN_BUSES, DAQ_RECORDINGS, PROGNOSIS, ONBOARD,
    ONBOARD_UNITS, SOAK, BENCH, PICTURES,
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Perform the study that the command line names; return the exit code."""
    parser = argparse.ArgumentParser(prog="study", description=__doc__)
    parser.add_argument("--list", action="store_true", help="list the studies, as without a name")
    named = parser.add_subparsers(dest="name", metavar="NAME")
    for item in STUDIES:
        own = named.add_parser(item.name, help=item.summary, description=item.summary)
        item.add_arguments(own)
        own.set_defaults(study=item)
    options = parser.parse_args(arguments)
    if options.name is not None:
        return run_study(options.study, options)
    for item in STUDIES:
        print(f"{item.name:16} {item.summary}")
    return 0
