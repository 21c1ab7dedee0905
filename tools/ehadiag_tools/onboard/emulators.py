"""Compiles a program for an export's target and runs it, in an emulator where it is another's."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from ehadiag.export.targets import Target, find_target

HERE = Path(__file__).parent
FIRMWARE = HERE.parents[2] / "firmware_iface" / "c"
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2")
TIMEOUT_S = 3600.0
"""Longest time of a program, s; an emulated identification takes minutes."""
BARE = ("--specs=rdimon.specs", "-Wl,--no-warn-execstack", "-Wl,--no-warn-rwx-segments")


@dataclass(frozen=True, slots=True)
class Emulator:
    """How programs for a target are built and run here.

    Options for the cross compiler are beside those of the target; `command` runs a program, its
    name behind; `extra` C sources belong to every program.
    """

    target: str
    compiler: str
    options: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()


def _mps2(name: str, machine: str) -> Emulator:
    """Bare Cortex-M of a board whose instructions QEMU counts."""
    command = (
        "qemu-system-arm", "-M", machine, "-nographic", "-monitor", "none", "-serial", "null",
        "-semihosting-config", "enable=on,target=native", "-icount", "shift=0", "-kernel",
    )  # fmt: skip
    options = (*BARE, "-DCOUNTED", "-T", str(FIRMWARE / "mps2.ld"))
    extra = (str(FIRMWARE / "mps2.c"),)
    return Emulator(name, "arm-none-eabi-gcc", options, command, extra)


EMULATED: tuple[Emulator, ...] = (
    # Static: a linker at run time binds a function in its first call, on the stack of that call.
    Emulator("host", "cc", ("-static",)),
    Emulator("host-single", "cc", ("-static", "-DEHA_SINGLE_HOST")),
    _mps2("cortex-m7", "mps2-an500"),
    _mps2("cortex-m4", "mps2-an386"),
    _mps2("cortex-m4-single", "mps2-an386"),
    Emulator("cortex-r5", "arm-none-eabi-gcc", BARE, ("qemu-arm", "-cpu", "max")),
    Emulator("cortex-a53", "aarch64-linux-gnu-gcc", ("-static",), ("qemu-aarch64",)),
    Emulator("riscv64", "riscv64-linux-gnu-gcc", ("-static",), ("qemu-riscv64",)),
    Emulator(
        "powerpc-e500mc", "powerpc-linux-gnu-gcc", ("-static",), ("qemu-ppc", "-cpu", "e500mc")
    ),
)


def missing(emulator: Emulator) -> list[str]:
    """Names of the programs of an emulator that are not installed."""
    needed = [emulator.compiler, *emulator.command[:1]]
    return [name for name in needed if shutil.which(name) is None]


def run_program(emulator: Emulator, export: Path, program: str, work: Path) -> str:
    """Compile a C source of this folder against an export, run it, return its standard output.

    Headers of the program may lie in `work`, where what is made goes.
    """
    kind: Target = find_target(emulator.target)
    made = work / f"{program}.elf"
    sources = [str(HERE / name) for name in (program, *emulator.extra)]
    subprocess.run(
        [emulator.compiler, *WARNINGS, *kind.flags, f"-I{export}", f"-I{work}", *sources,
         str(export / "libeha.a"), *emulator.options, "-lm", "-o", str(made)],
        check=True, stderr=sys.stderr,
    )  # fmt: skip
    done = subprocess.run(
        [*emulator.command, str(made)],
        check=True,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    return done.stdout
