"""Pictures of the documentation: what faults do, why they are found, intervals, the live view."""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from rich.console import Console

import ehadiag
from ehadiag.compile.jit import Array
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.least_squares import start_density
from ehadiag.identify.linearisation import (
    Derivatives,
    LinearModel,
    ParameterDensity,
    linearised_on_cross,
)
from ehadiag.identify.partial_refinement import anchored_derivatives
from ehadiag.identify.posterior import FEW_UNKNOWNS_SCHEDULE, cauchy_cost, search_posterior
from ehadiag.live import Snapshot
from ehadiag.model.registry import FAULT_NAMES, FAULTS, Unknowns
from ehadiag.report.response_signals import sensed_response
from ehadiag.terminal.live_view import draw_snapshot
from ehadiag_sim.conditions import Faults
from ehadiag_tools.study import Options, Record, Study, case_of

COLOURS = ("#0072b2", "#d55e00", "#009e73")
"""Okabe and Ito's, which colour-blind people tell apart; the dashes differ too."""
DASHES = ("-", "--", "-.")
WORN_UNIT = Faults(Kintas=0.4, FSS=0.3, FDJ=0.5)
ROUNDS_STD = 4e-3
"""Deviation of each severity about the start of the drawn refinement, 1."""
ROUND_COLOURS = ("#e69f00", "#0072b2", "#009e73", "#cc79a7", "#d55e00")
COST_LEVELS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Of the contours: root of the cost's rise above the optimum, 1."""
SIGNAL_OF = {"Kintas": 0, "FSS": 0, "FDJ": 1}
"""Signal that the search for each fault compares: 0, spool; 1, pressure (method.md)."""


@dataclass(frozen=True, slots=True)
class PictureCase:
    """One picture by its name, and the folder for it."""

    picture: str
    folder: Path


def draw_method(case: PictureCase) -> Record:
    """Draw a picture of the method."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    METHOD_PICTURES[case.picture](figure)
    case.folder.mkdir(parents=True, exist_ok=True)
    path = case.folder / f"method-{case.picture}.png"
    figure.savefig(path, dpi=100)
    return {"path": path}


TIME, CURRENT, SPOOL, JACK = "time, s", "current, mA", "spool position, mm", "jack position, mm"
PRESSURE = "differential pressure, MPa"
RAMPS, STEP = slice(0, 2300), slice(2395, 2440)
EFFECTS = {
    "FSS": (
        (TIME, SPOOL, "slow ramps of current", RAMPS, ""),
        (CURRENT, SPOOL, "the same over the current", RAMPS, ""),
    ),
    "Kintas": (
        (TIME, SPOOL, "step of current at 2.4 s", STEP, "."),
        (TIME, JACK, "what the jack makes of it", slice(2350, 3000), ""),
    ),
    "FDJ": (
        (TIME, PRESSURE, "slow ramps of current", RAMPS, ""),
        (TIME, JACK, "the jack meanwhile", RAMPS, ""),
    ),
}
"""What a fault alone does: a quantity over another in ticks of the open-loop test."""


def _effects(figure: Figure, name: str) -> None:
    axes = figure.subplots(1, 2)
    for value, colour, dash in zip((0.0, 0.5, 1.0), COLOURS, DASHES, strict=True):
        s = ehadiag.simulate("open", faults=Faults(**{name: value}), noise_lsb=0.0).samples
        assert s is not None
        seen = {
            TIME: np.arange(s.ticks) * 1e-3, CURRENT: 1e3 * s.current, SPOOL: 1e3 * s.spool,
            PRESSURE: 1e-6 * s.pressure, JACK: 1e3 * s.position,
        }  # fmt: skip
        for axis, (x, y, title, ticks, marker) in zip(axes, EFFECTS[name], strict=True):
            style = {"color": colour, "ls": dash, "lw": 1.3, "marker": marker}
            axis.plot(seen[x][ticks], seen[y][ticks], label=f"{value:g}", **style)
            axis.set(xlabel=x, ylabel=y, title=title)
    axes[0].legend(title=name)


def _searches(figure: Figure) -> None:
    experiment = worn_experiment()
    axes, candidates = figure.subplots(1, len(FAULTS), sharey=True), np.linspace(0.0, 1.0, 81)
    for index, (axis, fault) in enumerate(zip(axes, FAULTS, strict=True)):
        name = fault.name
        gaps = [
            gap_of(experiment, replace(WORN_UNIT, **{name: value}), name)
            for value in candidates.tolist()
        ]
        axis.semilogy(candidates, gaps, color=COLOURS[index], ls=DASHES[index])
        truth = getattr(WORN_UNIT, name)
        axis.axvline(truth, color="#333333", ls=":", label=f"truth {truth:g}")
        axis.set(xlabel=f"candidate {name}", title=_part(experiment, name))
        axis.legend()
    axes[0].set_ylabel("rms gap to the measured, in noise")


def _part(experiment: Experiment, name: str) -> str:
    start, end = getattr(experiment.test.windows, name)[0]
    return f"{('spool', 'pressure')[SIGNAL_OF[name]]}, {start:g} … {end:g} s"


def worn_experiment() -> Experiment:
    """Open-loop test of the worn unit of the pictures."""
    recording = ehadiag.simulate("open", faults=WORN_UNIT, seed=1)
    (experiment,) = ehadiag.diagnose(recording).diagnosis.experiments
    return experiment


def gap_of(experiment: Experiment, severities: Faults, name: str) -> float:
    """Rms difference of model and measured in the part of a fault's search, over the noise."""
    unknowns = Unknowns(tuple(FAULTS), (experiment.constants,), {})
    constants = unknowns.constants(np.array([getattr(severities, item.name) for item in FAULTS]))
    modelled = sensed_response(experiment, constants)[SIGNAL_OF[name]]
    measured = (experiment.spool, experiment.pressure)[SIGNAL_OF[name]]
    start, end = (round(t / experiment.tick) for t in getattr(experiment.test.windows, name)[0])
    gap = (measured - modelled)[start:end]
    return float(np.sqrt(np.nanmean(gap**2)) / experiment.noise[SIGNAL_OF[name]])


