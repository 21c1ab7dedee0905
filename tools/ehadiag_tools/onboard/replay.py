"""Runs exports for a target, in an emulator where it is another's: recordings, other programs."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.export.targets import Target, find_target
from ehadiag.model.plant import plant_constants, relative_viscosity
from ehadiag.model.registry import FAULTS
from ehadiag.onboard.onboard_memory import OnboardOutcome, set_environment
from firmware_iface.recording import CommandMode, Recording

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


@dataclass(frozen=True, slots=True)
class MonitorReplay:
    """What an exported monitor printed: alarms and numbers of each tick.

    Stacks of its start and of its deepest push, bytes; instructions of a push in the mean, to
    within some dozens, and at most; 0 where they are not counted.
    """

    lines: list[str]
    init_stack: int
    push_stack: int
    mean_push: int
    worst_push: int


@dataclass(frozen=True, slots=True)
class Identified:
    """What an exported identification printed: what it returned, and its results in bits.

    Deepest stack of its calls, bytes; millions of instructions, and those of the longest slice, 0
    where they are not counted.
    """

    bits: str
    stack: int
    millions: int
    longest: int

    @property
    def outcome(self) -> OnboardOutcome:
        """The results as numbers."""
        words = np.array([int(word, 16) for word in self.bits.split()[1:]], dtype=np.uint64)
        return OnboardOutcome(*words.view(np.float64).tolist())


def ticks_of(recording: Recording) -> NDArray[np.float64]:
    """Ticks of a recording as a monitor takes them, shape (n, 5)."""
    s = recording.samples
    assert s is not None
    return np.column_stack([s.command, s.current, s.spool, s.pressure, s.position])


def unit_of(
    recording: Recording, faults: Sequence[float], actuator: Actuator | None = None
) -> tuple[float, ...]:
    """Return what a monitor gets of the unit on a recording; None: the reference actuator."""
    environment, samples = recording.environment, recording.samples
    constants = plant_constants(actuator or default_actuator(), environment)
    degc = None if environment is None else environment.oil_temperature
    closed = samples is not None and samples.mode is CommandMode.POSITION
    viscosity = 1.0 if degc is None else relative_viscosity(degc)
    return (*faults, 0.0, 0.0, viscosity, float(constants.PSR), float(closed))


def surrounded(recording: Recording, actuator: Actuator | None = None) -> tuple[float, ...]:
    """Return what a computer that identifies by itself makes of a recording's surroundings."""
    around = recording.environment
    numbers = np.array(unit_of(recording, [0.0] * len(FAULTS), actuator), dtype=np.float64)
    oil, supply, back = around.oil_temperature, around.supply_pressure, around.return_pressure
    if oil is not None and supply is not None and back is not None:
        set_environment(numbers.ctypes.data, (oil, supply, back))
    return tuple(numbers.tolist())


def replayed(
    emulator: Emulator, export: Path, unit: Sequence[float], ticks: NDArray[np.float64], work: Path
) -> MonitorReplay:
    """Replay ticks, shape (n, 5), through an export on its target; `work`: folder for files."""
    _write_ticks(unit, ticks, work)
    output = run_program(emulator, export, "replay.c", work).splitlines()
    lines = [line.removeprefix("tick ").strip() for line in output if line.startswith("tick ")]
    stacks = {line.split()[0]: int(line.split()[-1]) for line in output if " stack " in line}
    counts = {line.split()[0]: int(line.split()[-1]) for line in output if " count " in line}
    return MonitorReplay(lines, stacks["init"], stacks["push"], counts["mean"], counts["worst"])


def identified(
    emulator: Emulator, export: Path, unit: Sequence[float], ticks: NDArray[np.float64], work: Path
) -> Identified:
    """Identify ticks, shape (n, 5), by an export on its target; `work`: folder for files."""
    _write_ticks(unit, ticks, work)
    output = dict(
        line.split(maxsplit=1)
        for line in run_program(emulator, export, "identify.c", work).splitlines()
    )
    counts = (int(output[name]) for name in ("stack", "millions", "longest"))
    return Identified(output["outcome"], *counts)


def _write_ticks(unit: Sequence[float], ticks: NDArray[np.float64], work: Path) -> None:
    """Write the header that the programs of this folder read."""
    rows = ",\n".join("{" + _words(row) + "}" for row in ticks)
    text = (
        "#include <stdint.h>\n"
        f"static const uint64_t unit_bits[{len(unit)}] = {{{_words(unit)}}};\n"
        f"static const uint64_t tick_bits[{len(ticks)}][5] = {{\n{rows}\n}};\n"
    )
    (work / "ticks.h").write_text(text)


def _words(numbers: Sequence[float] | NDArray[np.float64]) -> str:
    bits = np.asarray(numbers, dtype=np.float64).view(np.uint64)
    return ", ".join(f"0x{word:x}u" for word in bits.tolist())
