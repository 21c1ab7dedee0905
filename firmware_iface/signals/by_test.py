"""Places values that a logger took off a bus by the test that was played: of which tick each is.

Frames reach the logger late and in order, and one overtaken before it looks is lost: neither time
nor order tells of which tick a value is. The servovalve current does: it follows from the stored
command (in closed loop together with the jack position of the tick before). The most likely ticks
are a shortest path: each value a later tick than the one before (Viterbi, IEEE Trans. Information
Theory 13(2), 1967).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Controller

__all__ = ["Clockwork", "Events", "Expected", "Placed", "placed_by_time", "placed_in_order"]

CANDIDATES = 10
"""Ticks of which a value may be, from one after the tick in which it came on backwards."""
EARLY = 0.15
"""Ticks by which a value may come before the earliest ones."""
ROUGH = 3.0
"""Deviation of the delays, ticks, before anything is known of them."""
STRANGEST = 100.0
"""Most that the current of one value counts, in variances: a wrong one is no matter of placing."""
LATEST = 25.0
"""The same of its delay."""
SOON = 0.6
"""Ticks between two values in which the later one has waited for the earlier."""
LEAST_TOLD = 200
"""Values whose ticks the current tells, from which on the others do not count for the clock."""
LEAST_NOISE = 0.01
"""Of what the noise was held to be."""
DRIFTS = np.arange(-150, 151, 10) * 1e-6
"""Of the clocks against each other, beyond what the tests showed roughly."""
EARLIEST = 0.02
"""Quantile of the delays at which a value is on time."""
PASSES = 2
IMPOSSIBLE = 1e9
LOST = 4.0
"""Cost of a tick without a value, in variances: a seventh of the ticks, at one a tick."""
CLEAR = 4.0
"""Change of the command from tick to tick, in units of noise, from which on it tells the tick."""
LEAST_DEVIATION = 0.2
"""Ticks."""

Floats = NDArray[np.float64]
Ticks = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """New values in order of arrival.

    Attributes
    ----------
    at : Floats
        When each was seen first, in ticks of a rough clock, ascending, shape (n,).
    current : Floats
        A; NaN where it came by another message, shape (n,).
    position : Floats
        m, see `current`.
    every : float
        Ticks between two looks of the logger: as much later a value may be seen than it came.
    """

    at: Floats
    current: Floats
    position: Floats
    every: float


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What the tests on a stretch of ticks command.

    Attributes
    ----------
    command : Floats
        A, or m in closed loop; NaN outside the tests, shape (ticks,).
    closed : NDArray[np.bool_]
        Whether it is a position, shape (ticks,).
    controller : Controller
        Of the actuator.
    """

    command: Floats
    closed: NDArray[np.bool_]
    controller: Controller

    def current(self, tick: Ticks, before: Floats) -> Floats:
        """Current of ticks whose jack positions one tick before are given, A; NaN: not known."""
        inside = (tick >= 0) & (tick < len(self.command))
        at = np.clip(tick, 0, len(self.command) - 1)
        law = self.controller
        told = self.command[at]
        if law.GAI or law.GAD:
            told = np.where(self.closed[at], np.nan, told)
        value = np.where(self.closed[at], law.GAP * (told - before), told)
        return np.asarray(np.where(inside, np.clip(value, -law.IM, law.IM), np.nan))

    def tells(self, tick: Ticks, noise: float) -> NDArray[np.bool_]:
        """Whether the current changes enough about ticks to tell them from their neighbours."""
        inside = (tick >= 1) & (tick < len(self.command) - 1)
        at = np.clip(tick, 1, max(len(self.command) - 2, 1))
        gain = np.where(self.closed[at], self.controller.GAP, 1.0)
        before = np.abs(self.command[at] - self.command[at - 1])
        after = np.abs(self.command[at + 1] - self.command[at])
        return np.asarray(inside & (gain * np.minimum(before, after) > CLEAR * noise))


