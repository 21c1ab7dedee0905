"""Studies of exported libraries: recordings on all targets, and random units on this computer."""

from __future__ import annotations

import argparse
import ctypes
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from dataclasses import replace as replaced
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.compile.libraries import LEVELS, processor_level
from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.core.criteria import NORMAL_HALF_WIDTH_95
from ehadiag.export.library import (
    MANIFEST_FILE,
    SHARED_LIBRARY_FILE,
    STATIC_LIBRARY_FILE,
    export_library,
    exported_unit,
    library_plan,
)
from ehadiag.export.targets import Target, find_target
from ehadiag.identify.identification_session import NuisanceMode
from ehadiag.monitor.plan import design_cusum
from ehadiag.onboard.onboard_memory import ONBOARD as PLACES
from ehadiag.onboard.onboard_memory import OnboardOutcome
from ehadiag_sim.conditions import Effects
from ehadiag_tools.accuracy.cases import (
    UnitCase,
    add_conditions,
    draw_unit,
    knowledge,
    random_days,
    record_worn,
)
from ehadiag_tools.accuracy.figures import FAR_OFF, accuracy_table, is_answered
from ehadiag_tools.onboard.replay import (
    EMULATED,
    identified,
    missing,
    replayed,
    surrounded,
    ticks_of,
    unit_of,
)
from ehadiag_tools.simulator.units import Unit, add_group
from ehadiag_tools.study import Options, Record, Study, grouped, markdown
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import RESULT_MODE, Folder
from firmware_iface.recording import Recording
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import bundled_tests

SEVERITIES = (0.3, 0.4, 0.2)
"""Severities that the monitor has, 1."""
REFERENCE = {False: "host", True: "host-single"}
"""Whose digits a target must have, by whether it is of single precision."""
CLOCK_MHZ = 400.0
"""Clock for which a time is estimated, MHz, at one instruction a cycle."""


@dataclass(frozen=True, slots=True)
class OnboardCase:
    """One recording on one target, replayed through the monitor or identified.

    Folder of an export: empty for one that is made here.
    """

    log: str
    target: str
    export: str
    identify: bool


@cache
def _work() -> tempfile.TemporaryDirectory[str]:
    """Folder of this process, removed at its end."""
    return tempfile.TemporaryDirectory(prefix="ehadiag-onboard-")


@cache
def _export(name: str) -> Path:
    """Export of the reference actuator for a target."""
    return _exported(default_actuator(), find_target(name))


def _exported(actuator: Actuator, target: Target) -> Path:
    """Export of an actuator for a target, in a new folder."""
    out = Path(tempfile.mkdtemp(dir=_work().name))
    with Folder.at(out, RESULT_MODE) as folder:
        export_library(actuator, target, folder)
    return out


def _reference(name: str) -> str:
    return REFERENCE[find_target(name).processor.single]


def perform(case: OnboardCase) -> Record:
    """Run a recording through the export of a target and of its reference."""
    export = Path(case.export) if case.export else _export(case.target)
    reference = replaced(case, target=_reference(case.target), export="")
    if _manifest(export)["plan"] != _manifest(_export(reference.target))["plan"]:
        raise ConfigurationError("--into: an export of another actuator than the reference")
    found = _run(export, case)
    pairs = zip(found.pop("digits"), _digits(reference), strict=True)
    size = (export / STATIC_LIBRARY_FILE).stat().st_size
    return {**found, "differing": sum(a != b for a, b in pairs), "bytes": size}


@cache
def _digits(case: OnboardCase) -> list[str]:
    digits: list[str] = _run(_export(case.target), case)["digits"]
    return digits


def _run(export: Path, case: OnboardCase) -> Record:
    recording, work = read_recording(Path(case.log)), Path(_work().name)
    emulator = next(item for item in EMULATED if item.target == case.target)
    ticks = ticks_of(recording)
    if case.identify:
        done = identified(emulator, export, surrounded(recording), ticks, work)
        outcome = done.outcome
        severities = [float(outcome.Kintas), float(outcome.FSS), float(outcome.FDJ)]
        return {
            "digits": [done.bits], "done": len(ticks), "stack": done.stack,
            "millions": done.millions, "longest": done.longest, "runs": int(outcome.runs),
            "severities": severities,
        }  # fmt: skip
    replay = replayed(emulator, export, unit_of(recording, SEVERITIES), ticks, work)
    return {
        "digits": replay.lines, "done": len(ticks), "stack": replay.push_stack,
        "init_stack": replay.init_stack, "mean": replay.mean_push, "worst": replay.worst_push,
    }  # fmt: skip


