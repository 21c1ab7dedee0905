"""Places values that a logger took off a bus by the test that was played: of which tick each is.

Frames reach the logger late and in order, and one overtaken before it looks is lost: neither time
nor order tells the tick. The servovalve current does: it follows from the stored command (in closed
loop together with the jack position of the tick before). The most likely ticks are a shortest path
(Viterbi, IEEE Trans. Information Theory 13(2), 1967).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from firmware_iface.find_test import MatchedTest
from firmware_iface.recording import (
    BoolArray,
    FloatArray,
    IntArray,
    RecordedSignal,
    sampling_interval,
)
from firmware_iface.signals.resample import (
    HELD,
    SignalGroup,
    TickClock,
    groups_of,
    hold_forward,
    is_held,
)
from firmware_iface.stored_test import Controller


class Placement(msgspec.Struct, frozen=True):
    """Limits, costs and noise by which held values are placed on ticks."""

    candidates: int = 10
    """Ticks of which a value may be, from one after that of its arrival on backwards."""
    first_delay_std: float = 3.0
    """Standard deviation of the delays before the first fit, ticks."""
    min_delay_std: float = 0.2
    """Least standard deviation of the delays, ticks."""
    max_current_cost: float = 100.0
    """Most that the current of one value counts, variances: a wrong one is no matter of placing."""
    max_delay_cost: float = 25.0
    """Most that the delay of one value counts, variances."""
    lost_tick_cost: float = 4.0
    """Cost of a tick without a value, variances: a seventh of the ticks, at one a tick."""
    impossible_cost: float = 1e9
    """Cost of ticks that do not rise, variances."""
    waiting: float = 0.6
    """Ticks between two values within which the later one has waited for the earlier."""
    min_values: int = 200
    """Values whose ticks the current shows, from which on only these count for the clock."""
    min_commands: int = 200
    """Commands from which on they show how the clocks drift."""
    min_change: float = 4.0
    """Change of the command from tick to tick, in units of noise, that shows the tick."""
    min_noise: float = 0.01
    """Least noise, as a share of the assumed one."""
    drifts: FloatArray = np.arange(-150, 151, 10) * np.float64(1e-6)
    """Drifts of the clocks that are tried, 1; beyond what the tests showed roughly."""
    on_time: float = 0.02
    """Quantile of the delays at which a value is on time."""
    passes: int = 2
    """Times that clock and noise are fitted anew."""
    current_noise: float = 5e-4
    """First guess of the current's noise, of the rated current."""
    command_noise: float = 2e-5
    """Noise of a command, of the greatest."""
    coarse_step: float = 1.0
    """Least step of the computer's converters, in units of noise; a logger's are finer."""
    step_quantile: float = 0.1
    """Quantile of the steps between levels that counts as the converter's step."""
    moving_steps: float = 4.0
    """Least change before and after a repeated value that moves, in its smallest changes: noise of
    half a step and rounding change a value by three at most."""
    row_a_tick: float = 1.1
    """Largest number of samples a tick of a table with a row for each, 1: beyond it rows repeat."""
    repeated: int = 3
    """Least number of frames seen twice that show a logger on a bus, 1: four signals that move and
    are measured repeat together in less than one of 10 000 samples."""
    no_limit: float = 10.0
    """Command that none is beyond, A or m."""


PLACEMENT = Placement()


class Arrivals(msgspec.Struct, frozen=True, eq=False):
    """New values in order of arrival."""

    at: FloatArray
    """When each was seen first, in ticks of a rough clock, ascending, shape (n,)."""
    current: FloatArray
    """A; NaN where it came by another message, shape (n,)."""
    position: FloatArray
    """m, see `current`."""
    every: float
    """Ticks between two looks of the logger: as much later a value may be seen than it came."""


