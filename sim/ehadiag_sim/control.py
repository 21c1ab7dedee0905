"""Changes of a simulated unit while it runs: from Python, a script of times, or a control port.

All three make the same `Change`; the emulated computer applies them between two ticks.
"""

from __future__ import annotations

import socketserver
import struct
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ehadiag_sim.conditions import (
    ConditionOption,
    Effects,
    Faults,
    Sensors,
    UnmodelledEffects,
    check_within,
    condition_options,
)
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import read_toml
from firmware_iface.protection import crc8
from firmware_iface.transport.frames import Frame

MAX_LINE_BYTES = 1 << 16
"""Bytes of a request to the control port."""
LOOPBACK = "127.0.0.1"
"""Address of the control port: no other computer reaches it."""
NEXT_TEST_KEYS = frozenset({"plays", "filter_ms", "early_ms"})
"""Conditions of state or timing, which are those of the next test that begins."""
BUS_KEYS: Mapping[str, tuple[float, float]] = {
    "frames_lost": (0.0, 1.0),
    "frames_damaged": (0.0, 1.0),
    "frames_doubled": (0.0, 1.0),
    "second_sender": (0.0, 1.0),
    "bus_off_s": (0.0, 3600.0),
}
"""Damage to the bus with its range: shares of the frames, 1, and a time without any frame, s."""
COUNTER_BYTE_INDEX, CRC_BYTE_INDEX = 6, 7
"""Places in a payload of the default bus."""


@dataclass(frozen=True, slots=True)
class FrameMoment:
    """When a frame passes, s since the first one, and the chance that strikes it."""

    since: float
    rng: np.random.Generator


@dataclass(slots=True)
class FrameLoss:
    """Single frames vanish; `only` names the identifier it strikes."""

    share: float
    only: int | None = None

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Drop a frame by chance."""
        hit = self.only in (None, frame.can_id) and at.rng.random() < self.share
        return () if hit else (frame,)


@dataclass(slots=True)
class DuplicateFrames:
    """Frames come twice."""

    share: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Repeat a frame by chance."""
        return (frame, frame) if at.rng.random() < self.share else (frame,)


@dataclass(slots=True)
class BitFlips:
    """One bit of a payload changes; `mended` gives it a valid check sum."""

    share: float
    mended: bool = False

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Flip a bit by chance."""
        if not frame.data or at.rng.random() >= self.share:
            return (frame,)
        bit = int(at.rng.integers(8 * (CRC_BYTE_INDEX if self.mended else len(frame.data))))
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        damaged = msgspec.structs.replace(frame, data=bytes(data))
        return (with_valid_crc(damaged) if self.mended else damaged,)


@dataclass(slots=True)
class SecondSender:
    """Another device sends the same messages, with counters of its own and valid check sums."""

    share: float

    def __call__(self, frame: Frame, at: FrameMoment) -> Iterable[Frame]:
        """Add its frame by chance."""
        if len(frame.data) <= CRC_BYTE_INDEX or at.rng.random() >= self.share:
            return (frame,)
        data = bytearray(frame.data)
        data[COUNTER_BYTE_INDEX] = (data[COUNTER_BYTE_INDEX] + 128) % 256
        return (frame, with_valid_crc(msgspec.structs.replace(frame, data=bytes(data))))


def with_valid_crc(frame: Frame) -> Frame:
    """Return the frame with a valid check sum of the default bus."""
    header = struct.pack("<H", frame.can_id & 0xFFFF)
    body = frame.data[:CRC_BYTE_INDEX]
    return msgspec.structs.replace(frame, data=body + bytes((crc8(header + body),)))


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """New values of some conditions, at once or along a ramp."""

    set: dict[str, float | tuple[float, ...]]
    """By the keys of a scenario, in their units, and those of `BUS_KEYS`."""
    ramp_s: float = 0.0
    """Time in which each value goes to its new one, s."""
    at_s: float = 0.0
    """Time after the start of the simulated computer, s; past: at once."""


class _Script(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Script file."""

    change: tuple[Change, ...]


class _Inquiry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Request for the present values, `{"get": true}`."""

    get: bool


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of a simulated unit."""

    faults: Faults
    effects: Effects
    sensors: Sensors


@dataclass(slots=True)
class _Ramp:
    """A value on its way."""

    begin_tick: int
    ticks: int
    begin: float
    end: float