def _rounds(figure: Figure) -> None:
    """Densities of a refinement's rounds, from near the truth, over the cost in their plane."""
    experiment, (x, y) = worn_experiment(), ("Kintas", "FSS")
    model = anchored_derivatives([experiment])
    truth = {name: getattr(WORN_UNIT, name) for name in FAULT_NAMES}
    densities: list[ParameterDensity] = []

    def linearise(model: Derivatives, density: ParameterDensity) -> LinearModel:
        densities.append(density)
        return linearised_on_cross(model, density)

    begin = start_density(model, {**truth, x: truth[x] + 2e-3, y: truth[y] - 1e-3}, ROUNDS_STD)
    nothing = np.zeros((len(begin.x), len(begin.x)))
    found = search_posterior(model, begin, begin, nothing, linearise, FEW_UNKNOWNS_SCHEDULE)
    densities.append(found.density)
    names = [item.name for item in model.estimated]
    places = [names.index(x), names.index(y)]
    middle = np.array([truth[x], truth[y]])
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.array([np.cos(turn), np.sin(turn)])
    axes = figure.subplots(1, 2)
    for axis, half, shown in zip(axes, (1.2e-2, 6e-4), ((0, 1, 2), (1, 2, 3, -1)), strict=True):
        shifts = np.linspace(-half, half, 61)
        points = np.repeat(found.density.x[None, :], shifts.size**2, axis=0)
        points[:, places] = middle + np.stack(np.meshgrid(shifts, shifts), -1).reshape(-1, 2)
        costs = cauchy_cost(model.many(points)).reshape(shifts.size, -1)
        rise = np.sqrt(costs - costs.min())
        part = axis.contourf(
            100.0 * shifts, 100.0 * shifts, np.maximum(rise, COST_LEVELS[0]), COST_LEVELS,
            norm=LogNorm(), cmap="Greys",
        )  # fmt: skip
        for turns in shown:
            density, number, colour = densities[turns], turns % len(densities), ROUND_COLOURS[turns]
            root = density.root[[FAULT_NAMES.index(x), FAULT_NAMES.index(y)]]
            edge = 100.0 * ((density.x[places] - middle)[:, None] + _axes_of(root) @ circle)
            label = "start" if number == 0 else f"round {number}" + " (last)" * (turns < 0)
            axis.plot(*edge, color=colour, lw=1.8, label=label)
        axis.plot(0.0, 0.0, "+", color="#cc0000", ms=12, label="truth")
        ends = (-100.0 * half, 100.0 * half)
        axis.set(
            xlabel=f"{x} less the truth, %", ylabel=f"{y} less the truth, %", xlim=ends, ylim=ends
        )
        axis.legend(loc="upper right", fontsize=8)
    figure.colorbar(part, ax=axes, label="root of the rise of the cost, deviations")


