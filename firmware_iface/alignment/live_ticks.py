"""Assembles live telemetry and commands into control ticks, one by one, for the monitor.

A whole test is put together afterwards, from columns, by `firmware_iface.alignment.align`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ehadiag.core.errors import ConfigurationError
from ehadiag.core.recording import CommandMode
from firmware_iface.codec.decode import value_ends
from firmware_iface.codec.live_decode import bit_pattern, checked_values, counter_key
from firmware_iface.codec.validity import SenderWatch
from firmware_iface.mapping.bus_map import BusMap, MessageMap, default_map
from firmware_iface.mapping.signal_layout import SignalLayout
from firmware_iface.transport.frames import Frame

__all__ = ["LiveTick", "LiveTicks"]

NAN = math.nan
KEYS = ("channels.current", "channels.spool", "channels.pressure", "channels.position")
VALUES = {mode: f"command.{mode.name.lower()}" for mode in CommandMode}
LATE = 16
"""Ticks by which a frame may come late; its tick has been given out as lost."""
DOUBTFUL = 50
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

    Parameters
    ----------
    bus_map : BusMap | None
        Mapping; all channels must come in one frame, and its counter and that of the command
        must count ticks.
    mode : CommandMode | None
        Of the commands to take; those of the other mode count as lost. None: both, and `mode` says
        which the last command had.

    Attributes
    ----------
    mode : CommandMode
        Of the commands; a tick that `take` gives out has that of the command before it.
    lost : int
        Ticks whose telemetry did not come, or was damaged.
    breaks : int
        Silences so long that the ticks began anew after them.
    conflicts : int
        Counter values that came with different payloads: a second sender. The `DOUBTFUL` ticks
        after each are given out as lost: nothing tells which sender is right.

    Raises
    ------
    ConfigurationError
        A bus whose ticks cannot be told from single frames.
    """

    mode: CommandMode
    lost: int
    breaks: int
    conflicts: int

    def __init__(
        self, bus_map: BusMap | None = None, mode: CommandMode | None = CommandMode.POSITION
    ) -> None:
        bus_map = bus_map or default_map()
        self._mode_told = bus_map.fixed_mode is None
        self._follows = mode is None and self._mode_told
        self.mode = mode or bus_map.fixed_mode or CommandMode.POSITION
        self._telemetry, counter = _counted(bus_map, KEYS)
        values = [VALUES[self.mode]]
        if self._follows:
            values = [value for value in VALUES.values() if bus_map.find(value)] or values
        told = (*values, "command.mode") if self._mode_told else tuple(values)
        self._command, command_counter = _counted(bus_map, told)
        self._counters = {self._telemetry.name: counter, self._command.name: command_counter}
        self._modes = {float(number): meaning for number, meaning in bus_map.modes.items()}
        self._ends = tuple(_ends(self._telemetry, key) for key in KEYS)
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
        return [self._believed(tick) for tick in self._complete(frame)]

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
        if not values.keys().isdisjoint(VALUES.values()):
            self._take_command(count, values, out)
        if KEYS[0] in values:
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
        self._doubtful = DOUBTFUL
        return True

    def _believed(self, tick: LiveTick) -> LiveTick:
        """The tick, or a lost one in its place soon after a conflict."""
        if not self._doubtful:
            return tick
        self._doubtful -= 1
        self.lost += math.isfinite(tick.spool)
        return LiveTick(NAN, NAN, NAN, NAN, NAN)

    def _take_command(self, count: int, values: dict[str, float], out: list[LiveTick]) -> None:
        if self._mode_told:
            mode = self._modes.get(values.get("command.mode", NAN))
            if mode is None or (mode is not self.mode and not self._follows):
                return
            self.mode = mode
        value = values.get(VALUES[self.mode])
        if value is None:
            return
        if self._held is not None and count == self._at:
            out.append(self._held._replace(command=value))
            self._held = None
        elif (self._at - count) % self._turn >= LATE or self._at < 0:
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
        pairs = zip(KEYS, self._ends, strict=True)
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
        return 0 if step > self._turn - LATE else step

    def _taken(self, count: int) -> float:
        command, self._commands[count] = self._commands[count], NAN
        return command


def _longest_turn(tick_ns: int) -> int:
    """Counts that tell how long a pause was that is no silence yet; a wider counter is cut.

    A power of two, for that divides the turn of any counter. What a counter jumps by makes no more
    lost ticks than these, and they cost their memory.
    """
    return 1 << (2 * SILENCE_NS // tick_ns + 2 * LATE).bit_length()


def _counted(bus_map: BusMap, roles: tuple[str, ...]) -> tuple[MessageMap, SignalLayout]:
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
        or message.modulus <= 2 * LATE
        or not set(counter.selectors) <= set(role.signal.selectors)
    ):
        raise ConfigurationError(
            f"{bus_map.name}: to follow single ticks {message.name} needs a counter of ticks"
            f" beyond {2 * LATE} in the same frame"
        )
    return message, counter


def _ends(message: MessageMap, key: str) -> tuple[float, float]:
    """SI values between which a channel is not at its converter's end."""
    role = next(item for item in message.roles if item.name == key)
    low, high = sorted(end * role.gain + role.bias for end in value_ends(role.signal))
    return low, high
