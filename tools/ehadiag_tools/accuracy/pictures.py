"""Pictures of an identification: parity, residuals over time, objective along each severity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.refine.derivatives import CAP
from ehadiag.identify.search.objective import SEARCH_CAP, Objective
from ehadiag.identify.search.stages import LEAD_S
from ehadiag.identify.spans import ANCHOR_LSB, lay_out, unknowns_of
from ehadiag.model.batch import Batch
from ehadiag.model.parameters import FAULT_NAMES, FAULTS
from ehadiag.model.scalar.response import respond
from ehadiag.model.simd.model import SimdModel
from ehadiag_tools.accuracy.figures import percent_errors
from ehadiag_tools.accuracy.runs import Run, experiments_of
from ehadiag_tools.damaged import damaged

__all__ = ["draw_all"]

Record = Mapping[str, Any]
WIDE = np.linspace(0.0, 1.0, 201)
CLOSE = 2e-3
"""Half-width of the slices close to the optimum."""
SHAPES = {"open": "o", "closed": "s"}
HUES = {"open": "#0b6fa4", "closed": "#c45a10"}


def draw_all(
    runs: Sequence[Run], records: Sequence[Record], folder: Path, prefix: str
) -> list[Path]:
    """Write the pictures as PNG; returns their paths. Residuals and slices: one run a test."""
    mpl.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [_save(_parity(records), folder / f"{prefix}-parity.png")]
    for test in SHAPES:
        # The last of the paper's cases has all three faults.
        chosen = [i for i, run in enumerate(runs) if run.test == test and set(run.faults) == {0.6}]
        chosen = chosen or [i for i, run in enumerate(runs) if run.test == test]
        if chosen:
            run, record = runs[chosen[0]], records[chosen[0]]
            (experiment,) = experiments_of(run)
            value = np.array(record["value"])
            paths.append(
                _save(_residuals(run, experiment, value), folder / f"{prefix}-gaps-{test}.png")
            )
            drawn = _slices(run, experiment, value)
            paths.append(_save(drawn, folder / f"{prefix}-slices-{test}.png"))
    return paths


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=110)
    return path


def _parity(records: Sequence[Record]) -> Figure:
    """Estimate over truth, and error over truth with 95 % intervals."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, len(FAULTS), sharex="col", height_ratios=(1.6, 1.0))
    for j, name in enumerate(FAULT_NAMES):
        upper, lower = axes[0, j], axes[1, j]
        upper.plot([0, 1], [0, 1], color="0.7", lw=1, label="estimate = truth")
        lower.axhline(0.0, color="0.7", lw=1)
        for shift, test in zip((-0.008, 0.008), SHAPES, strict=True):
            mine = [record for record in records if record["test"] == test]
            if not mine:
                continue
            truth = np.array([record["faults"][j] for record in mine])
            style: dict[str, Any] = {"color": HUES[test], "ls": "", "alpha": 0.75}
            first = [record["first"][j] for record in mine]
            upper.plot(
                truth, first, marker="x", ms=7, label=f"{test}: first approximation", **style
            )
            value = [record["value"][j] for record in mine]
            upper.plot(truth, value, marker=SHAPES[test], ms=5, mfc="none", label=test, **style)
            error = percent_errors(mine)[:, j]
            low, high = 100.0 * np.array([record["interval95"][j] for record in mine]).T
            bars = np.abs(np.vstack([low, high]) - 100.0 * np.array(value))
            spread = shift + 0.012 * np.linspace(-0.5, 0.5, len(truth))
            lower.errorbar(
                truth + spread, error, bars, fmt=SHAPES[test], ms=3, lw=0.8, color=HUES[test],
                label=f"{test}, 95 % interval",
            )  # fmt: skip
        upper.set(title=name, xlim=(-0.04, 1.04), ylim=(-0.04, 1.04))
        lower.set(xlabel=f"true {name} (1 = limit of damage)")
        upper.grid(alpha=0.25)
        lower.grid(alpha=0.25)
    axes[0, 0].set(ylabel="estimate (1 = limit of damage)")
    axes[1, 0].set(ylabel="error, % of full damage")
    axes[0, 0].legend(fontsize=8)
    axes[1, 0].legend(fontsize=8)
    return figure