def _axes_of(root: Array) -> Array:
    """Half axes of the ellipse of a root of a covariance, shape (2, k): columns, shape (2, 2)."""
    turned, lengths, _ = np.linalg.svd(root, full_matrices=False)
    return np.asarray(turned * lengths)


def _intervals(figure: Figure) -> None:
    axes: Sequence[Axes] = figure.subplots(1, len(FAULTS))
    found = [
        ehadiag.diagnose(ehadiag.simulate("closed", faults=WORN_UNIT, seed=100 + number)).faults
        for number in range(20)
    ]
    for axis, fault in zip(axes, FAULTS, strict=True):
        truth = getattr(WORN_UNIT, fault.name)
        for number, faults in enumerate(found):
            item = faults[fault.name]
            inside = item.interval[0] <= truth <= item.interval[1]
            value = 100.0 * (item.value - truth)
            low, high = (100.0 * (end - truth) for end in item.interval)
            axis.errorbar(
                number + 1, value, yerr=[[value - low], [high - value]],
                fmt="o" if inside else "s", color=COLOURS[0] if inside else COLOURS[1], ms=4,
            )  # fmt: skip
        axis.axhline(0.0, color="#333333", ls=":")
        axis.set(xlabel="test of the same unit", title=f"{fault.name} = {truth:g}")
    axes[0].set_ylabel("estimate less truth, % of full damage")


def _exponent(figure: Figure) -> None:
    """What a file with m = 0 makes of the friction of a valve with m = 2."""
    axis, clogging = figure.subplots(), np.linspace(0.0, 1.0, 201)
    for truth, colour, dash in zip((0.1, 0.2, 0.4), COLOURS, DASHES, strict=True):
        read = np.minimum(truth / (1.0 - 0.8 * clogging) ** 2, 1.0)
        axis.plot(clogging, read, color=colour, ls=dash, label=f"{truth:g}")
        axis.fill_between(clogging, truth, read, color=colour, alpha=0.1)
    axis.set(xlabel="Kintas", ylabel="FSS as read", title="valve with m = 2, file says 0")
    axis.legend(title="true FSS", loc="lower right")


def _monitor(figure: Figure) -> None:
    """Live view of a monitor at the end of a log of a worn unit, as a terminal shows it."""
    seen: list[Snapshot] = []
    ehadiag.watch("tests/data/logs/paper-open-1.blf", snapshots=seen.append)
    console = Console(file=io.StringIO(), record=True, width=100, color_system=None)
    console.print(draw_snapshot(seen[-1], 100))
    figure.set_size_inches(9.0, 4.4)
    figure.patch.set_facecolor("#111417")
    text = console.export_text().rstrip()
    figure.text(0.01, 0.98, text, family="monospace", color="#e8eaed", va="top", size=9)


METHOD_PICTURES: dict[str, Callable[[Figure], None]] = {
    **{name: partial(_effects, name=name) for name in EFFECTS},
    "searches": _searches,
    "rounds": _rounds,
    "intervals": _intervals,
    "exponent": _exponent,
    "monitor": _monitor,
}
"""By name."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--folder", type=Path, default=Path("docs/img"), help="for the PNG files (%(default)s)")
    add("--only", choices=list(METHOD_PICTURES), help="one of them (all)")


def _cases(options: Options) -> list[PictureCase]:
    names = [options.only] if options.only else METHOD_PICTURES
    return [case_of(PictureCase, options, picture=name) for name in names]


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    for record in records:
        yield f"wrote {record['path']}"


PICTURES = Study(
    "pictures",
    "Draws pictures of the documentation: what faults do, why they are found, the live view.",
    _cases, draw_method, _report, _options, count=None, measures_time=True,
)  # fmt: skip
