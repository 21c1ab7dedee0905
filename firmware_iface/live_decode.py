"""Decodes single frames as they arrive: statuses, samples, requests, and complete control ticks.

A complete test is put together afterwards, from columns, by `firmware_iface.alignment.align`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import NamedTuple

import msgspec

from firmware_iface.bus_map import ONBOARD_SEVERITIES, BusMap, MessageMap, Role, default_map
from firmware_iface.codec import value_ends
from firmware_iface.dbc import FLOAT_FORMATS, SignalLayout
from firmware_iface.errors import ConfigurationError
from firmware_iface.protection import SenderWatch, intact
from firmware_iface.recording import (
    CHANNEL_NAMES,
    CHANNEL_ROLES,
    BitReason,
    BitState,
    CommandMode,
    OnboardResult,
    OnboardState,
)
from firmware_iface.slow_values import SlowValueWatch, brings_slow_values
from firmware_iface.transport.frames import Frame


class BitStatus(msgspec.Struct, frozen=True):
    """One valid `BitStatus` message."""

    state: BitState
    reason: BitReason = BitReason.NONE
    test_id: int | None = 0
    elapsed: float = 0.0
    """s."""
    serial: int | None = None
    refusal: str = ""
    """The computer's own word for a refusal without a reason."""


class Sample(msgspec.Struct, frozen=True):
    """One valid telemetry message: A, m, Pa, m; the last known value of what it does not bring."""

    current: float
    spool: float
    pressure: float
    position: float
    brought: frozenset[str] = frozenset(CHANNEL_NAMES)
    """Channels that this very message brings."""


class BitRequest(msgspec.Struct, frozen=True):
    """One valid `BitRequest` message; code `start`, `abort`, or empty for an unknown number."""

    code: str
    test_id: int


REASON_NUMBERS = frozenset(BitReason)
SAMPLE_FIELDS = dict(zip(CHANNEL_ROLES, CHANNEL_NAMES, strict=True))
"""Roles in the order of `Sample`'s fields."""


