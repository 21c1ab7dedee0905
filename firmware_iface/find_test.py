"""Finds which stored test a recording holds, and when it began, where the bus does not say.

The command is held against each stored test at each instant (in open loop, and without a command,
the measured current; in closed loop without one what the control law must have been told). The
telemetry has an instant of its own: stamps do not tell which of its samples a command belongs to,
the measured current does.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from firmware_iface.recording import (
    CHANNEL_NAMES,
    CHANNELS,
    BoolArray,
    Channel,
    CommandMode,
    FloatArray,
    Recording,
    Samples,
)
from firmware_iface.stored_test import RATE_TOLERANCE, Controller, StoredTest


class MatchLimits(msgspec.Struct, frozen=True):
    """Limits by which a stored test is found in samples."""

    commands: int = 100
    """Least commands that a test is compared with."""
    motion: float = 0.75
    """Least share of a test's motion within the recording."""
    misfit: float = 0.05
    """Misfit (rms over that of the test's own command) beyond which it is another test."""
    rival_distance_s: float = 0.05
    """Time from which on another instant of the same test is a rival, s."""
    rival_ratio: float = 2.0
    """Misfit of the rival over that of the test, below which the test is not sure."""
    shift: int = 4
    """Most ticks between telemetry and its command."""
    linear: float = 0.9
    """Share of the rated current up to which the control law is linear."""
    tests: int = 1000
    """Most tests of one recording."""


MATCH = MatchLimits()
COMMAND_TOLERANCE = {CommandMode.CURRENT: 2e-6, CommandMode.POSITION: 5e-6}
"""A, m: distance of a command from the test's from which on it is held to be of another tick."""


class CandidateTests(msgspec.Struct, frozen=True):
    """What may have been played, and where to look for it."""

    tests: tuple[StoredTest, ...]
    """The tests that it may be."""
    controller: Controller
    """Of the actuator; repeats the control law where no command is recorded."""
    start_s: float | None = None
    """Where the test begins, s from the first sample of the recording; None: anywhere."""
    end_s: float | None = None
    """Where it has ended; None: anywhere."""


class MatchedTest(msgspec.Struct, frozen=True):
    """A stored test in a stream of samples."""

    test: StoredTest
    first: int
    """Row of the samples that is its tick 0; may lie before the first one."""
    command_first: int
    """The same for the command, which has stamps of its own."""
    misfit: float
    """Rms of command less test over the rms of the test's command."""
    rival: float
    """The same of the best other test, or of this one elsewhere; infinite without one."""
    by: str
    """What was held against it: `command`, `current` or `control law`."""

    @property
    def sure(self) -> bool:
        """Whether no other test, nor another instant, fits nearly as well."""
        return self.rival > MATCH.rival_ratio * self.misfit


def extract_tests(
    recording: Recording,
    search: CandidateTests,
    *,
    within: bool = False,
    before: int = 0,
    others: bool = False,
) -> tuple[Recording, ...]:
    """Cut out of a recording the tests that it holds.

    recording: a recording whose bus does not say when which test ran; search: what to look for;
    within: the recording is known to hold one test: only its instant is looked for; before: rows at
    the recording's beginning that its reader does not count; others: other tests may have been
    played too: no start is taken at its word. Returns one for each test found, in order of time;
    the recording itself, with a note or a reason to refuse it, where none is found.
    """
    samples = recording.samples
    if samples is None:
        return (recording,)
    low, high = _search_range(samples, search, before)
    if (low, high) != (0, samples.ticks):
        samples = rows_of_samples(samples, low, low, high - low)
    begin = low - before
    found, nearest = search_tests(samples, search, once=within)
    alone = len(search.tests) == 1 and not others
    if not found and search.start_s is not None and alone:
        return (_cut_at_given_start(recording, samples, search.tests[0], begin),)
    if not found:
        return (_not_found(recording, nearest, samples.period_ns, begin),)
    found.sort(key=lambda item: item.first)
    return tuple(_cut_matched(recording, samples, item, begin, search.controller) for item in found)


