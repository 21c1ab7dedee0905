"""Replays a recording through the monitor of an export and compares it with the package's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.recording import CommandMode, Recording
from ehadiag.model.plant import plant_constants, relative_viscosity
from ehadiag.monitor.prepare import Unit
from ehadiag.onboard.environment import set_environment
from ehadiag.onboard.layout import Outcome
from ehadiag_tools.onboard.emulators import Emulator, run_program

__all__ = [
    "Identified",
    "Replay",
    "identified",
    "replayed",
    "surrounded",
    "ticks_of",
    "unit_of",
]


@dataclass(frozen=True, slots=True)
class Replay:
    """What an exported monitor printed.

    Attributes
    ----------
    lines : list[str]
        Alarms and numbers of each tick.
    init_stack : int
        Bytes of stack that its start took.
    push_stack : int
        The most that a push took.
    mean_push : int
        Instructions of a push in the mean, to within some dozens; 0 where they are not counted.
    worst_push : int
        The most of one push.
    """

    lines: list[str]
    init_stack: int
    push_stack: int
    mean_push: int
    worst_push: int


@dataclass(frozen=True, slots=True)
class Identified:
    """What an exported identification printed.

    Attributes
    ----------
    bits : str
        What it returned, and its results in bits.
    stack : int
        Bytes of stack that its calls took at most.
    millions : int
        Instructions, in millions; 0 where they are not counted.
    """

    bits: str
    stack: int
    millions: int

    @property
    def outcome(self) -> Outcome:
        """The results as numbers."""
        words = np.array([int(word, 16) for word in self.bits.split()[1:]], dtype=np.uint64)
        return Outcome(*words.view(np.float64).tolist())


def ticks_of(recording: Recording) -> NDArray[np.float64]:
    """Ticks of a recording as a monitor takes them.

    Parameters
    ----------
    recording : Recording
        With samples.

    Returns
    -------
    NDArray[np.float64]
        Shape (n, 5).
    """
    s = recording.samples
    assert s is not None
    return np.column_stack([s.command, s.current, s.spool, s.pressure, s.position])


def unit_of(
    recording: Recording, faults: Sequence[float], actuator: Actuator | None = None
) -> Unit:
    """Return what a monitor is told of the unit on a recording; None: the reference actuator."""
    environment, samples = recording.environment, recording.samples
    constants = plant_constants(actuator or default_actuator(), environment)
    degc = None if environment is None else environment.oil_temperature
    closed = samples is not None and samples.mode is CommandMode.POSITION
    viscosity = 1.0 if degc is None else relative_viscosity(degc)
    a, b, c = faults
    return Unit(a, b, c, 0.0, 0.0, viscosity, constants.PSR, float(closed))


def surrounded(recording: Recording, actuator: Actuator | None = None) -> Unit:
    """Return what a computer that identifies by itself makes of a recording's surroundings."""
    around = recording.environment
    numbers = np.array(unit_of(recording, (0.0, 0.0, 0.0), actuator), dtype=np.float64)
    oil, supply, back = around.oil_temperature, around.supply_pressure, around.return_pressure
    if oil is not None and supply is not None and back is not None:
        set_environment(numbers.ctypes.data, (oil, supply, back))
    return Unit(*numbers.tolist())


def replayed(
    emulator: Emulator, export: Path, unit: Unit, ticks: NDArray[np.float64], work: Path
) -> Replay:
    """Replay ticks through an export on its target.

    Parameters
    ----------
    emulator : Emulator
        The target's.
    export : Path
        Folder of the export.
    unit : Unit
        What the monitor is told.
    ticks : NDArray[np.float64]
        Shape (n, 5).
    work : Path
        Folder for what is made.

    Returns
    -------
    Replay
        What was printed.
    """
    _write_ticks(unit, ticks, work)
    said = run_program(emulator, export, "replay.c", work).splitlines()
    lines = [line.removeprefix("tick ").strip() for line in said if line.startswith("tick ")]
    stacks = {line.split()[0]: int(line.split()[-1]) for line in said if " stack " in line}
    counts = {line.split()[0]: int(line.split()[-1]) for line in said if " count " in line}
    return Replay(lines, stacks["init"], stacks["push"], counts["mean"], counts["worst"])


def identified(
    emulator: Emulator, export: Path, unit: Unit, ticks: NDArray[np.float64], work: Path
) -> Identified:
    """Identify ticks by an export on its target.

    Parameters
    ----------
    emulator : Emulator
        The target's.
    export : Path
        Folder of the export.
    unit : Unit
        What the identification is told.
    ticks : NDArray[np.float64]
        Shape (n, 5).
    work : Path
        Folder for what is made.

    Returns
    -------
    Identified
        What was printed.
    """
    _write_ticks(unit, ticks, work)
    said = dict(
        line.split(maxsplit=1)
        for line in run_program(emulator, export, "identify.c", work).splitlines()
    )
    return Identified(said["outcome"], int(said["stack"]), int(said["millions"]))


def _write_ticks(unit: Unit, ticks: NDArray[np.float64], work: Path) -> None:
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
