"""Finds the control ticks in signals that were measured separately, on the logger's clock.

The computer holds current and command through a tick. Of more than one sample a tick each change
lies between two samples: the ticks' edges are where most of the changes allow them. With fewer
samples a grid of phases and rates is held against the test: in open loop its command, in closed
loop what the control law makes of command and position.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping

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
from firmware_iface.stored_test import Controller


class ClockFit(msgspec.Struct, frozen=True):
    """How the phase of a logger's clock is fitted to a test."""

    min_samples: int = 100
    """Least samples of the test's leading signal."""
    edge_rate: float = 1.5
    """Samples a tick from which on changes show the edges of ticks."""
    quiet_share: float = 0.2
    """Share of the changes that are noise: of 1.5 samples a tick a third has no edge between."""
    quiet_quantile: float = 0.253
    """That quantile of a standard normal variable's size."""
    change: float = 5.0
    """Least change at an edge, in deviations of the noise."""
    steps: float = 4.0
    """Least change at an edge, in steps of the converter: noise of half a step and rounding change
    a value by three at most."""
    bins: int = 400
    """Phases of a tick that are tried."""
    rates: tuple[float, float] = (300e-6, 4e-6)
    """Largest rate of the clock that is tried, and the step; a quartz is within 100 ppm."""
    fine_rates: tuple[float, float] = (8e-6, 0.25e-6)
    """The same about the best of these."""
    slack: float = 0.004
    """Share of the changes, 1, by which a phase may explain fewer than the best one: of changes of
    five deviations that many are noise."""
    away: int = 3
    """Ticks by which the test may begin elsewhere than it was found roughly."""
    same_rate: float = 100e-6
    """Distance of rates, 1, up to which they are means of one another: gain and loss of a tick in a
    test of 5.5 s are 180 ppm apart."""
    level: float = 1.02
    """Misfit over the least one up to which phases are as good."""
    alike: float = 8.0
    """Logarithm of a likelihood below the largest one down to which phase and rate are possible:
    beyond it are 0.03 % of two normal variables."""
    points: int = 16
    """Points for each sample of a smoothed position, 1."""
    reach: int = 5
    """Samples on either side that a point is of, 1: five deviations."""
    starts: int = 8
    """Places on a coarse grid, 1, from which the best one is sought."""
    search_steps: tuple[tuple[float, float], tuple[float, float]] = ((0.05, 25e-6), (1e-3, 0.5e-6))
    """First and least steps of phase (ticks) and rate of that search."""
    grids: int = 10
    """Largest number of grids of phase and rate, 1, each twice as wide as the one before."""
    grid: int = 17
    """Phases and rates of each, 1."""


CLOCK = ClockFit()


class FittedClock(msgspec.Struct, frozen=True):
    """Ticks on the clock of a logger.

    begin: of one tick, near the test's middle, s; rate: length of a tick over the nominal one, less
    1; std: standard deviation of the begin, s; rate_std: standard deviation of the rate; by: what
    showed it.
    """

    begin: float
    rate: float
    std: float
    rate_std: float
    by: str


class Deviation(msgspec.Struct, frozen=True):
    """How far what was recorded is from the test."""

    residuals: Callable[[float, float], FloatArray]
    """By phase (ticks) and rate of the clock, less their median."""
    name: str


def fit_clock(
    signals: Mapping[str, RecordedSignal],
    begin: float,
    period: float,
    found: MatchedTest,
    controller: Controller,
) -> FittedClock | None:
    """Find the ticks of a test.

    signals: by role; begin: of the test, roughly, s; period: nominal length of a tick, s; found:
    the test; controller: of the actuator. Returns None where nothing recorded shows them.
    """
    span = found.test.ticks * period
    command = "command.position" if found.test.closed_loop else "command.current"
    best: FittedClock | None = None
    away = _deviation(signals, begin, period, found, controller)
    for role in ("channels.current", command):
        signal = signals.get(role)
        if signal is None:
            continue
        part = _within(signal, begin - 2.0 * period, begin + span)
        if len(part.time) < CLOCK.min_samples:
            continue
        edges = _by_edges(part, begin + 0.5 * span, period, role.partition(".")[2], away)
        if edges is not None and (best is None or edges.std < best.std):
            best = edges
    if best is not None or away is None:
        return best
    return _by_test(begin, period, found, away)


def _within(signal: RecordedSignal, low: float, high: float) -> RecordedSignal:
    inside = slice(*np.searchsorted(signal.time, [low, high]))
    return RecordedSignal(signal.time[inside], signal.value[inside])


