"""Study of random textbook units through the exported library of this computer.

Each unit is recorded, identified by the library and by the package; some tests are cut short.
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import default_actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.export.library import SHARED_LIBRARY_FILE, export_library
from ehadiag.export.plan import exported_unit, library_plan
from ehadiag.export.targets import find_target
from ehadiag.identify.experiment import build_experiment
from ehadiag.identify.identification_session import NuisanceMode, identify
from ehadiag.monitor.plan import design_cusum
from ehadiag.onboard.onboard_memory import ONBOARD, OnboardOutcome
from ehadiag_tools.accuracy.units import UnitCase, draw_unit, record_worn
from ehadiag_tools.onboard.replay import surrounded, ticks_of
from ehadiag_tools.study import Options, Record, Study, grouped, markdown
from firmware_iface.files import RESULT_MODE, Folder
from firmware_iface.recording import Recording
from firmware_iface.stored_test import resolve_test

NOT_TESTED = 30.0
"""Verdict of an identification that carries none."""
GOES_ON = 1
"""What a slice returns before the last one."""
FAR_OFF = 5.0
"""Error in stated deviations from which an estimate is wrong without a word, 1."""
TESTS = ("open", "closed")
SLICE = 1e5
"""Ticks of a model in a slice, 1: seldom enough to cost nothing."""
PLAN = library_plan(
    default_actuator(),
    design_cusum(FALSE_ALARM_INTERVAL_H, 1.0 / default_actuator().controller.rate),
)


@dataclass(frozen=True, slots=True)
class OnboardUnit:
    """Unit `case` of a seed, recorded in a stored test of which a share (0 … 1) is there."""

    test: str
    case: int
    seed: int
    share: float = 1.0


class SharedLibrary:
    """An exported shared library of this computer."""

    def __init__(self, path: Path) -> None:
        self._library = ctypes.CDLL(str(path))

    def call(self, name: str, *arguments: NDArray[np.float64]) -> int:
        """Call a function with pointers to these numbers."""
        pointers = [ctypes.c_void_p(item.ctypes.data) for item in arguments]
        return int(getattr(self._library, name)(*pointers))

    def identified(self, unit: Sequence[float], ticks: NDArray[np.float64]) -> OnboardOutcome:
        """Identify ticks, shape (n, 5), to the end."""
        memory, given = np.zeros(ONBOARD.end), exported_unit(unit, PLAN)
        told, slices = np.ascontiguousarray(ticks), np.array([len(ticks), SLICE])
        assert self.call("eha_identify_begin", memory, given) == 0
        while self.call("eha_identify_run", memory, told, slices) == GOES_ON:
            pass
        return OnboardOutcome(*memory[: len(OnboardOutcome._fields)].tolist())


@cache
def _library() -> SharedLibrary:
    """Export of the reference actuator, one for each process."""
    with tempfile.TemporaryDirectory(prefix="ehadiag-onboard-") as place:
        with Folder.at(Path(place), RESULT_MODE) as folder:
            export_library(default_actuator(), find_target("host"), folder)
        return SharedLibrary(Path(place, SHARED_LIBRARY_FILE))


@cache
def _recorded(test: str, case: int, seed: int) -> tuple[Recording, tuple[float, ...]]:
    """Recording of a random textbook unit, and its severities."""
    drawn = UnitCase(test, case, seed, data="textbook")
    unit, severities = draw_unit(drawn)
    return record_worn(drawn, unit, test, severities), tuple(severities)


def perform(case: OnboardUnit) -> Record:
    """Identify a recording on board and by the package; plain numbers."""
    recording, severities = _recorded(case.test, case.case, case.seed)
    ticks = ticks_of(recording)
    begin = time.process_time()
    found = _library().identified(surrounded(recording), ticks[: round(case.share * len(ticks))])
    spent = time.process_time() - begin
    out = {"faults": severities, "processor_s": spent, **found._asdict(), "value": found[:3]}
    if case.share == 1.0:
        assert recording.samples is not None
        experiment = build_experiment(
            recording.samples, recording.environment, resolve_test(case.test), default_actuator()
        )
        host = identify([experiment], nuisances=NuisanceMode.NONE)
        out["host"] = [item.value for item in host.estimates]
        out["host_std"] = [item.std for item in host.estimates]
    return {name: _plain(value) for name, value in out.items()}


def _plain(value: object) -> object:
    """Replace NaN, which JSON does not have, by None."""
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--test", action="append", choices=TESTS, help="may be repeated (both)")
    add("--cuts", type=int, default=0, help="ends of each test, drawn at random, instead of it (0)")


def _cases(options: Options) -> list[OnboardUnit]:
    out = []
    for case in range(options.cases):
        cuts = np.random.default_rng([options.seed, case, 1]).uniform(0.02, 0.999, options.cuts)
        for test in options.test or TESTS:
            shares = cuts.tolist() if options.cuts else [1.0]
            out += [OnboardUnit(test, case, options.seed, share) for share in shares]
    return out


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    rows, far = [], []
    for (test,), part in grouped(records, "test").items():
        stated = [item for item in part if item["verdict"] != NOT_TESTED]
        errors = [_errors(item) for item in stated]
        off = np.array([error / _stds(item) for error, item in zip(errors, stated, strict=True)])
        far += [item for item, row in zip(stated, off, strict=True) if row.max() > FAR_OFF]
        host = np.array([_distance(item) for item in stated if "host" in item])
        rows.append((
            test, len(part), len(part) - len(stated), sum(row.max() > FAR_OFF for row in off),
            *_figures([100.0 * error for error in errors]), *_figures(host),
            f"{100.0 * np.mean(off < 1.96):.1f}" if stated else "–",
            f"{np.mean([item['runs'] for item in part]):.0f}",
            f"{np.mean([item['processor_s'] for item in part]):.2f}",
        ))  # fmt: skip
    yield from markdown(
        ("test", "cases", "NOT TESTED", f"beyond {FAR_OFF:g} deviations", "error, %: mean", "worst",
         "from the package, deviations: mean", "worst", "coverage, %", "model runs",
         "processor, s"),
        rows,
    )  # fmt: skip
    wrong = [*far, *(i for i in records if i["verdict"] == NOT_TESTED and i["share"] == 1.0)]
    if wrong:
        yield "\nNOT TESTED, or beyond:\n"
        yield from markdown(
            ("test", "case", "share of the test", "truth", "estimate", "outliers"),
            ((i["test"], i["case"], f"{i['share']:.3f}", _text(i["faults"]), _text(i["value"]),
              i["outliers"]) for i in wrong),
        )  # fmt: skip


def _errors(item: Record) -> NDArray[np.float64]:
    return np.abs(np.array(item["value"]) - np.array(item["faults"]))


def _stds(item: Record) -> NDArray[np.float64]:
    return np.array([item[f"std_{name}"] for name in ("Kintas", "FSS", "FDJ")])


def _distance(item: Record) -> NDArray[np.float64]:
    return np.asarray(np.abs(np.array(item["value"]) - item["host"]) / np.array(item["host_std"]))


def _figures(values: Sequence[NDArray[np.float64]] | NDArray[np.float64]) -> tuple[str, str]:
    return (f"{np.mean(values):.4f}", f"{np.max(values):.3f}") if len(values) else ("–", "–")


def _text(values: Sequence[float | None]) -> str:
    return ", ".join("–" if value is None else f"{value:.4f}" for value in values)


def _any_wrong(records: Sequence[Record]) -> bool:
    stated = [item for item in records if item["verdict"] != NOT_TESTED]
    return any((_errors(item) > FAR_OFF * _stds(item)).any() for item in stated)


ONBOARD_UNITS = Study(
    "onboard-units",
    "Random textbook units through the exported library: NOT TESTED, errors, the package beside.",
    _cases, perform, _report, _options, count=40, counted="random units", failed=_any_wrong,
)  # fmt: skip
