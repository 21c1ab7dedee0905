"""Compiles a program for an export's target and runs it, in an emulator where it is another's."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from ehadiag.export.targets import Target, target

__all__ = ["EMULATED", "Emulator", "missing", "run_program"]

HERE = Path(__file__).parent
FIRMWARE = HERE.parents[2] / "firmware_iface" / "c"
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2")
MOST_S = 3600.0
"""An emulated identification takes minutes."""
BARE = ("--specs=rdimon.specs", "-Wl,--no-warn-execstack", "-Wl,--no-warn-rwx-segments")


@dataclass(frozen=True, slots=True)
class Emulator:
    """How programs for a target are built and run here.

    Attributes
    ----------
    target : str
        Name of the target.
    compiler : str
        Cross compiler.
    options : tuple[str, ...]
        For it, beside those of the target.
    command : tuple[str, ...]
        What runs a program, its name behind.
    extra : tuple[str, ...]
        C sources that belong to every program.
    """

    target: str
    compiler: str
    options: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()


MPS2 = (
    "qemu-system-arm", "-M", "mps2-an500", "-nographic", "-monitor", "none", "-serial", "null",
    "-semihosting-config", "enable=on,target=native", "-icount", "shift=0", "-kernel",
)  # fmt: skip

M4 = (
    "qemu-system-arm", "-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "null",
    "-semihosting-config", "enable=on,target=native", "-icount", "shift=0", "-kernel",
)  # fmt: skip

EMULATED: tuple[Emulator, ...] = (
    Emulator("host", "cc"),
    Emulator("host-single", "cc"),
    Emulator(
        "cortex-m7",
        "arm-none-eabi-gcc",
        (*BARE, "-DCOUNTED", "-T", str(FIRMWARE / "mps2.ld")),
        MPS2,
        (str(FIRMWARE / "mps2.c"),),
    ),
    Emulator(
        "cortex-m4",
        "arm-none-eabi-gcc",
        (*BARE, "-DCOUNTED", "-T", str(FIRMWARE / "mps2.ld")),
        M4,
        (str(FIRMWARE / "mps2.c"),),
    ),
    Emulator(
        "cortex-m4-single",
        "arm-none-eabi-gcc",
        (*BARE, "-DCOUNTED", "-T", str(FIRMWARE / "mps2.ld")),
        M4,
        (str(FIRMWARE / "mps2.c"),),
    ),
    Emulator("cortex-r5", "arm-none-eabi-gcc", BARE, ("qemu-arm", "-cpu", "max")),
    Emulator("cortex-a53", "aarch64-linux-gnu-gcc", ("-static",), ("qemu-aarch64",)),
    Emulator("riscv64", "riscv64-linux-gnu-gcc", ("-static",), ("qemu-riscv64",)),
    Emulator(
        "powerpc-e500mc", "powerpc-linux-gnu-gcc", ("-static",), ("qemu-ppc", "-cpu", "e500mc")
    ),
)


def missing(emulator: Emulator) -> list[str]:
    """Programs that are not installed, of those that it takes.

    Parameters
    ----------
    emulator : Emulator
        The target's.

    Returns
    -------
    list[str]
        Their names.
    """
    needed = [emulator.compiler, *emulator.command[:1]]
    return [name for name in needed if shutil.which(name) is None]


def run_program(emulator: Emulator, export: Path, program: str, work: Path) -> str:
    """Compile a program of this folder against an export, run it and return what it prints.

    Parameters
    ----------
    emulator : Emulator
        The target's.
    export : Path
        Folder that `ehadiag export` has written.
    program : str
        C source in this folder.
    work : Path
        Folder for what is made; headers of the program may lie there.

    Returns
    -------
    str
        Its standard output.
    """
    kind: Target = target(emulator.target)
    made = work / f"{program}.elf"
    sources = [str(HERE / name) for name in (program, *emulator.extra)]
    subprocess.run(
        [emulator.compiler, *WARNINGS, *kind.flags, f"-I{export}", f"-I{work}", *sources,
         str(export / "libeha.a"), *emulator.options, "-lm", "-o", str(made)],
        check=True, stderr=sys.stderr,
    )  # fmt: skip
    done = subprocess.run(
        [*emulator.command, str(made)], check=True, capture_output=True, text=True, timeout=MOST_S
    )
    return done.stdout