class ExpectedCommand(msgspec.Struct, frozen=True, eq=False):
    """What the tests on a stretch of ticks command."""

    command: FloatArray
    """A, or m in closed loop; NaN outside the tests, shape (ticks,)."""
    closed: BoolArray
    """Whether it is a position, shape (ticks,)."""
    controller: Controller
    """Of the actuator."""

    def current(self, tick: IntArray, before: FloatArray) -> FloatArray:
        """Current of ticks whose jack positions one tick before are given, A; NaN: not known."""
        inside = (tick >= 0) & (tick < len(self.command))
        at = np.clip(tick, 0, len(self.command) - 1)
        law = self.controller
        command = self.command[at]
        if law.GAI or law.GAD:
            command = np.where(self.closed[at], np.nan, command)
        value = np.where(self.closed[at], law.GAP * (command - before), command)
        return np.asarray(np.where(inside, np.clip(value, -law.IM, law.IM), np.nan))

    def shows(self, tick: IntArray, noise: float) -> BoolArray:
        """Whether the current changes enough about ticks to tell them from their neighbours."""
        inside = (tick >= 1) & (tick < len(self.command) - 1)
        at = np.clip(tick, 1, max(len(self.command) - 2, 1))
        gain = np.where(self.closed[at], self.controller.GAP, 1.0)
        before = np.abs(self.command[at] - self.command[at - 1])
        after = np.abs(self.command[at + 1] - self.command[at])
        return np.asarray(
            inside & (gain * np.minimum(before, after) > PLACEMENT.min_change * noise)
        )


class ArrivalClock(msgspec.Struct, frozen=True):
    """When values that are not late come, less their ticks: a straight line over the arrivals."""

    slope: float
    """Drift of the clocks, ticks a tick."""
    level: float
    """At time 0, ticks."""

    def at(self, arrival: FloatArray) -> FloatArray:
        """Phase at some arrivals, ticks."""
        return self.slope * arrival + self.level


class PlacedValues(msgspec.Struct, frozen=True, eq=False):
    """Ticks of values, and how late they came."""

    tick: IntArray
    """Ascending, shape (n,)."""
    late: FloatArray
    """Delay beyond the earliest ones, ticks, shape (n,)."""
    deviation: float
    """Of the delays beyond an interval of the logger's looks, of those that did not wait for
    others, ticks.
    """
    phase: FloatArray
    """Arrival of a value that is not late, less its tick, shape (n,)."""
    clock: ArrivalClock
    """The same as a function of the arrival."""


def placed_in_order(
    events: Arrivals,
    expected: ExpectedCommand,
    noise: float,
    clock: ArrivalClock | None = None,
    *,
    exact: bool = False,
) -> PlacedValues:
    """Find the most likely ticks of values, by their currents, arrivals and order.

    events: the values, at least two; noise: of the currents, roughly, A; clock: that of others of
    the same computer, which tells how the clocks drift; None: their own arrivals do; exact: the
    values have no noise: what they tell goes before the time.
    """
    least = PLACEMENT.min_noise * noise
    tick, away = _cheapest_path(
        events, expected, np.zeros(len(events.at)), PLACEMENT.first_delay_std, noise, rough=True
    )
    placed = _fitted_clock(events, tick, expected.shows(tick, noise), clock)
    for _ in range(0 if exact else PLACEMENT.passes):
        known = away[np.isfinite(away)]
        if known.size:
            noise = max(1.4826 * float(np.median(np.abs(known))), least)
        tick, away = _cheapest_path(events, expected, placed.phase, placed.deviation, noise)
        placed = _fitted_clock(events, tick, expected.shows(tick, noise), clock)
    return placed


def placed_by_time(at: FloatArray, clock: ArrivalClock, deviation: float) -> PlacedValues:
    """Find the ticks of values that tell nothing of them, on the clock that others have shown.

    at: when each was seen first, ticks, ascending, shape (n,); deviation: of their delays, ticks.
    """
    phase = clock.at(at)
    empty = np.full(len(at), np.nan)
    silent = ExpectedCommand(
        np.full(1, np.nan), np.zeros(1, dtype=np.bool_), Controller(IM=1.0, GAP=0.0)
    )
    tick, _ = _cheapest_path(Arrivals(at, empty, empty, 0.0), silent, phase, deviation, 1.0)
    return PlacedValues(tick, np.maximum(at - phase - tick, 0.0), deviation, phase, clock)


