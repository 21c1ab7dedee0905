"""Commands on recordings and their results: `diagnose` and `report`."""

from __future__ import annotations

import argparse
import glob
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from ehadiag.assess.verdict import Levels
from ehadiag.batch.journal import list_tests
from ehadiag.batch.result_files import is_result_table
from ehadiag.cli import options
from ehadiag.cli.batch_run import BatchRun, LogInput, add_batch_options, readable_name
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.options import (
    ActuatorArguments,
    add_actuators_options,
    add_history_option,
    add_history_options,
    arguments_of_actuators,
    history_path,
)
from ehadiag.cli.result_output import (
    OutputFile,
    ResultWriter,
    open_output_folder,
    refuse_overwriting,
    refuse_unwritable,
    reserved_stems,
)
from ehadiag.core.conventions import SIGNAL_FILE_SUFFIXES, fingerprint
from ehadiag.report.rendering import diagnosis_html_page, index_html_page
from ehadiag.request import Request, request_options
from ehadiag.result import Result, load_result
from ehadiag.setup import Setup
from ehadiag.terminal.output import (
    counting_bar,
    exit_code_of_inputs,
    print_compiling_notice,
    print_status,
    print_test_list,
    progress_bar,
    report_failure,
)
from firmware_iface.errors import (
    ConfigurationError,
    EhadiagError,
    reason_of,
)
from firmware_iface.files import write_file
from firmware_iface.logs.log_files import FRAME_READERS

OPTIONS_UNUSED_BY_LIST = (
    "joint", "out", "report", "signals", "history", "hours", "cycles", "results", "resume",
    "junit", "summary",
)  # fmt: skip
"""Options on making or writing a diagnosis: `--list` makes none."""
UNSET_VALUES: tuple[object, ...] = (None, False, [])


def define_diagnose(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        f"Diagnose actuators from recordings of their bus ({' '.join(FRAME_READERS)}, and these as"
        " .gz)."
    )
    options.add_request_options(parser, "logs", "test", "joint", "every_test")
    parser.add_argument(
        "--list", action="store_true", help="list the tests that each log holds, diagnose none"
    )
    options.add_request_options(parser, "start_s", "end_s")
    parser.add_argument("--out", metavar="DIR", help="write a JSON file and a picture for each")
    add_actuators_options(parser)
    options.add_request_options(parser, "columns", "merge", *options.READING, *options.SEARCH)
    options.add_json_option(parser)
    options.add_request_options(parser, "prior")
    add_history_options(parser)
    options.add_result_options(parser)
    add_batch_options(parser)
    show_help(
        parser,
        "ehadiag diagnose recording.blf --out results --report",
        "ehadiag diagnose recordings/*.blf --jobs 4 --results all.csv",
        usual="logs --test --list --out --report --json --actuator --mapping --history --jobs "
        "--summary --help-all",
    )


def run_diagnose(arguments: argparse.Namespace) -> int:
    """Diagnose each log; return the worst exit code."""
    inputs = expand_logs(arguments.logs, print_status)
    if not inputs:
        raise ConfigurationError("no recording named: the list on standard input is empty")
    if arguments.list:
        return exit_code_of_inputs(
            [_list_tests(unit, inputs) for unit in arguments_of_actuators(arguments)]
        )
    # What is wrong with the options is said before anything slow is loaded.
    _refuse_diagnose_contradictions(arguments)
    units = arguments_of_actuators(arguments)
    setups = [options.setup_of(unit.arguments, unit.label) for unit in units]
    for setup in setups:  # errors of its files come before a log is read
        _ = setup.sources, setup.actuator, setup.prior
    if arguments.joint and len(setups) > 1:
        raise ConfigurationError("--mapping: --joint is of one actuator, name one mapping")
    outputs = _output_files(arguments)
    reads = [("the log", item.name) for item in inputs]
    reads += [("the DBC", setup.bus_map.name) for setup in setups]
    refuse_overwriting(arguments, outputs, reads)
    refuse_unwritable(outputs)
    folder = open_output_folder(arguments.out) if arguments.out else None
    results = ResultWriter(
        arguments, folder, reserved_stems(folder.path, outputs) if folder else ()
    )
    history = results.history.snapshot()
    setups = [setup.with_history(history) for setup in setups]
    return BatchRun(arguments, setups, results, inputs).run()


