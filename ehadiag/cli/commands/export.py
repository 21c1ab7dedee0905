"""`ehadiag export`: the kernels as libraries and co-simulation units, without Python."""

from __future__ import annotations

import argparse
from pathlib import Path

from ehadiag.cli import argument_types, asked_for, options
from ehadiag.cli.output import put, say
from ehadiag.cli.results import make_folder
from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.false_alarms import HOURS_BETWEEN
from ehadiag.core.printable import printable

__all__ = ["add_parser", "run"]

COMPILING = "compiling; this may take half a minute"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "export",
        help="write the kernels as a library for another computer",
        description="Write monitor and identification as a static library with C headers for"
        " another computer. No cross compiler is needed.",
        allow_abbrev=False,
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--target", metavar="NAME", help="computer, see --list")
    what.add_argument(
        "--fmu",
        action="store_true",
        help="co-simulation units (FMI 2.0 and 3.0) of simulator and monitor, for this computer",
    )
    what.add_argument("--list", action="store_true", help="list the targets and exit")
    parser.add_argument("--out", metavar="DIR", help="folder to write into")
    parser.add_argument(
        "--hours",
        type=argument_types.positive,
        default=HOURS_BETWEEN,
        metavar="H",
        help="mean time between false alarms of the monitor (default %(default)g)",
    )
    options.add_actuator_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the export."""
    if arguments.list:
        from ehadiag.export.targets import TARGETS  # noqa: PLC0415 - loads the compiler

        width = max(len(item.name) for item in TARGETS)
        for item in TARGETS:
            put(f"{item.name:<{width}}  {item.meaning}")
        return 0
    if arguments.out is None:
        raise ConfigurationError("export: need --out DIR")
    actuator = asked_for.the_actuator(arguments)
    names = _units(arguments, actuator) if arguments.fmu else _library(arguments, actuator)
    for name in names:
        put(printable(str(Path(arguments.out) / name)))
    effects = actuator.calibration.effects if actuator.calibration else {}
    if any(effects.values()) and not arguments.fmu:
        say(
            "the exported code goes by the calibrated data, but knows none of the effects that the"
            f" calibration learned ({', '.join(sorted(effects))}): on this unit it will mostly find"
            " NOT TESTED"
        )
    return 0


def _units(arguments: argparse.Namespace, actuator: Actuator) -> list[str]:
    from ehadiag.export.fmu import export_fmus  # noqa: PLC0415 - loads the compiler

    with make_folder(arguments.out) as folder:
        say(COMPILING)
        return export_fmus(actuator, folder, hours=arguments.hours)


def _library(arguments: argparse.Namespace, actuator: Actuator) -> list[str]:
    from ehadiag.export.library import SHARED, export_library  # noqa: PLC0415
    from ehadiag.export.targets import target  # noqa: PLC0415

    chosen = target(arguments.target)
    with make_folder(arguments.out) as folder:
        say(COMPILING)
        names = export_library(actuator, chosen, folder, hours=arguments.hours)
    if chosen.processor.shared and SHARED not in names:
        say("no C compiler (cc, or what CC names): no shared library, only the static one")
    return names
