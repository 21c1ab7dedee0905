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
from firmware_iface.signals.resample import Clock, Group, forward, groups_of
from firmware_iface.signals.tables import Signal

__all__ = ["HeldRows", "held_by_test"]

NOISE = 5e-4
"""Noise of the current, of the rated current, before it is known."""
COMMAND_NOISE = 1e-4
"""The same of a command, of the greatest."""
WIDEST = 10.0
"""A, m: no command is beyond."""

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
    told : bool
        Whether the current tells the ticks, not only the time.
    """

    clock: Clock
    rows: Mapping[str, Floats]
    late: float
    told: bool


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
    at = _arrivals(lead, clock, period)
    placed = placed_in_order(
        Events(
            at, _values(held, "channels.current", lead), _values(held, "channels.position", lead)
        ),
        expected,
        NOISE * controller.IM,
    )
    rows: dict[str, Floats] = {}
    for group in groups:
        own = placed if group is lead else _beside(held, group, clock, period, expected, placed, at)
        for role in group.roles:
            item = held[role]
            value = np.full(clock.ticks, np.nan)
            inside = (own.tick >= 0) & (own.tick < clock.ticks)
            value[own.tick[inside]] = item.value[np.searchsorted(item.time, group.at[inside])]
            if not group.complete:
                value = _kept(forward(value, item.value[0]), value, role, expected)
            rows[role] = value
    offset = np.interp(np.arange(clock.ticks + 1), at, placed.phase)
    return HeldRows(Clock(clock.begin + period * offset), rows, placed.deviation, told=True)


def _beside(
    held: Mapping[str, Signal],
    group: Group,
    clock: Clock,
    period: float,
    expected: Expected,
    lead: Placed,
    lead_at: Floats,
) -> Placed:
    """Ticks of a group without the current: a command's by the tests, another's by time."""
    at = _arrivals(group, clock, period)
    if not group.command:
        return placed_by_time(at, lead, lead_at)
    (role,) = group.roles
    mine = expected.closed == (role == "command.position")
    told = Expected(
        np.where(mine, expected.command, np.nan),
        np.zeros(len(mine), dtype=np.bool_),
        Controller(IM=WIDEST, GAP=0.0),
    )
    nothing = np.full(len(at), np.nan)
    most = float(np.nanmax(np.abs(told.command), initial=0.0))
    return placed_in_order(
        Events(at, _values(held, role, group), nothing), told, COMMAND_NOISE * most
    )


def _kept(filled: Floats, seen: Floats, role: str, expected: Expected) -> Floats:
    """Values until the next one; of a command that moves, what was not seen is not known."""
    if not role.startswith("command."):
        return filled
    steps = np.abs(np.diff(expected.command, prepend=expected.command[:1]))
    moves = np.nan_to_num(steps) > 0.0
    return np.where(np.isnan(seen) & moves, np.nan, filled)


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