def _refuse_diagnose_contradictions(arguments: argparse.Namespace) -> None:
    if arguments.joint and arguments.merge:
        raise ConfigurationError("--merge: with --joint each log is a recording of its own")
    whole = "--joint" if arguments.joint else "--merge" if arguments.merge else ""
    for name in ("results", "resume", "junit", "summary", "cluster", "jobs"):
        if whole and getattr(arguments, name):
            raise ConfigurationError(f"--{name}: {whole} gives one result, and has no use for it")
    for name in ("jobs", "cluster"):
        if (arguments.report or arguments.signals) and getattr(arguments, name):
            option = "--report" if arguments.report else "--signals"
            raise ConfigurationError(f"--{name}: {option} needs samples, which workers do not send")
    if arguments.cluster and arguments.jobs:
        raise ConfigurationError("--jobs: a cluster has its own number of workers")


def _output_files(arguments: argparse.Namespace) -> list[OutputFile]:
    """Files that hold the results of the whole call."""
    named = [("--results", name) for name in arguments.results]
    named += [(f"--{key}", getattr(arguments, key)) for key in ("resume", "junit", "summary")]
    return [OutputFile(option, name) for option, name in named if name]


def _list_tests(unit: ActuatorArguments, inputs: Sequence[LogInput]) -> int:
    """Print the tests of one actuator in each log."""
    arguments, suffix = unit.arguments, f" ({unit.label})" if unit.label else ""
    if unused := [
        name for name in OPTIONS_UNUSED_BY_LIST if getattr(arguments, name) not in UNSET_VALUES
    ]:
        named = ", ".join(f"--{name}" for name in unused)
        print_status(f"--list diagnoses none, and has no use for {named}")
    # `--test` makes further tests known; it does not choose which ones are listed.
    setup = options.setup_of(arguments)
    codes: list[int] = []
    groups = [list(inputs)] if arguments.merge else [[item] for item in inputs]
    for group in groups:
        with report_failure(codes, EhadiagError):
            names = [readable_name(item) for item in group]
            with progress_bar() as progress:
                tests = list(list_tests(setup, *names, progress=progress))
            print_test_list(", ".join(names) + suffix, tests, as_json=arguments.json)
    return exit_code_of_inputs(codes)


def define_report(parser: argparse.ArgumentParser) -> None:
    """Add description and options of the command."""
    parser.description = (
        "Write a report, one HTML page, beside each stored result (NAME.json of"
        " `--out`). Where its recording is at hand, measured and modelled signals are drawn too;"
        " where there is a health history, the trend of the unit."
    )
    parser.add_argument("results", nargs="+", metavar="RESULT", help="JSON result, NAME.json")
    parser.add_argument(
        "--index", metavar="FILE", help="also write a page with a line for each result, worst first"
    )
    add_history_option(parser)
    options.add_request_options(
        parser, "test", "actuator", *options.BUS, *options.READING, *options.LEVELS
    )
    show_help(
        parser,
        "ehadiag report results/recording.json",
        "ehadiag report results/*.json --history fleet.sqlite",
        usual="results --history --test --actuator --mapping --help-all",
    )


