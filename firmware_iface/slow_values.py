"""Looks for a second sender of a message that brings slow values: supply pressure, oil temperature.

Such a message counts its own frames. A sender with a counter of its own uses no counter twice: it
is found by the rate, by counters that do not run on, and by values that do not stay together.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from firmware_iface.bus_map import MessageMap
from firmware_iface.protection import CONFLICTS
from firmware_iface.recording import BoolArray, FloatArray, IntArray


class SlowValueLimits(msgspec.Struct, frozen=True):
    """Limits beyond which the frames of a slow message are of two senders."""

    excess: float = 1.25
    """Frames per cycle, 1; clocks differ by less, and a quarter of strange frames leaves the median
    within the noise of the true ones."""
    leap: int = 16
    """Step of a counter, 1, forth or back, that no loss or late frame makes; senders whose counters
    lie nearer use each other's within as many frames, and `conflicting` finds them."""
    outliers: float = 0.02
    """Share of values, 1, that may lie apart: what is borne of conflicts."""
    scatters: float = 4.2
    """Deviations of the values about two levels by which those are of two senders: 3.5 of any even
    scatter or steady drift, at most 4.1 in a turn of the counter, 4.6 of two senders 8 K apart that
    scatter by 3 K either way."""
    chance: int = 8
    """Values, 1, that may stand apart by chance or be a short dip, where the level may move."""
    run: float = 3.0
    """Values in a row, 1, in the mean, beyond which a level is one that the sender itself went to:
    of two that send as often it has two."""
    watched: int = 256
    """Frames that the live watch looks back: one turn of eight bits."""
    repeat: float = 0.25
    """Cycles, 1, within which the same payload without a counter is a repeat, sent once."""
    judged: int = 64
    """Frames, 1, in less than such a time after which the live watch judges again: it takes
    0.3 ms, and a flood of one message comes at 8000 a second."""
    late_ns: int = 1_000_000_000
    """Time, ns, for which a busy computer may hold frames back before the live watch sees them."""


SLOW_VALUES = SlowValueLimits()
MAX_SPREADS = {
    "environment.supply_pressure": (2e6, 1e-6, "MPa"),
    "environment.return_pressure": (2e6, 1e-6, "MPa"),
    "environment.oil_temperature": (5.0, 1.0, "K"),
}
"""Role: largest distance of two levels, SI, its factor to the unit, and that unit. Pressures: a
tenth of the usual supply, twice what a pump's ripple and a moving jack take from it. Oil: its tank
warms by less than 0.1 K in a test."""


def brings_slow_values(message: MessageMap) -> bool:
    """Whether a message brings nothing but values of the environment."""
    return all(role.name.startswith("environment.") for role in message.roles)


def repeated_frames(
    message: MessageMap, time_ns: IntArray, data: NDArray[np.uint8], *, counted: bool
) -> BoolArray:
    """Frames that repeat the one before, as an interface that reports each of them twice makes.

    message: the message; time_ns: time stamps in order of arrival, shape (n,); data: payloads,
    shape (n, width); counted: whether the payloads have a counter. Returns shape (n,).
    """
    same = np.zeros(len(data), dtype=np.bool_)
    same[1:] = (data[1:] == data[:-1]).all(axis=1)
    if not counted:
        same[1:] &= np.diff(time_ns) < SLOW_VALUES.repeat * message.cycle_ns
    return same


def spread_conflict(role: str, values: FloatArray, *, steady: bool = True) -> str:
    """Why values of one role are not those of one sender; empty if they may be.

    Values of two senders stand about two levels that are farther apart than the scatter about each,
    whatever the level does meanwhile; noise about one level does not.

    role: such as `environment.oil_temperature`; values: SI values in order of arrival; NaN is no
    value; steady: they are of one test, in which a sender keeps its level too; else only levels in
    turn are of two. Returns one clause.
    """
    limit, factor, unit = MAX_SPREADS[role]
    found = values[np.isfinite(values)]
    # One damaged value is borne, the shortest span of all the others counts.
    kept = len(found) - max(math.floor(SLOW_VALUES.outliers * len(found)), 1)
    if kept < 3:
        return ""
    order = np.argsort(found, kind="stable")
    first = int(np.argmin(found[order[kept - 1 :]] - found[order[: len(found) - kept + 1]]))
    found = found[np.sort(order[first : first + kept])]
    place = np.arange(kept)
    line = np.polyval(np.polyfit(place, found, 1), place)
    rest = found - line
    apart = max(_levels_apart(item, limit, steady=steady) for item in (found, rest))
    moved = float(np.ptp(line))
    if steady and moved > max(limit, SLOW_VALUES.scatters * float(np.std(rest))):
        apart = max(apart, moved)
    if not apart:
        return ""
    return (
        f"values of {role} are {factor * apart:.3g} {unit} apart"
        f" ({factor * limit:.3g} {unit} are borne)"
    )


