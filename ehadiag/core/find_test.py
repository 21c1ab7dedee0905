"""Finds which stored test a recording holds, and when it began, where the bus does not say.

The command is held against each stored test at each instant (in open loop, and without a command,
the measured current; in closed loop without one what the control law must have been told). The
telemetry has an instant of its own: stamps do not tell which of its samples a command belongs to,
the measured current does.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Controller
from ehadiag.core.recording import CommandMode, Recording, Samples
from ehadiag.core.stored_test import SAME_RATE, StoredTest

__all__ = ["Found", "Sought", "find_test", "found_tests", "played_tests", "rows_of_samples"]

LEAST_COMMANDS = 100
LEAST_SHARE = 0.75
"""Of a test's motion that must lie within the recording."""
MOST_MISFIT = 0.05
"""Misfit (rms over that of the test's own command) beyond which it is another test."""
ELSEWHERE_S = 0.05
"""Another instant of the same test is a rival from here on."""
CLEARLY = 2.0
"""Misfit of the rival over that of the test below which which test it is is not sure."""
FARTHEST = 4
"""Ticks that telemetry may stand beside its command."""
LINEAR = 0.9
"""Share of the rated current up to which the control law is linear."""
OUT_OF_PLACE = {CommandMode.CURRENT: 2e-6, CommandMode.POSITION: 5e-6}
"""A, m: distance of a command from the test's from which on it is held to be of another tick."""
MOST_TESTS = 1000
ENGINEERING = {"current": ("mA", 1e3), "position": ("mm", 1e3)}

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sought:
    """What may have been played, and where to look for it.

    Attributes
    ----------
    tests : tuple[StoredTest, ...]
        The tests that it may be.
    controller : Controller
        Of the actuator; repeats the control law where no command is recorded.
    start_s : float | None
        Where the test begins, s from the first sample of the recording; None: anywhere.
    end_s : float | None
        Where it has ended; None: anywhere.
    """

    tests: tuple[StoredTest, ...]
    controller: Controller
    start_s: float | None = None
    end_s: float | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """A stored test in a stream of samples.

    Attributes
    ----------
    test : StoredTest
        Which.
    first : int
        Row of the samples that is its tick 0; may lie before the first one.
    command_first : int
        The same for the command, which has stamps of its own.
    misfit : float
        Rms of command less test over the rms of the test's command.
    rival : float
        The same of the best other test, or of this one elsewhere; infinite without one.
    by : str
        What was held against it: `command`, `current` or `control law`.
    """

    test: StoredTest
    first: int
    command_first: int
    misfit: float
    rival: float
    by: str

    @property
    def sure(self) -> bool:
        """Whether no other test, nor another instant, fits nearly as well."""
        return self.rival > CLEARLY * self.misfit


def found_tests(
    recording: Recording,
    search: Sought,
    *,
    within: bool = False,
    before: int = 0,
    others: bool = False,
) -> tuple[Recording, ...]:
    """Cut out of a recording the tests that it holds.

    Parameters
    ----------
    recording : Recording
        A recording whose bus does not say when which test ran.
    search : Sought
        What to look for.
    within : bool
        The recording is known to hold one test: only its instant is looked for.
    before : int
        Rows at the recording's beginning that its reader does not count.
    others : bool
        Other tests may have been played too: no start is taken at its word.

    Returns
    -------
    tuple[Recording, ...]
        One for each test found, in order of time; the recording itself, with a note or a reason
        to refuse it, where none is found.
    """
    samples = recording.samples
    if samples is None:
        return (recording,)
    low, high = _window(samples, search, before)
    if (low, high) != (0, samples.ticks):
        samples = rows_of_samples(samples, low, low, high - low)
    begin = low - before
    found, nearest = played_tests(samples, search, once=within)
    alone = len(search.tests) == 1 and not others
    if not found and search.start_s is not None and alone:
        return (_taken_at(recording, samples, search.tests[0], begin),)
    if not found:
        return (_not_found(recording, nearest, samples.period_ns, begin),)
    found.sort(key=lambda item: item.first)
    return tuple(_cut(recording, samples, item, begin, search.controller) for item in found)