def run_report(arguments: argparse.Namespace) -> int:
    """Write the reports; return the worst exit code."""
    levels = Levels(arguments.advisory, arguments.limit)
    setup = options.setup_of(arguments)
    _ = setup.actuator, setup.tests
    results = list(dict.fromkeys(arguments.results))
    pages = [OutputFile("report", str(_page_path_of(Path(name)))) for name in results]
    pages += [OutputFile("--index", arguments.index)] * bool(arguments.index)
    reads = [("the result", name) for name in results]
    refuse_overwriting(arguments, pages, [*reads, ("the DBC", setup.bus_map.name)])
    codes: list[int] = []
    written = []
    with counting_bar(len(results), "report") as count:
        for path in map(Path, results):
            with report_failure(codes, EhadiagError):
                written.append((_write_report(arguments, path, levels), _page_path_of(path)))
            count()
    if arguments.index:
        page = index_html_page(written, Path(arguments.index), levels, history_path(arguments))
        write_file(Path(arguments.index), page, "index")
        print_status(f"wrote {arguments.index}")
    return exit_code_of_inputs(codes)


def _write_report(arguments: argparse.Namespace, path: Path, levels: Levels) -> Result:
    """Write the page of a stored result; return the result."""
    result = load_result(path)
    try:
        result = _redrawn(arguments, path, result)
    except EhadiagError as error:
        print_status(f"{error}; no responses are drawn")
    if levels == Levels():
        levels = Levels(result.request.advisory, result.request.limit)
    page = diagnosis_html_page(result, levels, history_path(arguments))
    target = _page_path_of(path)
    write_file(target, page, "report")
    print_status(f"wrote {target}")
    return result


def _page_path_of(result: Path) -> Path:
    if not result.name:
        raise ConfigurationError(f"result {result}: is a folder, name a file in it")
    return result.with_suffix(".html")


def _redrawn(arguments: argparse.Namespace, path: Path, result: Result) -> Result:
    """Return a result with signals to draw: its recordings diagnosed again by its request."""
    named = result.request.logs or tuple(item.source for item in result.origins)
    paths = [item.log.path for item in result.origins if item.log is not None]
    files = [_at_hand(name, path, paths[place:]) for place, name in enumerate(named)]
    if not files or None in files:
        print_status(
            f"result {path}: its recording {result.source} is not at hand; no responses are drawn"
        )
        return result
    setup = Setup(_request(arguments, result.request))
    if result.actuator_sha256 != fingerprint(setup.actuator):
        name = setup.actuator.name
        print_status(
            f"result {path}: it goes by other actuator data than {name!r} has: name its"
            " file by --actuator; no responses are drawn"
        )
        return result
    print_compiling_notice()
    readings = [[name for name in files if name]]
    if not setup.request.merge:
        readings = [[name] for name in readings[0]]
    read = [setup.read(*names) for names in readings]
    groups = [[recording] for reading in read for recording in reading.recordings]
    if setup.request.joint:
        groups = [[recording for reading in read for recording in reading.recordings]]
    for recordings in groups:
        found = setup.diagnose(recordings)
        if _is_same_diagnosis(found, result):
            return result.with_diagnosis(found.diagnosis)
    print_status(
        f"result {path}: {result.source} is diagnosed otherwise now; no responses are drawn"
    )
    return result


def _at_hand(name: str, result: Path, paths: list[str]) -> str | None:
    """Return a log's file: by its name, beside the result, or at its stored path."""
    places = [Path(name), result.parent / name, result.parent / Path(name).name, *map(Path, paths)]
    return next((str(item) for item in places if item.is_file()), None)


def _request(arguments: argparse.Namespace, stored: Request) -> Request:
    """Return the stored request, with the files and bus options of this command line."""
    options_of, own = request_options(), options.request_of(arguments)
    names = ("test", "actuator", *options.BUS, *options.READING)
    given = {name: getattr(own, name) for name in names}
    changed = {key: value for key, value in given.items() if value != options_of[key].default}
    return msgspec.structs.replace(stored, **changed)