def _fitted_clock(
    events: Arrivals, tick: IntArray, certain: BoolArray, clock: ArrivalClock | None
) -> PlacedValues:
    """Clock and delays that ticks show: a line along the earliest arrivals.

    certain: values whose current shows the tick.
    """
    at, away = events.at, events.at - tick
    used = certain if certain.sum() >= PLACEMENT.min_values else np.ones(len(at), dtype=np.bool_)
    slope = _drift(at[used], away[used]) if clock is None else clock.slope
    rest = away - slope * at
    found = ArrivalClock(slope, float(np.quantile(rest[used], PLACEMENT.on_time)))
    late = np.maximum(away - found.at(at), 0.0)
    own = late[used & ~_waited(at)]
    deviation = _jitter(own, min(events.every, 1.0)) if own.size else PLACEMENT.first_delay_std
    return PlacedValues(tick, late, max(deviation, PLACEMENT.min_delay_std), found.at(at), found)


def _jitter(late: FloatArray, look: float) -> float:
    """Deviation of a half-normal delay to which a uniform one of the logger's looks is added."""
    both, mixed = float(np.mean(late**2)), 0.5 * look * np.sqrt(2.0 / np.pi)
    return float(np.sqrt(max(both - look**2 / 3.0 + mixed**2, mixed**2)) - mixed)


def _drift(at: FloatArray, away: FloatArray) -> float:
    """Slope of the highest line below most of the delays, ticks a tick.

    Looks of a logger with a clock of its own make delays climb and fall back by a tick: a line
    through their midst would follow the climb. That below them does not (Moon, Skelly and Towsley,
    INFOCOM 1999).
    """
    middle = float(at.mean())
    rest = away[None, :] - PLACEMENT.drifts[:, None] * (at - middle)[None, :]
    return float(PLACEMENT.drifts[np.argmax(np.quantile(rest, PLACEMENT.on_time, axis=1))])


def _cheapest_path(
    events: Arrivals,
    expected: ExpectedCommand,
    phase: FloatArray,
    deviation: float,
    noise: float,
    *,
    rough: bool = False,
) -> tuple[IntArray, FloatArray]:
    """Ticks of least cost, and the current of each less what is expected there, A.

    rough: the phase may be off by as much as the delays deviate.
    """
    ticks = np.floor(events.at - phase + 0.5).astype(np.int64)[:, None] - np.arange(
        PLACEMENT.candidates
    )
    ticks += PLACEMENT.candidates // 2 if rough else 1
    delay = (events.at - phase)[:, None] - ticks
    # Uniform over an interval of the logger's looks, and beyond that as late as frames are.
    over = delay if rough else delay - np.clip(delay, 0.0, min(events.every, 1.0))
    alone = np.minimum(
        (over / np.where((over > 0.0) | rough, deviation, HELD.early)) ** 2,
        PLACEMENT.max_delay_cost,
    )
    # One that comes right behind another had to wait for it: its delay says nothing of its own.
    alone = np.where(_waited(events.at)[:, None] & (delay > 0.0), 0.0, alone)
    steps, away = _step_costs(events, expected, ticks, noise)
    count = len(events.at)
    origin = np.zeros((count, PLACEMENT.candidates), dtype=np.int64)
    best = alone[0]
    for index in range(1, count):
        total = steps[index - 1] + best
        origin[index] = total.argmin(axis=1)
        best = total.min(axis=1) + alone[index]
    at = int(np.argmin(best))
    tick, left = np.empty(count, dtype=np.int64), np.full(count, np.nan)
    for index in range(count - 1, -1, -1):
        tick[index], before = ticks[index, at], int(origin[index, at])
        if index:
            left[index] = away[index - 1, at, before]
        at = before
    return tick, left


def _step_costs(
    events: Arrivals, expected: ExpectedCommand, ticks: IntArray, noise: float
) -> tuple[FloatArray, FloatArray]:
    """Cost of each value at each of its ticks after the one before at each of its own, and the
    current less what is expected, A; shape (n - 1, candidates, candidates)."""
    gap = ticks[1:, :, None] - ticks[:-1, None, :]
    before = events.position[:-1, None, None] + _speed(events)[1:, None, None] * (gap - 1)
    demanded = expected.current(np.broadcast_to(ticks[1:, :, None], gap.shape), before)
    away = events.current[1:, None, None] - demanded
    guessed = expected.controller.GAP * _roughness(events.position)
    scatter = noise**2 + np.where(gap > 1, guessed**2, 0.0)
    squares = np.minimum(away**2 / scatter, PLACEMENT.max_current_cost) + np.log(scatter / noise**2)
    cost = np.where(np.isfinite(squares), squares, 0.0)
    return np.where(
        gap >= 1, cost + PLACEMENT.lost_tick_cost * (gap - 1), PLACEMENT.impossible_cost
    ), away


