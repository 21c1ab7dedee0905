"""`ehadiag bit`: requests a built-in test, records it, diagnoses it."""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.assess.verdict import Levels, Rule
from ehadiag.cli import options
from ehadiag.cli.ahead import working_ahead
from ehadiag.cli.beforehand import refuse_beforehand
from ehadiag.cli.interrupt import stop_on_signals
from ehadiag.cli.output import (
    load_report,
    make_folder,
    progress_bar,
    say,
    say_if_compiling,
    show,
    write_report,
)
from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Environment, Outcome, Quality, Recording
from ehadiag.core.stored_test import StoredTest, resolve_test
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import DiagnosisSession
    from firmware_iface.logs.recorder import Recorder
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.session.tester import Progress
    from firmware_iface.transport.interface import Transport

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "bit",
        help="request a built-in test on a bus, record and diagnose it",
        description="Request a built-in test on a bus, record it to disk while it runs, diagnose"
        " it. The request makes the surface move. Ctrl-C requests an abort.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--test",
        required=True,
        metavar="open|closed|FILE",
        help="stored test by name, or a test file",
    )
    parser.add_argument(
        "--simulate",
        action="store_true",
        help="run the emulated flight-control computer for it; without"
        " --interface on a virtual bus of this process",
    )
    parser.add_argument(
        "--fast",
        action="store_true",
        help="with --simulate: simulated time and no bus between, as fast as it goes",
    )
    parser.add_argument(
        "--listen",
        action="store_true",
        help="send nothing: wait up to a minute for the test that somebody else starts",
    )
    parser.add_argument(
        "--record",
        metavar="FILE",
        help="recording, .blf .asc .csv .trc .mf4 (default: a BLF in the output folder)",
    )
    parser.add_argument(
        "--out",
        default="ehadiag-out",
        metavar="DIR",
        help="recording, JSON and picture go here (default ehadiag-out)",
    )
    for name, unit, what in (
        ("position", "mm", "jack position"),
        ("pressure", "MPa", "differential pressure"),
        ("current", "mA", "servovalve current"),
    ):
        parser.add_argument(
            f"--max-{name}",
            type=options.positive,
            metavar=unit,
            help=f"abort the test when the {what} goes beyond ±{unit} (default: not watched)",
        )
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    options.add_diagnosis_options(parser)
    options.add_bus_options(parser)
    options.add_fault_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the test and print the verdict."""
    actuator = options.the_actuator(arguments)
    test = resolve_test(arguments.test)
    levels = Levels(arguments.advisory, arguments.limit, Rule(arguments.rule))
    bus_map = options.the_bus_map(arguments)
    refuse_beforehand(arguments, test, actuator, bus_map)
    folder = make_folder(arguments.out)
    say_if_compiling(simulation=arguments.simulate)
    from ehadiag.assess.diagnosis import (  # noqa: PLC0415 - loads numba
        DiagnosisSession,
        not_tested,
    )
    from ehadiag.identify.search.solvers import make_solver  # noqa: PLC0415
    from ehadiag.identify.warmup import warm_up  # noqa: PLC0415

    # Before the test: a verdict must not wait for the compiler.
    warm_up(actuator, test)
    load_report(arguments)
    begin = time.perf_counter()
    session = DiagnosisSession(
        actuator,
        [test],
        default=test,
        levels=levels,
        solver=make_solver(arguments.solver),
        seed=arguments.seed,
    )
    recording, why, stem, ended_at = _acquire(arguments, actuator, test, bus_map, folder, session)
    read_s = time.perf_counter() - begin
    if why:
        result = not_tested(recording, test, actuator, [why])
    else:
        with progress_bar() as progress:
            result = session.finish([recording], progress)
    timing = Spent(read_s, None if ended_at is None else time.perf_counter() - ended_at)
    show(result, arguments, timing)
    write_report(result, stem, arguments, timing)
    return int(result.verdict)


def _acquire(
    arguments: argparse.Namespace,
    actuator: Actuator,
    test: StoredTest,
    bus_map: BusMap,
    folder: Path,
    session: DiagnosisSession,
) -> tuple[Recording, str, Path, float | None]:
    """Run the test on the bus.

    Returns the recording, why it is not one, the files' stem, and when the test was complete.
    """
    from firmware_iface.session.assembler import Assembler  # noqa: PLC0415 - loads python-can
    from firmware_iface.session.limits import Limits  # noqa: PLC0415
    from firmware_iface.session.tester import run_test  # noqa: PLC0415

    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    path = Path(arguments.record) if arguments.record else _unused(folder, test.name, stamp)
    assembler = Assembler(str(path), bus_map)
    with working_ahead(session, assembler, test) as ahead:
        with ExitStack() as stack:
            ours, recorder = _connect(arguments, actuator, test, bus_map, path, stack)
            stop = stack.enter_context(stop_on_signals())
            say(f"test {test.name!r} on {ours.name}, recording to {path}")
            display = stack.enter_context(progress_bar())

            def tell(progress: Progress) -> None:
                ahead.watch(progress)
                display(progress.phase.name.lower(), min(progress.elapsed / progress.duration, 1.0))

            began = time.monotonic()
            outcome = run_test(
                ours,
                test_id=test.id,
                duration=test.duration,
                transmit=not arguments.listen,
                recorder=recorder,
                bus_map=bus_map,
                limits=Limits(
                    position=_scaled(arguments.max_position, 1e-3),
                    pressure=_scaled(arguments.max_pressure, 1e6),
                    current=_scaled(arguments.max_current, 1e-3),
                ),
                on_frame=assembler.add,
                stop=stop,
                progress=tell,
                all_there=ahead.all_there,
            )
            listened = time.monotonic() - began
        if ahead.whole is not None:
            recording = ahead.whole
        else:
            recording = assembler.recording() if len(assembler) else _empty(path, outcome.outcome)
        if recording.serial is None:
            recording = replace(recording, serial=outcome.serial)
        if outcome.degraded:
            say(outcome.degraded)
        why = outcome.why
        if outcome.complete:
            ahead.finish()
        else:
            ahead.abandon()
            why += _what_was_heard(recording, ours.name, listened)
    stem = path.with_suffix("") if not arguments.record else folder / path.stem
    return recording, why, stem, ahead.ended_at


def _connect(
    arguments: argparse.Namespace,
    actuator: Actuator,
    test: StoredTest,
    bus_map: BusMap,
    path: Path,
    stack: ExitStack,
) -> tuple[Transport, Recorder]:
    """Open the bus and the recording; begin the emulated computer if it was asked for."""
    from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can

    if not arguments.simulate:
        ours = options.open_transport(arguments, transmit=not arguments.listen)
        return stack.enter_context(ours), Recorder(path, channel=bus_map.channel)
    from ehadiag.cli.simulator import emulator_beside, make_core  # noqa: PLC0415 - loads numba
    from ehadiag_sim.fcc.emulator import EmulatorTransport  # noqa: PLC0415

    core = make_core(arguments, actuator, [test], bus_map)
    if arguments.fast:
        return stack.enter_context(EmulatorTransport(core)), Recorder(path, channel=bus_map.channel)
    if not options.has_bus(arguments):
        arguments.interface, arguments.channel = "virtual", f"ehadiag-{id(arguments):x}"
    theirs = stack.enter_context(options.open_transport(arguments, transmit=True))
    ours = stack.enter_context(options.open_transport(arguments, transmit=True))
    recorder = Recorder(path, channel=bus_map.channel)
    stack.enter_context(emulator_beside(core, theirs))
    return ours, recorder


def _what_was_heard(recording: Recording, bus: str, listened: float) -> str:
    """Add to a failure what would else have to be guessed: a silent bus, or a foreign one."""
    quality = recording.quality
    if quality.total("received"):
        return ""
    if not quality.foreign:
        return f"; {bus} was silent for {listened:.1f} s"
    return (
        f"; {quality.foreign} frames heard on {bus} in {listened:.1f} s, none that the mapping "
        "knows: see ehadiag check-bus"
    )


def _unused(folder: Path, test: str, stamp: str) -> Path:
    """Return a file name for the recording that does not exist yet."""
    number = 1
    while True:
        suffix = f"-{number}" if number > 1 else ""
        path = folder / f"{stamp}-{Path(test).name}{suffix}.blf"
        if not path.exists():
            return path
        number += 1


def _empty(path: Path, outcome: Outcome) -> Recording:
    return Recording(str(path), None, None, None, outcome, Environment(), Quality())


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor
