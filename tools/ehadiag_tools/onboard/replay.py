"""Replays a recording through the monitor of an export and compares it with the package's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.model.plant import plant_constants, relative_viscosity
from ehadiag.model.registry import FAULTS
from ehadiag.onboard.onboard_memory import OnboardOutcome, set_environment
from ehadiag_tools.onboard.emulators import Emulator, run_program
from firmware_iface.recording import CommandMode, Recording


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


def _bits(numbers: Sequence[float] | NDArray[np.float64]) -> list[int]:
    values: list[int] = np.asarray(numbers, dtype=np.float64).view(np.uint64).tolist()
    return values


def _words(numbers: Sequence[float] | NDArray[np.float64]) -> str:
    return ", ".join(f"0x{bits:x}u" for bits in _bits(numbers))