def _waited(at: FloatArray) -> BoolArray:
    """Values that came so soon after the one before that this one kept them waiting."""
    return np.concatenate([[False], np.diff(at) < PLACEMENT.waiting])


def _speed(events: Arrivals) -> FloatArray:
    """Motion of the jack, m a tick, over some values on either side."""
    radius = 10
    index = np.arange(len(events.at))
    low, high = np.maximum(index - radius, 0), np.minimum(index + radius, len(index) - 1)
    span = np.maximum(events.at[high] - events.at[low], 1.0)
    return np.asarray((events.position[high] - events.position[low]) / span)


def _roughness(position: FloatArray) -> float:
    """Noise of the jack's positions, m."""
    second = np.abs(position[2:] - 2.0 * position[1:-1] + position[:-2])
    second = second[np.isfinite(second)]
    return float(np.median(second)) if second.size else 0.0


HELD_COMMAND_ROLES = ("command.position", "command.current")


class HeldRows(msgspec.Struct, frozen=True, eq=False):
    """Held values on the ticks of the computer."""

    clock: TickClock
    """The ticks on the logger's clock: when a value that is not late comes."""
    rows: Mapping[str, FloatArray]
    """By role, NaN where the tick's value was not seen, shape (ticks,)."""
    late: float
    """Root mean square of the delays, ticks."""


def bus_signals(signals: Mapping[str, RecordedSignal], period: float) -> dict[str, RecordedSignal]:
    """Find the signals that a logger took off a bus rather than measured by itself.

    signals: by role; period: length of a tick, s. Returns those that keep each value for a tick;
    where samples come too seldom to show that, all channels and commands if each channel has the
    coarse steps of the computer's converters.
    """
    held = {role: item for role, item in signals.items() if is_held(item, period)}
    channels = {role: item for role, item in signals.items() if role.startswith("channels.")}
    # In closed loop the noise of the jack's sensor is that of the current too.
    measured = [item for role, item in channels.items() if role != "channels.current"]
    slow = all(period / sampling_interval(item) < HELD.rate for item in channels.values())
    if held or not slow or not all(map(_is_coarse, measured)):
        return held
    # A row each tick repeats nothing: it is a table of frames.
    often = any(period / sampling_interval(item) > PLACEMENT.row_a_tick for item in measured)
    if often and not _repeats(measured):
        return held
    return channels | {role: item for role, item in signals.items() if role in HELD_COMMAND_ROLES}


def _repeats(signals: Sequence[RecordedSignal]) -> bool:
    """Whether all signals repeat their values at once while they move: a frame was seen twice."""
    count = min(len(item.value) for item in signals)
    if count < HELD.changes:
        return False
    steps = [np.diff(item.value[:count]) for item in signals]
    still = np.all([step[1:-1] == 0.0 for step in steps], axis=0)
    least = [float(np.abs(step[step != 0.0]).min(initial=np.inf)) for step in steps]
    moving = np.any(
        [
            np.minimum(np.abs(step[:-2]), np.abs(step[2:])) > PLACEMENT.moving_steps * size
            for step, size in zip(steps, least, strict=True)
        ],
        axis=0,
    )
    return int((still & moving).sum()) >= PLACEMENT.repeated


def _is_coarse(signal: RecordedSignal) -> bool:
    """Whether the steps between values are no less than the noise."""
    second = np.abs(np.diff(signal.value, 2))
    noise = 1.4826 * float(np.median(second)) / float(np.sqrt(6.0))
    levels = np.unique(signal.value)
    steps = np.diff(levels)
    return (
        steps.size > 0
        and float(np.quantile(steps, PLACEMENT.step_quantile)) > PLACEMENT.coarse_step * noise
    )


