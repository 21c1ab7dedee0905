"""Turns decoded signals into recordings of tests: ticks, test, instant within a tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.errors import ConfigurationError
from ehadiag.core.find_test import Found, Sought, find_test, found_tests, played_tests
from ehadiag.core.recording import CommandMode, Environment, Outcome, Quality, Recording, Samples
from firmware_iface.logs.budget import Budget
from firmware_iface.signals.columns import NEEDED, ColumnMap
from firmware_iface.signals.held import held_by_test, off_a_bus
from firmware_iface.signals.resample import (
    Clock,
    bend,
    held_on_ticks,
    interval,
    on_ticks,
)
from firmware_iface.signals.tables import Signal, joined, read_signals

__all__ = ["recordings_of_signals"]

MOST_TICKS = 1_000_000
COARSE = (np.arange(-1.5, 1.51, 0.1), np.arange(-300e-6, 301e-6, 50e-6))
FINE = (np.arange(-0.1, 0.101, 0.02), np.arange(-50e-6, 51e-6, 10e-6))
"""Phase in ticks and rate of the logger's clock, over which the test's own command is fitted."""
LEAST_SAMPLES = 100
MOST_FITTED = 20_000
MOST_ROUGHLY = 0.25
"""Misfit of a test's command that delays of some ticks make: it is judged anew afterwards."""
CHANNELS = {"current": ("mA", 1e3), "spool": ("mm", 1e3), "pressure": ("MPa", 1e-6),
            "position": ("mm", 1e3)}  # fmt: skip

Floats = NDArray[np.float64]


def recordings_of_signals(
    paths: Sequence[Path | str], columns: ColumnMap, sought: Sought, budget: Budget
) -> tuple[Recording, ...]:
    """Read the tests in one recording of decoded signals.

    Parameters
    ----------
    paths : Sequence[Path | str]
        Its files: one, or several that follow or complete one another.
    columns : ColumnMap
        Which column is what.
    sought : Sought
        The tests that may have been played.
    budget : Budget
        What reading may cost.

    Returns
    -------
    tuple[Recording, ...]
        At least one; without a test number where no stored test was found.

    Raises
    ------
    InputOutputError
        A file cannot be read.
    ConfigurationError
        A column is missing, or has a unit that is none of its quantity.
    """
    alone = len(paths) == 1
    signals = joined(read_signals(path, columns, budget, complete=alone) for path in paths)
    source = ", ".join(str(path) for path in paths)
    lacking = [role for role in NEEDED if role not in signals]
    if lacking:
        raise ConfigurationError(f"log {source}: no column for {', '.join(lacking)}")
    period = columns.tick_ns * 1e-9
    start = min(item.time[0] for item in signals.values())
    held = held_on_ticks(signals, period)
    rows: Mapping[str, Floats]
    if held is not None:
        clock, rows = held
        rate = float(np.mean(np.diff(clock.begin))) / period - 1.0
        said: tuple[str, ...] = (f"ticks by the changes of held signals ({1e6 * rate:+.0f} ppm)",)
    else:
        clock, rows, said = _clock(signals, period, sought)
    samples, rules = _samples(signals, rows, clock, columns.tick_ns, start)
    jitter = max(item.jitter for item in signals.values())
    even = (
        f"time stamps jitter by {1e3 * jitter:.2g} ms: the rows' own even clock takes their place"
    )
    evened = (even,) if jitter > 0.0 else ()
    cut = _cut_off(signals, clock)
    notes = ("decoded signals: no check sum, no counter", *evened, *cut, *said, *rules)
    whole = Recording(
        source=source,
        samples=samples,
        test_id=None,
        serial=None,
        outcome=Outcome(),
        environment=_environment(signals),
        quality=Quality(notes=notes),
        start_ns=round((clock.begin[0]) * 1e9),
        by_time=True,
    )
    return found_tests(whole, sought)


def _clock(
    signals: Mapping[str, Signal], period: float, sought: Sought
) -> tuple[Clock, Mapping[str, Floats], tuple[str, ...]]:
    """Ticks on the clock of a logger, held values on them, and what a reader should know."""
    first = max(signals[role].time[0] for role in NEEDED)
    last = min(signals[role].time[-1] for role in NEEDED)
    ticks = min(max(int((last - first) / period), 1), MOST_TICKS)
    even = Clock.even(first, period, ticks)
    samples, _ = _samples(signals, {}, even, round(period * 1e9), first)
    found = find_test(samples, sought.tests, sought.controller)
    led = None if found is None else _led(signals, found)
    if found is None or led is None:
        unsure = "nothing shows where in a tick the signals were sampled: half a tick unsure"
        return even, {}, (unsure,)
    phase, rate = _fitted(led, even, period, found)
    begin = first + period * (1.0 + rate) * (np.arange(ticks + 1)) + phase * period
    held = off_a_bus(signals, period)
    tests, _ = played_tests(samples, sought, most=MOST_ROUGHLY)
    if held and tests:
        placed = held_by_test(held, Clock(begin), tests, sought.controller)
        if placed is not None:
            late = placed.late * period * 1e3
            return (
                placed.clock,
                placed.rows,
                (
                    f"values reach the logger late by {late:.1f} ms rms, some overtaken:"
                    " the current against the test's command tells their ticks",
                ),
            )
    word = f"{phase % 1.0:.2f} of a tick, {1e6 * rate:+.0f} ppm"
    said = f"ticks by the {found.by} against test {found.test.name!r} ({word})"
    return Clock(begin), {}, (said,)


