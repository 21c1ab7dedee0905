"""Calls on a bus: run a test, watch, record, check, run the simulated computer.

A bus is an open python-can bus or a `Transport` of this project, which both stay open, or a
`BusOptions` with interface, channel and bit rate, which is opened for the call; so is what a
function with the keyword `transmit` opens. `watch` and `check_bus` also take the name of a log.
Nothing is sent but by `run_test` with `transmit=True` and by `run_simulator`. Further keywords are
fields of `ehadiag.Request`, as of `ehadiag.diagnose`: `actuator`, `mapping`, `dbc`, `test`, …
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import msgspec
from msgspec.structs import replace

from ehadiag.api import log_if_compiling, setup_for
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H, LEAST_MONITORED
from firmware_iface.errors import ConfigurationError, valid_text

if TYPE_CHECKING:
    import can

    from ehadiag.core.actuator import Actuator
    from ehadiag.live import Alarm, Snapshot
    from ehadiag.request import Request
    from ehadiag.result import Result
    from ehadiag.session.monitor_session import AlarmOutlets, DecodedSource, MonitorSummary
    from ehadiag.session.unit_state import KnownUnit, UnitState
    from ehadiag.setup import PathLike, Setup
    from firmware_iface.bus_map import BusMap
    from firmware_iface.bus_report import BusReport
    from firmware_iface.handshake import ChannelLimits
    from firmware_iface.logs.log_files import Budget
    from firmware_iface.logs.recorder import Recorder
    from firmware_iface.recording import Recording, Samples
    from firmware_iface.signals.recordings import DecodedItem
    from firmware_iface.stored_test import StoredTest
    from firmware_iface.tester import RequestProtocol
    from firmware_iface.transport.adapters import BusOptions
    from firmware_iface.transport.base import FrameSource, Transport
    from firmware_iface.transport.frames import Frame, FrameTable

Bus: TypeAlias = "can.BusABC | Transport | BusOptions | Callable[..., Transport]"
"""Open bus of python-can, transport, options of a bus, or what opens a transport."""
Progress: TypeAlias = Callable[[str, float], None]
"""Called with a stage and the share of it that is done, 0 … 1."""
ONBOARD_WAIT_S = 60.0
"""Time after a test, s, in which the computer's own result is awaited by default."""


@contextmanager
def open_transport(
    bus: Bus | PathLike, *, transmit: bool = False, budget: Budget | None = None
) -> Iterator[Transport]:
    """Give the transport of a bus; what the caller has opened stays open.

    bus: the bus, or a log; transmit: whether the bus may be sent to; an adapter is opened
    listen-only otherwise; budget: limits of reading a log; None: the usual ones. Yields the
    transport. EhadiagError: the bus or log cannot be opened.
    """
    from firmware_iface.transport.adapters import BusOptions  # noqa: PLC0415
    from firmware_iface.transport.base import Transport  # noqa: PLC0415
    from firmware_iface.transport.python_can import PythonCanTransport  # noqa: PLC0415

    if isinstance(bus, Transport):
        yield bus
        return
    if isinstance(bus, str | os.PathLike):
        from firmware_iface.logs.reader import read_frames  # noqa: PLC0415 - loads python-can
        from firmware_iface.logs.recorder import ReplayTransport  # noqa: PLC0415

        name = os.fspath(bus)
        opened: Transport = ReplayTransport(read_frames(name, budget), name)
    elif isinstance(bus, BusOptions):
        opened = PythonCanTransport(bus, transmit=transmit)
    elif callable(bus):
        opened = bus(transmit=transmit)
    else:
        opened = PythonCanTransport.of_bus(bus, transmit=transmit)
    with opened:
        yield opened