def search_tests(
    samples: Samples, search: CandidateTests, *, once: bool = False, most: float = MATCH.misfit
) -> tuple[list[MatchedTest], MatchedTest | None]:
    """Find all tests in a stretch of samples.

    samples: on a tick grid; search: what to look for; where to look does not count; once: it holds
    one test at most; most: misfit up to which a test is found: more where samples are placed
    roughly. Returns those found, the best one first, and what came nearest where the next is none.
    """
    found: list[MatchedTest] = []
    for item in _matches_in_order(samples, search, once=once):
        if item.misfit > most:
            return found, item
        found.append(item)
    return found, None


def _search_range(samples: Samples, search: CandidateTests, before: int) -> tuple[int, int]:
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

    samples: of shape (n,) each; first: row of the channels that becomes row 0; may be negative;
    command_first: the same of the command; ticks: rows of the result. Returns of shape (ticks,)
    each.
    """

    channels: dict[str, Any] = {
        name: _padded_slice(getattr(samples, name), first, ticks, np.nan) for name in CHANNEL_NAMES
    }
    return replace(
        samples,
        **channels,
        command=_padded_slice(samples.command, command_first, ticks, np.nan),
        saturated=_padded_slice(samples.saturated, first, ticks, False),
        host_ns=_padded_slice(samples.host_ns, first, ticks, -1),
    )


def _padded_slice(values: NDArray[Any], begin: int, ticks: int, fill: float) -> NDArray[Any]:
    out = np.full((*values.shape[:-1], ticks), fill, dtype=values.dtype)
    low, high = max(begin, 0), min(begin + ticks, values.shape[-1])
    if high > low:
        out[..., low - begin : high - begin] = values[..., low:high]
    return out


def _matches_in_order(
    samples: Samples, search: CandidateTests, *, once: bool
) -> Iterator[MatchedTest]:
    """Tests by how well they fit, each on samples that no better one has taken."""
    free = np.ones(samples.ticks, dtype=np.bool_)
    for _ in range(1 if once else MATCH.tests):
        item = match_test(samples, search.tests, search.controller, free=free)
        if item is None:
            return
        yield item
        free[max(item.command_first, 0) : max(item.command_first + item.test.ticks, 0)] = False


def match_test(
    samples: Samples,
    tests: Sequence[StoredTest],
    controller: Controller,
    *,
    free: BoolArray | None = None,
) -> MatchedTest | None:
    """Find the test that fits the samples best, whatever its misfit.

    samples: on a tick grid; tests: the tests that it may be; controller: of the actuator; free:
    rows that may belong to it, shape (ticks,); None: all. Returns None where nothing that could
    tell is recorded, or no test fits into the recording.
    """
    candidates: list[MatchedTest] = []
    for test in tests:
        if abs(samples.period_ns * 1e-9 * test.rate - 1.0) > RATE_TOLERANCE:
            continue
        seen, by = _observed_command(samples, test, controller)
        if free is not None:
            seen = np.where(free, seen, np.nan)
        candidates += _best_instants(seen, test, by)
    if not candidates:
        return None
    best = min(candidates, key=lambda item: item.misfit)
    others = (item.misfit for item in candidates if item is not best)
    best = replace(best, rival=min(others, default=np.inf))
    beside = _telemetry_shift(samples, best, controller)
    return replace(best, first=best.command_first + beside)


def _observed_command(
    samples: Samples, test: StoredTest, controller: Controller
) -> tuple[FloatArray, str]:
    """What was commanded, as far as the recording tells, A or m, and what tells it."""
    if samples.mode is test.command_mode and np.isfinite(samples.command).sum() >= MATCH.commands:
        return samples.command, "command"
    current = np.where(samples.saturated[0], np.nan, samples.current)
    if not test.closed_loop:
        return current, "current"
    if not controller.GAP or np.isfinite(samples.command).sum() >= MATCH.commands:
        return np.full(samples.ticks, np.nan), "control law"
    linear = np.abs(current) < MATCH.linear * controller.IM
    implied = np.concatenate([[np.nan], samples.position[:-1]]) + current / controller.GAP
    return np.where(linear, implied, np.nan), "control law"


def _best_instants(seen: FloatArray, test: StoredTest, by: str) -> list[MatchedTest]:
    """The best instant of a test, and the best one elsewhere."""
    stored = test.command()
    # What a control law tells has the offsets of position and current in it.
    free = by == "control law"
    power = float(np.var(stored) if free else np.mean(stored**2))
    known = np.isfinite(seen).astype(np.float64)
    if not known.any() or power == 0.0:
        return []
    lags = np.arange(1 - len(stored), len(seen))
    value = np.where(known > 0.0, seen, 0.0)
    size = 1 << len(lags).bit_length()
    known_waves, value_waves = np.fft.rfft(known, size), np.fft.rfft(value, size)
    stored_waves = np.conj(np.fft.rfft(stored, size))

    def summed(waves: NDArray[np.complex128]) -> FloatArray:
        """Sum of values[k + lag] * stored[k] over k, for each lag."""
        whole = np.fft.irfft(waves, size)
        return np.concatenate([whole[size - len(stored) + 1 :], whole[: len(seen)]])

    own = summed(known_waves * np.conj(np.fft.rfft(stored**2, size)))
    square = _windowed(value**2, len(stored)) - 2.0 * summed(value_waves * stored_waves) + own
    if free:
        count = np.maximum(_windowed(known, len(stored)), 1.0)
        mean = summed(known_waves * stored_waves)
        square -= (_windowed(value, len(stored)) - mean) ** 2 / count
        own -= mean**2 / count
    density = float(known.sum()) / max(int(np.ptp(np.flatnonzero(known))) + 1, 1)
    enough = own >= MATCH.motion * density * power * len(stored)
    if not enough.any():
        return []
    square = np.maximum(square, 0.0)
    misfit = np.sqrt(np.where(enough, square / np.where(enough, own, 1.0), np.inf))
    place = int(np.argmin(misfit))
    out = [MatchedTest(test, 0, int(lags[place]), float(misfit[place]), np.inf, by)]
    misfit[np.abs(lags - lags[place]) < MATCH.rival_distance_s * test.rate] = np.inf
    other = int(np.argmin(misfit))
    if np.isfinite(misfit[other]):
        out.append(MatchedTest(test, 0, int(lags[other]), float(misfit[other]), np.inf, by))
    return out


def _windowed(values: FloatArray, ticks: int) -> FloatArray:
    """Sum of values[k + lag] over so many ticks k, for lags from 1 - ticks on."""
    whole = np.cumsum(np.pad(values, ticks))
    return np.asarray((whole[ticks:] - whole[:-ticks])[:-1])


def _telemetry_shift(samples: Samples, found: MatchedTest, controller: Controller) -> int:
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
            before = _padded_slice(samples.position, late - 1, samples.ticks, np.nan)
            command = controller.GAP * (command - before)
        law = np.clip(command, -controller.IM, controller.IM)
        return _spread((samples.current - law)[inside & ~samples.saturated[0]])

    tried = sorted(range(-MATCH.shift, MATCH.shift + 1), key=abs)
    if not np.isfinite(misfit(0, 0)):
        return 0
    best = min(tried, key=lambda shift: misfit(shift, 0))
    if not found.test.closed_loop:
        return best
    # The jack's positions may come by another message than the currents, later than these.
    pairs = sorted(itertools.product(tried, tried), key=lambda pair: abs(pair[0]) + abs(pair[1]))
    shift, late = min(pairs, key=lambda pair: misfit(*pair))
    return shift if MATCH.rival_ratio * misfit(shift, late) < misfit(best, 0) else best


def _spread(values: FloatArray) -> float:
    """Rms about the median but for the outermost 2 %; infinite of too few values."""
    values = values[np.isfinite(values)]
    if len(values) < MATCH.commands:
        return np.inf
    inner = np.sort(np.abs(values - np.median(values)))[: int(0.98 * len(values))]
    return float(np.sqrt(np.mean(inner**2)))


def _position_late(mine: Samples, found: MatchedTest, controller: Controller) -> int:
    """Ticks by which the jack's positions come later than the currents, as the control law tells.

    They may come by another message than the current.
    """
    if not found.test.closed_loop or not controller.GAP or controller.GAI or controller.GAD:
        return 0
    stored = found.test.command()

    def misfit(late: int) -> float:
        seen = _padded_slice(mine.position, late - 1, len(stored), np.nan)
        law = np.clip(controller.GAP * (stored - seen), -controller.IM, controller.IM)
        return _spread((mine.current - law)[~mine.saturated[0]])

    best = min(
        sorted(range(-MATCH.shift, MATCH.shift + 1), key=abs),
        key=misfit,
    )
    return best if MATCH.rival_ratio * misfit(best) < misfit(0) < np.inf else 0


def _cut_matched(
    recording: Recording, samples: Samples, found: MatchedTest, begin: int, controller: Controller
) -> Recording:
    """The test's own rows, and what a reader should know of how it was found."""
    test, mode = found.test, CommandMode.POSITION
    if not found.test.closed_loop:
        mode = CommandMode.CURRENT
    mine = rows_of_samples(samples, found.first, found.command_first, test.ticks)
    late = _position_late(mine, found, controller)
    if late:
        mine = replace(
            mine, position=_padded_slice(samples.position, found.first + late, test.ticks, np.nan)
        )
    if found.by != "command":
        mine = replace(mine, command=np.full(test.ticks, np.nan))
    tolerance = max(COMMAND_TOLERANCE[mode], 0.6 * _resolution(mine.command))
    away = np.abs(mine.command - test.command())
    strange = np.isfinite(away) & (away > tolerance)
    strange &= _near_in_test(mine.command, test.command(), tolerance)
    mine = replace(mine, mode=mode, command=np.where(strange, np.nan, mine.command))
    period = samples.period_ns
    at = (found.first + begin) * period * 1e-9
    channel: Channel = getattr(CHANNELS, test.mode)
    rms = found.misfit * float(np.sqrt(np.mean(test.command() ** 2))) / channel.per_unit
    off = f"({rms:.2g} {channel.unit} rms off)"
    notes = [f"test {test.name!r} found by its {found.by} at {at:.3f} s {off}"]
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
        # Whoever measures the command himself keeps no order of frames.
        out_of_order=0.0 if samples.acquired else float(strange.mean()),
    )


