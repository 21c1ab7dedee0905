"""Replays or identifies recordings through the export of every target: digits, sizes, effort."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.recording import Recording
from ehadiag.export.library import LIBRARY, MANIFEST, export_library
from ehadiag.export.targets import target
from ehadiag_tools.onboard.emulators import EMULATED, Emulator, missing
from ehadiag_tools.onboard.replay import identified, replayed, surrounded, ticks_of, unit_of
from firmware_iface.logs.reader import read_recording

__all__ = ["REFERENCE", "main"]

SEVERITIES = (0.3, 0.4, 0.2)
REFERENCE = {False: "host", True: "host-single"}
"""Whose digits a target must have, by whether it is of single precision."""
CLOCK_MHZ = 400.0
"""For which a time is estimated, at one instruction a cycle."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One recording on one target.

    Attributes
    ----------
    log : str
        Name of the recording.
    target : str
        Name of the target.
    ticks : int
        Of the recording, that were gone through.
    same : bool
        Whether its digits are those of the reference.
    counts : Mapping[str, Any]
        Instructions, by their key in a manifest; empty where they are not counted.
    """

    log: str
    target: str
    ticks: int
    same: bool
    counts: Mapping[str, Any]


def main(argv: list[str] | None = None) -> int:
    """Print the table; 1 if a digit differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", type=Path, help="recordings, or folders of them")
    parser.add_argument("--identify", action="store_true", help="identify them, whole")
    parser.add_argument("--ticks", type=int, help="of each recording, from its start; default all")
    parser.add_argument("--target", action="append", help="only this one; repeatable")
    parser.add_argument(
        "--actuator", type=Path, metavar="FILE", help="of the unit that was recorded"
    )
    parser.add_argument(
        "--into", type=Path, metavar="DIR", help="measure this export, and tell its manifest"
    )
    arguments = parser.parse_args(argv)
    wanted = set(arguments.target or [item.target for item in EMULATED]) | set(REFERENCE.values())
    given = {}
    if arguments.into is not None:
        own = str(_manifest(arguments.into)["target"])
        given, wanted = {own: arguments.into.resolve()}, {own, *REFERENCE.values()}
    work = _identify if arguments.identify else _replay
    measured: list[Measured] = []
    actuator = default_actuator()
    if arguments.actuator is not None:
        actuator = load_actuator(arguments.actuator)
    with tempfile.TemporaryDirectory() as name:
        exports = _exports(wanted, actuator, Path(name), given)
        if len({_manifest(export)["plan"] for export in exports.values()}) > 1:
            parser.error("--into: an export of another actuator than the recordings' own")
        for log, recording in _recordings(arguments.logs):
            ticks = ticks_of(recording)[: arguments.ticks]
            measured += work(log, actuator, recording, ticks, exports, Path(name))
    if arguments.into is not None:
        _tell(arguments.into / MANIFEST, [item for item in measured if item.target in given])
    return 0 if all(item.same for item in measured) else 1


def _recordings(named: list[Path]) -> Iterator[tuple[str, Recording]]:
    """Recordings with samples, and their names."""
    for path in named:
        logs = [path]
        if path.is_dir():
            logs = sorted(p for p in path.iterdir() if p.suffix in (".blf", ".asc"))
        for log in logs:
            recording = read_recording(log)
            if recording.samples is not None:
                yield log.name, recording


def _manifest(export: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((export / MANIFEST).read_text())
    return content


def _tell(manifest: Path, measured: list[Measured]) -> None:
    """Write what was measured into the manifest of an export."""
    content = _manifest(manifest.parent)
    facts = content["measured"]
    facts["bit_equality"] = {
        item.log: f"{'same' if item.same else 'different'} over {item.ticks} ticks"
        for item in measured
    }
    for key in ("instructions_of_push", "instructions_of_identification"):
        counts = {item.log: item.counts[key] for item in measured if key in item.counts}
        facts[key] = counts or facts[key]
    manifest.write_text(json.dumps(content, indent=2) + "\n")


def _exports(
    wanted: set[str], actuator: Actuator, work: Path, given: Mapping[str, Path]
) -> dict[Emulator, Path]:
    """Export for every target that is wanted and can be run here, hosts first."""
    exports: dict[Emulator, Path] = {}
    for emulator in EMULATED:
        if emulator.target not in wanted:
            continue
        if missing(emulator):
            print(f"{emulator.target}: not installed: {', '.join(missing(emulator))}")
            continue
        out = given.get(emulator.target, work / emulator.target)
        if emulator.target not in given:
            out.mkdir()
            with Folder.at(out, RESULT_MODE) as folder:
                export_library(actuator, target(emulator.target), folder)
        exports[emulator] = out
        print(f"{emulator.target}: {(out / LIBRARY).stat().st_size} bytes", flush=True)
    return exports


def _reference(emulator: Emulator) -> str:
    return REFERENCE[target(emulator.target).processor.single]


def _replay(
    log: str,
    actuator: Actuator,
    recording: Recording,
    ticks: NDArray[np.float64],
    exports: dict[Emulator, Path],
    work: Path,
) -> Iterator[Measured]:
    """Print a line for each target."""
    unit = unit_of(recording, SEVERITIES, actuator)
    lines: dict[str, list[str]] = {}
    for emulator, export in exports.items():
        replay = replayed(emulator, export, unit, ticks, work)
        lines[emulator.target] = replay.lines
        pairs = zip(replay.lines, lines[_reference(emulator)], strict=True)
        count = sum(a != b for a, b in pairs)
        worst = {"mean": replay.mean_push, "worst": replay.worst_push}
        counts = {"instructions_of_push": worst} if replay.worst_push else {}
        yield Measured(log, emulator.target, len(ticks), count == 0, counts)
        print(
            f"{log} {emulator.target}: {count} of {len(ticks)} ticks differ,"
            f" stack of init {replay.init_stack}, of push {replay.push_stack} bytes,"
            f" instructions of push {replay.mean_push}, at most {replay.worst_push}",
            flush=True,
        )


def _identify(
    log: str,
    actuator: Actuator,
    recording: Recording,
    ticks: NDArray[np.float64],
    exports: dict[Emulator, Path],
    work: Path,
) -> Iterator[Measured]:
    """Print a line for each target."""
    unit = surrounded(recording, actuator)
    bits: dict[str, str] = {}
    for emulator, export in exports.items():
        found = identified(emulator, export, unit, ticks, work)
        bits[emulator.target] = found.bits
        same = found.bits == bits[_reference(emulator)]
        outcome = found.outcome
        millions = {"millions": found.millions, "runs": int(outcome.runs)}
        counts = {"instructions_of_identification": millions} if found.millions else {}
        yield Measured(log, emulator.target, len(ticks), same, counts)
        effort = ""
        if found.millions:
            seconds = found.millions / CLOCK_MHZ
            effort = (
                f", {found.millions} million instructions: {seconds:.1f} s at {CLOCK_MHZ:g} MHz"
                " and one instruction a cycle"
            )
        print(
            f"{log} {emulator.target}: {'same bits' if same else 'DIFFERENT BITS'},"
            f" {outcome.Kintas:.6f} {outcome.FSS:.6f} {outcome.FDJ:.6f},"
            f" {outcome.runs:.0f} runs of the model, stack {found.stack} bytes{effort}",
            flush=True,
        )
