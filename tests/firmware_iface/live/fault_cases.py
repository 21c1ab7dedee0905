"""Harness faults with the outcome stated for each; prints docs/reference/bus-faults.md.

python tests/firmware_iface/live/fault_cases.py > docs/reference/bus-faults.md
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import damaged_bus as bf
import numpy as np
from damaged_bus import FaultyTransport

from ehadiag import Recording, StoredTest, default_actuator
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.control import BitFlips, DuplicateFrames, FrameLoss
from ehadiag_sim.emulator import EmulatorTransport, FccCore
from firmware_iface import tester
from firmware_iface.alignment.align import assemble
from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.handshake import ChannelLimits
from firmware_iface.stored_test import Line, SearchWindows
from firmware_iface.transport.frames import Frame, FrameTable

TELEMETRY, COMMAND, ENVIRONMENT, STATUS = 0x110, 0x111, 0x120, 0x201
NUMBER, DURATION = 9, 0.4
MIDDLE = 0.3
"""s after the first frame: the test has run for some 0.14 s."""


Faulting = Callable[[float], Sequence[bf.HarnessFault]]
"""Faults for a run; the argument is the time when those strike that strike once."""


def nothing(_: float) -> Sequence[bf.HarnessFault]:
    """A sound harness."""
    return ()


@dataclass(frozen=True)
class Case:
    """One fault and its stated outcome.

    why: what NOT TESTED must say; empty: the test is complete.
    unfit: what NOT TESTED must say though the stored test was completed; empty: the same estimates.
    least: share of the samples that must be there, all of them equal to those of a sound bus.
    counts: counts of the quality that must not be zero.
    wrong: share of the samples that may differ: damage that no receiver can see.
    """

    name: str
    received: Faulting = nothing
    sent: Faulting = nothing
    core: dict[str, object] = field(default_factory=dict)
    limits: ChannelLimits = field(default_factory=ChannelLimits)
    restart: bool = False
    why: str = ""
    unfit: str = ""
    least: float = 1.0
    counts: tuple[str, ...] = ()
    wrong: float = 0.0


@dataclass(frozen=True)
class Run:
    """What came of a case."""

    outcome: tester.RequestOutcome
    recording: Recording
    simulated_s: float
    frames: list[Frame]


class Restarting:
    """A computer that loses its supply at a time and comes back 50 ms later."""

    def __init__(self, make: Callable[[int], FccCore], at: float) -> None:
        self._make, self._at = make, round(at * 1e9)
        self._core = make(0)
        self._restarted = False

    @property
    def now_ns(self) -> int:
        return self._core.now_ns

    def take(self, frame: Frame) -> None:
        self._core.take(frame)

    def step(self) -> list[Frame]:
        if not self._restarted and self._core.now_ns >= self._at:
            self._restarted = True
            self._core = self._make(self._core.now_ns + 50_000_000)
        return self._core.step()


def short_test() -> StoredTest:
    """0.4 s of current: enough for the handshake, quick to simulate."""
    span = ((0.0, DURATION),)
    points = ((0.0, 0.0), (0.1, 2.0), (0.3, -2.0), (DURATION, 0.0))
    return StoredTest(
        name="short",
        id=NUMBER,
        mode="current",
        unit="mA",
        segment=(Line(points=points),),
        windows=SearchWindows(FDJ=span, Kintas=span, FSS=span, refinement=span),
    )


def run(case: Case, seed: int = 1, test: StoredTest | None = None, at: float = MIDDLE) -> Run:
    """Run a test (the short one) under a fault that strikes `at` s after the first frame."""
    test = test or short_test()

    def make(start_ns: int) -> FccCore:
        options: dict[str, object] = {"faults": Faults(0.3, 0.3, 0.3), "serial": 77}
        return FccCore(default_actuator(), [test], start_ns=start_ns, **(options | case.core))

    core = Restarting(make, at) if case.restart else make(0)
    frames: list[Frame] = []
    with FaultyTransport(
        EmulatorTransport(core), case.received(at), sent=case.sent(at), seed=seed
    ) as bus:
        outcome = tester.run_test(
            bus,
            test_id=test.id,
            duration=test.duration,
            transmit=True,
            limits=case.limits,
            on_frame=frames.append,
        )
        simulated = bus.now_ns() / 1e9
    recording = assemble(FrameTable.from_frames(frames), default_map(), case.name)
    return Run(outcome, recording[-1], simulated, frames)


def right_and_wrong(sound: Recording, faulty: Recording) -> tuple[float, float]:
    """Shares of samples that came and equal those of a sound bus, and that came and differ."""
    if faulty.samples is None or sound.samples is None:
        return 0.0, 0.0
    right = wrong = 0
    count = sound.samples.ticks
    for name in ("current", "spool", "pressure", "position"):
        expected, got = getattr(sound.samples, name), getattr(faulty.samples, name)
        padded = np.full(max(count, len(got)), np.nan)
        padded[: len(got)] = got
        came = ~np.isnan(padded)
        equal = padded[:count] == expected
        right += int(equal.sum())
        wrong += int(came.sum()) - int(equal.sum())
    return right / (4 * count), wrong / (4 * count)


def foreign_request(code: str = "start", number: int = 2) -> Frame:
    return Encoder().request(code, number)[0]


def foreign_status() -> Frame:
    return Encoder().status(2, 0, 3, 0.1, 78, 0)[0]


LOST = ("lost",)
CASES = (
    Case("sound bus"),
    Case("loss of 1 %", lambda _: [FrameLoss(0.01)], least=0.97, counts=LOST),
    Case("loss of 5 %", lambda _: [FrameLoss(0.05)], least=0.92, counts=LOST),
    Case("loss of 10 %", lambda _: [FrameLoss(0.1)], least=0.86, counts=LOST),
    Case("loss of 20 %", lambda _: [FrameLoss(0.2)], least=0.74, counts=LOST),
    Case("loss of telemetry alone, 10 %", lambda _: [FrameLoss(0.1, TELEMETRY)], least=0.86),
    Case(
        "loss in bursts of 20 frames",
        lambda _: [bf.loss_bursts(20, 300.0)],
        least=0.85,
        counts=LOST,
    ),
    Case(
        "loss in bursts of 200 frames",
        lambda _: [bf.loss_bursts(200, 400.0)],
        least=0.4,
        counts=LOST,
    ),
    Case("frames twice, 10 %", lambda _: [DuplicateFrames(0.1)], counts=("repeated",)),
    Case("all frames twice", lambda _: [DuplicateFrames(1.0)], counts=("repeated",)),
    Case("frames 4 places late, 5 %", lambda _: [bf.reordering(0.05, 4)], counts=("out_of_order",)),
    Case("frames 40 places late, 5 %", lambda _: [bf.reordering(0.05, 40)], least=0.9),
    Case("bit flips, 1 %", lambda _: [BitFlips(0.01)], least=0.97, counts=("crc_errors",)),
    Case("bit flips, 20 %", lambda _: [BitFlips(0.2)], least=0.74, counts=("crc_errors",)),
    Case(
        "bit flips with a valid CRC, 1 %",
        lambda _: [BitFlips(0.01, True)],
        least=0.9,
        wrong=0.05,
        unfit="the command differs from test",
    ),
    Case(
        "wrong length, 5 %",
        lambda _: [bf.wrong_length(0.05)],
        least=0.92,
        counts=("length_errors",),
    ),
    Case("foreign frames, 5 beside each of ours", lambda _: [bf.foreign_frames(5)]),
    Case("foreign frames at full load, 50 beside each of ours", lambda _: [bf.foreign_frames(50)]),
    Case(
        "foreign frames and loss of 5 %",
        lambda _: [FrameLoss(0.05), bf.foreign_frames(3)],
        least=0.92,
    ),
    Case(
        "noise under our identifiers, 5 beside each of ours",
        lambda _: [bf.noise_frames(5)],
        counts=("crc_errors",),
    ),
    Case("error frames, 10 %", lambda _: [bf.error_frames(0.1)]),
    Case(
        "telemetry counter stuck",
        lambda at: [bf.stuck_counter(TELEMETRY, at)],
        least=0.3,
        counts=LOST,
        unfit="samples are missing",
    ),
    Case(
        "telemetry counter stuck for 0.1 s",
        lambda at: [bf.stuck_counter(TELEMETRY, at, at + 0.1)],
        least=0.7,
        counts=LOST,
    ),
    Case(
        "counters of telemetry and command stuck",
        lambda at: [bf.stuck_counter(TELEMETRY, at), bf.stuck_counter(COMMAND, at)],
        least=0.3,
        unfit="samples are missing",
    ),
    Case("status counter stuck", lambda _: [bf.stuck_counter(STATUS, 0.0)]),
    Case("host clock set back by 2 s", lambda at: [bf.clock_step(at, -2.0)]),
    Case("host clock set forward by 2 s", lambda at: [bf.clock_step(at, 2.0)]),
    Case("host clock set back by 0.1 s", lambda at: [bf.clock_step(at, -0.1)]),
    Case("stamps late by up to 50 ms", lambda _: [bf.stamp_jitter(50e-3)]),
    Case("stamps late by up to 5 ms", lambda _: [bf.stamp_jitter(5e-3)]),
    Case("pause of 0.1 s, frames lost", lambda at: [bf.bus_pause(at, 0.1)], least=0.7, counts=LOST),
    Case("pause of 0.1 s, frames in a burst", lambda at: [bf.bus_pause(at, 0.1, True)]),
    Case("pause of 0.3 s", lambda _: [bf.bus_pause(0.2, 0.3)], why="telemetry lost for 0.25 s"),
    Case("pause of 1 s", lambda at: [bf.bus_pause(at, 1.0)], why="telemetry lost for 0.25 s"),
    Case(
        "pause of 0.3 s, frames in a burst",
        lambda _: [bf.bus_pause(0.2, 0.3, True)],
        why="telemetry lost for 0.25 s",
    ),
    Case("pause of 5 s", lambda at: [bf.bus_pause(at, 5.0)], why="telemetry lost for 0.25 s"),
    Case("telemetry never comes", lambda _: [bf.message_silence(TELEMETRY)], why="telemetry lost"),
    Case("telemetry without command", lambda _: [bf.message_silence(COMMAND)]),
    Case("no environment", lambda _: [bf.message_silence(ENVIRONMENT)]),
    Case("status never comes", lambda _: [bf.message_silence(STATUS)], why="no answer within 1 s"),
    Case(
        "status ends while running",
        lambda at: [bf.message_silence(STATUS, at)],
        why="not complete 1 s",
    ),
    Case("bus off", lambda at: [bf.bus_failure(at, "bus off")], why="bus lost: .*bus off"),
    Case(
        "adapter unplugged",
        lambda _: [bf.bus_failure(0.02, "unplugged")],
        why="bus lost: .*unplugged",
    ),
    Case("request lost", sent=lambda _: [FrameLoss(1.0)], why="no answer within 1 s"),
    Case(
        "first abort lost",
        sent=lambda _: [bf.bus_pause(0.1, 0.3)],
        limits=ChannelLimits(current=1.5e-3),
        why="current .*beyond its limit .*mA$",
    ),
    Case(
        "second tester before the request",
        lambda _: [bf.inserted_frames(0.02, [foreign_request()])],
        why="another tester is on the bus",
    ),
    Case(
        "second tester while the test runs",
        lambda at: [bf.inserted_frames(at, [foreign_request()])],
        why="another tester is on the bus",
    ),
    Case(
        "status of another test",
        lambda at: [bf.inserted_frames(at, [foreign_status()])],
        why="changed to test 3",
    ),
    Case("computer restarts", restart=True, why="fell back to idle"),
    Case(
        "refused: oil too cold",
        core={"effects": Effects(oil_temperature=-40.0)},
        why="oil too cold",
    ),
    Case(
        "refused: supply pressure low",
        core={"effects": Effects(supply_pressure=9e6)},
        why="supply pressure low",
    ),
    Case("no telemetry while idle", core={"idle_telemetry": False}),
    Case("limit exceeded", limits=ChannelLimits(pressure=1e3), why="pressure .*beyond its limit"),
)


def concluded(case: Case) -> str:
    """What comes of a case, in words."""
    if case.why:
        reason = case.why.replace(".*", " … ").rstrip("$").strip()
        return f"NOT TESTED: {reason}"
    return f"NOT TESTED: {case.unfit}" if case.unfit else "the same verdict"


CLOSED_LOSSES = """\
| lost | interpolated | accepted | from truth |
| --- | --- | --- | --- |
| 1 % | 0.0 % | 20 of 20 | 1.8 |
| 5 % | 0.2 … 0.4 % | 20 of 20 | 1.9 |
| 10 % | 0.8 … 1.3 % | 20 of 20 | 2.2 |
| 15 % | 1.8 … 2.8 % | 23 of 28 | 20.5 |
| 20 % | 3.4 … 4.4 % | 15 of 20 | 10.4 |
| a dropout of 50, 100 or 200 ms | 0.9 % | 61 of 68 | 3.1 |
| 40 dropouts of 5 ms | 2.8 … 2.9 % | 26 of 28 | 4.9 |
| 10 dropouts of 20 ms | 3.2 … 3.5 % | 16 of 16 | 11.9 |
"""
"""Measured by closed_losses.py."""


def by_outcome(lines: list[tuple[str, ...]]) -> str:
    """Rows of a table: an outcome with the names of its cases."""
    names: dict[tuple[str, ...], list[str]] = {}
    for name, *outcome in lines:
        names.setdefault(tuple(outcome), []).append(name)
    return "".join(f"| {' | '.join(['; '.join(cases), *key])} |\n" for key, cases in names.items())


def table() -> str:
    """The tables of the docs."""
    from fault_logs import LOG_CASES  # builds upon this module

    rows = by_outcome([(item.name, concluded(item)) for item in CASES])
    logs = by_outcome([(item.name, item.stated) for item in LOG_CASES])
    return f"""# What a damaged harness does to a test

Each fault is injected between emulated computer and tester, in a short test and in `open`. `python
tests/firmware_iface/live/fault_cases.py` prints the tables, and `test_live_faults.py` checks each
line. *The same verdict*: each estimate is within its 95 % interval, too.

| fault | what comes of it |
| --- | --- |
{rows}
## Closed loop

Up to 10 % of losses, late frames, a pause of 0.1 s and damaged frames with a valid CRC do the same
in closed loop. A lost jack position follows from the current of the next tick; where that is lost
too, it is interpolated:

{CLOSED_LOSSES}
*Interpolated*: share of ticks. *From truth*: largest distance of an accepted estimate, in stated
deviations. **Above 1.5 % there is a verdict only where [the response shows the
positions](../explanation/frames-to-ticks.md#what-cannot-be-observed)**, up to 13 %, and none for a
controller with an integral or derivative part.

## What a damaged log does to a diagnosis

| log | diagnosis |
| --- | --- |
{logs}"""


if __name__ == "__main__":
    print(table(), end="")
