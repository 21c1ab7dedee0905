"""Stored tests: the command profile that a flight-control computer plays out, as data.

A test is a list of segments (straight lines through points, sines) and the windows of time that
each stage of the diagnosis uses. A rig's computer may store others: a test is a file, not code.
"""

from __future__ import annotations

import itertools
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from firmware_iface import FREE_MOTION
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import decode_toml, read_toml
from firmware_iface.recording import CommandMode, FloatArray

MAX_TEST_DURATION_S = 600.0
MIN_TEST_TICKS, MAX_TEST_TICKS = 100, 60_000
"""Bounds what an identification costs: a minute at 1 kHz, as long as the default bus can tell."""
MAX_COMMAND = 10.0
"""A or m."""
RATE_TOLERANCE = 1e-6
"""Relative difference up to which two rates are one."""
MIN_WINDOW_TICKS = 10
"""Ticks."""
TIME_TOLERANCE_S = 5e-10
"""Tick times are not exact in binary: times nearer than this are one."""
COMMAND_UNITS = {"current": {"A": 1.0, "mA": 1e-3}, "position": {"m": 1.0, "mm": 1e-3}}

NonNegative = Annotated[float, msgspec.Meta(ge=0)]
PositiveNumber = Annotated[float, msgspec.Meta(gt=0)]
CommandValue = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
ControlRate = Annotated[float, msgspec.Meta(ge=10, le=1e5)]
TimeWindow = tuple[NonNegative, NonNegative]
"""Start and end of a span of the test, s."""


