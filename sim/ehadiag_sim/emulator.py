"""Emulates the flight-control computer (BUS-4 to BUS-13), tick by tick or in real time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ehadiag.core.actuator import Actuator
from ehadiag_sim.broken_hardware import Hardware, break_hardware
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.control import Conditions, SimulatorControl
from ehadiag_sim.sensing import ChannelFault
from ehadiag_sim.simulation import Plant, refuse_other_rate, scales_of
from ehadiag_sim.xcp_slave import XcpSlave
from firmware_iface.bus_map import BusMap, default_map
from firmware_iface.codec import TickEncoder
from firmware_iface.errors import ConfigurationError, EhadiagError
from firmware_iface.live_decode import BitRequest, BitStatus, LiveDecoder
from firmware_iface.recording import CHANNEL_NAMES, BitReason, BitState, CommandMode
from firmware_iface.stored_test import StoredTest
from firmware_iface.transport.base import RECEIVE_POLL_S, Transport, TransportState
from firmware_iface.transport.frames import Frame
from firmware_iface.xcp import XcpIds, measurements_of
from firmware_iface.xcp_master import refuse_taken_identifiers

if TYPE_CHECKING:
    from ehadiag_sim.foreign_plant import ForeignPlant
    from ehadiag_sim.uds_server import UdsServer
    from firmware_iface.tester import RequestProtocol

MAX_SERIAL_NUMBER = 0xFFFF


@dataclass(frozen=True, slots=True)
class Preconditions:
    """What the computer demands before it starts a test."""

    supply: float = 15e6
    """Least supply pressure above return, Pa."""
    oil_temperature: float = -20.0
    """Least, degC."""
    off_centre: float = 1e-3
    """Largest jack position, m."""


class FccCore:
    """State of the emulated computer and its actuator; `step` advances both by one tick.

    Between tests the computer holds the surface in the middle. Each test begins with the actuator
    at rest there and with noise drawn from (seed, number of the test), so a run does not depend on
    how long the computer idled before. An abort commands zero current in the very next tick.

    actuator: data of the actuator; tests: tests that the computer stores, each with a number of its
    own; faults: severities of the three faults; None: as new; effects: effects beside the faults;
    None: none of them, default oil and supply; sensors: how the converters err; None: the specified
    noise, no offsets; seed: seed of the noise; each test draws from it and its own number; serial:
    serial number of the actuator, 0 … 65535; preconditions: what a test must find to be started;
    None: the defaults; idle_telemetry: whether telemetry is sent between tests too; start_ns: time
    of the first tick, ns; bus_map: messages to send and accept; None: the default bus;
    channel_faults: damage to the readings of the channels; None: none; control: changes while it
    runs; None: none; foreign: plant of another maker; None: the detailed simulator; xcp:
    identifiers of its XCP slave; None: it has none; protocol: how tests are requested and watched,
    with `uds` by nothing else. ConfigurationError: two tests with one number, a test at another
    rate than the controller; a serial number, a converter's range or the rated current that the bus
    cannot carry; an XCP identifier that a message has.
    """

    def __init__(
        self,
        actuator: Actuator,
        tests: Iterable[StoredTest],
        *,
        faults: Faults | None = None,
        effects: Effects | None = None,
        sensors: Sensors | None = None,
        seed: int = 0,
        serial: int = 1,
        preconditions: Preconditions | None = None,
        idle_telemetry: bool = True,
        start_ns: int = 0,
        bus_map: BusMap | None = None,
        channel_faults: Sequence[ChannelFault] = (),
        control: SimulatorControl | None = None,
        foreign: ForeignPlant | None = None,
        xcp: XcpIds | None = None,
        protocol: RequestProtocol = "native",
    ) -> None:
        if not 0 <= serial <= MAX_SERIAL_NUMBER:
            raise ConfigurationError(f"actuator serial {serial}: outside 0 … {MAX_SERIAL_NUMBER}")
        self._actuator = actuator
        self._tests = _by_number(tests, actuator)
        self._faults, self._sensors = faults, sensors
        self._channel_faults = tuple(channel_faults)
        self._foreign = foreign
        self._effects = effects or Effects()
        self._control = control
        if control is not None:
            given = Conditions(faults or Faults(), self._effects, sensors or Sensors())
            control.begin(given, actuator.controller.rate)
        self._seed, self._serial = seed, serial
        self._demands = preconditions or Preconditions()
        self._idle_telemetry = idle_telemetry
        bus_map = bus_map or default_map()
        self._scales = scales_of(bus_map, actuator)
        self._encoder = TickEncoder(bus_map, self._scales.channels)
        self._decoder = LiveDecoder(bus_map)
        self._rate = actuator.controller.rate
        self.period_ns = round(1e9 / self._rate)
        self._slave = None
        if xcp is not None:
            refuse_taken_identifiers(xcp, bus_map, uds=protocol == "uds")
            self._slave = XcpSlave(measurements_of(self._scales.channels), xcp, self.period_ns)
        self._start_ns = start_ns
        self._tick = 0
        self._count = 0
        self._plant = self._fresh_plant()
        self._state, self._test_id = BitState.IDLE, 0
        self._refused: tuple[BitReason, int] | None = None
        self._since = 0
        self._commands: list[float] = []
        self._elapsed = 0
        self._mode = CommandMode.POSITION
        self._sent_state: tuple[BitState, int] | None = None
        self._pending: deque[BitRequest] = deque()
        self.interlock_open = False
        self._uds: UdsServer | None = None
        if protocol == "uds":
            from ehadiag_sim.uds_server import UdsServer  # noqa: PLC0415 - optional packages

            self._uds = UdsServer(self, bus_map.uds_identifiers)

    @property
    def state(self) -> BitState:
        """State of the built-in test."""
        return self._state

    @property
    def now_ns(self) -> int:
        """Start of the next tick, ns."""
        return self._start_ns + self._tick * self.period_ns

    @property
    def tests_started(self) -> int:
        """Number of tests begun so far."""
        return self._count

    @property
    def plant(self) -> Plant:
        """The actuator as it is now."""
        return self._plant

    @property
    def status(self) -> BitStatus:
        """State of the test, its number and elapsed time, and the actuator's serial number."""
        elapsed = self._elapsed / self._rate
        return BitStatus(self._state, BitReason.NONE, self._test_id, elapsed, self._serial)

    @property
    def faults(self) -> Faults | None:
        """Severities of the actuator as it is now; None: of a plant of another maker, unknown."""
        return None if self._foreign is not None else self._faults or Faults()

    @property
    def offsets(self) -> tuple[float, ...]:
        """Offsets of the sensors as they are now, SI."""
        lsb = (self._sensors or Sensors()).offsets_lsb
        pairs = zip(lsb, self._scales.channels, strict=True)
        return tuple(count * channel.lsb for count, channel in pairs)

    def take(self, frame: Frame) -> None:
        """Take a frame off the bus; anything but a valid request is ignored."""
        if self._slave is not None:
            self._slave.take(frame)
        if self._uds is not None:
            self._uds.take(frame)
            return
        request = self._decoder.decode(frame)
        if isinstance(request, BitRequest):
            self._pending.append(request)

    def step(self) -> list[Frame]:
        """Run one control tick; return the frames that the computer sends at its end."""
        if self._control is not None and (changed := self._control.advance()) is not None:
            self._faults, self._effects = changed.faults, changed.effects
            self._sensors = changed.sensors
            self._plant.change(changed.faults, changed.effects, changed.sensors)
        while self._pending:
            request = self._pending.popleft()
            if request.code == "start":
                self.start(request.test_id)
            elif request.code == "abort":
                self.abort()
        answers = [] if self._uds is None else self._uds.step()
        self._advance()
        running = self._state is BitState.RUNNING
        if running:
            self._elapsed = self._tick - self._since
            command, mode, test_id = self._commands[self._elapsed], self._mode, self._test_id
        elif self._state is BitState.ABORTED:
            command, mode, test_id = 0.0, CommandMode.CURRENT, 0
        else:
            command, mode, test_id = 0.0, CommandMode.POSITION, 0
        codes = self._plant.tick(command, mode)
        self._tick += 1
        frames: list[Frame] = []
        frames += self._status() if self._uds is None else answers
        if running or self._idle_telemetry:
            self._encoder.command(mode, command, test_id, 0)
            self._encoder.telemetry(codes.tolist(), 0)
        if (self._tick - 1) % round(self._rate / 10.0) == 0:
            supply, drain, degc = self._plant.probed
            self._encoder.environment(supply, drain, degc, 0)
        frames += self._encoder.frames(0)
        if self._control is not None:
            frames = self._control.frames(frames)
        if self._slave is not None:
            values = self._raw_values(command, mode, test_id, codes.tolist())
            frames += self._slave.tick(values, self.now_ns)
        return [
            # An 8-byte frame at 1 Mbit/s with stuff bits: frames of a tick follow so.
            _stamped(frame, self.now_ns + i * 130_000)
            for i, frame in enumerate(frames)
        ]

    def _raw_values(
        self, command: float, mode: CommandMode, test_id: int, codes: Sequence[int]
    ) -> dict[str, int]:
        """What XCP measures in this tick, by the names of `MEASUREMENTS`."""
        supply, drain, degc = self._plant.probed
        commanded = round(command * 1e9)
        return {
            "tick": self._tick & 0xFFFFFFFF,
            "bit_state": int(self._state),
            "test_id": test_id,
            "command_mode": int(mode),
            "command_current": commanded if mode is CommandMode.CURRENT else 0,
            "command_position": commanded if mode is CommandMode.POSITION else 0,
            "supply_pressure": round(supply),
            "return_pressure": round(drain),
            "oil_temperature": round(degc * 100.0),
            **dict(zip(CHANNEL_NAMES, codes, strict=True)),
        }

    def start(self, test_id: int) -> BitReason:
        """Start a test, or say why it is refused."""
        reason = self._objection(test_id)
        if reason is BitReason.NONE:
            test = self._tests[test_id]
            self._commands = test.command().tolist()
            self._elapsed = 0
            self._mode = test.command_mode
            self._refused = None  # an earlier refusal may still stand on the bus
            self._enter(BitState.ARMING, test_id)
        elif self._state in (BitState.ARMING, BitState.RUNNING):
            self._refused = (reason, test_id)  # said once; the running test goes on
        else:
            self._refused = (reason, test_id)
            self._enter(BitState.REFUSED, test_id)
        return reason

    def _objection(self, test_id: int) -> BitReason:
        demands = self._demands
        supply, drain, degc = self._plant.probed
        codes = np.asarray(self._plant.codes[3:])
        position = float(self._scales.channels.position.decode(codes)[0])
        checks = (
            (self._state in (BitState.ARMING, BitState.RUNNING), BitReason.ALREADY_RUNNING),
            (test_id not in self._tests, BitReason.UNKNOWN_TEST),
            (self.interlock_open, BitReason.INTERLOCK_OPEN),
            (
                supply - drain < demands.supply,
                BitReason.SUPPLY_PRESSURE_LOW,
            ),
            (degc < demands.oil_temperature, BitReason.OIL_TOO_COLD),
            (abs(position) > demands.off_centre, BitReason.NOT_CENTRED),
        )
        return next((reason for failed, reason in checks if failed), BitReason.NONE)

    def abort(self) -> None:
        """Command zero current from this tick on, if a test runs."""
        if self._state in (BitState.ARMING, BitState.RUNNING):
            self._refused = None  # of a second request in the same tick: no reason of an abort
            self._enter(BitState.ABORTED, self._test_id)

    def _advance(self) -> None:
        """Change state when its time is up, before the tick is computed."""
        elapsed = self._tick - self._since
        if self._state is BitState.ARMING and elapsed >= 0.1 * self._rate:
            self._count += 1
            self._plant.close()
            self._plant = self._fresh_plant()
            self._enter(BitState.RUNNING, self._test_id)
        elif self._state is BitState.RUNNING and elapsed >= len(self._commands):
            self._elapsed = elapsed
            self._enter(BitState.COMPLETE, self._test_id)
        elif (
            self._state in (BitState.COMPLETE, BitState.ABORTED, BitState.REFUSED)
            and elapsed >= 0.5 * self._rate
        ):
            self._elapsed = 0
            self._enter(BitState.IDLE, 0)

    def _enter(self, state: BitState, test_id: int) -> None:
        self._state, self._test_id = state, test_id
        self._since = self._tick

    def _status(self) -> tuple[Frame, ...]:
        """Status on change and at its rate, given to the encoder; the answer to a second request
        that comes in between, as frames."""
        frames: tuple[Frame, ...] = ()
        running = self._state in (BitState.ARMING, BitState.RUNNING)
        reason = BitReason.NONE
        if self._refused is not None:
            reason, wanted = self._refused
            if running:
                self._encoder.status(BitState.REFUSED, reason, wanted, 0.0, self._serial, 0)
                frames = self._encoder.frames(0)
            if running or self._state is BitState.IDLE:
                self._refused, reason = None, BitReason.NONE
        present = (self._state, self._since)
        due = (self._tick - 1) % round(self._rate / 50.0) == 0
        if due or present != self._sent_state or frames:
            self._sent_state = present
            self._encoder.status(
                self._state, reason, self._test_id, self._elapsed / self._rate, self._serial, 0
            )
        return frames

    def _fresh_plant(self) -> Plant:
        seed = int(np.random.SeedSequence((self._seed, self._count)).generate_state(1)[0])
        return Plant(
            self._actuator,
            self._faults,
            self._effects,
            self._sensors,
            seed,
            channel_faults=self._channel_faults,
            scales=self._scales,
            foreign=self._foreign,
        )


