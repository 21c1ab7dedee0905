"""Tries to falsify a worn actuator's verdict by frames from a second sender: `tools/attack`.

Run it inside `tools/loopnet.sh`: all that it sends stays on the loopback interface.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from multiprocessing.synchronize import Event

import numpy as np

from ehadiag.core.actuator import default_actuator
from ehadiag.core.stored_test import bundled_tests
from ehadiag_sim.fcc.computer import FccCore
from ehadiag_sim.fcc.emulator import EmulatorTransport
from firmware_iface.codec.encode import Encoder
from firmware_iface.session.tester import run_test
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.python_can import BusOptions, PythonCanTransport

__all__ = ["KINDS", "main"]

BUS = BusOptions("udp_multicast")
TELEMETRY, COMMAND, STATUS, FOREIGN = 0x110, 0x111, 0x201, 0x321
COUNTER, TEST_ID = 6, 5
"""Bytes of telemetry and command."""
TEST = "open"
TRUTH = ("FAULT", "NOT_TESTED")
"""Verdicts on the worn actuator that are not wrong."""
PATIENCE = 5
"""Tries until the computer is there."""
FLOOD = 8
"""Foreign frames sent for each frame heard."""

Codes = tuple[int, int, int, int]


@dataclass(frozen=True)
class Healthy:
    """A test of a healthy actuator: converter codes of each tick, and all its frames."""

    codes: tuple[Codes, ...]
    frames: tuple[Frame, ...]


Answer = Callable[[Frame, int, Healthy, np.random.Generator], Sequence[Frame]]
"""What an attacker sends on hearing a telemetry frame of tick k of the test (-1: none runs)."""

ENCODER = Encoder()


def _telemetry(healthy: Healthy, tick: int, counter: int) -> tuple[Frame, ...]:
    codes = healthy.codes[min(max(tick, 0), len(healthy.codes) - 1)]
    return ENCODER.telemetry(codes, 0, counter % 256)


def equal_behind(
    heard: Frame, tick: int, healthy: Healthy, _: np.random.Generator
) -> Sequence[Frame]:
    """Send the same counter right after the computer."""
    return _telemetry(healthy, tick, heard.data[COUNTER])


def equal_ahead(
    heard: Frame, tick: int, healthy: Healthy, _: np.random.Generator
) -> Sequence[Frame]:
    """Send the next counter right before the computer."""
    return _telemetry(healthy, tick + 1, heard.data[COUNTER] + 1)


def equal_late(
    heard: Frame, tick: int, healthy: Healthy, _: np.random.Generator
) -> Sequence[Frame]:
    """Send the same counter more than half a tick later."""
    time.sleep(0.6e-3)
    return _telemetry(healthy, tick, heard.data[COUNTER])


def shifted(heard: Frame, tick: int, healthy: Healthy, _: np.random.Generator) -> Sequence[Frame]:
    """Send with a counter a hundred on."""
    return _telemetry(healthy, tick, heard.data[COUNTER] + 100)


def shifted_a_little(
    heard: Frame, tick: int, healthy: Healthy, _: np.random.Generator
) -> Sequence[Frame]:
    """Send with a counter five on, within what late frames make."""
    return _telemetry(healthy, tick + 5, heard.data[COUNTER] + 5)


def random_counters(
    _heard: Frame, tick: int, healthy: Healthy, rng: np.random.Generator
) -> Sequence[Frame]:
    """Send with a counter by chance."""
    return _telemetry(healthy, tick, int(rng.integers(256)))


def now_and_then(
    heard: Frame, tick: int, healthy: Healthy, rng: np.random.Generator
) -> Sequence[Frame]:
    """Send the same counter for one frame in a hundred, less than is refused."""
    return _telemetry(healthy, tick, heard.data[COUNTER]) if rng.random() < 0.01 else ()


def flood(_heard: Frame, _tick: int, _: Healthy, rng: np.random.Generator) -> Sequence[Frame]:
    """Fill the bus: foreign frames, and noise under the telemetry's own identifier."""
    noise = Frame(0, TELEMETRY, rng.bytes(8))
    return [*(Frame(0, FOREIGN, rng.bytes(8)) for _ in range(FLOOD)), noise]


KINDS: dict[str, Answer] = {
    "the same counters, behind": equal_behind,
    "the same counters, ahead": equal_ahead,
    "the same counters, 0.6 ms behind": equal_late,
    "counters shifted by 100": shifted,
    "counters shifted by 5": shifted_a_little,
    "random counters": random_counters,
    "one frame in a hundred": now_and_then,
    "flood at full load": flood,
}
REPLAY, TWO_COMPUTERS, NONE = "replay of a healthy test", "two computers", "nobody"


