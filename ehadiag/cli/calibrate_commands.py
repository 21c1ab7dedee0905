"""Commands that write an actuator or test file: `calibrate` (unit), `design` (test)."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from ehadiag.cli import options
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.result_output import open_output_folder
from ehadiag.core.actuator import CalibrationSource, actuator_toml
from ehadiag.core.interruption import defer_signals, interrupt_on_signals
from ehadiag.report.rendering import calibration_html_page, isolated_png
from ehadiag.terminal.output import (
    TABLE_COLUMNS,
    print_compiling_notice,
    print_status,
    print_text,
    progress_bar,
    report_failure,
    terminal_console,
    worst_exit_code,
    write_drawn,
    write_output,
)
from firmware_iface.errors import (
    ConfigurationError,
    InputOutputError,
    NotTestedError,
    reason_of,
    valid_text,
)
from firmware_iface.files import RESULT_MODE, Folder, write_errors
from firmware_iface.stored_test import RATE_TOLERANCE, StoredTest, encode_test, resolve_test

if TYPE_CHECKING:
    from ehadiag.calibration.unit_models import Calibrated
    from ehadiag.core.actuator import Actuator
    from ehadiag.design.score import MotionLimits, Proposal, Score
    from ehadiag.setup import Setup
    from firmware_iface.recording import Recording


def define_calibrate(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Learn data and effects of one unit from recordings of it as new, at least one"
        " of each loop, and write an actuator file for `diagnose --actuator`."
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
    options.add_request_options(parser, "test", "every_test")
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
    options.add_request_options(parser, "actuator", *options.BUS, *options.READING, "seed")
    options.add_json_option(parser)
    options.add_report_option(parser, "beside the actuator file, also where nothing was learned")
    show_help(
        parser,
        "ehadiag calibrate new-open.blf new-closed.blf --out unit.toml --report",
        "ehadiag calibrate later.blf --actuator unit.toml --update --out unit.toml",
        usual="logs --out --test --actuator --mapping --update --compare --report --help-all",
    )


def run_calibrate(arguments: argparse.Namespace) -> int:
    """Calibrate; return the exit code."""
    setup = options.setup_of(arguments)
    _ = setup.actuator
    out = _checked_out(arguments)
    # What cannot be written is said before anything slow.
    with open_output_folder(str(out.parent)) as folder:
        print_compiling_notice()
        recordings, digests = _read_logs(setup)
        found = _calibrated(arguments, setup, recordings, digests)
        defer_signals()
        codes = [0 if found.actuator is not None else NotTestedError.exit_code]
        written = _write_outputs(arguments, folder, out, found, codes)
    # What was learned is printed also where it could not be written.
    with report_failure(codes):
        _print_calibrated(found, as_json=arguments.json)
    if written:
        print_status("wrote " + ", ".join(str(item) for item in written))
    return worst_exit_code(codes)


def _print_calibrated(found: Calibrated, *, as_json: bool) -> None:
    from ehadiag.report.calibration_tables import calibration_json, print_calibration  # noqa: PLC0415

    if as_json:
        write_output(calibration_json(found) + "\n")
    else:
        console = terminal_console(least=TABLE_COLUMNS)
        print_calibration(found, console)
        write_drawn(console)


def _write_outputs(
    arguments: argparse.Namespace, folder: Folder, out: Path, found: Calibrated, codes: list[int]
) -> list[Path]:
    """Write file and picture of what was learned, and the report; return what was written.

    What cannot be written is said, and its exit code added to `codes`.
    """
    from ehadiag.report.response_signals import calibration_picture  # noqa: PLC0415

    written = []
    picture, page = out.with_suffix(".png"), out.with_suffix(".html")
    if found.actuator is not None:
        with report_failure(codes):
            with write_errors(f"actuator file {folder.path / out.name}"):
                put = folder.write if arguments.update else folder.write_new
                put(out.name, actuator_toml(found.actuator))
            written.append(out)
            with write_errors(f"picture {folder.path / picture.name}"):
                folder.write(picture.name, isolated_png(calibration_picture(found)))
            written.append(picture)
    if arguments.report:
        with report_failure(codes), write_errors(f"report {folder.path / page.name}"):
            folder.write(page.name, calibration_html_page(found))
            written.append(page)
    return written


def _checked_out(arguments: argparse.Namespace) -> Path:
    """Where to write: refused before anything slow where that cannot be."""
    out = Path(arguments.out)
    if out.suffix != ".toml":
        raise ConfigurationError(f"--out {arguments.out}: an actuator file's name ends in .toml")
    if arguments.update and not arguments.actuator:
        raise ConfigurationError("--update: needs --actuator, the calibrated file to refine")
    if arguments.update and arguments.compare:
        raise ConfigurationError("--update keeps the model that was chosen: --compare does nothing")
    if arguments.update and out.exists() and out.samefile(arguments.actuator):
        return out
    for suffix in (".toml", ".png", ".html") if arguments.report else (".toml", ".png"):
        path = out.with_suffix(suffix)
        if os.path.lexists(path):
            raise ConfigurationError(
                f"--out {arguments.out}: {path.name} exists; name another file, or remove it"
            )
    return out


def _read_logs(setup: Setup) -> tuple[list[Recording], list[str]]:
    """Read what is learned from, and digests of the logs, one of each recording."""
    interrupt_on_signals()
    recordings: list[Recording] = []
    digests: list[str] = []
    for log in setup.request.logs:
        found = setup.read(log).recordings
        recordings += found
        digests += [_log_digest(log)] * len(found)
    return recordings, digests


def _log_digest(log: str) -> str:
    try:
        with Path(log).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputOutputError(f"log {log}: {reason_of(error)}") from None


def _calibrated(
    arguments: argparse.Namespace,
    setup: Setup,
    recordings: Sequence[Recording],
    digests: Sequence[str],
) -> Calibrated:
    from ehadiag.assess.diagnosis import match_tests  # noqa: PLC0415 - loads kernels
    from ehadiag.calibration.calibrate_unit import calibrate, update_calibration  # noqa: PLC0415

    start, tests, default = setup.actuator, setup.tests, setup.default
    sources = [
        CalibrationSource(
            name=valid_text(Path(recording.source).name),
            test=test.name if test else "",
            sha256=digest,
        )
        for recording, test, digest in zip(
            recordings, match_tests(recordings, tests, default), digests, strict=True
        )
    ]
    learn = (
        update_calibration if arguments.update else partial(calibrate, compare=arguments.compare)
    )
    with progress_bar() as progress:
        return learn(
            recordings,
            start,
            tests,
            default=default,
            sources=sources,
            seed=setup.request.seed,
            progress=progress,
        )


MAX_TEST_ID = 255


def define_design(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Score how well a test shows each severity (Cramér-Rao bound), with offsets, effects and"
        " uncertain data unknown; with --out, search a better test within limits and write it."
        " Nothing is sent to any bus."
    )
    parser.add_argument(
        "--test",
        default="open",
        metavar="open|closed|FILE",
        help="stored test, or test file, to score and to begin with (default: open)",
    )
    options.add_request_options(parser, "actuator", "tolerance")
    parser.add_argument("--out", metavar="FILE", help="search a better test and write it here")
    limits = parser.add_argument_group(
        "limits of the better test (default: what the scored test itself does)"
    )
    for name, unit, what in (
        ("travel", "MM", "jack, to either side of its middle"),
        ("rate", "MM/S", "jack, speed"),
        ("pressure", "MPA", "differential pressure"),
        ("duration", "S", "length of the test"),
    ):
        limits.add_argument(f"--max-{name}", type=options.positive_number, metavar=unit, help=what)
    parser.add_argument(
        "--budget",
        type=options.positive_count,
        default=200,
        metavar="N",
        help="tests to try, some 0.2 s each (default 200)",
    )
    options.add_request_options(parser, "seed")
    parser.add_argument(
        "--name", metavar="NAME", help="of the better test (default: the test's with -designed)"
    )
    parser.add_argument(
        "--id",
        type=options.positive_count,
        metavar="N",
        help="number of the better test on the bus, 1 … 255 (default: the test's and 100)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    show_help(
        parser,
        "ehadiag design --test closed",
        "ehadiag design --test closed --max-travel 5 --out gentle.toml",
        usual="--test --actuator --out --max-travel --max-rate --max-duration --help-all",
    )


def run_design(arguments: argparse.Namespace) -> int:
    """Score a test, propose another; exit code 0, also where none was better."""
    test, actuator = resolve_test(arguments.test), options.setup_of(arguments, test=()).actuator
    if abs(actuator.controller.rate / test.rate - 1.0) > RATE_TOLERANCE:
        raise ConfigurationError(
            f"test {test.name!r} has {test.rate:g} Hz, the actuator's controller "
            f"{actuator.controller.rate:g} Hz: give both the same"
        )
    named = _name_and_number(arguments, test)
    if arguments.out:
        _refuse_unwritable_path(Path(arguments.out))
    print_compiling_notice()
    from ehadiag.design.score import score  # noqa: PLC0415 - loads the kernels

    scored = score(test, actuator)
    proposal = _propose(arguments, test, actuator, scored) if arguments.out else None
    found, codes, written = [(test, scored)], [0], False
    if proposal is not None and proposal.better:
        better = msgspec.structs.replace(
            proposal.test,
            name=named[0],
            id=named[1],
            description=f"made from {test.name!r} by ehadiag design, seed {arguments.seed}, "
            f"{proposal.scored} tests looked at",
        )
        found.append((better, proposal.score))
        with report_failure(codes):
            _write_test(Path(arguments.out), encode_test(better))
            written = True
            print_status(f"wrote {arguments.out}")
    # What was found is printed also where it could not be written.
    with report_failure(codes):
        _print_scores(arguments, found, arguments.out if written else None)
    if arguments.out and len(found) == 1:
        why = "all exceed the limits" if proposal is None else "none is better"
        print_status(f"no test written: of those looked at {why}; a larger --budget looks at more")
    return worst_exit_code(codes)


def _propose(
    arguments: argparse.Namespace, test: StoredTest, actuator: Actuator, scored: Score
) -> Proposal | None:
    from ehadiag.design.score import propose  # noqa: PLC0415

    with progress_bar() as show:
        return propose(
            test,
            actuator,
            _design_limits(arguments, test, actuator, scored),
            budget=arguments.budget,
            seed=arguments.seed,
            progress=lambda share: show("searching a better test", share),
        )


def _design_limits(
    arguments: argparse.Namespace, test: StoredTest, actuator: Actuator, scored: Score
) -> MotionLimits:
    """Limits that were given, else what the test does; as new the actuator goes farthest."""
    from ehadiag.design.score import (  # noqa: PLC0415
        MotionLimits,
        play_stored_test,
        typical_effects,
    )
    from ehadiag.model.registry import FAULTS  # noqa: PLC0415

    new = play_stored_test(test, actuator, (0.0,) * len(FAULTS), typical_effects())

    def limit(given: float | None, unit: float, *does: float) -> float:
        # What the test itself does, and a little for rounding.
        return 1.001 * max(does) if given is None else given * unit

    return MotionLimits(
        travel=limit(arguments.max_travel, 1e-3, scored.travel, new.travel),
        rate=limit(arguments.max_rate, 1e-3, scored.rate, new.rate),
        pressure=limit(arguments.max_pressure, 1e6, scored.pressure, new.pressure),
        duration=limit(arguments.max_duration, 1.0, test.duration),
    )


def _name_and_number(arguments: argparse.Namespace, test: StoredTest) -> tuple[str, int]:
    """Name and number of the better test."""
    # Another number than the given test: both can be known at once.
    number = arguments.id or (test.id + 100 - 1) % MAX_TEST_ID + 1
    name = arguments.name or f"{test.name[:55]}-designed"
    if not 1 <= number <= MAX_TEST_ID:
        raise ConfigurationError(f"--id {number}: need 1 … {MAX_TEST_ID}")
    if not 1 <= len(name) <= 64:
        raise ConfigurationError("--name: need 1 to 64 characters")
    return name, number


def _refuse_unwritable_path(path: Path) -> None:
    """Say before anything slow what could not be written."""
    if os.path.lexists(path):
        raise InputOutputError(f"{path}: exists already; name another file")
    if not path.parent.is_dir():
        raise InputOutputError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise InputOutputError(f"{path}: no right to write in its folder")


def _write_test(path: Path, content: bytes) -> None:
    try:
        with Folder.at(path.parent, RESULT_MODE, follow=True) as folder:
            folder.write_new(path.name, content)
    except FileExistsError:
        raise InputOutputError(f"{path}: exists already; name another file") from None
    except OSError as error:
        raise InputOutputError(f"{path}: {reason_of(error)}") from None


def _print_scores(
    arguments: argparse.Namespace, found: list[tuple[StoredTest, Score]], written: str | None
) -> None:
    from ehadiag.report.calibration_tables import DESIGN_SCHEMA, print_score, score_tree  # noqa: PLC0415

    if not arguments.json:
        for test, scored in found:
            console = terminal_console(least=TABLE_COLUMNS)
            print_score(test, scored, console)
            write_drawn(console)
        return
    out = {"schema": DESIGN_SCHEMA, "actuator": arguments.actuator, "scored": score_tree(*found[0])}
    if arguments.out:
        out |= {"seed": arguments.seed, "file": written}
        out["proposed"] = score_tree(*found[1]) if len(found) > 1 else None
    print_text(json.dumps(out, ensure_ascii=False))
