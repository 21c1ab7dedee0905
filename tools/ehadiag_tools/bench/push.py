"""Benchmark of the monitor's push: latency alone and beside a diagnosis."""

from __future__ import annotations

import itertools
import threading
import time

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import default_actuator
from ehadiag.identify.session import identify
from ehadiag.monitor import Monitor, Tick
from ehadiag_tools.bench.figures import Figure, Sizes
from ehadiag_tools.bench.problem import TRUTH, experiment, recording, samples

__all__ = ["measure"]

SECTION = "push"
PERIOD_S = 1e-3
SHARES = (50.0, 99.0, 99.9)


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    s = samples(sizes.logs)
    rows = zip(s.command, s.current, s.spool, s.pressure, s.position, strict=True)
    ticks = [Tick(*map(float, row)) for row in rows]
    monitor = Monitor(default_actuator(), TRUTH, recording(sizes.logs).environment)
    out = _rows("push, back to back", _back_to_back(monitor, ticks, sizes.pushes), "µs")
    if sizes.seconds > 0.0:
        paced = _Paced(monitor, ticks, sizes.seconds)
        paced.run_beside_a_diagnosis(sizes)
        remark = f"{len(paced.latency)} pushes at 1 kHz, {paced.diagnoses} diagnoses beside"
        out += _rows("push, a diagnosis beside it", paced.latency, "µs", remark)
        late = np.percentile(paced.late, 99.9) / 1e3
        remark = "the machine's scheduler and the interpreter lock, not the monitor"
        out.append(Figure(SECTION, "thread woken too late, p99.9", float(late), "µs", remark))
        out.append(Figure(SECTION, "alarms meanwhile", float(paced.alarms), ""))
    return out


def _rows(name: str, latency: NDArray[np.int64], unit: str, remark: str = "") -> list[Figure]:
    out = [
        Figure(SECTION, f"{name}, p{share:g}", float(np.percentile(latency, share)) / 1e3, unit)
        for share in SHARES
    ]
    largest = Figure(SECTION, f"{name}, largest", float(latency.max()) / 1e3, unit, remark)
    return [*out, largest]


def _back_to_back(monitor: Monitor, ticks: list[Tick], pushes: int) -> NDArray[np.int64]:
    """Latencies, ns; the recording over and over, from rest each time."""
    latency = np.empty(pushes, dtype=np.int64)
    clock = time.perf_counter_ns
    for k, tick in zip(range(pushes), itertools.cycle(ticks), strict=False):
        if k % len(ticks) == 0:
            monitor.reset()
        begin = clock()
        monitor.push(tick)
        latency[k] = clock() - begin
    return latency


class _Paced:
    """Pushes in a thread in time with a bus of 1 kHz."""

    def __init__(self, monitor: Monitor, ticks: list[Tick], seconds: float) -> None:
        self._monitor, self._ticks = monitor, ticks
        count = max(1, round(seconds / PERIOD_S))
        self.latency = np.empty(count, dtype=np.int64)
        self.late = np.empty(count, dtype=np.int64)
        self.alarms = self.diagnoses = 0

    def run_beside_a_diagnosis(self, sizes: Sizes) -> None:
        """Diagnose again and again while the other thread receives."""
        item = experiment(sizes.logs)
        receiver = threading.Thread(target=self._receive, name="receive")
        receiver.start()
        while receiver.is_alive():
            identify([item])
            self.diagnoses += 1
        receiver.join()

    def _receive(self) -> None:
        clock, monitor = time.perf_counter_ns, self._monitor
        due = clock()
        for k in range(len(self.latency)):
            if k % len(self._ticks) == 0:
                monitor.reset()
            due += round(PERIOD_S * 1e9)
            while (wait := due - clock()) > 0:
                time.sleep(wait * 1e-9)
            begin = clock()
            reading = monitor.push(self._ticks[k % len(self._ticks)])
            self.latency[k] = clock() - begin
            self.late[k] = begin - due
            self.alarms += int(reading.alarmed.sum())