def _levels_apart(values: FloatArray, limit: float, *, steady: bool) -> float:
    """Distance of the two levels about which values stand; 0 where they do not.

    The two are those with the least scatter about them (N. Otsu, IEEE Trans. SMC 9, 1979).
    """
    ascending = np.sort(values)
    count = np.arange(1, len(values))
    total = np.cumsum(ascending)
    low, high = total[:-1] / count, (total[-1] - total[:-1]) / count[::-1]
    distance = high - low
    best = int(np.argmax(count * count[::-1] * distance**2))
    above, fewer = values > ascending[best], min(best + 1, len(values) - best - 1)
    runs = np.count_nonzero(np.diff(above)) / 2
    if not steady and not SLOW_VALUES.chance < fewer <= SLOW_VALUES.run * runs:
        return 0.0
    left = values - np.where(above, high[best], low[best])
    scatter = math.sqrt(float(left @ left) / (len(values) - 2))
    apart = float(distance[best])
    return apart if apart > max(limit, SLOW_VALUES.scatters * scatter) else 0.0


def slow_value_conflict(
    message: MessageMap,
    time_ns: IntArray,
    counter: IntArray | None,
    modulus: int,
    values: Mapping[str, FloatArray],
    span_ns: int,
    *,
    steady: bool = True,
) -> str:
    """Why frames of a slow message are not of one sender; empty if nothing says so.

    message: the message; time_ns: time stamps of its sound frames in order of arrival without
    repeats, shape (n,); counter: their counters, shape (n,); None where not each of them has one;
    modulus: counts per turn; values: SI values by role, shape (n,); span_ns: time, ns, in which
    they were sent; steady: see `spread_conflict`. Returns one clause that names the message.
    """
    who = f"a second sender of {message.name} ({message.can_id:#x})"
    cycle = message.cycle_ns if brings_slow_values(message) else 0
    usual = span_ns / cycle + 1.0 if cycle else math.inf
    if len(time_ns) > SLOW_VALUES.excess * usual + CONFLICTS.chance:
        return (
            f"{who}, or a wrong cycle time in the DBC: {len(time_ns)} frames in"
            f" {span_ns / 1e9:.1f} s, {math.ceil(usual)} are usual"
        )
    if counter is not None:
        step = np.diff(counter)
        leaps = _leaps(step, modulus)
        if cycle:  # a long silence is no leap
            waited = np.rint(np.diff(time_ns) / cycle).astype(np.int64)
            leaps &= _leaps(step - waited, modulus)
        if leaps.sum() > CONFLICTS.chance:
            return f"{who}, two counters in turn: {leaps.sum()} of {len(step)} steps do not run on"
    for role, value in values.items():
        if role in MAX_SPREADS and (apart := spread_conflict(role, value, steady=steady)):
            return f"{who}, or a broken sensor: {apart}"
    return ""


def _leaps(step: IntArray, modulus: int) -> BoolArray:
    half = modulus // 2
    return np.asarray(np.abs((step + half) % modulus - half) > SLOW_VALUES.leap)


class SlowValueWatch:
    """Looks for a second sender of one slow message, a frame at a time; memory is constant."""

    def __init__(self, message: MessageMap) -> None:
        self._message = message
        self._streams: dict[tuple[frozenset[str], bool], deque[_SlowFrame]] = {}
        self._taken = 0
        self._judged_ns = 0
        self._found = ""

    def take(
        self, time_ns: int, counter: int | None, data: bytes, values: Mapping[str, float]
    ) -> str:
        """Take a sound frame; return why there are two senders, empty if nothing says so."""
        frames = self._streams.setdefault(
            (frozenset(values), counter is None), deque(maxlen=SLOW_VALUES.watched)
        )
        if frames and frames[-1].data == data:
            near = time_ns - frames[-1].time_ns < SLOW_VALUES.repeat * self._message.cycle_ns
            if counter is not None or near:
                return ""
        frames.append(_SlowFrame(time_ns, counter, data, values))
        self._taken += 1
        if (
            self._taken % SLOW_VALUES.judged
            and abs(time_ns - self._judged_ns) < SLOW_VALUES.repeat * self._message.cycle_ns
        ):
            return self._found
        self._judged_ns = time_ns
        # Between two frames of a slow page the counter goes on with all the fast ones.
        counts = len(self._streams) == 1 or brings_slow_values(self._message)
        stamps = np.array([item.time_ns for item in frames], dtype=np.int64)
        self._found = slow_value_conflict(
            self._message,
            stamps,
            np.array([item.counter for item in frames]) if counts and counter is not None else None,
            self._message.modulus,
            {key: np.array([item.values[key] for item in frames]) for key in values},
            int(np.ptp(stamps)) + SLOW_VALUES.late_ns,
            steady=False,
        )
        return self._found


class _SlowFrame(msgspec.Struct, frozen=True):
    time_ns: int
    counter: int | None
    data: bytes
    values: Mapping[str, float]
