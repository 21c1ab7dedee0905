#!/usr/bin/env python3
"""Fuzz C code in its own process: `python tools/fuzz/native.py fcc|onboard FOLDER [RUNS [SEED]]`.

fcc: the firmware side of the bus; onboard: a library of `ehadiag export` for this computer. New
inputs go to the folder; tests/data/fuzz is read too. A finding: docs/maintainers/fuzz.md.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
FIRMWARE = HERE.parents[1] / "firmware_iface" / "c"
CORPUS = HERE.parents[1] / "tests" / "data" / "fuzz"
TRACED = ("frames", "link", "node", "samples")
UNTRACED = ("check", "stored_tests", "generated/eha_fcc")
"""Sources in which each bit or each sine is a branch, or none is."""
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
OPTIONS = ("-std=gnu99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{HERE}")


def main() -> int:
    """Run until a finding, or as often as wanted."""
    if not 3 <= len(sys.argv) <= 5:
        raise SystemExit(__doc__)
    target, folder, *numbers = sys.argv[1:]
    runs, seed = (*numbers, *("1000000", "1")[len(numbers) :])
    Path(folder).mkdir(parents=True, exist_ok=True)
    names = [*(CORPUS / target).glob("*"), *Path(folder).glob("*")]
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as place:
        program = build(target, Path(place), ("-fsanitize=undefined",))
        done = subprocess.run(
            [program, seed, runs, folder], input="\n".join(map(str, names)), text=True, check=False
        )
    return done.returncode


def build(target: str, place: Path, options: Sequence[str]) -> Path:
    """Compile a target with the compiler's options into a folder, and return the program."""
    if target == "onboard":
        from ehadiag import default_actuator  # noqa: PLC0415 - not for the firmware alone
        from ehadiag.export.library import export_library  # noqa: PLC0415
        from ehadiag.export.targets import find_target  # noqa: PLC0415
        from firmware_iface.files import RESULT_MODE, Folder  # noqa: PLC0415

        with Folder.at(place, RESULT_MODE) as folder:
            export_library(default_actuator(), find_target("host"), folder)
        parts: list[Path] = [place / "libeha.a"]
        options = (*options, f"-I{place}")
    else:
        parts = []
        for name in (*TRACED, *UNTRACED):
            trace = ("-fsanitize-coverage=trace-pc",) * (name in TRACED)
            parts.append(place / f"{Path(name).name}.o")
            command = ["cc", "-std=c99", "-O2", *options, *trace, "-c", FIRMWARE / f"{name}.c"]
            subprocess.run([*command, "-o", parts[-1]], check=True)
        options = (*options, f"-I{FIRMWARE}")
    return compiled([HERE / f"{target}.c", *parts], place / f"fuzz-{target}", options)


def compiled(parts: Sequence[Path], program: Path, options: Sequence[str] = ()) -> Path:
    """Compile sources, and link them with object files and `native.c`; return the program."""
    command = ["cc", *OPTIONS, *options, HERE / "native.c", *parts, "-lm", "-o", program]
    subprocess.run(command, check=True)
    return program


if __name__ == "__main__":
    raise SystemExit(main())