def held_by_test(
    held: Mapping[str, RecordedSignal],
    clock: TickClock,
    found: Sequence[MatchedTest],
    controller: Controller,
) -> HeldRows | None:
    """Put held signals on ticks by the tests that were played.

    held: signals that keep each value until the next one comes, by role; clock: even ticks whose
    phase and rate fit the tests roughly; found: the tests on these ticks, at least one. Returns
    None where no current is among the signals: nothing then tells the ticks.
    """
    period = float(clock.begin[-1] - clock.begin[0]) / clock.ticks
    groups = groups_of(held, period)
    lead = next((item for item in groups if "channels.current" in item.roles), None)
    if lead is None or len(lead.at) < 2:
        return None
    expected = _expected(found, clock.ticks, controller)
    commands = [item for item in groups if item.command]
    by_command = {
        group.roles[0]: _place_command(held, group, clock, period, expected) for group in commands
    }
    # A command is exact: it tells best how the clocks drift.
    exact = max(by_command.values(), key=lambda item: len(item.tick), default=None)
    at = _arrivals(lead, clock, period)
    placed = placed_in_order(
        Arrivals(
            at,
            _values(held, "channels.current", lead),
            _values(held, "channels.position", lead),
            sampling_interval(held["channels.current"]) / period,
        ),
        expected,
        PLACEMENT.current_noise * controller.IM,
        exact.clock if exact is not None and len(exact.tick) >= PLACEMENT.min_commands else None,
    )
    rows: dict[str, FloatArray] = {}
    for group in groups:
        if group is lead:
            own = placed
        elif group.command:
            own = by_command[group.roles[0]]
        else:
            own = placed_by_time(_arrivals(group, clock, period), placed.clock, placed.deviation)
        for role in group.roles:
            item = held[role]
            value = group.on_ticks(item, own.tick, clock.ticks)
            if not group.complete:
                value = _held_values(hold_forward(value, item.value[0]), value, role, expected)
            rows[role] = value
    offset = placed.clock.at(np.arange(clock.ticks + 1, dtype=np.float64))
    return HeldRows(TickClock(clock.begin + period * offset), rows, placed.deviation)


def _place_command(
    held: Mapping[str, RecordedSignal],
    group: SignalGroup,
    clock: TickClock,
    period: float,
    expected: ExpectedCommand,
) -> PlacedValues:
    """Ticks of a command's values, by the tests."""
    at = _arrivals(group, clock, period)
    (role,) = group.roles
    mine = expected.closed == (role == "command.position")
    expected = ExpectedCommand(
        np.where(mine, expected.command, np.nan),
        np.zeros(len(mine), dtype=np.bool_),
        Controller(IM=PLACEMENT.no_limit, GAP=0.0),
    )
    empty = np.full(len(at), np.nan)
    most = float(np.nanmax(np.abs(expected.command), initial=0.0))
    noise = PLACEMENT.command_noise * (most or 1.0)
    every = sampling_interval(held[role]) / period
    values = Arrivals(at, _values(held, role, group), empty, every)
    return placed_in_order(values, expected, noise, exact=True)


def _held_values(
    filled: FloatArray, seen: FloatArray, role: str, expected: ExpectedCommand
) -> FloatArray:
    """Values until the next one; of a command that has moved since, what was not seen is lost."""
    if not role.startswith("command."):
        return filled
    ticks = np.arange(len(seen))
    last = np.maximum.accumulate(np.where(np.isfinite(seen), ticks, 0))
    moved = expected.command[last] != expected.command
    return np.where(moved & np.isfinite(expected.command), np.nan, filled)


def _expected(found: Sequence[MatchedTest], ticks: int, controller: Controller) -> ExpectedCommand:
    command, closed = np.full(ticks, np.nan), np.zeros(ticks, dtype=np.bool_)
    for item in found:
        stored = item.test.command()
        low, high = max(item.command_first, 0), min(item.command_first + len(stored), ticks)
        command[low:high] = stored[low - item.command_first : high - item.command_first]
        closed[low:high] = item.test.closed_loop
    return ExpectedCommand(command, closed, controller)


def _arrivals(group: SignalGroup, clock: TickClock, period: float) -> FloatArray:
    return np.asarray((group.at - clock.begin[0]) / period)


def _values(held: Mapping[str, RecordedSignal], role: str, group: SignalGroup) -> FloatArray:
    """Values that a group brought; NaN of a role that is none of its."""
    if role not in group.roles:
        return np.full(len(group.at), np.nan)
    return group.values(held[role])
