"""Study of recorded units with known truth, each calibrated as new and then diagnosed as worn."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import msgspec

from ehadiag.assess.diagnosis import diagnose
from ehadiag.calibration.calibrate_unit import calibrate
from ehadiag.core.actuator import Actuator, ExponentOrRange, default_actuator, load_actuator
from ehadiag.model.registry import FAULT_NAMES
from ehadiag_tools.accuracy.figures import (
    NOT_TESTED,
    accuracy_table,
    cramer_rao,
    outcome,
    percent_errors,
)
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
    exponents: tuple[ExponentOrRange, ...] = ()
    """Of the clogging, in place of the actuator file's; all with the same largest one."""


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
        action="append",
        metavar="M",
        help="of the clogging, or its range, in place of the file's; may be repeated",
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
    stated: dict[float, list[ExponentOrRange]] = {}
    for given in options.exponent or ():
        value = given[0] if len(given) == 1 else (given[0], given[1])
        stated.setdefault(given[-1], []).append(value)
    groups = [tuple(values) for values in stated.values()] or [()]
    return [RecordedUnit(folder, name, options.new, group) for group in groups for name in wanted]


def perform(case: RecordedUnit) -> Record:
    """Calibrate a unit and diagnose its worn recordings; fractions of 1.

    A range of exponents is calibrated with its largest: one calibration serves all of a case.
    """
    folder = Path(case.folder)
    rows = [r for r in read_rows(folder / "truth.csv") if r["file"].startswith(f"{case.unit}-")]
    new = [read_recording(folder / row["file"]) for row in rows if "-new-" in row["file"]]
    begin = time.process_time()
    chosen = new[: case.new or None]
    sheet = _sheet(case)
    statements = case.exponents or (sheet.servovalve.clogging_exponent,)
    stated = with_exponent(sheet, statements[0])
    found = calibrate(chosen, stated, bundled_tests().values())
    spent = time.process_time() - begin
    record: Record = {"calibration_s": spent, "reasons": list(found.reasons), "worn": []}
    record["tried"] = [f"{item.words} {item.excess:.2f}" for item in found.tried]
    if found.actuator is not None and found.actuator.calibration is not None:
        calibration = found.actuator.calibration
        record["learned"] = f"{calibration.fit.excess:.2f}, {', '.join(calibration.effects)}"
        for said, row in product(statements, rows):
            if "-new-" not in row["file"]:
                truth = [float(row[name]) for name in FAULT_NAMES]
                unit = with_exponent(found.actuator, said)
                record["worn"].append({"m": said, **_diagnosed(folder / row["file"], truth, unit)})
    return record


def _sheet(case: RecordedUnit) -> Actuator:
    """Data of the unit's type: `sheet-X.toml` beside its recordings, else the reference's."""
    path = Path(case.folder) / f"sheet-{case.unit}.toml"
    return load_actuator(path) if path.exists() else default_actuator()


def with_exponent(actuator: Actuator, exponent: ExponentOrRange) -> Actuator:
    """Return data of an actuator with another statement of the clogging's exponent."""
    valve = msgspec.structs.replace(actuator.servovalve, clogging_exponent=exponent)
    return msgspec.structs.replace(actuator, servovalve=valve)


def _diagnosed(path: Path, truth: list[float], unit: Actuator) -> Record:
    found = diagnose([read_recording(path)], unit, bundled_tests().values())
    if found.identification is None:
        raise EhadiagError(f"{path.name}: {'; '.join(found.reasons)}")
    bound = cramer_rao(found.experiments, truth).tolist()
    return {"recording": path.stem, "faults": truth, **outcome(found), "bound": bound}


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
        yield from markdown(("m", "recording", *FAULT_NAMES, "bounds", "verdict"), _rows(record))
    yield "\nErrors of what is answered, by m:\n"
    yield from accuracy_table([item for record in records for item in record["worn"]], "m")


def _rows(record: Record) -> Iterator[tuple[object, ...]]:
    for item in record["worn"]:
        (error,) = percent_errors([item])
        cells = [f"{e:+.3f} ± {100.0 * s:.3f}" for e, s in zip(error, item["std"], strict=True)]
        bounds = " ".join(f"{100.0 * value:.3f}" for value in item["bound"])
        verdict = item["verdict"].replace("_", " ")
        if item["verdict"] == NOT_TESTED:
            verdict += f": {'; '.join(item['reasons'])}"
        yield item["m"], item["recording"], *cells, bounds, verdict


RECORDED_UNITS = Study(
    "recorded-units",
    "Recorded units with known truth, each calibrated as new and then diagnosed as worn.",
    _cases, perform, _report, _options, count=None,
)  # fmt: skip