def _by_number(tests: Iterable[StoredTest], actuator: Actuator) -> dict[int, StoredTest]:
    numbered: dict[int, StoredTest] = {}
    for test in tests:
        if test.id in numbered:
            raise ConfigurationError(
                f"tests {numbered[test.id].name!r} and {test.name!r} have the same id {test.id}"
            )
        refuse_other_rate(test, actuator)
        numbered[test.id] = test
    return numbered


def _stamped(frame: Frame, time_ns: int) -> Frame:
    return Frame(time_ns, frame.can_id, frame.data, frame.extended, frame.fd)


def emulated_computer(
    actuator: Actuator,
    tests: Iterable[StoredTest],
    bus_map: BusMap | None = None,
    *,
    faults: Faults | None = None,
    effects: Effects | None = None,
    sensors: Sensors | None = None,
    broken: str | None = None,
    seed: int = 0,
    serial: int = 1,
    control: SimulatorControl | None = None,
    foreign: ForeignPlant | None = None,
    xcp: XcpIds | None = None,
    protocol: RequestProtocol = "native",
) -> FccCore:
    """Return a computer with an actuator that may be broken, its kernels loaded.

    tests: tests that the computer stores, each with a number of its own; bus_map: see `FccCore`, as
    for the parameters that follow; faults: severities of the faults; effects: effects beside the
    faults; sensors: errors of the converters; broken: kind of broken hardware (`HARDWARE_FAULTS`),
    its sizes drawn by the seed; None: none; seed: seed of the noise; serial: serial number of the
    actuator; control, foreign, xcp, protocol: see `FccCore`. Returns the emulated computer; its
    first tick has the present date, also in simulated time. ConfigurationError: see `FccCore`; an
    unknown kind of broken hardware, or one that a foreign plant cannot have.
    """
    item = Hardware(actuator, effects or Effects(), sensors or Sensors())
    if broken:
        item = break_hardware(broken, np.random.default_rng(seed), item)
        if foreign is not None and item.actuator != actuator:
            raise ConfigurationError(f"broken hardware {broken!r}: is not of a foreign plant")
    core = FccCore(
        item.actuator,
        tests,
        faults=faults,
        effects=item.effects,
        sensors=item.sensors,
        seed=seed,
        serial=serial,
        bus_map=bus_map,
        channel_faults=item.channel_faults,
        control=control,
        foreign=foreign,
        xcp=xcp,
        protocol=protocol,
        start_ns=time.time_ns(),
    )
    core.step()
    return core