def played_tests(
    samples: Samples, search: Sought, *, once: bool = False, most: float = MOST_MISFIT
) -> tuple[list[Found], Found | None]:
    """Find all tests in a stretch of samples.

    Parameters
    ----------
    samples : Samples
        On a tick grid.
    search : Sought
        What to look for; where to look does not count.
    once : bool
        It holds one test at most.
    most : float
        Misfit up to which a test is found: more where samples are placed roughly.

    Returns
    -------
    tuple[list[Found], Found | None]
        Those found, the best one first, and what came nearest where the next is none.
    """
    found: list[Found] = []
    for item in _each(samples, search, once=once):
        if item.misfit > most:
            return found, item
        found.append(item)
    return found, None


def _window(samples: Samples, search: Sought, before: int) -> tuple[int, int]:
    """First row, and one past the last, in which to look."""
    per_s = 1e9 / samples.period_ns
    low, high = 0, samples.ticks
    if search.start_s is not None:
        low = min(before + round(search.start_s * per_s), samples.ticks)
    if search.end_s is not None:
        high = min(before + round(search.end_s * per_s), samples.ticks)
    return low, max(high, low)


def rows_of_samples(samples: Samples, first: int, command_first: int, ticks: int) -> Samples:
    """Return a stretch of samples, NaN where it reaches beyond them; the command has its own start.

    Parameters
    ----------
    samples : Samples
        Of shape (n,) each.
    first : int
        Row of the channels that becomes row 0; may be negative.
    command_first : int
        The same of the command.
    ticks : int
        Rows of the result.

    Returns
    -------
    Samples
        Of shape (ticks,) each.
    """

    channels: dict[str, Any] = {
        name: _part(getattr(samples, name), first, ticks, np.nan)
        for name in ("current", "spool", "pressure", "position")
    }
    return replace(
        samples,
        **channels,
        command=_part(samples.command, command_first, ticks, np.nan),
        saturated=_part(samples.saturated, first, ticks, False),
        host_ns=_part(samples.host_ns, first, ticks, -1),
    )


def _part(values: NDArray[Any], begin: int, ticks: int, fill: float) -> NDArray[Any]:
    out = np.full((*values.shape[:-1], ticks), fill, dtype=values.dtype)
    low, high = max(begin, 0), min(begin + ticks, values.shape[-1])
    if high > low:
        out[..., low - begin : high - begin] = values[..., low:high]
    return out


def _each(samples: Samples, search: Sought, *, once: bool) -> Iterator[Found]:
    """Tests by how well they fit, each on samples that no better one has taken."""
    free = np.ones(samples.ticks, dtype=np.bool_)
    for _ in range(1 if once else MOST_TESTS):
        item = find_test(samples, search.tests, search.controller, free=free)
        if item is None:
            return
        yield item
        free[max(item.command_first, 0) : max(item.command_first + item.test.ticks, 0)] = False


def find_test(
    samples: Samples,
    tests: Sequence[StoredTest],
    controller: Controller,
    *,
    free: NDArray[np.bool_] | None = None,
) -> Found | None:
    """Find the test that fits the samples best, whatever its misfit.

    Parameters
    ----------
    samples : Samples
        On a tick grid.
    tests : Sequence[StoredTest]
        The tests that it may be.
    controller : Controller
        Of the actuator.
    free : NDArray[np.bool_] | None
        Rows that may belong to it, shape (ticks,); None: all.

    Returns
    -------
    Found | None
        None where nothing that could tell is recorded, or no test fits into the recording.
    """
    candidates: list[Found] = []
    for test in tests:
        if abs(samples.period_ns * 1e-9 * test.rate - 1.0) > SAME_RATE:
            continue
        seen, by = _told(samples, test, controller)
        if free is not None:
            seen = np.where(free, seen, np.nan)
        candidates += _instants(seen, test, by)
    if not candidates:
        return None
    best = min(candidates, key=lambda item: item.misfit)
    others = (item.misfit for item in candidates if item is not best)
    best = replace(best, rival=min(others, default=np.inf))
    beside = _beside(samples, best, controller)
    return replace(best, first=best.command_first + beside)


def _told(samples: Samples, test: StoredTest, controller: Controller) -> tuple[Floats, str]:
    """What was commanded, as far as the recording tells, A or m, and what tells it."""
    mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
    if samples.mode is mode and np.isfinite(samples.command).sum() >= LEAST_COMMANDS:
        return samples.command, "command"
    current = np.where(samples.saturated[0], np.nan, samples.current)
    if not test.closed_loop:
        return current, "current"
    if not controller.GAP or np.isfinite(samples.command).sum() >= LEAST_COMMANDS:
        return np.full(samples.ticks, np.nan), "control law"
    linear = np.abs(current) < LINEAR * controller.IM
    implied = np.concatenate([[np.nan], samples.position[:-1]]) + current / controller.GAP
    return np.where(linear, implied, np.nan), "control law"