def _cut_at_given_start(
    recording: Recording, samples: Samples, test: StoredTest, begin: int
) -> Recording:
    """The rows from the start that was named on."""
    at = begin * samples.period_ns * 1e-9
    note = f"test {test.name!r} taken from {at:.3f} s on, as named: no command nor current shows it"
    quality = replace(recording.quality, notes=(*recording.quality.notes, note))
    start = recording.start_ns
    if start is not None:
        start += begin * samples.period_ns
    mine = rows_of_samples(samples, 0, 0, test.ticks)
    return replace(recording, samples=mine, test_id=test.id, quality=quality, start_ns=start)


def _near_in_test(command: FloatArray, stored: FloatArray, tolerance: float) -> BoolArray:
    """Commands that the test has within a few ticks: they are of another tick than their row."""
    near = np.zeros(len(command), dtype=np.bool_)
    for shift in range(-MATCH.shift, MATCH.shift + 1):
        near |= np.abs(command - np.roll(stored, shift)) <= tolerance
    return near


def _resolution(command: FloatArray) -> float:
    """Smallest distance between two commands sent; 0 of too few."""
    levels = np.unique(command[np.isfinite(command)])
    return float(np.diff(levels).min()) if len(levels) > MATCH.commands else 0.0


def _not_found(
    recording: Recording, nearest: MatchedTest | None, period_ns: int, begin: int
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