class LiveDecoder:
    """Decodes single frames of the mapped messages, good ones only.

    Keeps the last value of each channel, for buses that spread a sample over several messages.
    Telemetry whose counter was just used with another payload is left out, and said to be.

    second_sender: what gives away that somebody else sends as the computer does; empty if nothing.
    """

    second_sender: str

    def __init__(self, bus_map: BusMap | None = None) -> None:
        self._map = bus_map or default_map()
        sections = ("channels", "environment", "status", "request")
        self._messages = {
            (item.can_id, item.extended): item
            for item in self._map.messages.values()
            if any(role.name.split(".")[0] in sections for role in item.roles)
        }
        self._codes = {number: name for name, number in self._map.requests.items()}
        self._last = dict.fromkeys(SAMPLE_FIELDS, math.nan)
        self._watches = {
            item.name: SenderWatch(item.modulus, _period_ns(item, self._map))
            for item in self._messages.values()
            if item.counter is not None and not _requests(item)
        }
        self._slow_watches = {
            item.name: SlowValueWatch(item)
            for item in self._messages.values()
            if brings_slow_values(item)
        }
        self._channel = self._map.channel or 0
        self.second_sender = ""

    @property
    def conflicts(self) -> int:
        """Counter values that came with different payloads so far."""
        return sum(item.conflicts for item in self._watches.values())

    def decode(self, frame: Frame) -> BitStatus | Sample | BitRequest | None:
        """Content of a frame; None for foreign, damaged and all other frames."""
        message = self._messages.get((frame.can_id, frame.extended))
        if (
            message is None
            or frame.error
            or frame.remote
            or not intact(message, frame.data)
            or self._of_another(message, frame)
        ):
            return None
        values = _values(message, frame.data)
        if slow := self._slow_watches.get(message.name):
            key = counter_key(message, message.counter, frame.data)
            found = slow.take(frame.time_ns, key[0] if key else None, frame.data, values)
            self.second_sender = found or self.second_sender
            return None
        if any(name in self._last for name in values):
            self._last |= {name: values[name] for name in SAMPLE_FIELDS if name in values}
            brought = frozenset(key for name, key in SAMPLE_FIELDS.items() if name in values)
            current, spool, pressure, position = (self._last[name] for name in SAMPLE_FIELDS)
            return Sample(current, spool, pressure, position, brought)
        if "status.state" in values:
            return self._status(values)
        if "request.code" in values:
            code = self._codes.get(round(values["request.code"]), "")
            return BitRequest(code, round(values.get("request.test_id", 0.0)))
        return None

    def _of_another(self, message: MessageMap, frame: Frame) -> bool:
        """Whether a sound frame is another channel's, or in conflict with one before."""
        if frame.channel not in (0, self._channel) and not _requests(message):
            if self._channel:
                if self._map.channel is None:
                    self.second_sender = (
                        f"frames of the actuator's on the channels {self._channel} and"
                        f" {frame.channel}: choose one by channel in the mapping"
                    )
                return True
            self._channel = frame.channel
        watch = self._watches.get(message.name)
        key = counter_key(message, message.counter, frame.data)
        if watch is None or key is None:
            return False
        state = None
        if not message.measures:
            state = _values(message, frame.data).get("status.state")
        conflict = watch.take(key, frame.data, frame.time_ns, state)
        if conflict and watch.second_sender:
            self.second_sender = (
                f"a second sender of {message.name} ({message.can_id:#x}): counters come with"
                " different payloads"
            )
        return conflict and message.measures  # what a status says, the handshake has to hear

    def _status(self, values: Mapping[str, float]) -> BitStatus | None:
        state = self._map.states.get(round(values["status.state"]))
        if state is None:
            return None
        reason = round(values.get("status.reason", 0.0))
        serial = values.get("status.serial")
        test_id = values.get("status.test_id")
        return BitStatus(
            state=BitState(state),
            reason=BitReason(reason) if reason in REASON_NUMBERS else BitReason.NONE,
            test_id=None if test_id is None else round(test_id),
            elapsed=values.get("status.elapsed", 0.0),
            serial=None if serial is None else round(serial),
        )


def counter_key(
    message: MessageMap, counter: SignalLayout | None, data: bytes
) -> tuple[int, ...] | None:
    """Counter of a payload and the page that it counts; None where it carries no counter."""
    if counter is None:
        return None
    selectors = {item: chosen for role in message.roles for item, chosen in role.signal.selectors}
    pages = tuple(bit_pattern(item, data) for item in selectors)
    if any(bit_pattern(item, data) not in chosen for item, chosen in counter.selectors):
        return None
    return (bit_pattern(counter, data), *pages)


def _requests(message: MessageMap) -> bool:
    return all(role.name.startswith("request.") for role in message.roles)


def _period_ns(message: MessageMap, bus_map: BusMap) -> int:
    """Usual time between two counts."""
    if message.counts_ticks or message.measures:
        return bus_map.tick_ns
    return message.cycle_ns or 20_000_000


def checked_values(message: MessageMap, data: bytes) -> dict[str, float] | None:
    """SI value of each role in a payload; None where its length or its check sum is wrong."""
    return _values(message, data) if intact(message, data) else None


def bit_pattern(signal: SignalLayout, data: bytes) -> int:
    """Bits of a signal in a payload, as an unsigned number."""
    words = {True: int.from_bytes(data, "big"), False: int.from_bytes(data, "little")}
    return _pattern(signal, words, 8 * len(data))


def _values(message: MessageMap, data: bytes) -> dict[str, float]:
    """SI value of each role that is present."""
    words = {True: int.from_bytes(data, "big"), False: int.from_bytes(data, "little")}
    bits = 8 * len(data)
    return {
        role.name: _si(role, words, bits)
        for role in message.roles
        if all(_pattern(item, words, bits) in chosen for item, chosen in role.signal.selectors)
    }