def run_test(
    bus: Bus,
    test: StoredTest | PathLike,
    *,
    transmit: bool,
    record: PathLike | None = None,
    limits: ChannelLimits | None = None,
    onboard_wait_s: float = ONBOARD_WAIT_S,
    protocol: RequestProtocol = "native",
    xcp: tuple[int, int] | None = None,
    stop: threading.Event | None = None,
    progress: Progress | None = None,
    snapshots: Callable[[Snapshot], None] | None = None,
    request: Request | None = None,
    **options: Any,
) -> Result:
    """Run a built-in test on a bus and diagnose it: with `transmit=True` the surface moves.

    Parameters
    ----------
    bus : Bus
        Open bus of python-can, transport, or options of a bus.
    test : StoredTest | PathLike
        A test, the name of a stored one, or a test file; the computer must store it too.
    transmit : bool
        True: the test is requested, and aborted where it must be. False: nothing is sent; a test
        that somebody else starts within a minute is diagnosed.
    record : PathLike | None
        Recording to write while the test runs (.blf .asc .csv .trc .mf4); None: none.
    limits : ChannelLimits | None
        Values beyond which the test is aborted; None: none.
    onboard_wait_s : float
        Time after the test in which the computer's own result is awaited, s.
    protocol : RequestProtocol
        How the test is requested and watched: the bus's own messages, or "uds".
    xcp : tuple[int, int] | None
        Identifiers of XCP's commands and answers, as (0x6F0, 0x6F1), by which command and channels
        are measured; None: by telemetry.
    stop : threading.Event | None
        When set, the abort is requested and its answer awaited; the result is NOT TESTED.
    progress : Progress | None
        Called with the stage, first the test, and its share done.
    snapshots : Callable[[Snapshot], None] | None
        Called four times a second, in a thread of its own.
    request : Request | None
        Options of the diagnosis; None: the usual ones.
    **options : Any
        Fields of the request by name, as of `diagnose`.

    Returns
    -------
    Result
        Also where no verdict can be given: it is then `NOT_TESTED`, and `reasons` say why.

    Raises
    ------
    ConfigurationError
        A file, a name or a value is wrong; the bus was opened to listen only.
    InputOutputError
        Bus or recording cannot be opened.
    KeyboardInterrupt
        Ctrl-C: the abort was requested, its answer not awaited; the recording is complete.
    """
    from ehadiag.session.bit_run import (  # noqa: PLC0415
        BitSettings,
        BitTest,
        measured_by_xcp,
        refuse_untestable,
    )
    from firmware_iface.xcp import checked_xcp_ids  # noqa: PLC0415 - loads numpy

    setup = setup_for(request, {**options, "test": test})
    (stored,), channel = setup.named_tests, setup.bus_map.channel
    refuse_untestable(stored, setup.actuator, setup.bus_map, transmit=transmit, protocol=protocol)
    ids = None if xcp is None else checked_xcp_ids(*xcp)
    log_if_compiling()
    settings = BitSettings(
        transmit=transmit, limits=limits, onboard_wait_s=onboard_wait_s, protocol=protocol
    )
    stop = stop or threading.Event()
    source = f"bus test {stored.name}" if record is None else os.fspath(record)

    @contextmanager
    def connection() -> Iterator[tuple[Transport, Recorder | None]]:
        from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can

        with ExitStack() as stack:
            opened = stack.enter_context(open_transport(bus, transmit=transmit))
            if ids is not None:
                opened = stack.enter_context(measured_by_xcp(opened, setup, stored, ids, protocol))
            yield opened, None if record is None else Recorder(source, channel=channel)

    with BitTest(setup, settings, progress=progress, snapshots=snapshots) as run:
        run.acquire(connection(), source, stop)
        if run.interrupted:
            raise KeyboardInterrupt
        result = run.diagnose(stop)
        if run.interrupted:
            raise KeyboardInterrupt
    return result


