"""Replays or identifies recordings through the export of every target: digits, sizes, effort."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import default_actuator
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.core.recording import Recording
from ehadiag.export.library import LIBRARY, export_library
from ehadiag.export.targets import target
from ehadiag_tools.onboard.emulators import EMULATED, Emulator, missing
from ehadiag_tools.onboard.replay import identified, replayed, surrounded, ticks_of, unit_of
from firmware_iface.logs.reader import read_recording

__all__ = ["main"]

SEVERITIES = (0.3, 0.4, 0.2)
REFERENCE = {True: "host", False: "host-unfused"}
"""Whose digits a target must have, by whether it fuses."""
CLOCK_MHZ = 400.0
"""For which a time is estimated, at one instruction a cycle."""


def main(argv: list[str] | None = None) -> int:
    """Print the table; 1 if a digit differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", type=Path, help="recordings, or folders of them")
    parser.add_argument("--identify", action="store_true", help="identify them, whole")
    parser.add_argument("--ticks", type=int, help="of each recording, from its start; default all")
    parser.add_argument("--target", action="append", help="only this one; repeatable")
    arguments = parser.parse_args(argv)
    wanted = set(arguments.target or [item.target for item in EMULATED]) | set(REFERENCE.values())
    work = _identify if arguments.identify else _replay
    with tempfile.TemporaryDirectory() as name:
        exports = _exports(wanted, Path(name))
        different = sum(
            work(log, recording, ticks_of(recording)[: arguments.ticks], exports, Path(name))
            for log, recording in _recordings(arguments.logs)
        )
    return 1 if different else 0


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


def _exports(wanted: set[str], work: Path) -> dict[Emulator, Path]:
    """Export for every target that is wanted and can be run here, hosts first."""
    exports: dict[Emulator, Path] = {}
    for emulator in EMULATED:
        if emulator.target not in wanted:
            continue
        if missing(emulator):
            print(f"{emulator.target}: not installed: {', '.join(missing(emulator))}")
            continue
        out = work / emulator.target
        out.mkdir()
        with Folder.at(out, RESULT_MODE) as folder:
            export_library(default_actuator(), target(emulator.target), folder)
        exports[emulator] = out
        print(f"{emulator.target}: {(out / LIBRARY).stat().st_size} bytes", flush=True)
    return exports


def _reference(emulator: Emulator) -> str:
    return REFERENCE[target(emulator.target).processor.fused]


def _replay(
    log: str,
    recording: Recording,
    ticks: NDArray[np.float64],
    exports: dict[Emulator, Path],
    work: Path,
) -> int:
    """Print a line for each target; how many ticks differ in all."""
    unit, different = unit_of(recording, SEVERITIES), 0
    lines: dict[str, list[str]] = {}
    for emulator, export in exports.items():
        replay = replayed(emulator, export, unit, ticks, work)
        lines[emulator.target] = replay.lines
        pairs = zip(replay.lines, lines[_reference(emulator)], strict=True)
        count = sum(a != b for a, b in pairs)
        different += count
        print(
            f"{log} {emulator.target}: {count} of {len(ticks)} ticks differ,"
            f" stack of init {replay.init_stack}, of push {replay.push_stack} bytes,"
            f" instructions of push {replay.mean_push}, at most {replay.worst_push}",
            flush=True,
        )
    return different


def _identify(
    log: str,
    recording: Recording,
    ticks: NDArray[np.float64],
    exports: dict[Emulator, Path],
    work: Path,
) -> int:
    """Print a line for each target; on how many the result differs."""
    unit, different = surrounded(recording), 0
    bits: dict[str, str] = {}
    for emulator, export in exports.items():
        found = identified(emulator, export, unit, ticks, work)
        bits[emulator.target] = found.bits
        same = found.bits == bits[_reference(emulator)]
        different += not same
        outcome = found.outcome
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
    return different
