"""`ehadiag check-bus`: listens, and reports which signals of a bus are usable."""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import argument_types, asked_for, bus_options, options
from ehadiag.cli.interrupt import stop_on_signals
from ehadiag.cli.matplotlib_alone import matplotlib_alone
from ehadiag.cli.output import progress_bar, put, say
from ehadiag.cli.would_diagnose import Outlook, outlook
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import conversion_of
from ehadiag.core.errors import InputOutputError, reason_of
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.printable import valid_text
from ehadiag.core.recording import Samples

if TYPE_CHECKING:
    from firmware_iface.session.bus_report import BusReport

__all__ = ["add_parser", "run"]

SCHEMA = "ehadiag.bus/1"
NOT_USABLE = 30
POLL_S = 0.05


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "check-bus",
        help="listen to a bus and report what maps, rates, gaps, range use",
        description="Listen to a bus (or read a recording) without sending anything, and report"
        " what maps, what is missing, rates, gaps, and the range use of each channel."
        " Exit code 30 where something stands in the way of a diagnosis.",
        allow_abbrev=False,
    )
    parser.add_argument("--log", metavar="LOG", help="check a recording instead of a bus")
    parser.add_argument(
        "--duration",
        type=argument_types.positive,
        default=3.0,
        metavar="S",
        help="how long to listen (default 3)",
    )
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    parser.add_argument(
        "--plot", metavar="FILE", help="draw each channel over time, PNG; a file there is replaced"
    )
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_log_options(parser)
    bus_options.add_bus_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Listen and report."""
    bus_options.need_bus_or_log(arguments)
    bus_map, actuator = asked_for.the_bus_map(arguments), asked_for.the_actuator(arguments)
    from firmware_iface.logs.reader import read_frames  # noqa: PLC0415
    from firmware_iface.session.assembler import Assembler  # noqa: PLC0415 - loads python-can
    from firmware_iface.session.bus_report import render, report_bus  # noqa: PLC0415
    from firmware_iface.transport.receiver import Receiver  # noqa: PLC0415

    if arguments.log is not None:
        table = read_frames(arguments.log, asked_for.the_budget(arguments))
        heard = f"log {arguments.log}"
    else:
        with (
            bus_options.open_transport(arguments, transmit=False) as transport,
            Receiver(transport) as receiver,
            stop_on_signals(after_s=arguments.duration) as stop,
            progress_bar() as display,
        ):
            collected = Assembler(transport.name, bus_map)
            begin = time.monotonic()
            while not stop.is_set():
                frame = receiver.receive(POLL_S)
                if frame is not None:
                    collected.add(frame)
                display("listening", (time.monotonic() - begin) / arguments.duration)
            listened = time.monotonic() - begin
        table = collected.table()
        heard = f"listened to {transport.name} for {listened:.1f} s, sent nothing"
    report = report_bus(table, bus_map)
    seen = outlook(table, bus_map, actuator, asked_for.known_tests([]))
    report = _as_diagnosed(report, seen)
    if arguments.json:
        content = {"schema": SCHEMA, "source": valid_text(heard), **dataclasses.asdict(report)}
        put(json.dumps({**content, "test": seen.test or None}))
    else:
        put(heard)
        put(render(report))
    code = NOT_USABLE if report.problems else 0
    if arguments.plot and seen.heard is None:
        say(f"--plot {arguments.plot}: no sample of a channel was heard, nothing is drawn")
    elif arguments.plot and seen.heard is not None:
        _plot(Path(arguments.plot), seen.heard, actuator, heard)
    return code


def _plot(path: Path, samples: Samples, actuator: Actuator, heard: str) -> None:
    """Draw what was heard, and say where."""
    with matplotlib_alone():
        from ehadiag.report.picture_bus import draw_bus  # noqa: PLC0415 - matplotlib is slow
    content = draw_bus(samples, conversion_of(samples, actuator), heard)
    try:
        with Folder.at(path.parent, RESULT_MODE, follow=True) as folder:
            folder.write(path.name, content)
    except OSError as error:
        raise InputOutputError(f"picture {path}: {reason_of(error)}") from None
    say(f"wrote {path}")


def _as_diagnosed(report: BusReport, seen: Outlook) -> BusReport:
    """Let what a diagnosis says of a whole test decide, and add what motion contradicts."""
    if not seen.test:
        return replace(report, problems=(*report.problems, *seen.units))
    told = f"test {seen.test!r} is in it whole"
    if seen.refused:
        why = tuple(f"a diagnosis of test {seen.test!r} refuses: {item}" for item in seen.refused)
        return replace(report, problems=(*report.problems, *seen.units, *why))
    # What a diagnosis bears stands in nobody's way.
    remarks = (*report.remarks, *report.problems, f"{told}, and a diagnosis takes it")
    return replace(report, problems=seen.units, remarks=remarks)