def watch(
    bus: Bus | PathLike | Iterable[DecodedItem],
    *,
    unit: KnownUnit | None = None,
    find: Callable[[int], KnownUnit | None] | None = None,
    hours: float = FALSE_ALARM_INTERVAL_H,
    least: float | None = None,
    least_monitored: float = LEAST_MONITORED,
    duration_s: float | None = None,
    stop: threading.Event | None = None,
    bitrate: float | None = None,
    outlets: AlarmOutlets | None = None,
    on_alarm: Callable[[Alarm], None] | None = None,
    snapshots: Callable[[Snapshot], None] | None = None,
    request: Request | None = None,
    **options: Any,
) -> MonitorSummary:
    """Watch an actuator on a bus without sending anything, and raise alarms when it changes.

    Parameters
    ----------
    bus : Bus | PathLike | Iterable[DecodedItem]
        Open bus of python-can, transport, options of a bus, or a log, of decoded signals too. Or an
        iterable of decoded signals: a `Tick` for each control tick; between them a `CommandMode`
        says what commands are, an `Environment` what oil and supply are from there on.
    unit : KnownUnit | None
        Last result of the unit, or its JSON file; None: as new, or as calibrated.
    find : Callable[[int], KnownUnit | None] | None
        Looks up the last result of a unit once the bus has its serial number; None: nothing is
        looked up.
    hours : float
        Mean time between false alarms, h; between tests at least 2.
    least : float | None
        Least change of a severity worth an alarm, 1; None: `ehadiag.monitor.change_test.LEAST`.
    least_monitored : float
        Share of the ticks, 0 … 1, below which too little was monitored.
    duration_s : float | None
        Longest duration, s; None: until `stop`, or the end of the log.
    stop : threading.Event | None
        When set, the watch ends.
    bitrate : float | None
        Of the bus, bit/s, for its load; None: unknown.
    outlets : AlarmOutlets | None
        Log, recordings and command of alarms; closed at the end. None: none.
    on_alarm : Callable[[Alarm], None] | None
        Called for each alarm.
    snapshots : Callable[[Snapshot], None] | None
        Called four times a second, in a thread of its own.
    request : Request | None
        Options as of `diagnose`; None: the usual ones.
    **options : Any
        Fields of the request by name; `test`: further tests that the computer may run.

    Returns
    -------
    MonitorSummary
        Alarms, numbers of ticks, severities by free motion; also where the bus was lost.

    Raises
    ------
    ConfigurationError
        A file, a name or a value is wrong.
    InputOutputError
        The bus cannot be opened, an alarm not written.
    """
    from ehadiag.live import publish  # noqa: PLC0415
    from ehadiag.monitor.change_test import LEAST  # noqa: PLC0415 - loads kernels
    from ehadiag.session.monitor_session import (  # noqa: PLC0415 - loads kernels
        AlarmOutlets,
        MonitorSession,
    )
    from ehadiag.session.unit_state import new_unit_state, unit_state_of  # noqa: PLC0415

    setup = setup_for(request, options)
    if duration_s is not None and not duration_s > 0.0:
        raise ConfigurationError(f"duration_s {duration_s:g}: need more than 0 s")
    if not 0.0 <= least_monitored <= 1.0:
        raise ConfigurationError(f"least_monitored {least_monitored:g}: need a share, 0 … 1")

    def look_up(serial: int) -> UnitState | None:
        known = find(serial) if find else None
        return None if known is None else unit_state_of(known, setup.actuator)

    with outlets or AlarmOutlets() as places:
        session = MonitorSession(
            setup.actuator,
            setup.bus_map,
            unit_state_of(unit or new_unit_state(setup.actuator), setup.actuator),
            setup.tests,
            places,
            hours=hours,
            least=LEAST if least is None else least,
            of_log=isinstance(bus, str | os.PathLike),
            bitrate=bitrate,
            find=None if find is None else look_up,
            on_alarm=on_alarm,
            least_monitored=least_monitored,
        )
        with (
            _open_source(bus, setup, session.notes) as source,
            publish(session.look, snapshots) as refresh,
        ):
            found = session.run(source, stop or threading.Event(), duration_s, refresh)
    severities, why = session.watcher.severities()
    place = os.fspath(bus) if isinstance(bus, str | os.PathLike) else source.name
    result = setup.monitored(place, found.begun, session.watcher.serial, severities, why)
    return msgspec.structs.replace(found, result=result)


