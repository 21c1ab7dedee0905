"""Study of recordings through the exports of all targets: digits, sizes, effort."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from ehadiag.core.actuator import default_actuator, load_actuator
from ehadiag.export.library import MANIFEST_FILE, STATIC_LIBRARY_FILE, export_library
from ehadiag.export.targets import find_target
from ehadiag_tools.onboard.emulators import EMULATED, Emulator, missing
from ehadiag_tools.onboard.replay import identified, replayed, surrounded, ticks_of, unit_of
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import RESULT_MODE, Folder
from firmware_iface.logs.reader import read_recording

SEVERITIES = (0.3, 0.4, 0.2)
"""Severities that the monitor has, 1."""
REFERENCE = {False: "host", True: "host-single"}
"""Whose digits a target must have, by whether it is of single precision."""
CLOCK_MHZ = 400.0
"""Clock for which a time is estimated, MHz, at one instruction a cycle."""


@dataclass(frozen=True, slots=True)
class OnboardCase:
    """One recording on one target, replayed through the monitor or identified.

    Folder of an export: empty for one that is made here. Actuator: path of a file, empty for the
    reference actuator. Ticks: from the start of the recording; 0: all.
    """

    log: str
    target: str
    export: str
    actuator: str
    identify: bool
    ticks: int


@cache
def _work() -> tempfile.TemporaryDirectory[str]:
    """Folder of this process, removed at its end."""
    return tempfile.TemporaryDirectory(prefix="ehadiag-onboard-")


@cache
def _export(name: str, actuator: str) -> Path:
    """Export for a target."""
    out = Path(_work().name) / name
    out.mkdir()
    unit = load_actuator(Path(actuator)) if actuator else default_actuator()
    with Folder.at(out, RESULT_MODE) as folder:
        export_library(unit, find_target(name), folder)
    return out


def _reference(name: str) -> str:
    return REFERENCE[find_target(name).processor.single]


def perform(case: OnboardCase) -> Record:
    """Run a recording through the export of a target and of its reference."""
    export = Path(case.export) if case.export else _export(case.target, case.actuator)
    other = _export(_reference(case.target), case.actuator)
    if _manifest(export)["plan"] != _manifest(other)["plan"]:
        raise ConfigurationError("--into: an export of another actuator than the recordings' own")
    found = _run(_emulator(case.target), export, case)
    reference = _digits(replace(case, target=_reference(case.target), export=""))
    pairs = zip(found.pop("digits"), reference, strict=True)
    size = (export / STATIC_LIBRARY_FILE).stat().st_size
    return {**found, "differing": sum(a != b for a, b in pairs), "bytes": size}


@cache
def _digits(case: OnboardCase) -> list[str]:
    export = _export(case.target, case.actuator)
    digits: list[str] = _run(_emulator(case.target), export, case)["digits"]
    return digits


def _run(emulator: Emulator, export: Path, case: OnboardCase) -> Record:
    recording, work = read_recording(Path(case.log)), Path(_work().name)
    actuator = load_actuator(Path(case.actuator)) if case.actuator else default_actuator()
    ticks = ticks_of(recording)[: case.ticks or None]
    if case.identify:
        done = identified(emulator, export, surrounded(recording, actuator), ticks, work)
        outcome = done.outcome
        severities = [float(outcome.Kintas), float(outcome.FSS), float(outcome.FDJ)]
        return {
            "digits": [done.bits], "done": len(ticks), "stack": done.stack,
            "millions": done.millions, "longest": done.longest, "runs": int(outcome.runs),
            "severities": severities,
        }  # fmt: skip
    replay = replayed(emulator, export, unit_of(recording, SEVERITIES, actuator), ticks, work)
    return {
        "digits": replay.lines, "done": len(ticks), "stack": replay.push_stack,
        "init_stack": replay.init_stack, "mean": replay.mean_push, "worst": replay.worst_push,
    }  # fmt: skip


def _emulator(name: str) -> Emulator:
    return next(item for item in EMULATED if item.target == name)


def _manifest(export: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((export / MANIFEST_FILE).read_text())
    return content


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("logs", nargs="+", type=Path, help="recordings, or folders of them")
    add("--identify", action="store_true", help="identify them as a whole")
    add("--ticks", type=int, default=0, help="of each recording, from its start (all)")
    add("--target", action="append", help="only this one; may be repeated")
    add("--actuator", type=Path, metavar="FILE", help="of the unit that was recorded")
    add("--into", type=Path, metavar="FOLDER",
        help="measure this export, and write the results into its manifest")  # fmt: skip


def _cases(options: Options) -> list[OnboardCase]:
    given = options.into.resolve() if options.into else None
    names = [str(_manifest(given)["target"])] if given else options.target
    chosen = [_emulator(name) for name in names] if names else EMULATED
    present = [item.target for item in chosen if not missing(item)]
    return [
        OnboardCase(
            str(log), name, str(given or ""), str(options.actuator or ""), options.identify,
            options.ticks,
        )
        for log in _logs(options.logs)
        for name in present
    ]  # fmt: skip


def _logs(paths: Sequence[Path]) -> Iterator[Path]:
    """Recordings with samples."""
    for path in paths:
        logs = [path]
        if path.is_dir():
            logs = sorted(p for p in path.iterdir() if p.suffix in (".blf", ".asc"))
        yield from (log for log in logs if read_recording(log).samples is not None)


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    if options.into is not None:
        _write_manifest(options.into / MANIFEST_FILE, records)
    for emulator in EMULATED if options.into is None else ():
        if missing(emulator):
            yield f"{emulator.target}: not installed: {', '.join(missing(emulator))}\n"
    rows = (_identified_row if options.identify else _replayed_row)(records)
    headings = ("recording", "target", "library, bytes", "ticks")
    if options.identify:
        yield from markdown(
            (*headings, "digits", "Kintas, FSS, FDJ", "model runs", "stack, bytes",
             "million instructions", "most in a slice", f"s at {CLOCK_MHZ:g} MHz"),
            rows,
        )  # fmt: skip
    else:
        yield from markdown(
            (*headings, "ticks that differ", "stack of init, bytes", "stack of push, bytes",
             "instructions of push", "at most"),
            rows,
        )  # fmt: skip


def _label(item: Record) -> tuple[object, ...]:
    return Path(item["log"]).name, item["target"], item["bytes"], item["done"]


def _identified_row(records: Sequence[Record]) -> Iterator[tuple[object, ...]]:
    for item in records:
        digits = "DIFFERENT" if item["differing"] else "same"
        severities = ", ".join(f"{value:.6f}" for value in item["severities"])
        millions = item["millions"]
        effort = ("–", "–", "–")
        if millions:
            effort = (millions, item["longest"], f"{millions / CLOCK_MHZ:.1f}")
        yield *_label(item), digits, severities, item["runs"], item["stack"], *effort


def _replayed_row(records: Sequence[Record]) -> Iterator[tuple[object, ...]]:
    for item in records:
        effort = (item["mean"], item["worst"]) if item["worst"] else ("–", "–")
        yield *_label(item), item["differing"], item["init_stack"], item["stack"], *effort


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


def _any_differs(records: Sequence[Record]) -> bool:
    return any(item["differing"] for item in records)


ONBOARD = Study(
    "onboard",
    "Recordings through the exports of all targets, in emulators: bits, sizes, instructions.",
    _cases, perform, _report, _options, count=None, failed=_any_differs, measures_time=True,
)  # fmt: skip
