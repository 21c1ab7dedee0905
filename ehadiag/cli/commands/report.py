"""`ehadiag report`: writes reports from stored results."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehadiag.assess.verdict import Levels
from ehadiag.cli import asked_for, options
from ehadiag.cli.exit_codes import code_of_inputs
from ehadiag.cli.history_file import add_history_file, history_place
from ehadiag.cli.output import say, say_if_compiling
from ehadiag.cli.overwriting import Output, refuse_overwriting
from ehadiag.cli.report_page import need_report_library, report_of
from ehadiag.core.errors import ConfigurationError, EhadiagError, InputOutputError, reason_of
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.small_file import read_small_file

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis

__all__ = ["add_parser", "run"]

MOST_BYTES = 1 << 20
SCHEMA = "ehadiag.diagnosis/"
NEAR = 1e-3
"""Difference of an estimate from the stored one above which the recording is another's."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "report",
        help="write reports (HTML) from stored results",
        description="Write a report, one HTML page, beside each stored result (NAME.json of"
        " `--out`). Where its recording is at hand, measured and modelled signals are drawn too;"
        " where there is a health history, the trend of the unit.",
        allow_abbrev=False,
    )
    parser.add_argument("results", nargs="+", metavar="RESULT", help="JSON result, NAME.json")
    parser.add_argument(
        "--test",
        action="append",
        default=[],
        metavar="FILE",
        help="test (file) that a recording may be of, besides the stored ones; repeatable",
    )
    add_history_file(parser)
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_log_options(parser)
    options.add_level_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the reports; return the worst exit code."""
    need_report_library()
    asked = Levels(arguments.advisory, arguments.limit)
    asked_for.the_actuator(arguments)
    bus_map = asked_for.the_bus_map(arguments)
    results = list(dict.fromkeys(arguments.results))
    pages = [Output("report", str(_page_of(Path(name)))) for name in results]
    reads = [("the result", name) for name in results]
    refuse_overwriting(arguments, pages, [*reads, ("the DBC", bus_map.name)])
    asked_for.known_tests(arguments.test)
    codes = []
    for name in results:
        try:
            _write(arguments, Path(name), asked)
        except EhadiagError as error:
            say(str(error))
            codes.append(error.exit_code)
        else:
            codes.append(0)
    return code_of_inputs(codes)


def _write(arguments: argparse.Namespace, path: Path, asked: Levels) -> None:
    line = read_small_file(path, MOST_BYTES, "result").decode("utf-8", errors="replace")
    result = _result(path, line)
    try:
        diagnosis = _again(arguments, path, result)
    except EhadiagError as error:
        say(f"{error}; no responses are drawn")
        diagnosis = None
    levels = asked if asked != Levels() else _levels_of(result)
    page = report_of(line, levels, history_place(arguments), diagnosis)
    target = _page_of(path)
    try:
        with Folder.at(target.parent, RESULT_MODE, follow=True) as folder:
            folder.write(target.name, page)
    except OSError as error:
        raise InputOutputError(f"report {target}: {reason_of(error)}") from None
    say(f"wrote {target}")


def _page_of(result: Path) -> Path:
    if not result.name:
        raise ConfigurationError(f"result {result}: is a folder, name a file in it")
    return result.with_suffix(".html")


def _result(path: Path, line: str) -> dict[str, Any]:
    try:
        result = json.loads(line)
        known = isinstance(result, dict) and str(result.get("schema")).startswith(SCHEMA)
        faults = result["faults"].values() if known else ()
        if known and all(map(_is_fault, faults)) and _is_solver(result.get("solver")):
            return dict(result)
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
        pass
    raise ConfigurationError(f"result {path}: is none of ehadiag's JSON results")


def _is_fault(item: dict[str, Any]) -> bool:
    """Whether estimate and interval are numbers, or null."""
    numbers = [item["estimate"], *(item["interval95"] or ())]
    flags = item.get("flags") or []
    return (
        all(value is None or isinstance(value, int | float) for value in numbers)
        and (item["interval95"] is None or len(item["interval95"]) == 2)
        and isinstance(flags, list)
        and all(isinstance(flag, str) for flag in flags)
    )


def _is_solver(item: Any) -> bool:
    """Whether the search is named, if at all, and its seed one that can be given."""
    if item is None:
        return True
    seed = item.get("seed")
    return seed is None or (isinstance(seed, int) and 0 <= seed < 1 << 32)


def _levels_of(result: dict[str, Any]) -> Levels:
    """Return the levels that the verdict goes by; the usual ones where the result is of old."""
    stored = (result.get("configuration") or {}).get("levels") or {}
    try:
        return Levels(float(stored["advisory"]), float(stored["limit"]))
    except (KeyError, TypeError, ValueError, ConfigurationError):
        return Levels()


def _again(arguments: argparse.Namespace, path: Path, result: dict[str, Any]) -> Diagnosis | None:
    """Diagnose the result's recording once more; None where it is not at hand, or another."""
    source = str(result.get("source"))
    log = next((item for item in (Path(source), path.parent / source) if item.is_file()), None)
    if log is None:
        say(f"result {path}: its recording {source} is not at hand; no responses are drawn")
        return None
    actuator = asked_for.the_actuator(arguments)
    if result.get("actuator_sha256") not in (None, fingerprint(actuator)):
        say(
            f"result {path}: it goes by other actuator data than {actuator.name!r} has: name its"
            " file by --actuator; no responses are drawn"
        )
        return None
    from ehadiag.assess.diagnosis import diagnose  # noqa: PLC0415 - loads numba
    from ehadiag.identify.search.solvers import make_solver  # noqa: PLC0415
    from firmware_iface.logs.reader import read_recordings  # noqa: PLC0415 - loads cantools

    say_if_compiling()
    solver = result.get("solver") or {}
    name, seed = solver.get("name"), solver.get("seed")
    found = read_recordings(
        str(log), asked_for.the_bus_map(arguments), asked_for.the_budget(arguments)
    )
    tests = asked_for.known_tests(arguments.test)
    default = tests[-1] if len(arguments.test) == 1 else None
    for recording in found:
        again = diagnose(
            [recording],
            actuator,
            tests,
            default=default,
            solver=make_solver(name if name in ("cga", "pygad") else "cga"),
            seed=seed if isinstance(seed, int) else 0,
        )
        if _same(again, result):
            return again
    say(f"result {path}: {log} is diagnosed otherwise now; no responses are drawn")
    return None


def _same(again: Diagnosis, result: dict[str, Any]) -> bool:
    stored = {name: item.get("estimate") for name, item in result["faults"].items()}
    if again.identification is None:
        return all(value is None for value in stored.values())
    return all(
        isinstance(stored.get(item.name), float) and abs(stored[item.name] - item.value) < NEAR
        for item in again.identification.estimates
    )
