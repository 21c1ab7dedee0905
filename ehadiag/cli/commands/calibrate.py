"""`ehadiag calibrate`: learns a unit from recordings of it, as an actuator file of its own."""

from __future__ import annotations

import argparse
import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import asked_for, options
from ehadiag.cli.exit_codes import worst_code
from ehadiag.cli.interrupt import interrupt_on_signals, keep_signals
from ehadiag.cli.matplotlib_alone import matplotlib_alone
from ehadiag.cli.output import emit, failure_said, progress_bar, rendered, say, say_if_compiling
from ehadiag.cli.report_page import add_report_option, calibration_report, need_report_library
from ehadiag.cli.results import make_folder
from ehadiag.core.errors import ConfigurationError, InputOutputError, NotTestedError, reason_of
from ehadiag.core.stored_test import resolve_test

if TYPE_CHECKING:
    from ehadiag.calibration.result import Calibrated
    from ehadiag.core.actuator import Actuator
    from ehadiag.core.calibration import Source
    from ehadiag.core.folder import Folder
    from ehadiag.core.recording import Recording

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "calibrate",
        help="learn a unit from recordings of it as new, as an actuator file",
        description="Learn data and effects of one unit from recordings of it as new, at least one"
        " of each loop, and write an actuator file for `diagnose --actuator`.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="LOG",
        help="recording of the unit as new; of a log with several tests its last complete one",
    )
    parser.add_argument(
        "--out", required=True, metavar="FILE", help="actuator file to write, .toml; with a picture"
    )
    parser.add_argument(
        "--test",
        action="append",
        default=[],
        metavar="FILE",
        help="test (file) that a log may be of, besides the stored ones; repeatable",
    )
    parser.add_argument("--all", action="store_true", help="every test in a log, not its last one")
    parser.add_argument(
        "--update",
        action="store_true",
        help="refine the calibrated --actuator by later recordings, still healthy",
    )
    parser.add_argument(
        "--compare",
        action="store_true",
        help="try each second stage and hysteresis; print the evidence",
    )
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_log_options(parser)
    options.add_seed_option(parser, "seed of the search")
    options.add_json_option(parser)
    add_report_option(parser, "beside the actuator file, also where nothing was learned")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate; return the exit code."""
    start = asked_for.the_actuator(arguments)
    out = _place(arguments)
    if arguments.report:
        need_report_library()
    # What cannot be written is said before anything slow.
    with make_folder(str(out.parent)) as folder:
        say_if_compiling()
        recordings, digests = _read(arguments)
        found = _learn(arguments, start, recordings, digests)
        keep_signals()
        codes = [0 if found.actuator is not None else NotTestedError.exit_code]
        written = _bring_out(arguments, folder, out, found, codes)
    # What was learned is printed also where it could not be written.
    with failure_said(codes):
        _print(found, as_json=arguments.json)
    if written:
        say("wrote " + ", ".join(str(item) for item in written))
    return worst_code(codes)


def _print(found: Calibrated, *, as_json: bool) -> None:
    from ehadiag.report.calibration import (  # noqa: PLC0415
        calibration_json,
        print_calibration,
    )

    if as_json:
        emit(calibration_json(found) + "\n")
    else:
        emit(rendered(lambda console: print_calibration(found, console)))


def _bring_out(
    arguments: argparse.Namespace, folder: Folder, out: Path, found: Calibrated, codes: list[int]
) -> list[Path]:
    """Write file and picture of what was learned, and the report; return what was written.

    What cannot be written is said, and its exit code added to `codes`.
    """
    written = []
    if found.actuator is not None:
        with failure_said(codes):
            _write(folder, out.name, found.actuator, replaced=arguments.update)
            written.append(out)
            _draw(folder, _picture(out).name, found)
            written.append(_picture(out))
    if arguments.report:
        with failure_said(codes):
            _report(folder, _page(out).name, found)
            written.append(_page(out))
    return written


def _place(arguments: argparse.Namespace) -> Path:
    """Where to write: refused before anything slow where that cannot be."""
    out = Path(arguments.out)
    if out.suffix != ".toml":
        raise ConfigurationError(f"--out {arguments.out}: an actuator file's name ends in .toml")
    if arguments.update and not arguments.actuator:
        raise ConfigurationError("--update: needs --actuator, the calibrated file to refine")
    if arguments.update and arguments.compare:
        raise ConfigurationError("--update keeps the model that was chosen: --compare does nothing")
    same = arguments.update and _is_same(out, Path(arguments.actuator))
    beside = (_picture(out), _page(out)) if arguments.report else (_picture(out),)
    for path in () if same else (out, *beside):
        if os.path.lexists(path):
            raise ConfigurationError(
                f"--out {arguments.out}: {path.name} exists; name another file, or remove it"
            )
    return out


def _is_same(one: Path, other: Path) -> bool:
    return one.exists() and other.exists() and one.samefile(other)


def _picture(out: Path) -> Path:
    return out.with_suffix(".png")


def _page(out: Path) -> Path:
    return out.with_suffix(".html")


def _read(arguments: argparse.Namespace) -> tuple[list[Recording], list[str]]:
    """Read what is learned from, and digests of the logs, one of each recording."""
    from firmware_iface.logs.reader import (  # noqa: PLC0415 - loads cantools
        read_recording,
        read_recordings,
    )

    bus_map, budget = asked_for.the_bus_map(arguments), asked_for.the_budget(arguments)
    interrupt_on_signals()
    recordings, digests = [], []
    for log in arguments.logs:
        every = read_recordings if arguments.all else None
        found = (
            list(every(log, bus_map, budget)) if every else [read_recording(log, bus_map, budget)]
        )
        recordings += found
        digests += [_digest(log)] * len(found)
    return recordings, digests


def _digest(log: str) -> str:
    try:
        with Path(log).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputOutputError(f"log {log}: {reason_of(error)}") from None


def _learn(
    arguments: argparse.Namespace,
    start: Actuator,
    recordings: Sequence[Recording],
    digests: Sequence[str],
) -> Calibrated:
    from ehadiag.assess.diagnosis import match_tests  # noqa: PLC0415 - loads numba
    from ehadiag.calibration.unit import calibrate, update  # noqa: PLC0415

    tests = asked_for.known_tests(arguments.test)
    default = resolve_test(arguments.test[0]) if len(arguments.test) == 1 else None
    matched = match_tests(recordings, tests, default)
    sources = [
        _source(recording, test.name if test else "", digest)
        for recording, test, digest in zip(recordings, matched, digests, strict=True)
    ]
    with progress_bar() as progress:
        if arguments.update:
            return update(
                recordings,
                start,
                tests,
                default=default,
                sources=sources,
                seed=arguments.seed,
                progress=progress,
            )
        return calibrate(
            recordings,
            start,
            tests,
            default=default,
            sources=sources,
            compare=arguments.compare,
            seed=arguments.seed,
            progress=progress,
        )


def _source(recording: Recording, test: str, digest: str) -> Source:
    from ehadiag.core.calibration import Source  # noqa: PLC0415
    from ehadiag.core.printable import valid_text  # noqa: PLC0415

    return Source(name=valid_text(Path(recording.source).name), test=test, sha256=digest)


def _write(folder: Folder, name: str, unit: Actuator, *, replaced: bool) -> None:
    from ehadiag.core.actuator_file import actuator_toml  # noqa: PLC0415

    try:
        put = folder.write if replaced else folder.write_new
        put(name, actuator_toml(unit))
    except OSError as error:
        raise InputOutputError(f"actuator file {folder.path / name}: {reason_of(error)}") from None


def _draw(folder: Folder, name: str, found: Calibrated) -> None:
    with matplotlib_alone():
        from ehadiag.report.calibration_picture import draw_calibration  # noqa: PLC0415 - slow
    try:
        folder.write(name, draw_calibration(found))
    except OSError as error:
        place = folder.path / name
        raise InputOutputError(f"picture {place}: {reason_of(error)}") from None


def _report(folder: Folder, name: str, found: Calibrated) -> None:
    try:
        folder.write(name, calibration_report(found))
    except OSError as error:
        raise InputOutputError(f"report {folder.path / name}: {reason_of(error)}") from None