def _by_edges(
    signal: RecordedSignal, middle: float, period: float, name: str, away: Deviation | None
) -> FittedClock | None:
    """Ticks whose edges lie between samples of different values."""
    step = sampling_interval(signal)
    if period / step < CLOCK.edge_rate:
        return None
    change, apart = np.abs(np.diff(signal.value)), np.diff(signal.time)
    some = change[change > 0.0]
    if not some.size:
        return None
    noise = float(np.quantile(change, CLOCK.quiet_share)) / CLOCK.quiet_quantile
    least = max(CLOCK.change * noise, CLOCK.steps * float(some.min()))
    at_edge = (change > least) & (apart < 1.5 * step)
    if at_edge.sum() < CLOCK.min_samples:
        return None
    low, high = signal.time[:-1][at_edge] - middle, signal.time[1:][at_edge] - middle
    rate = 0.0
    for most, by in (CLOCK.rates, CLOCK.fine_rates):
        rates = rate + np.arange(-most, most + 0.5 * by, by)
        count = np.stack([_explained(low, high, period * (1.0 + item)) for item in rates])
        best = count.max() - max(CLOCK.slack * len(low), 0.5)
        where, phase = np.nonzero(count >= best)
        if away is not None and most == CLOCK.rates[0]:
            kept = _fitting_rates(rates, where, phase, away.residuals)
            where, phase = where[kept], phase[kept]
        weight = count[where, phase] - best + 1.0
        turn = np.exp(2j * np.pi * (phase + 0.5) / CLOCK.bins)
        mean = complex(np.sum(weight * turn) / weight.sum())
        rate = float(np.sum(weight * rates[where]) / weight.sum())
    spread = np.angle(turn / mean) / (2.0 * np.pi)
    std = float(np.sqrt(np.mean(spread**2) + 1.0 / (12.0 * CLOCK.bins**2)))
    length = period * (1.0 + rate)
    return FittedClock(
        middle + length * float(np.angle(mean)) / (2.0 * np.pi), rate, std * period,
        float(np.hypot(rates[where].std(), by)), f"changes of the {name}",
    )  # fmt: skip


def _fitting_rates(
    rates: FloatArray,
    where: IntArray,
    phase: IntArray,
    residuals: Callable[[float, float], FloatArray],
) -> BoolArray:
    """Which of the rates and phases (bins) that the edges allow fit the test, too.

    With few samples a tick a logger that gains a tick and one that loses it see the same edges. The
    command, or the jack in closed loop, moves on between them.
    """
    cost = np.full(len(rates), np.inf)
    for index in np.unique(where).tolist():
        turn = np.exp(2j * np.pi * (phase[where == index] + 0.5) / CLOCK.bins).sum()
        place = float(np.angle(turn)) / (2.0 * np.pi) * (1.0 + float(rates[index]))
        cost[index] = min(
            _capped_mean(residuals(place + whole, float(rates[index])))
            for whole in range(-CLOCK.away, CLOCK.away + 1)
        )
    best = int(np.argmin(cost))
    return np.asarray(
        (cost[where] <= CLOCK.level * cost[best])
        & (np.abs(rates[where] - rates[best]) <= CLOCK.same_rate)
    )


def _explained(low: FloatArray, high: FloatArray, length: float) -> FloatArray:
    """How many intervals hold an edge, by the edges' phase, shape (bins,)."""
    bins = CLOCK.bins
    begin = np.floor(low / length % 1.0 * bins).astype(np.int64)
    wide = np.minimum(np.rint((high - low) / length * bins).astype(np.int64), bins)
    edges = np.zeros(2 * bins + 1)
    np.add.at(edges, begin, 1.0)
    np.add.at(edges, begin + wide, -1.0)
    total = np.cumsum(edges[:-1])
    return np.asarray(total[:bins] + total[bins:])