@contextmanager
def _open_source(
    bus: Bus | PathLike | Iterable[DecodedItem], setup: Setup, notes: list[str]
) -> Iterator[FrameSource | DecodedSource]:
    """Give what frames or decoded signals come from; notes: takes what there is to say of them."""
    from ehadiag.session.monitor_session import DecodedSource  # noqa: PLC0415 - loads kernels
    from firmware_iface.transport.base import open_source  # noqa: PLC0415

    tick_ns = round(1e9 / setup.actuator.controller.rate)
    # A bus of python-can gives its frames one by one, too.
    if isinstance(bus, Iterable) and not (isinstance(bus, str) or hasattr(bus, "recv")):
        yield DecodedSource(iter(bus), "decoded signals", tick_ns)
        return
    if isinstance(bus, str | os.PathLike):
        from firmware_iface.logs.log_files import holds_signals  # noqa: PLC0415
        from firmware_iface.signals.columns import ColumnMap  # noqa: PLC0415
        from firmware_iface.signals.recordings import decoded_items  # noqa: PLC0415

        name, columns = os.fspath(bus), setup.columns
        if holds_signals(name, mapped=columns is not None):
            columns = msgspec.structs.replace(columns or ColumnMap(), tick_ns=tick_ns)
            whole, items = decoded_items(name, columns, setup.candidate_tests, setup.budget)
            notes.extend(whole.quality.notes)
            yield DecodedSource(items, f"replay of {name}", tick_ns, whole.start_ns or 0)
            return
    with (
        open_transport(cast("Bus | PathLike", bus), budget=setup.budget) as transport,
        open_source(transport) as source,
    ):
        yield source


def record(
    bus: Bus,
    path: PathLike,
    *,
    duration_s: float | None = None,
    stop: threading.Event | None = None,
    max_bytes: int | None = None,
    on_frame: Callable[[Frame], None] | None = None,
    progress: Progress | None = None,
    request: Request | None = None,
    **options: Any,
) -> Recording:
    """Record a bus without sending anything.

    Parameters
    ----------
    bus : Bus
        Open bus of python-can, transport, or options of a bus.
    path : PathLike
        File to write (.blf .asc .csv .trc .mf4), flushed every half second; one that exists is
        refused.
    duration_s : float | None
        Longest duration, s; None: until `stop` or Ctrl-C, whose KeyboardInterrupt leaves a complete
        file.
    stop : threading.Event | None
        When set, the recording ends.
    max_bytes : int | None
        Size at which the next file is begun; None: never.
    on_frame : Callable[[Frame], None] | None
        Called for each frame, after it was written.
    progress : Progress | None
        Called with the share of the duration that is over.
    request : Request | None
        Options as of `diagnose`; None: the usual ones.
    **options : Any
        Fields of the request by name: `mapping`, `dbc`.

    Returns
    -------
    Recording
        Last complete test in the frames, as `read` returns it.

    Raises
    ------
    ConfigurationError
        A file or a value is wrong.
    InputOutputError
        The bus cannot be opened or failed, the file cannot be written.
    """
    bus_map = setup_for(request, options).bus_map
    from firmware_iface.logs.recorder import Recorder  # noqa: PLC0415 - loads python-can
    from firmware_iface.tester import Assembler  # noqa: PLC0415

    name = os.fspath(path)
    collected = Assembler(name, bus_map)

    def take(frame: Frame) -> None:
        collected.add(frame)
        if on_frame is not None:
            on_frame(frame)

    with (
        open_transport(bus) as transport,
        Recorder(name, max_bytes=max_bytes, channel=bus_map.channel) as recorder,
    ):
        collect_frames(
            transport, take, recorder, duration_s=duration_s, stop=stop, progress=progress
        )
    return collected.recording()


BUS_SCHEMA = "ehadiag.bus/1"
STATUS_ROLE_PREFIXES = ("status.", "command.test_id", "request.")


