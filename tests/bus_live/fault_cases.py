"""Faults of a harness and what becomes of a test under each; also prints the table of the docs.

python tests/bus_live/fault_cases.py > docs/reference/bus-faults.md
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ehadiag.actuator import default_actuator
from ehadiag.recording import Recording
from ehadiag.storedtest import Line, StoredTest, Windows
from ehadiag_sim import busfaults as bf
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.emulator import EmulatorTransport
from ehadiag_sim.faultybus import FaultyTransport
from ehadiag_sim.fcc import FccCore
from firmware_iface import tester
from firmware_iface.align import assemble
from firmware_iface.busmap import default_map
from firmware_iface.encode import Encoder
from firmware_iface.frames import Frame, FrameTable
from firmware_iface.handshake import Limits

TELEMETRY, COMMAND, ENVIRONMENT, STATUS = 0x110, 0x111, 0x120, 0x201
NUMBER, DURATION = 9, 0.4
MIDDLE = 0.3
"""s after the first frame: the test has run for some 0.14 s."""


@dataclass(frozen=True)
class Case:
    """One fault and its stated outcome.

    why: what NOT TESTED must say; empty: the test is complete.
    least: share of the samples that must be there, all of them equal to those of a sound bus.
    counts: counts of the quality that must not be zero.
    wrong: share of the samples that may differ: damage that no receiver can see.
    """

    name: str
    received: Callable[[], Sequence[bf.Fault]] = tuple
    sent: Callable[[], Sequence[bf.Fault]] = tuple
    core: dict[str, object] = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)
    restart: float | None = None
    why: str = ""
    least: float = 1.0
    counts: tuple[str, ...] = ()
    wrong: float = 0.0


@dataclass(frozen=True)
class Run:
    """What came of a case."""

    outcome: tester.TesterOutcome
    recording: Recording
    simulated_s: float


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
        windows=Windows(FDJ=span, Kintas=span, FSS=span, refinement=span),
    )


def run(case: Case, seed: int = 1) -> Run:
    """Run the short test under a fault."""

    def make(start_ns: int) -> FccCore:
        options: dict[str, object] = {"faults": Faults(0.3, 0.3, 0.3), "serial": 77}
        return FccCore(
            default_actuator(), [short_test()], start_ns=start_ns, **(options | case.core)
        )

    core = make(0) if case.restart is None else Restarting(make, case.restart)
    frames: list[Frame] = []
    with FaultyTransport(
        EmulatorTransport(core), case.received(), sent=case.sent(), seed=seed
    ) as bus:
        outcome = tester.run_test(
            bus,
            test_id=NUMBER,
            duration=DURATION,
            transmit=True,
            limits=case.limits,
            on_frame=frames.append,
        )
        simulated = bus.now_ns() / 1e9
    recording = assemble(FrameTable.from_frames(frames), default_map(), case.name)
    return Run(outcome, recording[-1], simulated)


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
    Case("loss of 1 %", lambda: [bf.Loss(0.01)], least=0.97, counts=LOST),
    Case("loss of 5 %", lambda: [bf.Loss(0.05)], least=0.92, counts=LOST),
    Case("loss of 10 %", lambda: [bf.Loss(0.1)], least=0.86, counts=LOST),
    Case("loss of 20 %", lambda: [bf.Loss(0.2)], least=0.74, counts=LOST),
    Case("loss of telemetry alone, 10 %", lambda: [bf.Loss(0.1, TELEMETRY)], least=0.86),
    Case("loss in bursts of 20 frames", lambda: [bf.Bursts(20, 300.0)], least=0.85, counts=LOST),
    Case("loss in bursts of 200 frames", lambda: [bf.Bursts(200, 400.0)], least=0.4, counts=LOST),
    Case("frames twice, 10 %", lambda: [bf.Duplicates(0.1)], counts=("repeated",)),
    Case("all frames twice", lambda: [bf.Duplicates(1.0)], counts=("repeated",)),
    Case("frames 4 places late, 5 %", lambda: [bf.Reordering(0.05, 4)], counts=("out_of_order",)),
    Case("frames 40 places late, 5 %", lambda: [bf.Reordering(0.05, 40)], least=0.9),
    Case("bit flips, 1 %", lambda: [bf.BitFlips(0.01)], least=0.97, counts=("crc_errors",)),
    Case("bit flips, 20 %", lambda: [bf.BitFlips(0.2)], least=0.74, counts=("crc_errors",)),
    Case(
        "bit flips with a valid CRC, 1 %", lambda: [bf.BitFlips(0.01, True)], least=0.9, wrong=0.05
    ),
    Case(
        "wrong length, 5 %", lambda: [bf.WrongLength(0.05)], least=0.92, counts=("length_errors",)
    ),
    Case("foreign frames, 5 beside each of ours", lambda: [bf.Foreign(5)]),
    Case("foreign frames and loss of 5 %", lambda: [bf.Loss(0.05), bf.Foreign(3)], least=0.92),
    Case(
        "noise under our identifiers, 5 beside each of ours",
        lambda: [bf.Noise(5)],
        counts=("crc_errors",),
    ),
    Case("error frames, 10 %", lambda: [bf.ErrorFrames(0.1)]),
    # The frame whose true counter is the one that it is stuck at comes once every 256 ticks.
    Case(
        "telemetry counter stuck",
        lambda: [bf.StuckCounter(TELEMETRY, MIDDLE)],
        least=0.3,
        counts=("lost", "repeated"),
        wrong=0.005,
    ),
    Case("status counter stuck", lambda: [bf.StuckCounter(STATUS, 0.0)]),
    Case("host clock set back by 2 s", lambda: [bf.ClockStep(MIDDLE, -2.0)]),
    Case("host clock set forward by 2 s", lambda: [bf.ClockStep(MIDDLE, 2.0)]),
    Case("host clock set back by 0.1 s", lambda: [bf.ClockStep(MIDDLE, -0.1)]),
    Case("stamps late by up to 5 ms", lambda: [bf.Jitter(5e-3)]),
    Case("pause of 0.1 s, frames lost", lambda: [bf.Pause(MIDDLE, 0.1)], least=0.7, counts=LOST),
    Case("pause of 0.1 s, frames in a burst", lambda: [bf.Pause(MIDDLE, 0.1, True)]),
    Case("pause of 0.3 s", lambda: [bf.Pause(0.2, 0.3)], why="telemetry lost for 0.25 s"),
    Case("pause of 5 s", lambda: [bf.Pause(MIDDLE, 5.0)], why="telemetry lost for 0.25 s"),
    Case("telemetry never comes", lambda: [bf.Silence(TELEMETRY)], why="telemetry lost"),
    Case("telemetry without command", lambda: [bf.Silence(COMMAND)]),
    Case("no environment", lambda: [bf.Silence(ENVIRONMENT)]),
    Case("status never comes", lambda: [bf.Silence(STATUS)], why="no answer within 1 s"),
    Case("status ends while running", lambda: [bf.Silence(STATUS, MIDDLE)], why="not complete 1 s"),
    Case("bus off", lambda: [bf.Failure(MIDDLE, "bus off")], why="bus lost: .*bus off"),
    Case("adapter unplugged", lambda: [bf.Failure(0.02, "unplugged")], why="bus lost: .*unplugged"),
    Case("request lost", sent=lambda: [bf.Loss(1.0)], why="no answer within 1 s"),
    Case(
        "first abort lost",
        sent=lambda: [bf.Pause(0.1, 0.3)],
        limits=Limits(current=1.5e-3),
        why="current beyond its limit$",
    ),
    Case(
        "second tester before the request",
        lambda: [bf.Inserted(0.02, [foreign_request()])],
        why="another tester is on the bus",
    ),
    Case(
        "second tester while the test runs",
        lambda: [bf.Inserted(MIDDLE, [foreign_request()])],
        why="another tester is on the bus",
    ),
    Case(
        "status of another test",
        lambda: [bf.Inserted(MIDDLE, [foreign_status()])],
        why="changed to test 3",
    ),
    Case("computer restarts", restart=MIDDLE, why="fell back to idle"),
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
    Case("limit exceeded", limits=Limits(pressure=1e3), why="pressure beyond its limit"),
)


def stated(case: Case) -> str:
    """The outcome of a case in words."""
    if case.why:
        reason = case.why.replace(".*", " … ").rstrip("$").strip()
        return f"NOT TESTED: {reason}"
    parts = [
        f"complete; {'all' if case.least == 1.0 else f'at least {case.least:.0%} of the'} samples"
    ]
    if case.counts:
        parts.append("counted as " + ", ".join(item.replace("_", " ") for item in case.counts))
    if case.wrong:
        parts.append(f"up to {case.wrong:.1%} of the samples wrong, unseen")
    return "; ".join(parts)


def table() -> str:
    """The table of the docs."""
    rows = "".join(f"| {case.name} | {stated(case)} |\n" for case in CASES)
    return f"""# What a damaged harness does to a test

Each fault is injected between an emulated computer and the tester while a short test runs
(`tests/bus_live/fault_cases.py`, from which this table is printed; `test_live_faults.py` checks
each line). \u201cSamples\u201d are those of the sound bus to the last bit: none is ever made up.
Whether what came is enough for a verdict is decided later, by the limits of the data quality.

| fault | stated outcome |
| --- | --- |
{rows}"""


if __name__ == "__main__":
    print(table(), end="")