def read_script(path: Path | str) -> tuple[Change, ...]:
    """Read the changes of a script, a TOML file of tables `[[change]]`.

    ConfigurationError: an unknown key, a value out of its range; InputOutputError: it cannot be
    read.
    """
    script: _Script = read_toml(Path(path), _Script, "script")
    for change in script.change:
        _check(change, f"script {path}")
    return script.change


class SimulatorControl:
    """Changes of one simulated unit, applied between its ticks; safe to call from any thread.

    changes: those of a script; seed: of what strikes frames by chance.
    """

    def __init__(self, changes: Iterable[Change] = (), *, seed: int = 0) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Change] = deque()
        self._script = sorted(changes, key=lambda item: item.at_s)
        self._ramps: dict[str, _Ramp] = {}
        self._rate = 1.0
        self._tick = 0
        self._off_until = 0
        self._bus = dict.fromkeys(BUS_KEYS, 0.0)
        self._loss, self._flips = FrameLoss(0.0), BitFlips(0.0)
        self._double, self._second = DuplicateFrames(0.0), SecondSender(0.0)
        self._rng = np.random.default_rng(seed)
        self._conditions = Conditions(Faults(), Effects(), Sensors())

    def apply(self, change: Change) -> None:
        """Apply a change before the next tick, or at its time.

        ConfigurationError: an unknown key, a value of another kind or out of its range.
        """
        _check(change, "change")
        with self._lock:
            self._waiting.append(change)

    def state(self) -> dict[str, Any]:
        """Return the present values by their keys, and the time, s."""
        with self._lock:
            values = {
                key: _in_unit(item, getattr(_part(self._conditions, kind), item.field))
                for key, (kind, item) in _known().items()
            }
            return {"time_s": self._tick / self._rate, **values, **self._bus}

    def begin(self, conditions: Conditions, rate: float) -> None:
        """Take what the computer starts with, and its ticks a second, Hz."""
        self._conditions, self._rate = conditions, rate

    def advance(self) -> Conditions | None:
        """Go on by a tick; return the conditions from it on where they change."""
        with self._lock:
            now = self._tick / self._rate
            self._tick += 1
            due = [*self._waiting]
            self._waiting.clear()
            for change in due:
                if change.at_s > now:
                    self._script.append(change)
            self._script.sort(key=lambda item: item.at_s)
            due = [item for item in due if item.at_s <= now]
            while self._script and self._script[0].at_s <= now:
                due.append(self._script.pop(0))
            before = self._conditions
            for change in due:
                self._begin(change)
            # Each step of a ramp costs 0.1 ms: the plant's coefficients.
            if self._ramps and self._tick % 10 == 0:
                self._move()
            return self._conditions if self._conditions is not before else None

    def frames(self, frames: Iterable[Frame]) -> list[Frame]:
        """Return what a damaged bus makes of the frames of a tick."""
        with self._lock:
            if self._tick < self._off_until:
                return []
            found = list(frames)
            if any(self._bus.values()):
                moment = FrameMoment(self._tick / self._rate, self._rng)
                for fault in (self._second, self._double, self._flips, self._loss):
                    found = [out for frame in found for out in fault(frame, moment)]
            return found

    def _begin(self, change: Change) -> None:
        for key, value in change.set.items():
            self._ramps.pop(key, None)
            if change.ramp_s > 0.0 and not isinstance(value, tuple):
                ticks = max(round(change.ramp_s * self._rate), 1)
                self._ramps[key] = _Ramp(self._tick, ticks, self._present(key), float(value))
            else:
                self._put(key, value)

    def _move(self) -> None:
        """Bring the values of all ramps up to date."""
        for key, ramp in list(self._ramps.items()):
            share = min((self._tick - ramp.begin_tick) / ramp.ticks, 1.0)
            self._put(key, ramp.begin + share * (ramp.end - ramp.begin))
            if share >= 1.0:
                del self._ramps[key]

    def _present(self, key: str) -> float:
        if key in BUS_KEYS:
            return self._bus[key]
        kind, item = _known()[key]
        return float(_in_unit(item, getattr(_part(self._conditions, kind), item.field)))

    def _put(self, key: str, value: float | tuple[float, ...]) -> None:
        if key in BUS_KEYS:
            assert not isinstance(value, tuple)
            self._bus[key] = value
            self._loss.share, self._flips.share = (
                self._bus["frames_lost"],
                self._bus["frames_damaged"],
            )
            self._double.share = self._bus["frames_doubled"]
            self._second.share = self._bus["second_sender"]
            if key == "bus_off_s":
                self._off_until = self._tick + round(value * self._rate)
                self._bus[key] = 0.0
            return
        self._conditions = _with_value(self._conditions, key, value)