def _cut_off(signals: Mapping[str, Signal], clock: Clock) -> tuple[str, ...]:
    """Say where more was recorded than is looked at."""
    left = min(signals[role].time[-1] for role in NEEDED) - float(clock.begin[-1])
    if clock.ticks < MOST_TICKS or left <= 0.0:
        return ()
    seen = float(clock.begin[-1] - clock.begin[0])
    return (f"the first {seen:.0f} s are looked at, the {left:.0f} s behind them are not",)


def _led(signals: Mapping[str, Signal], found: Found) -> Signal | None:
    """The signal that the test's command can be held against, sample by sample."""
    if found.by == "command":
        return signals["command.position" if found.test.closed_loop else "command.current"]
    return signals["channels.current"] if found.by == "current" else None


def _fitted(signal: Signal, even: Clock, period: float, found: Found) -> tuple[float, float]:
    """Phase in ticks, and rate, at which the test's command explains a signal best."""
    stored = found.test.command()
    begin = even.begin[0] + found.first * period
    inside = (signal.time >= begin - 2 * period) & (signal.time <= begin + len(stored) * period)
    time, value = signal.time[inside], signal.value[inside]
    every = max(len(time) // MOST_FITTED, 1)
    time, value = time[::every], value[::every]
    if len(time) < LEAST_SAMPLES:
        return 0.0, 0.0

    def misfit(phase: float, rate: float) -> float:
        # The clock's rate turns about the recording's first tick, as in `_clock`.
        at = (time - even.begin[0] - phase * period) / (period * (1.0 + rate)) - found.first
        index = np.floor(at).astype(np.int64)
        known = (index >= 0) & (index < len(stored))
        away = value[known] - stored[index[known]]
        return float(np.mean((away - away.mean()) ** 2)) if known.any() else np.inf

    # Far from the beginning a rate also shifts the test: both together, in units of the test.
    best = (0.0, 0.0)
    for phases, rates in (COARSE, FINE):
        tried = [
            (best[0] + phase - (rate * found.first), best[1] + rate)
            for phase in phases
            for rate in rates
        ]
        best = min(tried, key=lambda item: misfit(*item))
    return best


def _samples(
    signals: Mapping[str, Signal],
    held: Mapping[str, Floats],
    clock: Clock,
    tick_ns: int,
    start: float,
) -> tuple[Samples, tuple[str, ...]]:
    """All signals on the ticks, and the rules by which they came there."""
    ticks, period = clock.ticks, tick_ns * 1e-9
    nothing = np.full(ticks, np.nan)
    filled: dict[str, Floats] = {}
    rules: dict[str, list[str]] = {}
    for key, (unit, factor) in CHANNELS.items():
        signal = signals.get(f"channels.{key}")
        if signal is None:
            filled[key] = nothing
            rules.setdefault("not recorded", []).append(key)
            continue
        if f"channels.{key}" in held:
            filled[key], rule = held[f"channels.{key}"], "values as held, by their changes"
        else:
            # The computer holds the current through a tick, whoever measures it.
            filled[key], rule = on_ticks(signal, clock, period, hold=key == "current")
        if "line" in rule:
            rule = f"{rule} (off by up to {factor * bend(signal):.2g} {unit})"
        rules.setdefault(f"{1.0 / interval(signal):.0f} Hz, {rule}", []).append(key)
    mode, command = CommandMode.CURRENT, nothing
    for mode_of, role in (
        (CommandMode.POSITION, "command.position"),
        (CommandMode.CURRENT, "command.current"),
    ):
        item = signals.get(role)
        if item is not None and np.ptp(item.value) > 0.0:
            mode = mode_of
            command = held[role] if role in held else on_ticks(item, clock, period, hold=True)[0]
            break
    samples = Samples(
        period_ns=tick_ns,
        mode=mode,
        current=filled["current"],
        spool=filled["spool"],
        pressure=filled["pressure"],
        position=filled["position"],
        command=command,
        saturated=np.zeros((len(CHANNELS), ticks), dtype=np.bool_),
        host_ns=np.rint((clock.begin[:-1] - start) * 1e9).astype(np.int64),
    )
    return samples, tuple(f"{', '.join(keys)}: {rule}" for rule, keys in rules.items())


def _environment(signals: Mapping[str, Signal]) -> Environment:
    def median(key: str) -> float | None:
        item = signals.get(f"environment.{key}")
        return float(np.median(item.value)) if item is not None and len(item.value) else None

    return Environment(
        supply_pressure=median("supply_pressure"),
        return_pressure=median("return_pressure"),
        oil_temperature=median("oil_temperature"),
    )
