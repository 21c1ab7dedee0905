"""Sizes, figures and clocks that the benchmark's sections share."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Figure", "Sizes", "cpu_median", "each"]

SUBSTEPS = 10
"""Sub-steps of 100 µs in a tick: times are also given for one of these."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """How much is measured."""

    logs: Path
    repeats: int = 15
    ticks: int = 300
    seeds: int = 5
    budget: int = 6000
    pushes: int = 200_000
    seconds: float = 20.0
    frames: int = 1_000_000


@dataclass(frozen=True, slots=True)
class Figure:
    """One row of the table."""

    section: str
    name: str
    value: float | None
    """None: not measured; the remark says why."""
    unit: str
    remark: str = ""


def cpu_median(work: Callable[[], object], repeats: int) -> float:
    """Median CPU time (s) of this thread for a call, after one that does not count."""
    work()
    spent = []
    for _ in range(repeats):
        begin = time.thread_time()
        work()
        spent.append(time.thread_time() - begin)
    return statistics.median(spent)


def each(seconds: float, ticks: int) -> str:
    """Say what a time of so many ticks is for one."""
    tick = seconds * 1e9 / ticks
    return f"{tick:.3g} ns a tick, {tick / SUBSTEPS:.3g} ns for 100 µs"
