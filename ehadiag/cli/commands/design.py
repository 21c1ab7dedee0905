"""`ehadiag design`: scores a test by what it can show of an actuator, and proposes a better one."""

from __future__ import annotations

import argparse
import json
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from ehadiag.cli import argument_types, asked_for, options
from ehadiag.cli.exit_codes import worst_code
from ehadiag.cli.output import (
    emit,
    failure_said,
    progress_bar,
    put,
    rendered,
    say,
    say_if_compiling,
)
from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.stored_test import SAME_RATE, StoredTest, encode_test, resolve_test

if TYPE_CHECKING:
    from ehadiag.core.actuator import Actuator
    from ehadiag.design.propose import Limits, Proposal
    from ehadiag.design.score import Score

__all__ = ["add_parser", "run"]

ROOM = 1.001
"""Where no limit is given it is what the test itself does, and a little for rounding."""
DESIGNED_ID = 100
"""Added to a test's number, so that both can be known at once."""
MOST_ID = 255


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "design",
        help="score a test by what it can show, propose a better one",
        description="Score a test by the Cramér-Rao bound of each severity while sensor offsets,\n"
        "nuisances and the data that have a tolerance are unknown; with --out, search a better\n"
        "test within limits and write it. Nothing is sent to any bus.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--test",
        default="open",
        metavar="open|closed|FILE",
        help="stored test, or test file, to score and to begin with (default: open)",
    )
    options.add_actuator_options(parser)
    options.add_tolerance_option(parser)
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
        limits.add_argument(f"--max-{name}", type=argument_types.positive, metavar=unit, help=what)
    parser.add_argument(
        "--budget",
        type=argument_types.count,
        default=200,
        metavar="N",
        help="tests to look at (200)",
    )
    options.add_seed_option(parser, "seed of the search")
    parser.add_argument("--name", metavar="NAME", help="of the better test (NAME-designed)")
    parser.add_argument(
        "--id",
        type=argument_types.count,
        metavar="N",
        help="number of the better test on the bus, 1 … 255 (the test's and 100)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Score a test, propose another; exit code 0, also where none was better."""
    test, actuator = resolve_test(arguments.test), asked_for.the_actuator(arguments)
    if abs(actuator.controller.rate / test.rate - 1.0) > SAME_RATE:
        raise ConfigurationError(
            f"test {test.name!r} has {test.rate:g} Hz, the actuator's controller "
            f"{actuator.controller.rate:g} Hz: give both the same"
        )
    named = _named(arguments, test)
    if arguments.out:
        _refuse_place(Path(arguments.out))
    say_if_compiling()
    from ehadiag.design.score import score  # noqa: PLC0415 - loads the kernels

    scored = score(test, actuator)
    proposal = _proposal(arguments, test, actuator, scored) if arguments.out else None
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
        with failure_said(codes):
            _write(Path(arguments.out), encode_test(better))
            written = True
            say(f"wrote {arguments.out}")
    # What was found is printed also where it could not be written.
    with failure_said(codes):
        _print(arguments, found, arguments.out if written else None)
    if arguments.out and len(found) == 1:
        why = "all exceed the limits" if proposal is None else "none is better"
        say(f"no test written: of those looked at {why}; a larger --budget looks at more")
    return worst_code(codes)


def _proposal(
    arguments: argparse.Namespace, test: StoredTest, actuator: Actuator, scored: Score
) -> Proposal | None:
    from ehadiag.design.propose import propose  # noqa: PLC0415

    with progress_bar() as show:
        return propose(
            test,
            actuator,
            _limits(arguments, test, actuator, scored),
            budget=arguments.budget,
            seed=arguments.seed,
            tell=lambda share: show("searching a better test", share),
        )


def _limits(
    arguments: argparse.Namespace, test: StoredTest, actuator: Actuator, scored: Score
) -> Limits:
    """Limits that were given, else what the test does; as new the actuator goes farthest."""
    from ehadiag.design.play import play  # noqa: PLC0415
    from ehadiag.design.propose import Limits  # noqa: PLC0415
    from ehadiag.design.score import usual_effects  # noqa: PLC0415
    from ehadiag.model.parameters import FAULTS  # noqa: PLC0415

    new = play(test, actuator, (0.0,) * len(FAULTS), usual_effects())

    def limit(given: float | None, unit: float, *does: float) -> float:
        return ROOM * max(does) if given is None else given * unit

    return Limits(
        travel=limit(arguments.max_travel, 1e-3, scored.travel, new.travel),
        rate=limit(arguments.max_rate, 1e-3, scored.rate, new.rate),
        pressure=limit(arguments.max_pressure, 1e6, scored.pressure, new.pressure),
        duration=limit(arguments.max_duration, 1.0, test.duration),
    )


def _named(arguments: argparse.Namespace, test: StoredTest) -> tuple[str, int]:
    """Name and number of the better test."""
    number = arguments.id or (test.id + DESIGNED_ID - 1) % MOST_ID + 1
    name = arguments.name or f"{test.name[:55]}-designed"
    if not 1 <= number <= MOST_ID:
        raise ConfigurationError(f"--id {number}: need 1 … {MOST_ID}")
    if not 1 <= len(name) <= 64:
        raise ConfigurationError("--name: need 1 to 64 characters")
    return name, number


def _refuse_place(path: Path) -> None:
    """Say before anything slow what could not be written."""
    if os.path.lexists(path):
        raise InputOutputError(f"{path}: exists already; name another file")
    if not path.parent.is_dir():
        raise InputOutputError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise InputOutputError(f"{path}: no right to write in its folder")


def _write(path: Path, content: bytes) -> None:
    try:
        with Folder.at(path.parent, RESULT_MODE, follow=True) as folder:
            folder.write_new(path.name, content)
    except FileExistsError:
        raise InputOutputError(f"{path}: exists already; name another file") from None
    except OSError as error:
        raise InputOutputError(f"{path}: {reason_of(error)}") from None


def _print(
    arguments: argparse.Namespace, found: list[tuple[StoredTest, Score]], written: str | None
) -> None:
    from ehadiag.report.test_score import SCHEMA, json_of, print_score  # noqa: PLC0415

    if not arguments.json:
        for test, scored in found:
            emit(rendered(partial(print_score, test, scored)))
        return
    out = {"schema": SCHEMA, "actuator": arguments.actuator, "scored": json_of(*found[0])}
    if arguments.out:
        out |= {"seed": arguments.seed, "file": written}
        out["proposed"] = json_of(*found[1]) if len(found) > 1 else None
    put(json.dumps(out, ensure_ascii=False))