def _manifest(export: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((export / MANIFEST_FILE).read_text())
    return content


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("logs", nargs="+", type=Path, help="recordings, or folders of them")
    add("--identify", action="store_true", help="identify them as a whole")
    add("--into", type=Path, metavar="FOLDER",
        help="measure this export, and write the results into its manifest")  # fmt: skip


def _cases(options: Options) -> list[OnboardCase]:
    given = options.into.resolve() if options.into else None
    targets = [item.target for item in EMULATED if not missing(item)]
    if given:
        targets = [name for name in targets if name == _manifest(given)["target"]]
    logs: list[Path] = []
    for path in options.logs:
        inside = [log for end in ("blf", "asc") for log in sorted(path.glob(f"*.{end}"))]
        logs += inside if path.is_dir() else [path]
    return [
        OnboardCase(str(log), name, str(given or ""), options.identify)
        for log in logs
        if read_recording(log).samples is not None
        for name in targets
    ]


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    if options.into is not None:
        _write_manifest(options.into / MANIFEST_FILE, records)
    for emulator in EMULATED if options.into is None else ():
        if missing(emulator):
            yield f"{emulator.target}: not installed: {', '.join(missing(emulator))}\n"
    headings = ["recording", "target", "library, bytes", "ticks"]
    rows: list[list[object]] = [
        [Path(item["log"]).name, item["target"], item["bytes"], item["done"]] for item in records
    ]
    if options.identify:
        headings += ["digits", "Kintas, FSS, FDJ", "model runs", "stack, bytes"]
        headings += ["million instructions", "most in a slice", f"s at {CLOCK_MHZ:g} MHz"]
        for row, item in zip(rows, records, strict=True):
            severities = ", ".join(f"{value:.6f}" for value in item["severities"])
            row.extend(["DIFFERENT" if item["differing"] else "same", severities, item["runs"]])
            millions = item["millions"]
            effort = millions, item["longest"], f"{millions / CLOCK_MHZ:.1f}"
            row.extend([item["stack"], *(effort if millions else "–––")])
    else:
        headings += ["ticks that differ", "stack of init, bytes", "stack of push, bytes"]
        headings += ["instructions of push", "at most"]
        for row, item in zip(rows, records, strict=True):
            instructions = item["mean"], item["worst"]
            row.extend([item["differing"], item["init_stack"], item["stack"]])
            row.extend(instructions if item["worst"] else "––")
    yield from markdown(headings, rows)


def _write_manifest(manifest: Path, records: Sequence[Record]) -> None:
    """Write what was measured into the manifest of an export."""
    content = _manifest(manifest.parent)
    facts = content["measured"]
    facts["bit_equality"] = {
        Path(item["log"]).name:
            f"{'different' if item['differing'] else 'same'} over {item['done']} ticks"
        for item in records
    }  # fmt: skip
    counts = {
        "instructions_of_push": ("mean", "worst"),
        "instructions_of_identification": ("millions", "runs"),
    }
    for key, names in counts.items():
        found = {
            Path(item["log"]).name: {name: item[name] for name in names}
            for item in records
            if item.get(names[0])
        }
        facts[key] = found or facts[key]
    manifest.write_text(json.dumps(content, indent=2) + "\n")


ONBOARD = Study(
    "onboard",
    "Recordings through the exports of all targets, in emulators: bits, sizes, instructions.",
    _cases, perform, _report, _options, count=None, measures_time=True,
    failed=lambda item: item["differing"] > 0,
)  # fmt: skip


GOES_ON = 1
"""What a slice returns before the last one."""
TESTS = ("open", "closed")
SLICE = 1e5
"""Ticks of a model in a slice, 1: seldom enough to cost nothing."""
UNKNOWN = {
    "bias": Unit(effects=Effects(null_bias=1e-5)),
    "hysteresis": Unit(effects=Effects(hysteresis=0.002)),
}
"""Units with one effect that a library of the reference actuator knows nothing of."""
DATA = ("textbook", "calibrated", *UNKNOWN)
"""What the units are: without effects; with many, calibrated; with one that is unknown."""


@dataclass(frozen=True, slots=True)
class OnboardUnit:
    """Unit `case` of a seed, recorded in a stored test.

    Data: one of `DATA`. Groups: of effects of a calibrated one, see `random_unit`. Bits: whether
    the builds of the kernels for this computer are compared, too. Conditions: oil, degC, and
    supply, Pa, of the day; None: the simulator's own.
    """

    test: str
    case: int
    seed: int
    data: str = "textbook"
    groups: tuple[str, ...] = ()
    bits: bool = False
    conditions: tuple[float, float] | None = None


class OnboardLibrary:
    """Shared library of an actuator, and its plan."""

    def __init__(self, actuator: Actuator, target: Target) -> None:
        self.actuator = actuator
        self.code = ctypes.CDLL(str(_exported(actuator, target) / SHARED_LIBRARY_FILE))
        tick = 1.0 / actuator.controller.rate
        self.plan = library_plan(actuator, design_cusum(FALSE_ALARM_INTERVAL_H, tick))

    def call(self, name: str, *arguments: NDArray[np.float64]) -> int:
        """Call a function of the library with pointers to these numbers."""
        pointers = [ctypes.c_void_p(item.ctypes.data) for item in arguments]
        return int(getattr(self.code, name)(*pointers))

    def identified(self, recording: Recording) -> NDArray[np.float64]:
        """Outcome of a recording."""
        ticks = np.ascontiguousarray(ticks_of(recording))
        memory, given = np.zeros(PLACES.end), surrounded(recording, self.actuator)
        slices = np.array([len(ticks), SLICE])
        assert self.call("eha_identify_begin", memory, exported_unit(given, self.plan)) == 0
        while self.call("eha_identify_run", memory, ticks, slices) == GOES_ON:
            pass
        return memory[: len(OnboardOutcome._fields)]


@lru_cache(maxsize=4)
def _library(unit: UnitCase | None, build: str = "host") -> OnboardLibrary:
    """Library of a calibrated unit, None: of the reference actuator.

    Builds of the ground are for all that this processor has.
    """
    target = find_target("host")
    if build != "host":
        level = replace(LEVELS[processor_level()], fast=build == "fused")
        target = replace(target, processor=level)
    return OnboardLibrary(default_actuator() if unit is None else knowledge(unit)[0], target)


def perform_random(case: OnboardUnit) -> Record:
    """Identify a recording of a random unit on board and by the package."""
    of_unit = case.data == "calibrated"
    kind = "calibrated" if of_unit else "textbook"
    drawn = UnitCase(case.test, case.case, case.seed, data=kind, groups=case.groups)
    unit, severities = draw_unit(drawn)
    unit = UNKNOWN.get(case.data, unit)
    if case.conditions is not None:
        oil, supply = case.conditions
        day = replaced(unit.effects, oil_temperature=oil, supply_pressure=supply)
        unit = replaced(unit, effects=day)
    recording = record_worn(drawn, unit, case.test, severities)
    known = replaced(drawn, test=TESTS[0]) if of_unit else None
    library = _library(known)
    begin = time.process_time()
    numbers = library.identified(recording)
    spent, found = time.process_time() - begin, OnboardOutcome(*numbers.tolist())
    std = [found.std_Kintas, found.std_FSS, found.std_FDJ]
    ends = [
        (v - NORMAL_HALF_WIDTH_95 * s, v + NORMAL_HALF_WIDTH_95 * s)
        for v, s in zip(found[:3], std, strict=True)
    ]
    out = {
        "faults": severities, "processor_s": spent, "value": found[:3], "std": std,
        "interval95": ends, "runs": found.runs, "outliers": found.outliers,
        "reasons": found.reasons, "verdict": Verdict(int(found.verdict)).name,
    }  # fmt: skip
    if case.bits:
        portable, fused = (
            _library(known, build).identified(recording) for build in ("portable", "fused")
        )
        out["same_bits"] = portable.tobytes() == numbers.tobytes()
        apart = np.abs(fused[:3] - numbers[:3]) / numbers[3:6]
        out["fused"] = float(apart.max())
        out["fused_verdict"] = bool(fused[8] == numbers[8])
    mode = NuisanceMode.NONE if case.data == "textbook" else NuisanceMode.AUTO
    begin = time.process_time()
    host = diagnose([recording], library.actuator, bundled_tests().values(), nuisances=mode)
    assert host.identification is not None
    estimates = host.identification.estimates
    out |= {
        "host_verdict": host.verdict.name, "host": [item.value for item in estimates],
        "host_std": [item.std for item in estimates], "host_s": time.process_time() - begin,
    }  # fmt: skip
    return {name: _plain(value) for name, value in out.items()}


def _plain(value: object) -> object:
    """Replace NaN, which JSON does not have, by None."""
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _random_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--test", action="append", choices=TESTS, help="may be repeated (both)")
    add("--data", action="append", choices=DATA, help="what the units are (textbook)")
    add("--bits", action="store_true", help="compare builds for this computer, too")
    add_conditions(parser)
    add_group(parser)


def _random_cases(options: Options) -> list[OnboardUnit]:
    groups = tuple(sorted(set(options.group)))
    return [
        OnboardUnit(test, case, options.seed, data, groups, options.bits, day)
        for data in options.data or DATA[:1]
        for case, day in enumerate(random_days(options))
        for test in options.test or TESTS
    ]


def _random_report(records: Sequence[Record], options: Options) -> Iterator[str]:
    yield from accuracy_table(records, "data", "test")
    costs = [(item["runs"], 1e3 * item["processor_s"], 1e3 * item["host_s"]) for item in records]
    runs, spent, beside = np.median(costs, axis=0)
    yield f"\nMedians: {runs:.0f} model runs, {spent:.0f} ms of processor; package {beside:.0f} ms"
    if options.bits:
        yield from _bits_lines(records)
    yield from _package_lines(records)
    yield f"\nNOT TESTED, or beyond {FAR_OFF:g} deviations:\n"
    yield from markdown(
        ("data", "test", "case", "truth", "estimate", "outliers", "reasons"),
        ((i["data"], i["test"], i["case"], _text(i["faults"]), _text(i["value"]), i["outliers"],
          i["reasons"])
         for i in records if not is_answered(i) or _is_far(i)),
    )  # fmt: skip


def _bits_lines(records: Sequence[Record]) -> Iterator[str]:
    """How the ground's builds of the same kernels differ from the library."""
    same = sum(item["same_bits"] for item in records)
    yield f"portable build of the ground: the same bits in {same} of {len(records)}"
    fused = [item["fused"] for item in records if item["fused"] is not None]
    other = sum(not item["fused_verdict"] for item in records)
    yield f"fused build: at most {max(fused, default=0.0):.2g} deviations, other verdicts {other}"


def _package_lines(records: Sequence[Record]) -> Iterator[str]:
    """How the package's estimates of the same recordings differ."""
    rows = []
    for (data, test), part in grouped(records, "data", "test").items():
        answered = [item for item in part if is_answered(item)]
        cells: list[str] = []
        if answered:
            apart = np.array([_deviations(item, "host", "std") for item in answered])
            ratio = np.array([np.divide(item["std"], item["host_std"]) for item in answered])
            cells += [f"{apart.mean():.2f}", f"{apart.max():.2f}"]
            cells += [", ".join(f"{value:.2f}" for value in np.median(ratio, axis=0))]
            cells += [", ".join(f"{value:.2f}" for value in ratio.max(axis=0))]
        other = sum(item["verdict"] != item["host_verdict"] for item in part)
        shown = sum(item["host_verdict"] != Verdict.NOT_TESTED.name for item in part)
        rows.append((data, test, len(part), len(answered), shown, *(cells or "––––"), other))
    yield "\nThe package beside, in deviations of the library, for Kintas, FSS, FDJ:\n"
    yield from markdown(
        ("data", "test", "cases", "answered", "by the package", "apart, mean", "most",
         "deviation over its, median", "most", "other verdicts"),
        rows,
    )  # fmt: skip


def _is_far(item: Record) -> bool:
    return is_answered(item) and bool((_deviations(item, "faults", "std") > FAR_OFF).any())


def _deviations(item: Record, other: str, std: str) -> NDArray[np.float64]:
    """Distance of the estimates from others, in deviations."""
    return np.asarray(np.abs(np.array(item["value"]) - item[other]) / np.array(item[std]))


def _text(values: Sequence[float | None]) -> str:
    return ", ".join("–" if value is None else f"{value:.4f}" for value in values)


ONBOARD_UNITS = Study(
    "onboard-units",
    "Random units through the exported library, the package and other builds beside.",
    _random_cases, perform_random, _random_report, _random_options, count=40,
    counted="random units", failed=_is_far,
)  # fmt: skip