@dataclass(slots=True)
class Pace:
    """Whether a simulation keeps to real time."""

    behind_s: float = 0.0
    """Longest time by which a tick came late, s."""


def run_emulator(
    core: FccCore,
    transport: Transport,
    stop: threading.Event,
    *,
    real_time: bool = True,
    on_degraded: Callable[[str], None] | None = None,
    pace: Pace | None = None,
) -> int:
    """Run the computer on a bus until `stop` is set; return the number of ticks.

    Ticks have absolute deadlines, so lateness is made up and the rate does not drift. With
    `real_time` false ticks follow at once and only the frames' time stamps tell the time.

    stop: set from outside to end the loop; real_time: keep to the wall clock, or run as fast as the
    bus takes frames; on_degraded: called once with the transport's `detail` when it is first
    degraded; pace: takes how far the computer falls behind. BusLostError: the bus failed.
    """
    period = core.period_ns
    started = time.monotonic_ns()
    ticks = 0
    while not stop.is_set():
        if real_time:
            due = started + (ticks + 1) * period
            while (left := due - time.monotonic_ns()) > 0 and not stop.is_set():
                frame = transport.receive(min(left / 1e9, RECEIVE_POLL_S))
                if frame is not None:
                    core.take(frame)
            if pace is not None:
                pace.behind_s = max(pace.behind_s, (time.monotonic_ns() - due) / 1e9)
        # A flooded bus must not stop the control law.
        for _ in range(64):
            frame = transport.receive(0.0)
            if frame is None:
                break
            core.take(frame)
        for frame in core.step():
            transport.send(frame)
        if on_degraded is not None and transport.state is TransportState.DEGRADED:
            on_degraded(transport.detail)
            on_degraded = None
        ticks += 1
    return ticks