def _pattern(signal: SignalLayout, words: Mapping[bool, int], bits: int) -> int:
    big = signal.big_endian
    shift = bits - signal.lead - signal.length if big else signal.start
    return words[big] >> shift & ((1 << signal.length) - 1)


def _si(role: Role, words: Mapping[bool, int], bits: int) -> float:
    signal = role.signal
    pattern = _pattern(signal, words, bits)
    raw: float = pattern
    if signal.is_float:
        size = signal.length // 8
        raw = struct.unpack(FLOAT_FORMATS[signal.length], pattern.to_bytes(size, "little"))[0]
    elif signal.signed and pattern >> (signal.length - 1):
        raw = pattern - (1 << signal.length)
    return (raw * signal.scale + signal.offset) * role.gain + role.bias


NAN = math.nan
COMMAND_ROLES = {mode: f"command.{mode.name.lower()}" for mode in CommandMode}
MAX_LATE_TICKS = 16
"""Ticks by which a frame may come late; its tick has been given out as lost."""
DOUBTFUL_TICKS = 50
"""Ticks given out as lost after a conflict: with 2 % of conflicts, the most that is borne, all."""
SILENCE_NS = 1_000_000_000
"""After so long the counter says nothing any more: the ticks begin anew."""


class LiveTick(NamedTuple):
    """One control tick in SI; NaN where a value was lost or stands at its converter's end."""

    command: float
    """A or m, active during the tick."""
    current: float
    """A, at the end of the tick, like the rest."""
    spool: float
    """m."""
    pressure: float
    """Pa."""
    position: float
    """m."""


