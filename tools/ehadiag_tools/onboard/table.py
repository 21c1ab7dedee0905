"""Replays recordings through the export of every target: digits, sizes and stack, as a table."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from ehadiag.core.actuator import default_actuator
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.export.library import LIBRARY, export_library
from ehadiag.export.targets import target
from ehadiag_tools.onboard.emulators import EMULATED, missing
from ehadiag_tools.onboard.replay import replayed, ticks_of, unit_of
from firmware_iface.logs.reader import read_recording

__all__ = ["main"]

SEVERITIES = (0.3, 0.4, 0.2)
REFERENCE = {True: "host", False: "host-unfused"}
"""Whose digits a target must have, by whether it fuses."""


def main(argv: list[str] | None = None) -> int:
    """Print the table; 1 if a digit differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", type=Path, help="folder of recordings, or one of them")
    parser.add_argument("--ticks", type=int, help="of each recording, from its start; default all")
    parser.add_argument("--target", action="append", help="only this one; repeatable")
    arguments = parser.parse_args(argv)
    logs = [arguments.logs]
    if arguments.logs.is_dir():
        logs = sorted(p for p in arguments.logs.iterdir() if p.suffix in (".blf", ".asc"))
    wanted = set(arguments.target or [item.target for item in EMULATED]) | set(REFERENCE.values())
    different = 0
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        exports: dict[str, Path] = {}
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
            exports[emulator.target] = out
            print(f"{emulator.target}: {(out / LIBRARY).stat().st_size} bytes")
        for log in logs:
            recording = read_recording(log)
            if recording.samples is None:
                continue
            ticks, unit = ticks_of(recording)[: arguments.ticks], unit_of(recording, SEVERITIES)
            lines: dict[str, list[str]] = {}
            for emulator in EMULATED:
                if emulator.target not in exports:
                    continue
                replay = replayed(emulator, exports[emulator.target], unit, ticks, work)
                lines[emulator.target] = replay.lines
                same = lines[REFERENCE[target(emulator.target).processor.fused]]
                pairs = zip(replay.lines, same, strict=True)
                count = sum(a != b for a, b in pairs)
                different += count
                print(
                    f"{log.name} {emulator.target}: {count} of {len(ticks)} ticks differ,"
                    f" stack of init {replay.init_stack}, of push {replay.push_stack} bytes,"
                    f" instructions of push {replay.mean_push}, at most {replay.worst_push}",
                    flush=True,
                )
    return 1 if different else 0