class Controller(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Position controller of the flight-control computer (PHY-2)."""

    IM: Annotated[float, msgspec.Meta(ge=1e-4, le=10)]
    """Rated current and saturation, A."""
    GAP: Annotated[float, msgspec.Meta(ge=0, le=1e4)]
    """Proportional gain, A/m."""
    GAI: Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)] = 0.0
    """Integral gain, A/(m s)."""
    GAD: Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)] = 0.0
    """Derivative gain, A s/m."""
    rate: Annotated[float, msgspec.Meta(ge=10, le=1e5)] = 1000.0
    """Control rate, Hz."""


class Line(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="line"):
    """Straight lines through points (time in s, value); a time given twice is a step."""

    points: Annotated[
        tuple[tuple[NonNegative, CommandValue], ...], msgspec.Meta(min_length=2, max_length=10_000)
    ]

    @property
    def start(self) -> float:
        """First time, s."""
        return self.points[0][0]

    @property
    def end(self) -> float:
        """Last time, s."""
        return self.points[-1][0]

    def values(self, time: FloatArray) -> FloatArray:
        """Value at each time; at a step still the value before it."""
        times = np.array([point[0] for point in self.points])
        levels = np.array([point[1] for point in self.points])
        right = np.clip(
            np.searchsorted(times, time - TIME_TOLERANCE_S, side="left"), 1, len(times) - 1
        )
        t0, t1 = times[right - 1], times[right]
        weight = np.divide(time - t0, t1 - t0, out=np.zeros_like(time), where=t1 > t0)
        return levels[right - 1] + (levels[right] - levels[right - 1]) * weight


class Sine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="sine"):
    """`amplitude * sin(2 pi frequency (t - start))` from start to end."""

    start: NonNegative
    end: NonNegative
    amplitude: CommandValue
    frequency: PositiveNumber
    """Hz."""

    def values(self, time: FloatArray) -> FloatArray:
        """Value at each time."""
        return self.amplitude * np.sin(2.0 * np.pi * self.frequency * (time - self.start))


SearchSpans = Annotated[tuple[TimeWindow, ...], msgspec.Meta(min_length=1, max_length=32)]


class SearchWindows(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which spans of the test serve which search (s)."""

    FDJ: SearchSpans
    Kintas: SearchSpans
    FSS: SearchSpans
    refinement: SearchSpans


class StoredTest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, dict=True):
    """One stored test of a flight-control computer."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    id: Annotated[int, msgspec.Meta(ge=1, le=255)]
    mode: Literal["current", "position"]
    unit: str
    rate: ControlRate = 1000.0
    """Control rate, Hz."""
    description: Annotated[str, msgspec.Meta(max_length=1000)] = ""
    segment: Annotated[tuple[Line | Sine, ...], msgspec.Meta(min_length=1, max_length=1000)]
    windows: SearchWindows

    @property
    def duration(self) -> float:
        """Length, s."""
        return self.segment[-1].end

    @cached_property
    def ticks(self) -> int:
        """Number of control ticks."""
        return round(self.duration * self.rate)

    @cached_property
    def closed_loop(self) -> bool:
        """Whether the command is a position."""
        return self.mode == "position"

    @property
    def command_mode(self) -> CommandMode:
        """What the command is."""
        return CommandMode.POSITION if self.closed_loop else CommandMode.CURRENT

    def time(self) -> FloatArray:
        """Start of each tick, s, shape (ticks,)."""
        return np.arange(self.ticks) / self.rate

    def command(self) -> FloatArray:
        """Command of each tick, SI (A or m), shape (ticks,).

        Where segments meet, and at a step, the tick that starts there still has the earlier value:
        so the reference recordings show it.
        """
        time = self.time()
        out = np.zeros(self.ticks)
        for part in reversed(self.segment):
            inside = time <= part.end + TIME_TOLERANCE_S
            out[inside] = part.values(time[inside])
        return out * COMMAND_UNITS[self.mode][self.unit]


def load_test(path: Path | str) -> StoredTest:
    """Read a test file.

    Parameters
    ----------
    path : Path | str
        File to read.

    Returns
    -------
    StoredTest
        The test, checked.

    Raises
    ------
    InputOutputError
        The file cannot be read.
    ConfigurationError
        Not TOML, a key unknown or missing, times out of order, windows outside.
    """
    return _checked(read_toml(Path(path), StoredTest, "test file"), f"test file {path}")


def encode_test(test: StoredTest) -> bytes:
    """Return a test as the content of a test file, which `load_test` reads back."""
    return msgspec.toml.encode(test)


def bundled_tests() -> dict[str, StoredTest]:
    """Return the stored tests that come with the package (PHY-25, PHY-26), by name."""
    return {test.name: test for test in _bundled_tests()}


@cache
def _bundled_tests() -> tuple[StoredTest, ...]:
    """Stored tests that come with the package, read once."""
    tests = []
    for entry in sorted((Path(__file__).parent / "data/tests").iterdir()):
        if entry.name.endswith(".toml"):
            where = f"bundled test {entry.name}"
            tests.append(_checked(decode_toml(entry.read_bytes(), StoredTest, where), where))
    return tuple(tests)


def resolve_test(name: str) -> StoredTest:
    """Return the bundled test of that name or number, or read it as a file."""
    tests = bundled_tests()
    if name in tests:
        return tests[name]
    if Path(name).exists() or "/" in name or name.endswith(".toml"):
        return load_test(name)
    for test in tests.values():
        if str(test.id) == name:
            return test
    known = ", ".join(f"{test.name} or {test.id}" for test in tests.values())
    raise ConfigurationError(f"test {name!r}: neither a stored test ({known}) nor a test file")


def _checked(test: StoredTest, where: str) -> StoredTest:
    if test.name == FREE_MOTION:
        raise ConfigurationError(
            f"{where}: the name {test.name!r} is kept for severities by the monitor: choose another"
        )
    if test.unit not in COMMAND_UNITS[test.mode]:
        choice = " or ".join(COMMAND_UNITS[test.mode])
        raise ConfigurationError(
            f"{where}: unit {test.unit!r} for a {test.mode} test, need {choice}"
        )
    at = 0.0
    for index, part in enumerate(test.segment):
        if isinstance(part, Line):
            times = [point[0] for point in part.points]
            if any(b < a for a, b in itertools.pairwise(times)):
                raise ConfigurationError(f"{where}: times out of order in segment[{index}].points")
        if part.end <= part.start:
            raise ConfigurationError(f"{where}: segment[{index}] ends before it begins")
        if abs(part.start - at) > 1e-9:
            raise ConfigurationError(
                f"{where}: segment[{index}] begins at {part.start:g} s, must at {at:g} s"
            )
        at = part.end
    if test.duration > MAX_TEST_DURATION_S:
        raise ConfigurationError(f"{where}: longer than {MAX_TEST_DURATION_S:g} s")
    if not MIN_TEST_TICKS <= test.ticks <= MAX_TEST_TICKS:
        raise ConfigurationError(
            f"{where}: {test.ticks} ticks long, need {MIN_TEST_TICKS} to {MAX_TEST_TICKS}"
        )
    _check_command(test, where)
    _check_windows(test, where)
    return test


def _check_command(test: StoredTest, where: str) -> None:
    for index, part in enumerate(test.segment):
        if isinstance(part, Sine) and part.frequency > test.rate / 2.0:
            raise ConfigurationError(
                f"{where}: segment[{index}].frequency beyond half the rate of {test.rate:g} Hz"
            )
    greatest = float(np.abs(test.command()).max())
    if greatest > MAX_COMMAND:
        si = "m" if test.closed_loop else "A"
        raise ConfigurationError(
            f"{where}: a command of {greatest:g} {si}, need at most {MAX_COMMAND:g} {si}"
        )


def _check_windows(test: StoredTest, where: str) -> None:
    for field in test.windows.__struct_fields__:
        windows: tuple[TimeWindow, ...] = getattr(test.windows, field)
        for start, end in windows:
            if not start < end <= test.duration + 1e-9:
                raise ConfigurationError(
                    f"{where}: windows.{field} [{start:g}, {end:g}] not inside the test"
                )
            if (end - start) * test.rate < MIN_WINDOW_TICKS:
                raise ConfigurationError(
                    f"{where}: windows.{field} [{start:g}, {end:g}] shorter than "
                    f"{MIN_WINDOW_TICKS} ticks"
                )
