"""Benchmark of the live verdict: two processes on a serial line, from the last frame on."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from ehadiag_tools.bench.figures import Figure, Sizes

__all__ = ["measure"]

SECTION = "live"
COMMAND = (
    sys.executable,
    "-c",
    "import sys; from ehadiag.cli.main import main; sys.exit(main(sys.argv[1:]))",
)
START_S = 3.0
"""Until the emulated computer sends."""
WORN = ("--Kintas", "0.3", "--FSS", "0.6", "--FDJ", "0.3")
CASES = (("open", WORN, ""), ("closed", WORN, ""), ("closed", (), ", healthy actuator"))
"""Stored test, severities of the emulated unit, and what a figure's name says of it."""
MOST_S = 60.0


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    if not hasattr(os, "openpty"):
        return [Figure(SECTION, "end of a live test to verdict", None, "ms", "needs a pty")]
    import tty  # noqa: PLC0415 - not on every system

    left, right = os.openpty(), os.openpty()
    for end in (*left, *right):
        tty.setraw(end)
    for source, sink in ((left[0], right[0]), (right[0], left[0])):
        threading.Thread(target=_pump, args=(source, sink), daemon=True).start()
    out = []
    for test, severities, words in CASES:
        delays = []
        with (
            tempfile.TemporaryDirectory() as folder,
            _computer(os.ttyname(left[1]), severities),
        ):
            for _ in range(max(1, sizes.repeats // 5)):
                found = _bit(test, os.ttyname(right[1]), folder)
                if found is not None:
                    delays.append(found)
        value = statistics.median(delays) * 1e3 if delays else None
        remark = f"median of {len(delays)} tests; wall time of two processes on a serial line"
        name = f"last frame of a live test ({test}{words}) to verdict"
        out.append(Figure(SECTION, name, value, "ms", remark))
    return out


def _bit(test: str, port: str, folder: str) -> float | None:
    """Seconds from the word that a test is complete to its verdict; None if it was not tested."""
    done = subprocess.run(
        [*COMMAND, "bit", "--test", test, "--serial", port, "--json", "--out", folder],
        capture_output=True,
        text=True,
        check=False,
        timeout=MOST_S,
    )
    try:
        line = json.loads(done.stdout)
    except ValueError:
        return None
    if line["verdict"] == "NOT_TESTED":
        return None
    return float(line["timing_s"]["after_test"])


@contextmanager
def _computer(port: str, severities: tuple[str, ...]) -> Iterator[None]:
    """Run the emulated flight-control computer beside."""
    arguments = ["sim", "--serial", port, *severities]
    process = subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        time.sleep(START_S)
        yield
    finally:
        process.terminate()
        process.wait(timeout=MOST_S)


def _pump(source: int, sink: int) -> None:
    """Carry bytes from one end to the other until it closes."""
    while True:
        try:
            os.write(sink, os.read(source, 65536))
        except OSError:
            return