def _instants(seen: Floats, test: StoredTest, by: str) -> list[Found]:
    """The best instant of a test, and the best one elsewhere."""
    stored = test.command()
    power = float(np.mean(stored**2))
    known = np.isfinite(seen)
    if not known.any() or power == 0.0:
        return []
    lags = np.arange(1 - len(stored), len(seen))
    value = np.where(known, seen, 0.0)
    cross = _correlate(value, stored, len(lags))
    own = _correlate(known.astype(np.float64), stored**2, len(lags))
    theirs = _correlate(value**2, np.ones(len(stored)), len(lags))
    density = float(known.sum()) / max(int(np.ptp(np.flatnonzero(known))) + 1, 1)
    enough = own >= LEAST_SHARE * density * power * len(stored)
    if not enough.any():
        return []
    square = np.maximum(theirs - 2.0 * cross + own, 0.0)
    misfit = np.sqrt(np.where(enough, square / np.where(enough, own, 1.0), np.inf))
    place = int(np.argmin(misfit))
    out = [Found(test, 0, int(lags[place]), float(misfit[place]), np.inf, by)]
    misfit[np.abs(lags - lags[place]) < ELSEWHERE_S * test.rate] = np.inf
    other = int(np.argmin(misfit))
    if np.isfinite(misfit[other]):
        out.append(Found(test, 0, int(lags[other]), float(misfit[other]), np.inf, by))
    return out


def _correlate(values: Floats, stored: Floats, lags: int) -> Floats:
    """Sum of values[k + lag] * stored[k] over k, for lags from 1 - len(stored) on."""
    size = 1 << int(lags).bit_length()
    spectrum = np.fft.rfft(values, size) * np.conj(np.fft.rfft(stored, size))
    whole = np.fft.irfft(spectrum, size)
    return np.concatenate([whole[size - len(stored) + 1 :], whole[: len(values)]])


def _beside(samples: Samples, found: Found, controller: Controller) -> int:
    """Ticks by which the telemetry's rows come after the command's, as the current tells."""
    if found.by != "command":
        return 0
    ticks = np.arange(samples.ticks) - found.command_first
    if found.test.closed_loop and (controller.GAI or controller.GAD):
        return 0
    stored = found.test.command()

    def misfit(shift: int, late: int) -> float:
        at = ticks - shift
        inside = (at >= 0) & (at < len(stored))
        command = stored[np.clip(at, 0, len(stored) - 1)]
        if found.test.closed_loop:
            before = _part(samples.position, late - 1, samples.ticks, np.nan)
            command = controller.GAP * (command - before)
        law = np.clip(command, -controller.IM, controller.IM)
        away = (samples.current - law)[inside & ~samples.saturated[0]]
        away = away[np.isfinite(away)]
        if len(away) < LEAST_COMMANDS:
            return np.inf
        away = np.sort(np.abs(away - np.median(away)))[: int(0.98 * len(away))]
        return float(np.sqrt(np.mean(away**2)))

    tried = sorted(range(-FARTHEST, FARTHEST + 1), key=abs)
    if not np.isfinite(misfit(0, 0)):
        return 0
    best = min(tried, key=lambda shift: misfit(shift, 0))
    if not found.test.closed_loop:
        return best
    # The jack's positions may come by another message than the currents, later than these.
    pairs = sorted(itertools.product(tried, tried), key=lambda pair: abs(pair[0]) + abs(pair[1]))
    shift, late = min(pairs, key=lambda pair: misfit(*pair))
    return shift if CLEARLY * misfit(shift, late) < misfit(best, 0) else best


def _position_late(mine: Samples, found: Found, controller: Controller) -> int:
    """Ticks by which the jack's positions come later than the currents, as the control law tells.

    They may come by another message than the current.
    """
    if not found.test.closed_loop or not controller.GAP or controller.GAI or controller.GAD:
        return 0
    stored = found.test.command()

    def misfit(late: int) -> float:
        seen = _part(mine.position, late - 1, len(stored), np.nan)
        law = np.clip(controller.GAP * (stored - seen), -controller.IM, controller.IM)
        away = (mine.current - law)[~mine.saturated[0]]
        away = away[np.isfinite(away)]
        if len(away) < LEAST_COMMANDS:
            return np.inf
        away = np.sort(np.abs(away - np.median(away)))[: int(0.98 * len(away))]
        return float(np.sqrt(np.mean(away**2)))

    best = min(sorted(range(-FARTHEST, FARTHEST + 1), key=abs), key=misfit)
    return best if CLEARLY * misfit(best) < misfit(0) < np.inf else 0