@dataclass(frozen=True, slots=True)
class Clockwork:
    """When values that are not late come, less their ticks: a straight line over the arrivals.

    Attributes
    ----------
    slope : float
        Drift of the clocks, ticks a tick.
    level : float
        At time 0, ticks.
    """

    slope: float
    level: float

    def at(self, arrival: Floats) -> Floats:
        """Phase at some arrivals, ticks."""
        return self.slope * arrival + self.level


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Ticks of values, and how late they came.

    Attributes
    ----------
    tick : Ticks
        Ascending, shape (n,).
    late : Floats
        Delay beyond the earliest ones, ticks, shape (n,).
    deviation : float
        Of the delays beyond an interval of the logger's looks, of those that did not wait for
        others, ticks.
    phase : Floats
        Arrival of a value that is not late, less its tick, shape (n,).
    clock : Clockwork
        The same as a function of the arrival.
    """

    tick: Ticks
    late: Floats
    deviation: float
    phase: Floats
    clock: Clockwork


def placed_in_order(
    events: Events,
    expected: Expected,
    noise: float,
    clock: Clockwork | None = None,
    *,
    exact: bool = False,
) -> Placed:
    """Find the most likely ticks of values, by their currents, arrivals and order.

    Parameters
    ----------
    events : Events
        The values, at least two.
    expected : Expected
        What was commanded.
    noise : float
        Of the currents, roughly, A.
    clock : Clockwork | None
        That of others of the same computer, which tells how the clocks drift; None: their own
        arrivals do.
    exact : bool
        The values have no noise: what they tell goes before the time.

    Returns
    -------
    Placed
        Their ticks.
    """
    least = LEAST_NOISE * noise
    tick, away = _path(events, expected, np.zeros(len(events.at)), ROUGH, noise, rough=True)
    placed = _described(events, tick, expected.tells(tick, noise), clock)
    for _ in range(0 if exact else PASSES):
        known = away[np.isfinite(away)]
        if known.size:
            noise = max(1.4826 * float(np.median(np.abs(known))), least)
        tick, away = _path(events, expected, placed.phase, placed.deviation, noise)
        placed = _described(events, tick, expected.tells(tick, noise), clock)
    return placed


def placed_by_time(at: Floats, clock: Clockwork, deviation: float) -> Placed:
    """Find the ticks of values that tell nothing of them, on the clock that others have shown.

    Parameters
    ----------
    at : Floats
        When each was seen first, ticks, ascending, shape (n,).
    clock : Clockwork
        Of the others.
    deviation : float
        Of their delays, ticks.

    Returns
    -------
    Placed
        Their ticks.
    """
    phase = clock.at(at)
    nothing = np.full(len(at), np.nan)
    silent = Expected(np.full(1, np.nan), np.zeros(1, dtype=np.bool_), Controller(IM=1.0, GAP=0.0))
    tick, _ = _path(Events(at, nothing, nothing, 0.0), silent, phase, deviation, 1.0)
    return Placed(tick, np.maximum(at - phase - tick, 0.0), deviation, phase, clock)


def _described(
    events: Events, tick: Ticks, told: NDArray[np.bool_], clock: Clockwork | None
) -> Placed:
    """Clock and delays that ticks show: a line along the earliest arrivals.

    told: values whose current has told the tick.
    """
    at, away = events.at, events.at - tick
    used = told if told.sum() >= LEAST_TOLD else np.ones(len(at), dtype=np.bool_)
    slope = _drift(at[used], away[used]) if clock is None else clock.slope
    rest = away - slope * at
    found = Clockwork(slope, float(np.quantile(rest[used], EARLIEST)))
    late = np.maximum(away - found.at(at), 0.0)
    own = late[used & ~_waited(at)]
    deviation = _jitter(own, min(events.every, 1.0)) if own.size else ROUGH
    return Placed(tick, late, max(deviation, LEAST_DEVIATION), found.at(at), found)


def _jitter(late: Floats, look: float) -> float:
    """Deviation of a half-normal delay to which a uniform one of the logger's looks is added."""
    both, mixed = float(np.mean(late**2)), 0.5 * look * np.sqrt(2.0 / np.pi)
    return float(np.sqrt(max(both - look**2 / 3.0 + mixed**2, mixed**2)) - mixed)


