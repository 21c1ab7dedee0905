"""Damaged logs of a whole stored test, with the outcome stated for each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from damaged_bus import foreign_frames
from msgspec.structs import replace

from ehadiag import Recording
from ehadiag_sim.control import FrameMoment
from firmware_iface.logs.recorder import Recorder
from firmware_iface.signals.recordings import read_recording
from firmware_iface.tester import Assembler
from firmware_iface.transport.frames import Frame

MIDDLE_OF_ALL = 0.5
END = 5.5
"""s: length of the stored test."""
KEPT = 20_000
"""Frames that the assembler of the endless logs keeps."""
NOISE = 40_000
"""Foreign frames: twice what is kept. What does not grow with them does not with 10^8."""


@dataclass(frozen=True)
class LogCase:
    """A damage, and what NOT TESTED must say; an empty reason: the same estimates."""

    name: str
    damage: Callable[[list[Frame], float, Path], Recording]
    why: str = ""

    @property
    def stated(self) -> str:
        """The outcome in words."""
        return f"NOT TESTED: {self.why}" if self.why else "same"


def half(frames: list[Frame], _begun: float, folder: Path) -> Recording:
    """Cut the file, not only its content: a full disk, a killed process."""
    path = folder / "half.blf"
    with Recorder(path) as recorder:
        for item in frames:
            recorder.write(item)
    content = path.read_bytes()
    path.write_bytes(content[: int(MIDDLE_OF_ALL * len(content))])
    return read_recording(path)


def without(first: float, last: float) -> Callable[[list[Frame], float, Path], Recording]:
    """Take out all frames between two times of the test, s."""

    def damage(frames: list[Frame], begun: float, _: Path) -> Recording:
        return collected(item for item in frames if not first <= item.time_ns / 1e9 - begun < last)

    return damage


def collected(frames: Iterator[Frame], kept: int = 4_000_000) -> Recording:
    """Read frames as they come, with bounded memory."""
    assembler = Assembler("log", max_frames=kept)
    assembler.extend(frames)
    return assembler.recording()


def noise(count: int, time_ns: int) -> Iterator[Frame]:
    """Foreign frames without end, none of them kept here."""
    foreign, at = foreign_frames(1), FrameMoment(0.0, np.random.default_rng(7))
    carrier = Frame(time_ns, 0x110, bytes(8))
    for _ in range(count):
        yield next(iter(foreign(carrier, at)))


def after_noise(frames: list[Frame], _begun: float, _folder: Path) -> Recording:
    """Put noise before the test."""

    def stream() -> Iterator[Frame]:
        yield from noise(NOISE, frames[0].time_ns)
        yield from frames

    return collected(stream(), KEPT)


def before_noise(frames: list[Frame], _begun: float, _folder: Path) -> Recording:
    """Put noise after the test: what is too old is forgotten."""

    def stream() -> Iterator[Frame]:
        yield from frames
        yield from noise(NOISE, frames[-1].time_ns)

    return collected(stream(), KEPT)


def endless(frames: list[Frame], begun: float, _: Path) -> Recording:
    """Put an hour's idling before the test: the frames before it again and again."""
    idle = [item for item in frames if item.time_ns / 1e9 < begun - 0.15]
    span = round(0.256e9)  # a whole turn of the counters

    def stream() -> Iterator[Frame]:
        rounds = 2 * KEPT // len(idle)
        for index in range(rounds):
            back = (rounds - index) * span
            yield from (replace(item, time_ns=item.time_ns - back) for item in idle)
        yield from frames

    return collected(stream(), KEPT)


LOG_CASES = (
    LogCase("half a log (BLF truncated)", half, "samples are missing"),
    LogCase("last 0.2 s missing, and with it the status of completion", without(END - 0.2, 99.0)),
    LogCase("last 0.3 s missing", without(END - 0.3, 99.0), "no spool sample for 0.3"),
    LogCase("first 0.2 s missing", without(-99.0, 0.2)),
    LogCase("0.2 s missing during the steps", without(2.45, 2.65)),
    LogCase("0.3 s missing during the steps", without(2.45, 2.75), "no spool sample for 0.3"),
    LogCase("an endless log, the test at its end", endless),
    LogCase("a flood of foreign frames, then the test", after_noise),
    LogCase("the test, then a flood of foreign frames", before_noise, "no telemetry"),
)