def _by_test(begin: float, period: float, found: MatchedTest, away: Deviation) -> FittedClock:
    """Ticks on which the test explains what was recorded best.

    A sample that comes to lie in the next tick misfits at once: the misfit has cliffs.
    """
    tried = np.array(list(itertools.product(
        np.arange(-1.5, 1.51, 0.1), np.arange(-300e-6, 301e-6, 50e-6)
    )))  # fmt: skip
    left = [away.residuals(*item) for item in tried]
    misfits = np.array([_capped_mean(item) for item in left])
    noise = 1.4826 * float(np.median(np.abs(left[int(np.argmin(misfits))])))
    noise += np.finfo(float).tiny

    def misfit(item: FloatArray) -> float:
        return float(np.log1p((away.residuals(*item.tolist()) / noise) ** 2).sum())

    starts = tried[np.argsort(misfits)[: CLOCK.starts]]
    best = min((_lowest_about(misfit, item) for item in starts), key=misfit)
    width = 8.0 * np.array(CLOCK.search_steps[1])
    for _ in range(CLOCK.grids):
        shares = np.linspace(-1.0, 1.0, CLOCK.grid)
        tried = best + width * np.array(list(itertools.product(shares, repeat=2)))
        cost = np.array([misfit(item) for item in tried])
        alike = tried[cost <= cost.min() + CLOCK.alike]
        ends = np.stack([best - alike.min(axis=0), alike.max(axis=0) - best])
        beyond = ends.max(axis=0) > 0.95 * width
        if not beyond.any():
            break
        best, width = alike.mean(axis=0), np.where(beyond, 2.0 * width, width)
    phase, rate = (float(value) for value in alike.mean(axis=0))
    std, rate_std = (
        float(value) for value in np.hypot(alike.std(axis=0), 2.0 * width / (CLOCK.grid - 1))
    )
    middle = 0.5 * found.test.ticks
    return FittedClock(begin + period * (phase + middle), rate, std * period, rate_std, away.name)


def _lowest_about(misfit: Callable[[FloatArray], float], start: FloatArray) -> FloatArray:
    """Point of least misfit that steps to the eight neighbours lead to, halved where none is."""
    around = np.array([item for item in itertools.product((-1.0, 0.0, 1.0), repeat=2) if any(item)])
    here, least, step = start, misfit(start), np.array(CLOCK.search_steps[0])
    while step[0] > CLOCK.search_steps[1][0]:
        neighbours = here + step * around
        costs = [misfit(item) for item in neighbours]
        index = int(np.argmin(costs))
        if costs[index] < least:
            here, least = neighbours[index], costs[index]
        else:
            step = 0.5 * step
    return here


def _capped_mean(away: FloatArray) -> float:
    """Mean square of residuals, a few large ones aside."""
    away = np.abs(away)
    return float(np.mean(np.minimum(away, 6.0 * np.median(away) + np.finfo(float).tiny) ** 2))


def _smoothed(signal: RecordedSignal) -> RecordedSignal:
    """Signal with points between its samples, all of the same noise.

    A line from sample to sample has half of the noise in their middle: of two phases that explain a
    recording equally well the one that looks there would win. The weights of a Gaussian of one
    sample's width leave the noise to 0.01 % the same.
    """
    points = CLOCK.points
    samples = np.arange(len(signal.value))
    reach = np.arange(-CLOCK.reach, CLOCK.reach + 1)
    padded = np.pad(signal.value, CLOCK.reach, mode="edge")
    fine = np.empty((len(samples), points))
    for index in range(points):
        weight = np.exp(-0.5 * (reach - index / points) ** 2)
        fine[:, index] = np.correlate(padded, weight / weight.sum(), mode="valid")
    between = np.arange(len(samples) * points) / points
    return RecordedSignal(np.interp(between, samples, signal.time), fine.ravel())


def _deviation(
    signals: Mapping[str, RecordedSignal],
    begin: float,
    period: float,
    found: MatchedTest,
    controller: Controller,
) -> Deviation | None:
    """How far what was recorded is from the test, by phase and rate of the clock."""
    stored, closed = found.test.command(), found.test.closed_loop
    role, name = "channels.current", "control law" if closed else "current"
    position = signals["channels.position"]
    if "channels.current" not in signals or (closed and (controller.GAI or controller.GAD)):
        role, name = ("command.position" if closed else "command.current"), "command"
        if role not in signals:
            return None
    part = _within(signals[role], begin - 2.0 * period, begin + len(stored) * period)
    if len(part.time) < CLOCK.min_samples:
        return None
    half = 0.5 * len(stored)
    position = _smoothed(position)

    def residuals(phase: float, rate: float) -> FloatArray:
        # About the test's middle, where phase and rate say nothing of each other.
        at = (part.time - begin) / period - phase
        tick = np.floor(half + (at - half) / (1.0 + rate)).astype(np.int64)
        known = (tick >= 0) & (tick < len(stored))
        asked = stored[tick[known]]
        if name == "control law":
            edge = (half + (tick[known] - half) * (1.0 + rate) + phase) * period + begin
            asked = controller.GAP * (asked - np.interp(edge, position.time, position.value))
        limit = controller.IM if name != "command" else np.inf
        away = part.value[known] - np.clip(asked, -limit, limit)
        return np.asarray(away - np.median(away)) if away.size else np.full(1, np.inf)

    return Deviation(residuals, name)