class LiveTicks:
    """Puts single frames together into ticks: every tick once, in order, lost ones as NaN.

    A tick is given out when its telemetry and its command are there, a tick without a command when
    the next telemetry comes. Memory is constant. Use it from one thread.

    bus_map: mapping; all channels must come in one frame, and its counter and that of the command
    must count ticks; mode: of the commands to take; those of the other mode count as lost. None:
    both, and the attribute `mode` is that of the last command before the tick that `take` gives
    out; lost: ticks whose telemetry did not come, or was
    damaged; breaks: silences so long that the ticks began anew after them; conflicts: counter
    values that came with different payloads: a second sender. The `DOUBTFUL_TICKS` ticks after each
    are given out as lost: nothing tells which sender is right. ConfigurationError: a bus whose
    ticks cannot be told from single frames.
    """

    mode: CommandMode
    lost: int
    breaks: int
    conflicts: int

    def __init__(
        self, bus_map: BusMap | None = None, mode: CommandMode | None = CommandMode.POSITION
    ) -> None:
        bus_map = bus_map or default_map()
        self._has_mode = bus_map.fixed_mode is None
        self._follows = mode is None and self._has_mode
        self.mode = mode or bus_map.fixed_mode or CommandMode.POSITION
        self._telemetry, counter = _counted_message(bus_map, CHANNEL_ROLES)
        values = [COMMAND_ROLES[self.mode]]
        if self._follows:
            values = [value for value in COMMAND_ROLES.values() if bus_map.find(value)] or values
        roles = (*values, "command.mode") if self._has_mode else tuple(values)
        self._command, command_counter = _counted_message(bus_map, roles)
        self._counters = {self._telemetry.name: counter, self._command.name: command_counter}
        self._modes = {float(number): meaning for number, meaning in bus_map.modes.items()}
        self._ends = tuple(_channel_ends(self._telemetry, key) for key in CHANNEL_ROLES)
        self._turn = min(self._telemetry.modulus, _longest_turn(bus_map.tick_ns))
        self._commands = [NAN] * self._turn
        self._at = -1
        self._time_ns = 0
        self._held: LiveTick | None = None
        self._watches = {
            item.name: SenderWatch(item.modulus, bus_map.tick_ns)
            for item in (self._telemetry, self._command)
        }
        self._channel = bus_map.channel or 0
        self._doubtful = 0
        self.lost = 0
        self.breaks = 0
        self.conflicts = 0

    def take(self, frame: Frame) -> list[LiveTick]:
        """Take a frame; returns the ticks that are complete now, mostly none or one."""
        return [self._or_doubtful(tick) for tick in self._complete(frame)]

    def _complete(self, frame: Frame) -> list[LiveTick]:
        for message in (self._telemetry, self._command):
            if frame.can_id == message.can_id and frame.extended == message.extended:
                break
        else:
            return []
        values = None if frame.error or frame.remote else checked_values(message, frame.data)
        if values is None:
            return []
        if self._of_another(message, frame):
            return []
        count = bit_pattern(self._counters[message.name], frame.data) % self._turn
        out: list[LiveTick] = []
        if not values.keys().isdisjoint(COMMAND_ROLES.values()):
            self._take_command(count, values, out)
        if CHANNEL_ROLES[0] in values:
            self._take_telemetry(count, frame.time_ns, values, out)
        return out

    def _of_another(self, message: MessageMap, frame: Frame) -> bool:
        """Whether a frame is another channel's, or in conflict with one before."""
        if frame.channel not in (0, self._channel):
            if self._channel:
                return True
            self._channel = frame.channel
        key = counter_key(message, self._counters[message.name], frame.data)
        if key is None or not self._watches[message.name].take(key, frame.data, frame.time_ns):
            return False
        self.conflicts += 1
        self._doubtful = DOUBTFUL_TICKS
        return True

    def _or_doubtful(self, tick: LiveTick) -> LiveTick:
        """The tick, or a lost one in its place soon after a conflict."""
        if not self._doubtful:
            return tick
        self._doubtful -= 1
        self.lost += math.isfinite(tick.spool)
        return LiveTick(NAN, NAN, NAN, NAN, NAN)

    def _take_command(self, count: int, values: dict[str, float], out: list[LiveTick]) -> None:
        if self._has_mode:
            mode = self._modes.get(values.get("command.mode", NAN))
            if mode is None or (mode is not self.mode and not self._follows):
                return
            self.mode = mode
        value = values.get(COMMAND_ROLES[self.mode])
        if value is None:
            return
        if self._held is not None and count == self._at:
            out.append(self._held._replace(command=value))
            self._held = None
        elif (self._at - count) % self._turn >= MAX_LATE_TICKS or self._at < 0:
            self._commands[count] = value

    def _take_telemetry(
        self, count: int, time_ns: int, values: dict[str, float], out: list[LiveTick]
    ) -> None:
        step = self._step(count, time_ns)
        if step == 0:
            return
        if self._held is not None:
            out.append(self._held)
            self._held = None
        for _ in range(step - 1):
            self._at = (self._at + 1) % self._turn
            out.append(LiveTick(self._taken(self._at), NAN, NAN, NAN, NAN))
        self.lost += step - 1
        self._at, self._time_ns = count, time_ns
        pairs = zip(CHANNEL_ROLES, self._ends, strict=True)
        seen = [values[key] if low < values[key] < high else NAN for key, (low, high) in pairs]
        tick = LiveTick(self._taken(count), *seen)
        if math.isfinite(tick.command):
            out.append(tick)
        else:
            self._held = tick

    def _step(self, count: int, time_ns: int) -> int:
        """Ticks since the telemetry before: 0 for a frame that is repeated or comes late."""
        if self._at < 0:
            return 1
        if time_ns - self._time_ns > SILENCE_NS:
            self._commands = [NAN] * self._turn
            self.breaks += 1
            return 1
        step = (count - self._at) % self._turn
        return 0 if step > self._turn - MAX_LATE_TICKS else step

    def _taken(self, count: int) -> float:
        command, self._commands[count] = self._commands[count], NAN
        return command