class BusCheck(msgspec.Struct, frozen=True):
    """Report on the frames of a bus; print it, or `to_dict`."""

    source: str
    """Where the frames are from, for people."""
    report: BusReport
    """Messages, rates, gaps, ranges; `problems` stand in the way of a diagnosis."""
    test: str
    """Stored test that the frames hold from beginning to end; empty without one."""
    samples: Samples | None
    """All samples on ticks; None: no channel was received."""

    @property
    def usable(self) -> bool:
        """Whether nothing stands in the way of a diagnosis."""
        return not self.report.problems

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `check-bus --json`."""
        head = {"schema": BUS_SCHEMA, "source": valid_text(self.source)}
        return {**head, **msgspec.to_builtins(self.report), "test": self.test or None}

    def __str__(self) -> str:
        """Return the report as lines of text."""
        from firmware_iface.bus_report import render_bus_report  # noqa: PLC0415

        return f"{self.source}\n{render_bus_report(self.report)}"


def check_bus(
    bus: Bus | PathLike,
    *,
    duration_s: float = 3.0,
    stop: threading.Event | None = None,
    progress: Progress | None = None,
    request: Request | None = None,
    **options: Any,
) -> BusCheck:
    """Listen to a bus, and report what maps, what is missing, and what a diagnosis would refuse.

    Parameters
    ----------
    bus : Bus | PathLike
        Open bus of python-can, transport, options of a bus, or a log.
    duration_s : float
        Time to listen, s.
    stop : threading.Event | None
        When set, the listening ends.
    progress : Progress | None
        Called with the share of the duration that is over.
    request : Request | None
        Options as of `diagnose`; None: the usual ones.
    **options : Any
        Fields of the request by name.

    Returns
    -------
    BusCheck
        `str` of it is the command's report.

    Raises
    ------
    ConfigurationError
        A file, a name or a value is wrong.
    InputOutputError
        Bus or log cannot be opened, or failed.
    """
    from firmware_iface.logs.reader import read_frames  # noqa: PLC0415
    from firmware_iface.tester import Assembler  # noqa: PLC0415 - loads python-can

    setup = setup_for(request, options)
    if isinstance(bus, str | os.PathLike):
        table, source = read_frames(os.fspath(bus), setup.budget), f"log {os.fspath(bus)}"
    else:
        with open_transport(bus) as transport:
            collected = Assembler(transport.name, setup.bus_map)
            listened = collect_frames(
                transport, collected.add, duration_s=duration_s, stop=stop, progress=progress
            )
        table = collected.table()
        source = f"listened to {transport.name} for {listened:.1f} s, sent nothing"
    return _check_frames(table, setup.bus_map, setup.actuator, setup.tests, source)


def _check_frames(
    table: FrameTable,
    bus_map: BusMap,
    actuator: Actuator,
    tests: tuple[StoredTest, ...],
    source: str,
) -> BusCheck:
    """Check frames as a diagnosis would.

    table: frames in order of arrival; bus_map: meaning of the frames; actuator: data of the
    actuator; tests: tests that may have been played; source: where the frames are from, for people.
    Returns the report; with a complete test the diagnosis decides on its problems.
    """
    from ehadiag.assess.acceptance import objections_to_units  # noqa: PLC0415 - only where frames came
    from ehadiag.assess.diagnosis import diagnose  # noqa: PLC0415 - loads kernels
    from ehadiag.assess.verdict import Verdict  # noqa: PLC0415
    from firmware_iface.alignment.align import windowed_recordings  # noqa: PLC0415
    from firmware_iface.bus_report import report_bus  # noqa: PLC0415
    from firmware_iface.find_test import CandidateTests  # noqa: PLC0415

    report = report_bus(table, bus_map)
    if not len(table):
        return BusCheck(source, report, "", None)
    window = len(table) + 1
    (everything,) = windowed_recordings([table], _without_status(bus_map), "", window, window)
    samples = everything.samples
    units = () if samples is None else objections_to_units(samples, actuator)
    candidates = CandidateTests(tests, actuator.controller)
    complete = [
        (item, test)
        for item in windowed_recordings([table], bus_map, "", window, window, candidates)
        for test in tests
        if item.test_id == test.id and item.samples is not None
        if item.samples.ticks == test.ticks
    ]
    if not complete:
        remarks = (*report.remarks, "no whole test is in it: a diagnosis needs one")
        report = replace(report, problems=(*report.problems, *units), remarks=remarks)
        return BusCheck(source, report, "", samples)
    recording, test = complete[-1]
    found = diagnose([recording], actuator, [test])
    if found.verdict is Verdict.NOT_TESTED:
        why = (f"a diagnosis of test {test.name!r} refuses: {item}" for item in found.reasons)
        report = replace(report, problems=(*report.problems, *units, *why))
    else:  # in spite of the report's problems
        verdict = f"test {test.name!r} is in it whole, and a diagnosis takes it"
        remarks = (*report.remarks, *report.problems, *units, verdict)
        report = replace(report, problems=(), remarks=remarks)
    return BusCheck(source, report, test.name, samples)


def _without_status(bus_map: BusMap) -> BusMap:
    """Return the bus without what it says of tests: all its frames are then one recording."""
    messages = {
        name: replace(
            item,
            roles=tuple(
                role for role in item.roles if not role.name.startswith(STATUS_ROLE_PREFIXES)
            ),
        )
        for name, item in bus_map.messages.items()
    }
    return replace(bus_map, messages={name: item for name, item in messages.items() if item.roles})


class SimulatorRun(msgspec.Struct, frozen=True):
    """What the simulated computer did."""

    ticks: int
    tests_started: int
    """Number of tests that were started."""


def run_simulator(
    bus: Bus,
    *,
    stop: threading.Event | None = None,
    on_degraded: Callable[[str], None] | None = None,
    conditions: Mapping[str, Any] | None = None,
    request: Request | None = None,
    **options: Any,
) -> SimulatorRun:
    """Run the emulated flight-control computer with its actuator on a bus; this transmits.

    Parameters
    ----------
    bus : Bus
        Open bus of python-can, transport, or options of a bus.
    stop : threading.Event | None
        When set, the computer ends; None: only an exception ends it.
    on_degraded : Callable[[str], None] | None
        Called once when frames were lost on this side.
    conditions : Mapping[str, Any] | None
        `faults`, `effects`, `sensors`, `broken`, `seed`, `serial`, `protocol` of
        `ehadiag_sim.emulator.emulated_computer`; None: a unit as new.
    request : Request | None
        Options as of `diagnose`; None: the usual ones.
    **options : Any
        Fields of the request by name; `test`: tests that the computer stores beside the bundled
        ones.

    Returns
    -------
    SimulatorRun
        Numbers of ticks and tests.

    Raises
    ------
    ConfigurationError
        A file, a name or a value is wrong.
    InputOutputError
        The bus cannot be opened, or failed.
    """
    from ehadiag_sim.emulator import emulated_computer, run_emulator  # noqa: PLC0415 - loads kernels

    setup = setup_for(request, options)
    core = emulated_computer(setup.actuator, setup.tests, setup.bus_map, **(conditions or {}))
    with open_transport(bus, transmit=True) as transport:
        ticks = run_emulator(core, transport, stop or threading.Event(), on_degraded=on_degraded)
    return SimulatorRun(ticks, core.tests_started)


def collect_frames(
    transport: Transport,
    take: Callable[[Frame], None],
    recorder: Recorder | None = None,
    *,
    duration_s: float | None = None,
    stop: threading.Event | None = None,
    progress: Progress | None = None,
) -> float:
    """Hand over the frames of a bus until the time is over; return the time listened, s."""
    from firmware_iface.transport.base import RECEIVE_POLL_S, open_source  # noqa: PLC0415

    end = threading.Event() if stop is None else stop
    sink, idle = (None, None) if recorder is None else (recorder.write, recorder.idle)
    begin = time.monotonic()
    with open_source(transport, sink=sink, idle=idle) as source:
        started = source.now_ns()
        while not end.is_set() and not source.at_end:
            frame = source.receive(RECEIVE_POLL_S)
            if frame is not None:
                take(frame)
            if duration_s is None:
                continue
            elapsed = (source.now_ns() - started) / 1e9
            if progress is not None:
                progress("listening", min(elapsed / duration_s, 1.0))
            if elapsed >= duration_s:
                break
    return time.monotonic() - begin