def healthy_test() -> Healthy:
    """Play the test on a healthy actuator, in simulated time."""
    test = bundled_tests()[TEST]
    frames: list[Frame] = []
    with EmulatorTransport(FccCore(default_actuator(), [test], serial=2)) as bus:
        run_test(
            bus, test_id=test.id, duration=test.duration, transmit=True, on_frame=frames.append
        )
    begun = next(k for k, f in enumerate(frames) if f.can_id == COMMAND and f.data[TEST_ID])
    codes: list[Codes] = []
    for frame in frames[begun:]:
        if frame.can_id == TELEMETRY:
            word = int.from_bytes(frame.data[:6], "little")
            current, spool, pressure, position = (word >> 12 * k & 0xFFF for k in range(4))
            codes.append((current, spool, pressure, position))
    kept = tuple(item for item in frames[begun:] if item.can_id in (TELEMETRY, COMMAND, STATUS))
    return Healthy(tuple(codes), kept)


def answer_frames(kind: str, seed: int, healthy: Healthy, stop: Event, ready: Event) -> None:
    """Attack until told to stop; a process of its own."""
    rng = np.random.default_rng(seed)
    tick = -1
    with PythonCanTransport(BUS, transmit=True) as bus:
        ready.set()
        while not stop.is_set():
            heard = bus.receive(0.05)
            if heard is None or heard.error:
                continue
            if heard.can_id == COMMAND:
                tick = tick + 1 if heard.data[TEST_ID] else -1
            elif heard.can_id == TELEMETRY and kind in KINDS:
                for frame in KINDS[kind](heard, tick, healthy, rng):
                    bus.send(frame)
            if kind == REPLAY and tick == 0:
                _replay(bus, healthy, stop)


def _replay(bus: PythonCanTransport, healthy: Healthy, stop: Event) -> None:
    begin, first = time.monotonic(), healthy.frames[0].time_ns
    for frame in healthy.frames:
        wait = begin + (frame.time_ns - first) / 1e9 - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        if stop.is_set():
            return
        bus.send(replace(frame, sent=False))


@contextmanager
def computer(serial: int, *faults: str) -> Iterator[None]:
    """Run an emulated flight-control computer in a process of its own."""
    command = [sys.executable, "-m", "ehadiag", "sim", "--interface", BUS.interface]
    process = subprocess.Popen(
        [*command, "--serial-number", str(serial), *faults], stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.terminate()
        process.wait(20)


@contextmanager
def attacker(kind: str, seed: int, healthy: Healthy) -> Iterator[None]:
    """Run one attacker in a process of its own."""
    context = multiprocessing.get_context("spawn")
    stop, ready = context.Event(), context.Event()
    process = context.Process(
        target=answer_frames, args=(kind, seed, healthy, stop, ready), daemon=True
    )
    process.start()
    try:
        if not ready.wait(60):
            raise SystemExit("the attacker did not start")
        yield
    finally:
        stop.set()
        process.join(20)


def attempt(kind: str, seed: int, healthy: Healthy) -> tuple[str, str]:
    """Request a test while somebody attacks; return verdict and reasons as the command says."""
    with ExitStack() as stack:
        if kind == TWO_COMPUTERS:
            stack.enter_context(computer(2))
            time.sleep(4.0)  # until it sends
        elif kind != NONE:
            stack.enter_context(attacker(kind, seed, healthy))
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        command = [sys.executable, "-m", "ehadiag", "bit", "--test", TEST, "--json"]
        done = subprocess.run(
            [*command, "--interface", BUS.interface, "--out", folder],
            capture_output=True,
            text=True,
            check=False,
        )
    if not done.stdout.strip():
        return f"exit {done.returncode}", done.stderr.strip().splitlines()[-1]
    result = json.loads(done.stdout)
    return result["verdict"], "; ".join(result["reasons"])


def _undisturbed(healthy: Healthy) -> tuple[str, str]:
    """What the command says without an attacker, once the computer has compiled its kernels."""
    for _ in range(PATIENCE):
        verdict, reasons = attempt(NONE, 0, healthy)
        if verdict == TRUTH[0]:
            break
    return verdict, reasons


def main() -> int:
    """Run the attempts and print what came of them; 1 if a verdict was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--attempts", type=int, default=40, metavar="N", help="(default 40)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="(default 1)")
    arguments = parser.parse_args()
    healthy = healthy_test()
    kinds = [*KINDS, REPLAY, TWO_COMPUTERS]
    verdicts: Counter[str] = Counter()
    with computer(1, "--FSS", "0.9"):
        verdict, reasons = _undisturbed(healthy)
        print(f"worn actuator, nobody beside it: {verdict}  {reasons}", flush=True)
        for number in range(arguments.attempts):
            kind = kinds[number % len(kinds)]
            verdict, reasons = attempt(kind, arguments.seed + number, healthy)
            verdicts[verdict] += 1
            print(f"{number + 1:3d}  {kind}: {verdict}  {reasons[:200]}", flush=True)
    wrong = sum(count for verdict, count in verdicts.items() if verdict not in TRUTH)
    counted = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
    print(f"{arguments.attempts} attempts: {counted}; wrong verdicts: {wrong}")
    return 1 if wrong else 0