def _drift(at: Floats, away: Floats) -> float:
    """Slope of the highest line below most of the delays, ticks a tick.

    Looks of a logger with a clock of its own make delays climb and fall back by a tick: a line
    through their midst would follow the climb. That below them does not (Moon, Skelly and Towsley,
    INFOCOM 1999).
    """
    middle = float(at.mean())
    rest = away[None, :] - DRIFTS[:, None] * (at - middle)[None, :]
    return float(DRIFTS[np.argmax(np.quantile(rest, EARLIEST, axis=1))])


def _path(
    events: Events,
    expected: Expected,
    phase: Floats,
    deviation: float,
    noise: float,
    *,
    rough: bool = False,
) -> tuple[Ticks, Floats]:
    """Ticks of least cost, and the current of each less what is expected there, A.

    rough: the phase may be off by as much as the delays deviate.
    """
    ticks = np.floor(events.at - phase + 0.5).astype(np.int64)[:, None] - np.arange(CANDIDATES)
    ticks += CANDIDATES // 2 if rough else 1
    delay = (events.at - phase)[:, None] - ticks
    # Uniform over an interval of the logger's looks, and beyond that as late as frames are.
    over = delay if rough else delay - np.clip(delay, 0.0, min(events.every, 1.0))
    alone = np.minimum((over / np.where((over > 0.0) | rough, deviation, EARLY)) ** 2, LATEST)
    # One that comes right behind another had to wait for it: its delay says nothing of its own.
    alone = np.where(_waited(events.at)[:, None] & (delay > 0.0), 0.0, alone)
    steps, away = _steps(events, expected, ticks, noise)
    count = len(events.at)
    origin = np.zeros((count, CANDIDATES), dtype=np.int64)
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


def _steps(events: Events, expected: Expected, ticks: Ticks, noise: float) -> tuple[Floats, Floats]:
    """Cost of each value at each of its ticks after the one before at each of its own, and the
    current less what is expected, A; shape (n - 1, candidates, candidates)."""
    gap = ticks[1:, :, None] - ticks[:-1, None, :]
    before = events.position[:-1, None, None] + _speed(events)[1:, None, None] * (gap - 1)
    asked = expected.current(np.broadcast_to(ticks[1:, :, None], gap.shape), before)
    away = events.current[1:, None, None] - asked
    guessed = expected.controller.GAP * _roughness(events.position)
    scatter = noise**2 + np.where(gap > 1, guessed**2, 0.0)
    squares = np.minimum(away**2 / scatter, STRANGEST) + np.log(scatter / noise**2)
    cost = np.where(np.isfinite(squares), squares, 0.0)
    return np.where(gap >= 1, cost + LOST * (gap - 1), IMPOSSIBLE), away


def _waited(at: Floats) -> NDArray[np.bool_]:
    """Values that came so soon after the one before that this one kept them waiting."""
    return np.concatenate([[False], np.diff(at) < SOON])


def _speed(events: Events) -> Floats:
    """Motion of the jack, m a tick, over some values on either side."""
    reach = 10
    index = np.arange(len(events.at))
    low, high = np.maximum(index - reach, 0), np.minimum(index + reach, len(index) - 1)
    span = np.maximum(events.at[high] - events.at[low], 1.0)
    return np.asarray((events.position[high] - events.position[low]) / span)


def _roughness(position: Floats) -> float:
    """Noise of the jack's positions, m."""
    second = np.abs(position[2:] - 2.0 * position[1:-1] + position[:-2])
    second = second[np.isfinite(second)]
    return float(np.median(second)) if second.size else 0.0
