"""Finds the ticks of values that a logger took off a bus whose frames come late and get lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Controller
from ehadiag.core.find_test import Found
from firmware_iface.signals.by_test import (
    Events,
    Expected,
    Placed,
    placed_by_time,
    placed_in_order,
)
from firmware_iface.signals.resample import DENSE, Clock, Group, forward, groups_of, holds, interval
from firmware_iface.signals.tables import Signal

__all__ = ["HeldRows", "held_by_test", "off_a_bus"]

NOISE = 5e-4
"""Noise of the current, of the rated current, before it is known."""
COMMAND_NOISE = 2e-5
"""The same of a command, of the greatest."""
COARSE = 1.0
"""Steps of a converter, in units of noise, that are those of the computer's, not of a logger's."""
WIDEST = 10.0
"""A, m: no command is beyond."""

SMALL = 0.1
LEAST_COMMANDS = 200
COMMANDS = ("command.position", "command.current")

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class HeldRows:
    """Held values on the ticks of the computer.

    Attributes
    ----------
    clock : Clock
        The ticks on the logger's clock: when a value that is not late comes.
    rows : Mapping[str, Floats]
        By role, NaN where the tick's value was not seen, shape (ticks,).
    late : float
        Root mean square of the delays, ticks.
    """

    clock: Clock
    rows: Mapping[str, Floats]
    late: float


def off_a_bus(signals: Mapping[str, Signal], period: float) -> dict[str, Signal]:
    """Find the signals that a logger took off a bus rather than measured by itself.

    Parameters
    ----------
    signals : Mapping[str, Signal]
        By role.
    period : float
        Length of a tick, s.

    Returns
    -------
    dict[str, Signal]
        Those that keep each value for a tick; where samples come too seldom to show that, all
        channels and commands if each channel has the coarse steps of the computer's converters.
    """
    held = {role: item for role, item in signals.items() if holds(item, period)}
    channels = {role: item for role, item in signals.items() if role.startswith("channels.")}
    # In closed loop the noise of the jack's sensor is that of the current too.
    measured = [item for role, item in channels.items() if role != "channels.current"]
    slow = all(period / interval(item) < DENSE for item in channels.values())
    if held or not slow or not all(map(_is_coarse, measured)):
        return held
    return channels | {role: item for role, item in signals.items() if role in COMMANDS}


def _is_coarse(signal: Signal) -> bool:
    """Whether the steps between values are no less than the noise."""
    second = np.abs(np.diff(signal.value, 2))
    noise = 1.4826 * float(np.median(second)) / float(np.sqrt(6.0))
    levels = np.unique(signal.value)
    steps = np.diff(levels)
    return steps.size > 0 and float(np.quantile(steps, SMALL)) > COARSE * noise


def held_by_test(
    held: Mapping[str, Signal],
    clock: Clock,
    found: Sequence[Found],
    controller: Controller,
) -> HeldRows | None:
    """Put held signals on ticks by the tests that were played.

    Parameters
    ----------
    held : Mapping[str, Signal]
        Signals that keep each value until the next one comes, by role.
    clock : Clock
        Even ticks whose phase and rate fit the tests roughly.
    found : Sequence[Found]
        The tests on these ticks, at least one.
    controller : Controller
        Of the actuator.

    Returns
    -------
    HeldRows | None
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
        group.roles[0]: _command(held, group, clock, period, expected) for group in commands
    }
    # A command is exact: it tells best how the clocks drift.
    exact = max(by_command.values(), key=lambda item: len(item.tick), default=None)
    at = _arrivals(lead, clock, period)
    placed = placed_in_order(
        Events(
            at,
            _values(held, "channels.current", lead),
            _values(held, "channels.position", lead),
            interval(held["channels.current"]) / period,
        ),
        expected,
        NOISE * controller.IM,
        exact.clock if exact is not None and len(exact.tick) >= LEAST_COMMANDS else None,
    )
    rows: dict[str, Floats] = {}
    for group in groups:
        if group is lead:
            own = placed
        elif group.command:
            own = by_command[group.roles[0]]
        else:
            own = placed_by_time(_arrivals(group, clock, period), placed.clock, placed.deviation)
        for role in group.roles:
            item = held[role]
            value = np.full(clock.ticks, np.nan)
            inside = (own.tick >= 0) & (own.tick < clock.ticks)
            value[own.tick[inside]] = item.value[np.searchsorted(item.time, group.at[inside])]
            if not group.complete:
                value = _kept(forward(value, item.value[0]), value, role, expected)
            rows[role] = value
    offset = placed.clock.at(np.arange(clock.ticks + 1, dtype=np.float64))
    return HeldRows(Clock(clock.begin + period * offset), rows, placed.deviation)


def _command(
    held: Mapping[str, Signal], group: Group, clock: Clock, period: float, expected: Expected
) -> Placed:
    """Ticks of a command's values, by the tests."""
    at = _arrivals(group, clock, period)
    (role,) = group.roles
    mine = expected.closed == (role == "command.position")
    told = Expected(
        np.where(mine, expected.command, np.nan),
        np.zeros(len(mine), dtype=np.bool_),
        Controller(IM=WIDEST, GAP=0.0),
    )
    nothing = np.full(len(at), np.nan)
    most = float(np.nanmax(np.abs(told.command), initial=0.0))
    noise = COMMAND_NOISE * (most or 1.0)
    every = interval(held[role]) / period
    values = Events(at, _values(held, role, group), nothing, every)
    return placed_in_order(values, told, noise, exact=True)


def _kept(filled: Floats, seen: Floats, role: str, expected: Expected) -> Floats:
    """Values until the next one; of a command that has moved since, what was not seen is lost."""
    if not role.startswith("command."):
        return filled
    ticks = np.arange(len(seen))
    last = np.maximum.accumulate(np.where(np.isfinite(seen), ticks, 0))
    moved = expected.command[last] != expected.command
    return np.where(moved & np.isfinite(expected.command), np.nan, filled)


def _expected(found: Sequence[Found], ticks: int, controller: Controller) -> Expected:
    command, closed = np.full(ticks, np.nan), np.zeros(ticks, dtype=np.bool_)
    for item in found:
        stored = item.test.command()
        low, high = max(item.command_first, 0), min(item.command_first + len(stored), ticks)
        command[low:high] = stored[low - item.command_first : high - item.command_first]
        closed[low:high] = item.test.closed_loop
    return Expected(command, closed, controller)


def _arrivals(group: Group, clock: Clock, period: float) -> Floats:
    return np.asarray((group.at - clock.begin[0]) / period)


def _values(held: Mapping[str, Signal], role: str, group: Group) -> Floats:
    """Values that a group brought; NaN of a role that is none of its."""
    if role not in group.roles:
        return np.full(len(group.at), np.nan)
    item = held[role]
    return item.value[np.searchsorted(item.time, group.at)]
