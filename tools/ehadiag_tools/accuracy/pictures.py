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
from matplotlib.figure import Figure
from rich.console import Console

import ehadiag
from ehadiag.identify.experiment import Experiment
from ehadiag.live import Snapshot
from ehadiag.model.registry import FAULTS, Unknowns
from ehadiag.report.response_signals import sensed_response
from ehadiag.terminal.live_view import draw_snapshot
from ehadiag_sim.conditions import Faults
from ehadiag_tools.study import Options, Record, Study, case_of

COLOURS = ("#0072b2", "#d55e00", "#009e73")
"""Okabe and Ito's, which colour-blind people tell apart; the dashes differ too."""
DASHES = ("-", "--", "-.")
WORN_UNIT = Faults(Kintas=0.4, FSS=0.3, FDJ=0.5)
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