def _longest_turn(tick_ns: int) -> int:
    """Counts that tell how long a pause was that is no silence yet; a wider counter is cut.

    A power of two, for that divides the turn of any counter. What a counter jumps by makes no more
    lost ticks than these, and they cost their memory.
    """
    return 1 << (2 * SILENCE_NS // tick_ns + 2 * MAX_LATE_TICKS).bit_length()


def _counted_message(bus_map: BusMap, roles: tuple[str, ...]) -> tuple[MessageMap, SignalLayout]:
    """Return the message of which one frame brings all these roles, and its counter of ticks."""
    found = [item for item in map(bus_map.find, roles) if item is not None]
    frames = {(message.name, role.signal.selectors) for message, role in found}
    if len(found) < len(roles) or len(frames) != 1:
        raise ConfigurationError(
            f"{bus_map.name}: to follow single ticks one frame must bring {', '.join(roles)}"
        )
    message, role = found[0]
    counter = message.counter if message.counts_ticks else None
    if (
        counter is None
        or message.modulus <= 2 * MAX_LATE_TICKS
        or not set(counter.selectors) <= set(role.signal.selectors)
    ):
        raise ConfigurationError(
            f"{bus_map.name}: to follow single ticks {message.name} needs a counter of ticks"
            f" beyond {2 * MAX_LATE_TICKS} in the same frame"
        )
    return message, counter


def _channel_ends(message: MessageMap, key: str) -> tuple[float, float]:
    """SI values between which a channel is not at its converter's end."""
    role = next(item for item in message.roles if item.name == key)
    low, high = sorted(end * role.gain + role.bias for end in value_ends(role.signal))
    return low, high


BUSY_ONBOARD_STATES = (OnboardState.RECORDING, OnboardState.IDENTIFYING)


class OnboardReader:
    """Puts a result together of its messages, in order of arrival.

    The severities count that come while the computer says that it is done.

    result: the last whole result; None when a later test has begun.
    """

    result: OnboardResult | None

    def __init__(self, bus_map: BusMap) -> None:
        self._messages = {(item.can_id, item.extended): item for item in bus_map.onboard}
        self._state: int | None = None
        self._progress: dict[str, float] = {}
        self._values: dict[str, float] = {}
        self.result = None

    @property
    def awaited(self) -> bool:
        """Whether the computer is about to find something, or has and not yet said all of it."""
        return self._state in BUSY_ONBOARD_STATES or (
            self._state == OnboardState.DONE and self.result is None
        )

    def of_test(self, test_id: int | None) -> OnboardResult | None:
        """Return the result if it can be that of a test; None: the number is not known."""
        found = self.result
        return found if found is not None and found.is_of(test_id) else None

    def take(self, frame: Frame) -> None:
        """Take any frame."""
        if not (frame.error or frame.remote):
            self.take_payload(frame.can_id, frame.extended, frame.data)

    def take_payload(self, can_id: int, extended: bool, data: bytes) -> None:
        """Take the payload of a data frame."""
        message = self._messages.get((can_id, extended))
        values = None if message is None else checked_values(message, data)
        if values is not None:
            self._take_values(
                {name.removeprefix("onboard."): value for name, value in values.items()}
            )

    def _take_values(self, values: Mapping[str, float]) -> None:
        if "state" in values:
            self._state = round(values["state"])
            if values != self._progress:
                self._values, self.result, self._progress = {}, None, dict(values)
        if self._state != OnboardState.DONE:
            return
        self._values |= values
        if self.result is None and all(
            name in self._values for key in ONBOARD_SEVERITIES for name in (key, f"std_{key}")
        ):
            std = {key: self._values[f"std_{key}"] for key in ONBOARD_SEVERITIES}
            # A deviation of 0 says that the computer has no estimate.
            self.result = OnboardResult(
                test_id=self._number("test_id"),
                verdict=self._number("verdict"),
                runs=self._number("runs"),
                severities={k: self._values[k] if std[k] > 0.0 else math.nan for k in std},
                std={k: value if value > 0.0 else math.nan for k, value in std.items()},
            )

    def _number(self, key: str) -> int | None:
        return round(self._values[key]) if key in self._values else None
