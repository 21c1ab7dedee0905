"""Runs a built-in test on a bus, recording it and starting its analysis: first half of `bit`."""

from __future__ import annotations

import argparse
import os
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.cli import bus_options
from ehadiag.cli.ahead import Ahead, working_ahead
from ehadiag.cli.deadline import Deadline
from ehadiag.cli.output import say
from ehadiag.cli.screen.bit_view import BitView
from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import InputOutputError
from ehadiag.core.printable import plain_name
from ehadiag.core.recording import Environment, Outcome, Quality, Recording
from ehadiag.core.stored_test import StoredTest

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import DiagnosisSession
    from firmware_iface.logs.recorder import Recorder
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.session.tester import Progress, TesterOutcome
    from firmware_iface.transport.frames import Frame
    from firmware_iface.transport.interface import Transport

__all__ = ["STOPPED", "Heard", "acquire", "recording_path"]

STOPPED = "stopped by the user"
STOPPED_TWICE = "stopped by the user; the abort was requested, its answer not waited for"


@dataclass(frozen=True, slots=True)
class Heard:
    """What came of a test on the bus."""

    recording: Recording
    why: str
    """Why it is none; empty where it is one."""
    name: str
    """Of the recording's file, without suffix."""
    ended_at: float | None
    """When the word came that the test is complete, on `time.perf_counter`."""
    deadline: Deadline
    """Of the identification."""


def acquire(
    arguments: argparse.Namespace,
    actuator: Actuator,
    test: StoredTest,
    bus_map: BusMap,
    folder: Path,
    session: DiagnosisSession,
    stop: threading.Event,
    view: BitView,
    shared: tuple[Transport, Path] | None = None,
) -> Heard:
    """Run the test on the bus; `shared`: listen on one that is open, and recorded there already."""
    from firmware_iface.session.assembler import Assembler  # noqa: PLC0415 - loads python-can
    from firmware_iface.session.limits import Limits  # noqa: PLC0415
    from firmware_iface.session.tester import run_test  # noqa: PLC0415

    path = shared[1] if shared else recording_path(arguments, folder, test)
    assembler = Assembler(str(path), bus_map)
    outcome, why, listened = None, STOPPED, 0.0
    with working_ahead(session, assembler, test) as ahead:
        with suppress(KeyboardInterrupt), ExitStack() as stack:
            ours, recorder = (
                (shared[0], None)
                if shared
                else _connect(arguments, actuator, test, bus_map, path, stack)
            )
            bus = ours.name
            if not shared:
                say(f"test {test.name!r} on {bus}, recording to {path}")
            view.connected(ours)

            def tell(progress: Progress) -> None:
                ahead.watch(progress)
                view.progress(progress)

            def take(frame: Frame) -> None:
                assembler.add(frame)
                view.take(frame)

            began = time.monotonic()
            # From here on a second signal means that the abort was requested and nobody waits.
            why = STOPPED if arguments.listen else STOPPED_TWICE
            try:
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
                    on_frame=take,
                    stop=stop,
                    progress=tell,
                    all_there=ahead.all_there,
                    onboard_wait=arguments.onboard_wait,
                )
            except InputOutputError as error:  # of the recording; the abort was requested
                why = str(error)
            listened = time.monotonic() - began
        deadline = Deadline(arguments.time_limit)
        if ahead.whole is not None:
            recording = ahead.whole
        else:
            recording = assembler.recording() if len(assembler) else _empty(path, outcome)
        if outcome is not None:
            why = outcome.why
            if recording.serial is None:
                recording = replace(recording, serial=outcome.serial)
            if outcome.onboard is not None:
                recording = replace(recording, onboard=outcome.onboard)
            if outcome.degraded:
                view.notes = (outcome.degraded,)
        if outcome is None or not outcome.complete:
            ahead.abandon()
        if outcome is not None and not outcome.complete:
            why += _what_was_heard(recording, bus, listened)
        elif outcome is not None and not _finished(ahead, deadline, stop):
            ahead.abandon()
            why = deadline.reason("work ahead") if deadline.passed else STOPPED
    return Heard(recording, why, path.stem, ahead.ended_at, deadline)


def _finished(ahead: Ahead, deadline: Deadline, stop: threading.Event) -> bool:
    """Wait for what runs ahead; a signal or the time limit ends the wait."""
    with suppress(KeyboardInterrupt):
        return ahead.finish(deadline, stop)
    return False


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
        ours = bus_options.open_transport(arguments, transmit=not arguments.listen)
        return stack.enter_context(ours), Recorder(path, channel=bus_map.channel)
    from ehadiag.cli.simulator import emulator_beside, make_core  # noqa: PLC0415 - loads numba
    from ehadiag_sim.fcc.emulator import EmulatorTransport  # noqa: PLC0415

    core = make_core(arguments, actuator, [test], bus_map)
    if arguments.fast:
        return stack.enter_context(EmulatorTransport(core)), Recorder(path, channel=bus_map.channel)
    if not bus_options.has_bus(arguments):
        arguments.interface, arguments.channel = "virtual", f"ehadiag-{id(arguments):x}"
    theirs = stack.enter_context(bus_options.open_transport(arguments, transmit=True))
    ours = stack.enter_context(bus_options.open_transport(arguments, transmit=True))
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


def recording_path(arguments: argparse.Namespace, folder: Path, test: StoredTest) -> Path:
    """Return where the recording goes."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    return Path(arguments.record) if arguments.record else _unused(folder, test.name, stamp)


def _unused(folder: Path, test: str, stamp: str) -> Path:
    """Return a file name for the recording that does not exist yet."""
    number = 1
    while True:
        suffix = f"-{number}" if number > 1 else ""
        path = folder / f"{stamp}-{plain_name(test)}{suffix}.blf"
        if not os.path.lexists(path):
            return path
        number += 1


def _empty(path: Path, came: TesterOutcome | None) -> Recording:
    outcome = Outcome() if came is None else came.outcome
    return Recording(str(path), None, None, None, outcome, Environment(), Quality())


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor
