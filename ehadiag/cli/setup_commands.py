"""Commands without a recording or bus: `init`, `tests`, `export`, `warmup`, `completion`."""

from __future__ import annotations

import argparse
import csv
import os
import sys
import time
from functools import partial
from importlib import resources
from pathlib import Path

from ehadiag.cli import options
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.result_output import OutputFile, open_output_folder, refuse_overwriting
from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.request import TEST
from ehadiag.terminal.output import print_status, print_text, terminal_console, write_drawn
from firmware_iface.errors import (
    ConfigurationError,
    InputOutputError,
    install_command,
    printable,
    reason_of,
)
from firmware_iface.files import RESULT_MODE, Folder, write_errors, write_file
from firmware_iface.stored_test import COMMAND_UNITS, bundled_tests, resolve_test

FILE_TEMPLATES = {
    "actuator": (("ehadiag", "data/actuator.toml", "actuator.toml"),),
    "test": (("firmware_iface", "data/tests/open.toml", "test.toml"),),
    "mapping": (
        ("firmware_iface", "data/eha_fcc.toml", "mapping.toml"),
        ("firmware_iface", "data/eha_fcc.dbc", "eha_fcc.dbc"),
    ),
    "defaults": (("ehadiag", "data/templates/ehadiag.toml", "ehadiag.toml"),),
}
REFERENCE_PAGES = {
    "actuator": "actuator-file.md",
    "test": "test-file.md",
    "mapping": "mapping-file.md",
    "defaults": "command-line.md",
}


def define_init(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Write a commented template that works as it is: the reference actuator, the"
        " open-loop test, the computer's own bus with its DBC, or defaults of options."
    )
    parser.add_argument("kind", choices=tuple(FILE_TEMPLATES), help="which file")
    parser.add_argument(
        "folder", nargs="?", default=".", metavar="DIR", help="where (default: the working folder)"
    )
    show_help(parser, "ehadiag init actuator", "ehadiag init mapping my-bus")


def run_init(arguments: argparse.Namespace) -> int:
    """Write the files; none that is there is changed."""
    folder = Path(arguments.folder)
    files = FILE_TEMPLATES[arguments.kind]
    if os.path.lexists(folder) and not folder.is_dir():
        raise InputOutputError(f"{folder}: is no folder; name the one to write {files[0][2]} into")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with Folder.at(folder, RESULT_MODE, follow=True) as place:
            for _, _, name in files:
                if place.exists(name):
                    raise InputOutputError(f"{folder / name}: is there already, not overwritten")
            for package, source, name in files:
                content = resources.files(package).joinpath(source).read_bytes()
                place.write_new(name, content)
                print_text(os.fspath(folder / name))
    except FileExistsError as error:
        raise InputOutputError(
            f"{folder / str(error)}: is there already, not overwritten"
        ) from None
    except OSError as error:
        raise InputOutputError(f"folder {folder}: {reason_of(error)}") from None
    print_status(f"each key is explained in docs/reference/{REFERENCE_PAGES[arguments.kind]}")
    return 0


def define_tests(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = "List the stored tests; --csv prints time and command of one."
    parser.add_argument("--csv", metavar=TEST, help="test to print as CSV")
    show_help(parser, "ehadiag tests", "ehadiag tests --csv closed")


def run_tests(arguments: argparse.Namespace) -> int:
    """List the tests or print one."""
    if arguments.csv:
        test = resolve_test(arguments.csv)
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(["time_s", f"command_{test.unit}"])
        scale = COMMAND_UNITS[test.mode][test.unit]
        for time, value in zip(test.time(), test.command() / scale, strict=True):
            writer.writerow([f"{time:.9g}", f"{value:.9g}"])
        return 0
    from rich.table import Table  # noqa: PLC0415 - not for CSV

    table = Table(box=None, pad_edge=False)
    for name in ("id", "name", "command", "length", "rate", "description"):
        table.add_column(name, justify="right" if name in ("id", "length", "rate") else "left")
    for test in sorted(bundled_tests().values(), key=lambda item: item.id):
        table.add_row(
            str(test.id),
            test.name,
            f"{test.mode}, {test.unit}",
            f"{test.duration:g} s",
            f"{test.rate:g} Hz",
            test.description,
        )
    console = terminal_console()
    console.print(table)
    write_drawn(console)
    return 0


EXPORT_NOTICE = "compiling; this may take half a minute"


def define_export(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Write monitor and identification as a static library with C headers for"
        " another computer (no cross compiler is needed), simulation units, an A2L file, or the"
        " description of the UDS services."
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--target", metavar="NAME", help="computer, see --list")
    what.add_argument(
        "--fmu",
        action="store_true",
        help="co-simulation units (FMI 2.0 and 3.0) of simulator and monitor",
    )
    what.add_argument(
        "--a2l",
        action="store_true",
        help="A2L file (ASAM MCD-2 MC) of what the emulated computer measures by XCP",
    )
    what.add_argument(
        "--pdx",
        metavar="FILE",
        help="diagnostic description of the computer's UDS services (ODX 2.2); a file there is"
        " replaced",
    )
    what.add_argument("--list", action="store_true", help="list the targets and exit")
    parser.add_argument(
        "--platform",
        action="append",
        default=[],
        metavar="NAME",
        help="with --fmu: computer that the units run on: x86_64-linux, aarch64-linux,"
        " x86_64-windows, x86_64-darwin, aarch64-darwin or all; repeatable; needs ziglang (default"
        " this computer, by its C compiler)",
    )
    parser.add_argument("--out", metavar="DIR", help="folder to write into")
    parser.add_argument(
        "--hours",
        type=options.positive_number,
        default=FALSE_ALARM_INTERVAL_H,
        metavar="H",
        help="mean time between false alarms of the monitor (default %(default)g)",
    )
    options.add_request_options(parser, "actuator", "mapping", "dbc", "id_offset")
    options.add_xcp_option(parser, "with --a2l: how the computer is reached")
    show_help(
        parser,
        "ehadiag export --target cortex-m7 --out eha-m7",
        "ehadiag export --fmu --platform all --out units",
        usual="--target --list --out --actuator --hours --fmu --platform --a2l --pdx --help-all",
    )
    parser.set_defaults(run=partial(run_export, parser))


def run_export(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    """Write the export; `parser` knows the defaults."""
    if arguments.list:
        from ehadiag.export.targets import TARGETS  # noqa: PLC0415 - loads the compiler

        width = max(len(item.name) for item in TARGETS)
        for item in TARGETS:
            print_text(f"{item.name:<{width}}  {item.meaning}")
        return 0
    if not (arguments.a2l or arguments.pdx):
        for name in (*options.BUS, "xcp"):
            if getattr(arguments, name) != parser.get_default(name):
                raise ConfigurationError(
                    f"--{name.replace('_', '-')}: needs --a2l or --pdx; libraries and simulation"
                    " units know no bus"
                )
    if arguments.pdx:
        from ehadiag.export.pdx import pdx_content  # noqa: PLC0415 - not for help texts

        bus_map = options.setup_of(arguments).bus_map
        output = OutputFile("--pdx", arguments.pdx)
        refuse_overwriting(arguments, [output], [("the DBC", bus_map.name)])
        identifiers = bus_map.uds_identifiers
        write_file(Path(arguments.pdx), pdx_content(identifiers), "diagnostic description")
        print_text(printable(arguments.pdx))
        return 0
    if arguments.out is None:
        raise ConfigurationError("export: need --out DIR")
    if arguments.a2l:
        print_text(printable(str(Path(arguments.out) / _write_a2l(arguments))))
        return 0
    if arguments.platform and not arguments.fmu:
        raise ConfigurationError("--platform: needs --fmu")
    actuator = options.setup_of(arguments).actuator
    names = (
        _write_fmus(arguments, actuator) if arguments.fmu else _write_library(arguments, actuator)
    )
    for name in names:
        print_text(printable(str(Path(arguments.out) / name)))
    effects = actuator.calibration.effects if actuator.calibration else {}
    if any(effects.values()) and arguments.fmu:
        print_status(
            "the units go by the calibrated data, but know none of the effects that the calibration"
            f" learned ({', '.join(sorted(effects))})"
        )
    return 0


def _write_a2l(arguments: argparse.Namespace) -> str:
    from ehadiag.export.a2l import A2L_FILE, a2l_text  # noqa: PLC0415 - loads the simulator
    from firmware_iface.xcp import XcpIds  # noqa: PLC0415 - loads numpy

    setup = options.setup_of(arguments)
    text = a2l_text(setup.actuator, setup.bus_map, options.xcp_ids(arguments) or XcpIds())
    with open_output_folder(arguments.out) as folder, write_errors(f"A2L file {A2L_FILE}"):
        folder.write(A2L_FILE, text.encode("ascii"))
    return A2L_FILE


def _write_fmus(arguments: argparse.Namespace, actuator: Actuator) -> list[str]:
    from ehadiag.export.fmu import export_fmus  # noqa: PLC0415 - loads the compiler

    with open_output_folder(arguments.out) as folder:
        print_status(EXPORT_NOTICE)
        return export_fmus(actuator, folder, hours=arguments.hours, platforms=arguments.platform)


def _write_library(arguments: argparse.Namespace, actuator: Actuator) -> list[str]:
    from ehadiag.export.library import SHARED_LIBRARY_FILE, export_library  # noqa: PLC0415
    from ehadiag.export.targets import find_target  # noqa: PLC0415

    chosen = find_target(arguments.target)
    with open_output_folder(arguments.out) as folder:
        print_status(EXPORT_NOTICE)
        names = export_library(actuator, chosen, folder, hours=arguments.hours)
    if chosen.processor.shared and SHARED_LIBRARY_FILE not in names:
        print_status("no C compiler (cc, or what CC names): no shared library, only the static one")
    return names


def define_warmup(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Compile the model's kernels into the cache folder (EHADIAG_CACHE_DIR, else"
        " the user's cache), so that the first diagnosis does not wait for it."
    )
    show_help(parser, "ehadiag warmup", "ehadiag warmup --verbose")


def run_warmup(_arguments: argparse.Namespace) -> int:
    """Compile."""
    begin = time.perf_counter()
    from ehadiag.compile import libraries  # noqa: PLC0415 - not for help texts
    from firmware_iface.bus_map import default_map  # noqa: PLC0415

    absent = libraries.missing(libraries.SHIPPED)
    libraries.prepare(absent, print_status)
    default_map()  # keeps what it finds in the DBC
    folder = libraries.cache_folder()
    took = f"{time.perf_counter() - begin:.1f} s"
    if not absent:
        print_status("all kernels are there")
        return 0
    if folder is None:
        print_status(f"kernels compiled in {took}, and kept nowhere")
        return InputOutputError.exit_code
    print_status(f"kernels ready in {folder.path} after {took}")
    return 0


FILE_METAVARS, FOLDER_METAVARS = ("FILE", "LOG"), ("DIR",)
"""Metavariables whose values are paths."""


def define_completion(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Print a completion script: for bash, put its output into"
        " ~/.local/share/bash-completion/completions/ehadiag."
    )
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="which shell")
    show_help(parser, "ehadiag completion bash", "ehadiag completion zsh")


def run_completion(arguments: argparse.Namespace) -> int:
    """Print the script."""
    from ehadiag.cli.main import parser_and_commands  # noqa: PLC0415 - it has this module's parser

    parser, _ = parser_and_commands()
    try:
        import shtab  # noqa: PLC0415 - optional
    except ImportError:
        raise ConfigurationError(
            f"completion: needs shtab: {install_command('completion')}"
        ) from None
    for action in _all_actions(parser):
        names = action.metavar if isinstance(action.metavar, str) else ""
        if names.endswith(FILE_METAVARS):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        elif names.endswith(FOLDER_METAVARS):
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    print_text(shtab.complete(parser, arguments.shell))
    return 0


def _all_actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """All options and arguments, of all commands."""
    found: list[argparse.Action] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                found += _all_actions(command)
        else:
            found.append(action)
    return found
