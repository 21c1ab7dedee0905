"""Study of recorded units with known truth, each calibrated as new and then diagnosed as worn."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_tools.accuracy.figures import cramer_rao, holds_truth, percent_errors
from ehadiag_tools.simulator.compare_logs import read_rows
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.errors import ConfigurationError, EhadiagError
from firmware_iface.logs.reader import read_recording
from firmware_iface.stored_test import bundled_tests


@dataclass(frozen=True, slots=True)
class RecordedUnit:
    """Folder, name, and how many of the unit's recordings as new are calibrated on; 0: all."""

    folder: str
    unit: str
    new: int
    exponent: float | tuple[float, float] | None = None
    """Of the clogging, in place of the actuator file's."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--recordings", type=Path, required=True, metavar="FOLDER",
        help="with recordings X-new-….blf, and others of X when worn, of units X, and truth.csv"
        " with the columns file, Kintas, FSS, FDJ")  # fmt: skip
    add("--unit", action="append", metavar="X", help="may be repeated (all of truth.csv)")
    add(
        "--exponent",
        type=float,
        nargs="+",
        metavar="M",
        help="of the clogging, or the two ends of its range, in place of the file's",
    )
    add("--new", type=int, default=0, metavar="N", help="calibrate on the first N as new (all)")


def _cases(options: Options) -> list[RecordedUnit]:
    rows = read_rows(options.recordings / "truth.csv")
    names = dict.fromkeys(row["file"].partition("-")[0] for row in rows if "-new-" in row["file"])
    wanted = options.unit or list(names)
    for name in wanted:
        if name not in names:
            raise ConfigurationError(f"--unit {name}: no recording of it as new in truth.csv")
    folder = str(options.recordings)
    given = options.exponent
    exponent = None if given is None else given[0] if len(given) == 1 else (given[0], given[1])
    return [RecordedUnit(folder, name, options.new, exponent) for name in wanted]


def perform(case: RecordedUnit) -> Record:
    """Calibrate a unit and diagnose its worn recordings; fractions of 1."""
    folder = Path(case.folder)
    rows = [r for r in read_rows(folder / "truth.csv") if r["file"].startswith(f"{case.unit}-")]
    new = [read_recording(folder / row["file"]) for row in rows if "-new-" in row["file"]]
    begin = time.process_time()
    chosen = new[: case.new or None]
    found = calibrate(chosen, _sheet(case), bundled_tests().values())
    spent = time.process_time() - begin
    record: Record = {"calibration_s": spent, "reasons": list(found.reasons), "worn": []}
    record["tried"] = [f"{item.words} {item.excess:.2f}" for item in found.tried]
    if found.actuator is not None and found.actuator.calibration is not None:
        calibration = found.actuator.calibration
        record["learned"] = f"{calibration.fit.excess:.2f}, {', '.join(calibration.effects)}"
        for row in rows:
            if "-new-" not in row["file"]:
                truth = [float(row[name]) for name in FAULT_NAMES]
                record["worn"].append(_diagnosed(folder / row["file"], truth, found.actuator))
    return record


def _sheet(case: RecordedUnit) -> Actuator:
    """Data of the unit's type: `sheet-X.toml` beside its recordings, else the reference's."""
    path = Path(case.folder) / f"sheet-{case.unit}.toml"
    sheet = load_actuator(path) if path.exists() else default_actuator()
    if case.exponent is None:
        return sheet
    valve = msgspec.structs.replace(sheet.servovalve, clogging_exponent=case.exponent)
    return msgspec.structs.replace(sheet, servovalve=valve)


def _diagnosed(path: Path, truth: list[float], unit: Actuator) -> Record:
    found = diagnose([read_recording(path)], unit, bundled_tests().values())
    if found.identification is None:
        raise EhadiagError(f"{path.name}: {'; '.join(found.reasons)}")
    estimates = found.identification.estimates
    return {
        "recording": path.stem,
        "faults": truth,
        "value": [item.value for item in estimates],
        "std": [item.std for item in estimates],
        "interval95": [list(item.interval95) for item in estimates],
        "bound": cramer_rao(found.experiments, truth).tolist(),
        "verdict": found.verdict.name.replace("_", " "),
        "refused": list(found.reasons) if found.verdict is Verdict.NOT_TESTED else [],
    }


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Errors with stated deviations in percent; bounds are those with all else known."""
    for record in records:
        tried = "; ".join(record["tried"])
        spent = f"{record['calibration_s']:.1f} s of processor time"
        yield f"\nUnit {record['unit']}: {spent}, residuals over noise: {tried}\n"
        if "learned" not in record:
            yield f"refused: {'; '.join(record['reasons'])}"
            continue
        yield f"learned: {record['learned']}\n"
        worn = record["worn"]
        if worn:
            headings = ("recording", *FAULT_NAMES, "bounds", "covered", "verdict")
            yield from markdown(headings, _rows(worn))
            yield from _summary(worn)


def _summary(worn: Sequence[Record]) -> Iterator[str]:
    """What was answered: mean and worst error of each severity, coverage; why the rest was not."""
    answered = [item for item in worn if not item["refused"]]
    yield f"\nanswered: {len(answered)} of {len(worn)}"
    if answered:
        error = np.abs(percent_errors(answered))
        means, worst = error.mean(axis=0), error.max(axis=0)
        each = (
            f"{name} mean {mean:.3f}, worst {most:.3f}"
            for name, mean, most in zip(FAULT_NAMES, means, worst, strict=True)
        )
        held = 100.0 * holds_truth(answered).mean()
        yield f"{'; '.join(each)}; coverage {held:.0f} %"
    for item in worn:
        if item["refused"]:
            yield f"{item['recording']}: {'; '.join(item['refused'])}"


def _rows(worn: Sequence[Record]) -> Iterator[tuple[object, ...]]:
    for item, error, held in zip(worn, percent_errors(worn), holds_truth(worn), strict=True):
        cells = [f"{e:+.3f} ± {100.0 * s:.3f}" for e, s in zip(error, item["std"], strict=True)]
        bounds = " ".join(f"{100.0 * value:.3f}" for value in item["bound"])
        covered = "yes" if held.all() else "no"
        yield item["recording"], *cells, bounds, covered, item["verdict"]


RECORDED_UNITS = Study(
    "recorded-units",
    "Recorded units with known truth, each calibrated as new and then diagnosed as worn.",
    _cases, perform, _report, _options, count=None,
)  # fmt: skip