def _cut(
    recording: Recording, samples: Samples, found: Found, begin: int, controller: Controller
) -> Recording:
    """The test's own rows, and what a reader should know of how it was found."""
    test, mode = found.test, CommandMode.POSITION
    if not found.test.closed_loop:
        mode = CommandMode.CURRENT
    mine = rows_of_samples(samples, found.first, found.command_first, test.ticks)
    late = _position_late(mine, found, controller)
    if late:
        mine = replace(
            mine, position=_part(samples.position, found.first + late, test.ticks, np.nan)
        )
    if found.by != "command":
        mine = replace(mine, command=np.full(test.ticks, np.nan))
    tolerance = max(OUT_OF_PLACE[mode], 0.6 * _resolution(mine.command))
    away = np.abs(mine.command - test.command())
    strange = np.isfinite(away) & (away > tolerance)
    strange &= _near(mine.command, test.command(), tolerance)
    mine = replace(mine, mode=mode, command=np.where(strange, np.nan, mine.command))
    period = samples.period_ns
    at = (found.first + begin) * period * 1e-9
    unit, factor = ENGINEERING[test.mode]
    rms = found.misfit * float(np.sqrt(np.mean(test.command() ** 2))) * factor
    notes = [f"test {test.name!r} found by its {found.by} at {at:.3f} s ({rms:.2g} {unit} rms off)"]
    if not found.sure:
        notes.append("another test, or another instant, fits the command nearly as well")
    if found.first != found.command_first:
        beside = (found.first - found.command_first) * period / 1e6
        notes.append(
            f"the stamps of telemetry and command differ by {beside:g} ms more than a tick"
        )
    if late:
        notes.append(
            f"the jack's positions come {late * period / 1e6:g} ms later than the currents"
        )
    if strange.any():
        notes.append(f"{int(strange.sum())} commands out of place by their stamps are left out")
    quality = replace(recording.quality, notes=(*recording.quality.notes, *notes))
    start = recording.start_ns
    if start is not None:
        start += (found.first + begin) * period
    return replace(
        recording,
        samples=mine,
        test_id=test.id,
        quality=quality,
        start_ns=start,
        out_of_order=float(strange.mean()),
    )


def _taken_at(recording: Recording, samples: Samples, test: StoredTest, begin: int) -> Recording:
    """The rows from the start that was named on."""
    at = begin * samples.period_ns * 1e-9
    note = f"test {test.name!r} taken from {at:.3f} s on, as named: no command nor current shows it"
    quality = replace(recording.quality, notes=(*recording.quality.notes, note))
    start = recording.start_ns
    if start is not None:
        start += begin * samples.period_ns
    mine = rows_of_samples(samples, 0, 0, test.ticks)
    return replace(recording, samples=mine, test_id=test.id, quality=quality, start_ns=start)


def _near(command: Floats, stored: Floats, tolerance: float) -> NDArray[np.bool_]:
    """Commands that the test has within a few ticks: they are of another tick than their row."""
    near = np.zeros(len(command), dtype=np.bool_)
    for shift in range(-FARTHEST, FARTHEST + 1):
        near |= np.abs(command - np.roll(stored, shift)) <= tolerance
    return near


def _resolution(command: Floats) -> float:
    """Smallest distance between two commands sent; 0 of too few."""
    levels = np.unique(command[np.isfinite(command)])
    return float(np.diff(levels).min()) if len(levels) > LEAST_COMMANDS else 0.0


def _not_found(
    recording: Recording, nearest: Found | None, period_ns: int, begin: int
) -> Recording:
    why = "no stored test fits into the recording"
    if nearest is not None:
        at = (nearest.first + begin) * period_ns * 1e-9
        why = (
            f"no stored test was played: the nearest, {nearest.test.name!r} at {at:.3f} s, is"
            f" {nearest.misfit:.0%} of its command off by the {nearest.by}"
        )
    quality = replace(recording.quality, notes=(*recording.quality.notes, why))
    return replace(recording, quality=quality)