def _known() -> dict[str, tuple[type[Any], ConditionOption]]:
    """Conditions by their keys, each with its class."""
    kinds = (Faults, Effects, UnmodelledEffects, Sensors)
    return {item.key: (kind, item) for kind in kinds for item in condition_options(kind)}


def _part(conditions: Conditions, kind: type[Any]) -> Any:
    """Part of the conditions that is of a class."""
    parts = (conditions.faults, conditions.effects, conditions.effects.unmodelled)
    return next(item for item in (*parts, conditions.sensors) if type(item) is kind)


def _in_unit(item: ConditionOption, value: Any) -> Any:
    """Return a value in the unit of its key."""
    return value / item.scale if isinstance(value, float) else value


def _with_value(conditions: Conditions, key: str, value: float | tuple[float, ...]) -> Conditions:
    """Return conditions with one other value, in the unit of its key."""
    kind, item = _known()[key]
    several = isinstance(item.default, tuple)
    if several != isinstance(value, tuple):
        need = f"{len(item.default)} numbers" if several else "a number"
        raise ConfigurationError(f"{key}: {value!r}: need {need}")
    if isinstance(item.default, float) and not isinstance(value, tuple):
        value = value * item.scale
    changed = replace(_part(conditions, kind), **{item.field: value})
    if kind is UnmodelledEffects:
        return replace(conditions, effects=replace(conditions.effects, unmodelled=changed))
    name = next(f.name for f in fields(Conditions) if type(getattr(conditions, f.name)) is kind)
    return replace(conditions, **{name: changed})


def _check(change: Change, where: str) -> None:
    """Raise ConfigurationError unless a change can be made."""
    known = (*_known(), *BUS_KEYS)
    try:
        check_within("ramp_s", change.ramp_s, 0.0, 1e6)
        check_within("at_s", change.at_s, 0.0, 1e9)
        for key, value in change.set.items():
            if key in BUS_KEYS:
                if isinstance(value, tuple):
                    raise ConfigurationError(f"{key}: need a number")
                check_within(key, value, *BUS_KEYS[key])
            elif key in known:
                _with_value(Conditions(Faults(), Effects(), Sensors()), key, value)
            else:
                near = get_close_matches(key, known, n=1)
                hint = f", did you mean {near[0]}?" if near else ""
                raise ConfigurationError(f"there is no key {key}{hint}")
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from None


@contextmanager
def control_port(control: SimulatorControl, port: int) -> Iterator[int]:
    """Serve a control port on this computer's loopback address while the block runs.

    Each request is a line of JSON, a `Change` such as `{"set": {"FSS": 0.4}, "ramp_s": 2}` or
    `{"get": true}`; each answer is a line, `{"ok": true}`, the values, or `{"error": "..."}`.

    port: number, 0 … 65535; 0: any free one. ConfigurationError: it is in use, or not allowed.
    """

    class LineHandler(socketserver.StreamRequestHandler):
        timeout = 60.0

        def handle(self) -> None:
            """Answer the lines of one connection."""
            while line := self.rfile.readline(MAX_LINE_BYTES + 1):
                self.wfile.write(msgspec.json.encode(_answer(control, line)) + b"\n")
                if len(line) > MAX_LINE_BYTES:
                    return

    class Server(socketserver.ThreadingTCPServer):
        allow_reuse_address = True
        daemon_threads = True

        def handle_error(self, _request: Any, _address: Any) -> None:
            """A connection that breaks off is the other end's business."""

    try:
        server = Server((LOOPBACK, port), LineHandler)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigurationError(f"control port {port}: {reason}; choose another") from None
    thread = threading.Thread(target=server.serve_forever, name="ehadiag-control", daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _answer(control: SimulatorControl, line: bytes) -> dict[str, Any]:
    if len(line) > MAX_LINE_BYTES:
        return {"error": f"a line of more than {MAX_LINE_BYTES} bytes"}
    try:
        request: Any = msgspec.json.decode(line)
        if isinstance(request, dict) and "get" in request:
            msgspec.convert(request, _Inquiry)
            return control.state()
        change = msgspec.convert(request, Change)
        control.apply(change)
    except (msgspec.MsgspecError, ConfigurationError, RecursionError) as error:
        return {"error": str(error)}
    later = sorted(NEXT_TEST_KEYS & change.set.keys())
    return {"ok": True, **({"from_next_test": later} if later else {})}
