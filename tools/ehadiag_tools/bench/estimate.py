"""Benchmark of one estimate: from samples to interval, wall and CPU time by stage."""

from __future__ import annotations

import statistics
import time

from ehadiag.identify.session import identify
from ehadiag_tools.bench.figures import Figure, Sizes
from ehadiag_tools.bench.problem import HEALTHY, LOG, TRUTH, experiment, healthy_experiment
from ehadiag_tools.bench.rivals import rivals

__all__ = ["measure"]

SECTION = "estimate"


def measure(sizes: Sizes) -> list[Figure]:
    """Run the section."""
    result = identify([experiment(sizes.logs)])
    error = max(abs(e.value - true) for e, true in zip(result.estimates, TRUTH, strict=True))
    walls, cpus, prepares, stages = [], [], [], []
    for _ in range(max(1, sizes.repeats // 3)):
        wall, cpu = time.perf_counter(), time.process_time()
        item = experiment(sizes.logs)
        prepares.append(time.perf_counter() - wall)
        timing = identify([item]).timing
        walls.append(time.perf_counter() - wall)
        # The search has a thread of its own.
        cpus.append(time.process_time() - cpu)
        stages.append((timing.first, timing.search, timing.refine))
    evaluations = f"{result.evaluations} runs of the model, {result.attempts} attempt(s)"
    out = [
        _ms("samples to estimate and interval, wall", walls, evaluations),
        _ms("samples to estimate and interval, CPU", cpus, f"of {LOG}; the file is read before"),
        _ms("  prepare, wall", prepares, "current rebuilt, noise judged"),
    ]
    names = "first approximation", "genetic search", "refinement and interval"
    for index, name in enumerate(names):
        out.append(_ms(f"  {name}, wall", [stage[index] for stage in stages]))
    whole = statistics.median(cpus)
    healthy, item = [], healthy_experiment(sizes.logs)
    for _ in range(max(1, sizes.repeats // 3)):
        cpu = time.process_time()
        identify([item])
        healthy.append(time.process_time() - cpu)
    out.append(_ms("a healthy actuator in closed loop, CPU", healthy, f"of {HEALTHY}"))
    return [
        *out,
        Figure(SECTION, "largest error of the three constants", 100.0 * error, "%"),
        *rivals(sizes, result, whole),
    ]


def _ms(name: str, seconds: list[float], remark: str = "") -> Figure:
    return Figure(SECTION, name, statistics.median(seconds) * 1e3, "ms", remark)