def _residuals(run: Run, experiment: Experiment, value: NDArray[np.float64]) -> Figure:
    """Measured signals and what the model leaves of them, in units of noise."""
    current = experiment.trace.current
    answer = respond(damaged(experiment.constants, value), current, experiment.tick)
    time = np.arange(1, experiment.ticks + 1) * experiment.tick
    rows = (
        ("spool, mm", experiment.spool * 1e3, answer.spool * 1e3, experiment.spool_noise * 1e3),
        (
            "pressure, MPa",
            experiment.pressure * 1e-6,
            answer.pressure * 1e-6,
            experiment.pressure_noise * 1e-6,
        ),
    )
    figure = Figure(figsize=(11, 8), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.4, 1.0, 1.4, 1.0))
    for index, (label, measured, modelled, noise) in enumerate(rows):
        upper, lower = axes[2 * index], axes[2 * index + 1]
        upper.plot(time, measured, lw=2.0, color="0.65", label="measured")
        upper.plot(time, modelled, lw=0.7, color="#a4140b", label="model at the estimate")
        upper.set(ylabel=label)
        upper.legend(fontsize=8, loc="upper left", ncols=2)
        residual = (measured - modelled) / noise
        lower.plot(time, residual, ".", ms=1.5, color=HUES[run.test])
        reach = max(5.0, float(np.nanmax(np.abs(residual))) * 1.1)
        lower.set(ylabel="residual / noise", ylim=(-reach, reach))
        for level in (-3.0, 3.0):
            lower.axhline(level, color="0.5", lw=0.7, ls="--")
    for axis in axes:
        axis.grid(alpha=0.25)
    axes[-1].set(xlabel="time, s", xlim=(0.0, time[-1]))
    truth = ", ".join(f"{v:g}" for v in run.faults)
    axes[0].set(title=f"{run.test} loop, true Kintas, FSS, FDJ = {truth}; dashed: 3 deviations")
    return figure


def _slices(run: Run, experiment: Experiment, value: NDArray[np.float64]) -> Figure:
    """Objective of search and refinement along each severity through the estimate."""
    windows = [experiment.test.windows.refinement]

    def objective_of(batch: Batch, cap: float) -> Objective:
        return Objective(SimdModel(batch, unknowns_of([experiment], FAULTS)), cap)

    objectives = {
        "search (second part, runs free)": (
            objective_of(lay_out([experiment], windows, lead=LEAD_S), SEARCH_CAP), "#0b6fa4", "-",
        ),
        "refinement (all of the test, re-anchored)": (
            objective_of(lay_out([experiment], anchor_lsb=ANCHOR_LSB), CAP), "#c45a10", "--",
        ),
    }  # fmt: skip
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, len(FAULTS))
    for j, name in enumerate(FAULT_NAMES):
        near = np.linspace(max(0.0, value[j] - CLOSE), min(1.0, value[j] + CLOSE), 81)
        for axis, grid, scale in ((axes[0, j], WIDE, 1.0), (axes[1, j], near, 100.0)):
            rows = np.tile(value, (len(grid), 1))
            rows[:, j] = grid
            for label, (objective, hue, line) in objectives.items():
                samples = np.count_nonzero(objective.model.batch.weight)
                cost = objective(rows)
                shown = cost / samples if scale == 1.0 else cost - cost.min()
                axis.plot(scale * grid, shown, color=hue, ls=line, lw=1.3, label=label)
            axis.axvline(scale * run.faults[j], color="0.3", lw=0.9, ls=":", label="truth")
            axis.plot(
                [scale * value[j]], [axis.get_ylim()[0]], "^", color="k", ms=6, clip_on=False,
                label="estimate",
            )  # fmt: skip
            axis.grid(alpha=0.25)
        axes[0, j].set(title=name, xlabel=f"{name} (1 = limit of damage)", yscale="log")
        axes[1, j].set(xlabel=f"{name}, % of full damage")
    axes[0, 0].set(ylabel="capped squared residual, a sample")
    axes[1, 0].set(ylabel="objective above its lowest value")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    return figure