@contextmanager
def emulator_in_thread(core: FccCore, transport: Transport) -> Iterator[Pace]:
    """Run the computer on a bus in a thread of its own while the block runs.

    Yields how far the computer falls behind. EhadiagError: the emulator's bus failed meanwhile.
    """
    stop = threading.Event()
    failure: list[EhadiagError] = []
    pace = Pace()

    def work() -> None:
        try:
            run_emulator(core, transport, stop, pace=pace)
        except EhadiagError as error:
            failure.append(error)

    thread = threading.Thread(target=work, name="ehadiag-emulator", daemon=True)
    thread.start()
    try:
        yield pace
    finally:
        stop.set()
        thread.join()
    if failure:
        raise failure[0]


class EmulatorTransport(Transport):
    """The emulated computer itself as a transport, in simulated time and without threads.

    Reading advances the computer as far as the next frame needs; a time limit is simulated time.
    The same frames in the same order, whatever the host does.
    """

    def __init__(self, core: FccCore, *, transmit: bool = True) -> None:
        super().__init__("simulated flight-control computer", transmit=transmit)
        self._core = core
        self._frames: deque[Frame] = deque()
        self._now = core.now_ns

    @property
    def real_time(self) -> bool:
        """Nothing waits here."""
        return False

    def now_ns(self) -> int:
        """Simulated time, ns."""
        return self._now

    def stamp_ns(self) -> int:
        """Simulated time, ns."""
        return self._now

    def _receive(self, timeout: float) -> Frame | None:
        limit = self._now + round(timeout * 1e9)
        while not self._frames and self._core.now_ns < limit:
            self._frames.extend(self._core.step())
        if not self._frames:
            self._now = max(self._now, limit)
            return None
        frame = self._frames.popleft()
        self._now = max(self._now, frame.time_ns)
        return frame

    def _send(self, frame: Frame) -> None:
        self._core.take(frame)

    def _close(self) -> None:
        self._frames.clear()