def _is_same_diagnosis(found: Result, stored: Result) -> bool:
    """Whether two results have the same estimates."""
    for name, item in found.severities.items():
        other = stored.severities.get(name)
        if other is None or (item.estimate is None) != (other.estimate is None):
            return False
        # A larger difference shows another recording than the stored result's.
        if item.estimate is not None and abs(item.value - other.value) >= 1e-3:
            return False
    return True


STANDARD_INPUT_NAME = "-"
MAX_LIST_BYTES = 64 << 20
"""A list of a hundred thousand long names is a tenth of it."""


def expand_logs(names: Iterable[str], report: Callable[[str], None]) -> list[LogInput]:
    """Return the recordings that arguments stand for, in their order and as often as named.

    A folder stands for all recordings in it and below, in the order of their names, but not for
    hidden ones, what lies in hidden folders or behind links, and tables and signals of results; a
    pattern (`*`, `?`, `[…]`, `**`), where there is no file of that name, for what it matches; `-`
    for the names on standard input, one a line, or ended by null characters.

    names: arguments of the command; report: takes a sentence on what of a folder is left out. A
    name that stands for no recording is in the list too, with the reason. ConfigurationError: the
    list on standard input is longer than any list of names.
    """
    return [
        item
        for name in names
        for path in (_names_on_standard_input() if name == STANDARD_INPUT_NAME else [name])
        for item in _expand_path(path, report)
    ]


def _expand_path(name: str, report: Callable[[str], None]) -> Iterator[LogInput]:
    if os.path.isdir(name):
        yield from _expand_folder(name, report)
    elif glob.has_magic(name) and not os.path.lexists(name):
        matches = sorted(glob.glob(name, recursive=True))
        for match in matches:
            if os.path.isdir(match):
                yield from _expand_folder(match, report)
            else:
                yield LogInput(match)
        if not matches:
            yield LogInput(name, f"pattern {name}: matches no file")
    else:
        yield LogInput(name)


def _expand_folder(folder: str, report: Callable[[str], None]) -> Iterator[LogInput]:
    from firmware_iface.logs.log_files import kind_of, known_suffixes  # noqa: PLC0415

    known = known_suffixes()
    links: list[str] = []
    inside = []
    closed: list[OSError] = []
    for place, folders, names in os.walk(folder, onerror=closed.append):
        folders[:] = [name for name in folders if not name.startswith(".")]
        links += [path for name in folders if os.path.islink(path := os.path.join(place, name))]
        inside += [
            os.path.join(place, name)
            for name in names
            if not name.startswith(".") and kind_of(Path(name)) in known
        ]
    ours = [name for name in inside if is_result_table(Path(name))]
    signals = [name for name in inside if name.endswith(SIGNAL_FILE_SUFFIXES)]
    for left_out, why in (
        (links, "a link to a folder is not followed, name the folder to read it"),
        (ours, "a table of results is no recording"),
        (signals, "signals of a result are no recording"),
    ):
        if left_out:
            more = f" and {len(left_out) - 1} more" if len(left_out) > 1 else ""
            report(f"folder {folder}: {why}: {min(left_out)}{more}")
    recordings = sorted(set(inside).difference(ours, signals))
    for error in closed:
        yield LogInput(error.filename, f"folder {error.filename}: {reason_of(error)}")
    if not recordings and not closed:
        yield LogInput(folder, f"folder {folder}: no recording in it ({', '.join(sorted(known))})")
    yield from map(LogInput, recordings)


def _names_on_standard_input() -> list[str]:
    """Names on standard input."""
    stream = getattr(sys.stdin, "buffer", None)
    if stream is None:  # a text put in its place
        content = sys.stdin.read(MAX_LIST_BYTES + 1)
    else:
        content = os.fsdecode(stream.read(MAX_LIST_BYTES + 1))
    if len(content) > MAX_LIST_BYTES:
        raise ConfigurationError(f"standard input: more than {MAX_LIST_BYTES} bytes of names")
    lines = content.split("\0") if "\0" in content else content.splitlines()
    return [line for line in lines if line.strip()]
