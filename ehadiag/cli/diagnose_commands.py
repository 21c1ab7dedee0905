"""Commands on recordings and their results: `diagnose` and `report`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import msgspec

from ehadiag.assess.verdict import Levels
from ehadiag.batch.journal import list_tests
from ehadiag.batch.workers import LogInput, expand_logs
from ehadiag.cli import options
from ehadiag.cli.batch_run import BatchRun, add_batch_options, diagnose_and_deliver
from ehadiag.cli.command_parser import show_help
from ehadiag.cli.history_options import add_history_option, add_history_options, history_path
from ehadiag.cli.option_values import (
    ActuatorArguments,
    add_actuators_options,
    arguments_of_actuators,
)
from ehadiag.cli.result_output import (
    OutputFile,
    ResultWriter,
    open_output_folder,
    refuse_overwriting,
    refuse_unwritable,
    reserved_stems,
)
from ehadiag.core.conventions import fingerprint
from ehadiag.core.interruption import defer_signals
from ehadiag.report.rendering import diagnosis_html_page, index_html_page
from ehadiag.request import Request, request_options
from ehadiag.result import Log, Result, load_result
from ehadiag.setup import Setup
from ehadiag.terminal.output import (
    counting_bar,
    exit_code_of_inputs,
    print_compiling_notice,
    print_status,
    print_test_list,
    progress_bar,
    report_failure,
    worst_exit_code,
)
from firmware_iface.errors import ConfigurationError, EhadiagError, InputOutputError
from firmware_iface.files import write_file
from firmware_iface.logs.log_files import FRAME_READERS
from firmware_iface.recording import Recording

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
    parser.add_argument("logs", nargs="+", metavar="LOG", help=request_options()["logs"].help)
    options.add_request_options(parser, "test", "joint", "every_test")
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
    setups = [_loaded(unit) for unit in arguments_of_actuators(arguments)]
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
    history = results.snapshot()
    setups = [setup.with_history(history) for setup in setups]
    print_compiling_notice()
    if arguments.merge:
        codes = {_diagnose_merged(setup, results, inputs) for setup in setups}
        code = worst_exit_code(codes) if len(codes) > 1 else codes.pop()
    elif arguments.joint:
        code = _diagnose_joint(setups[0], results, inputs)
    else:
        code = BatchRun(arguments, setups, results, inputs).run()
    defer_signals()
    return code


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


def _loaded(unit: ActuatorArguments) -> Setup:
    """Load the setup of one actuator, to raise errors of its files before a log is read."""
    setup = options.setup_of(unit.arguments, unit.label)
    _ = setup.sources, setup.actuator, setup.prior
    return setup


def _diagnose_joint(setup: Setup, results: ResultWriter, inputs: Sequence[LogInput]) -> int:
    """Make one estimate from all logs."""
    together: list[Recording] = []
    logs: list[Log | None] = []
    read_s = 0.0
    codes: list[int] = []
    for item in inputs:
        with report_failure(codes, EhadiagError), progress_bar() as progress:
            reading = setup.read(_readable(item), progress=progress)
            for recording, log in reading.each():
                together.append(recording)
                logs.append(log)
            read_s += reading.seconds
    if any(codes):
        print_status("no joint estimate: not all of the logs could be read")
        return exit_code_of_inputs(codes)
    files = [item.name for item in inputs]
    return diagnose_and_deliver(setup, results, together, files, logs, read_s, "joint")[1]


def _diagnose_merged(setup: Setup, results: ResultWriter, inputs: Sequence[LogInput]) -> int:
    """Diagnose one recording that is split over several files."""
    names = [_readable(item) for item in inputs]
    with progress_bar() as progress:
        reading = setup.read(*names, progress=progress)
    codes = [
        diagnose_and_deliver(setup, results, [recording], reading.files, [log], reading.seconds)[1]
        for recording, log in reading.each()
    ]
    return worst_exit_code(codes)


def _readable(item: LogInput) -> str:
    """Name of an input; InputOutputError: it was found unreadable when the names were expanded."""
    if item.why:
        raise InputOutputError(item.why)
    return item.name


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
            names = [_readable(item) for item in group]
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
