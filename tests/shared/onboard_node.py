"""The node that diagnoses itself: built for this computer or a bare Cortex-M7, and started."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.export.targets import find_target
from ehadiag_tools.onboard.replay import BARE, EMULATED, FIRMWARE, WARNINGS
from firmware_iface.bus_map import default_map
from firmware_iface.recording import Recording

__all__ = ["BareNode", "bare_node", "build_bare_node", "build_node", "write_played"]

MACHINE = (
    "qemu-system-arm", "-M", "mps2-an500", "-display", "none", "-monitor", "none",
    "-serial", "pty", "-semihosting-config", "enable=on,target=native", "-kernel",
)  # fmt: skip
BOARD = ("diagnosis.c", "played.c", "samples.c", "check.c", "frames.c", "link.c", "node.c",
         "stored_tests.c", "generated/eha_fcc.c", "mps2.c", "main_mps2.c")  # fmt: skip
CHANNELS = ("current", "spool", "pressure", "position")


def write_played(recording: Recording, folder: Path) -> None:
    """Write `played_codes.h`, what the converters of a recorded test read.

    A lost code is the last one before it.
    """
    samples, around = recording.samples, recording.environment
    assert samples is not None
    columns = [_codes(f"channels.{name}", getattr(samples, name)) for name in CHANNELS]
    rows = ",\n".join(
        "    {" + ", ".join(map(str, row)) + "}" for row in zip(*columns, strict=True)
    )
    rig = [
        _codes(f"environment.{name}", np.array([getattr(around, name)], dtype=np.float64))[0]
        for name in ("supply_pressure", "return_pressure", "oil_temperature")
    ]
    (folder / "played_codes.h").write_text(
        "#include <stdint.h>\n"
        f"#define PLAYED_RIG {{{rig[0]}, {rig[1]}, {rig[2]}, false}}\n"
        f"#define PLAYED_SERIAL {recording.serial or 0}\n"
        f"static const uint16_t played_codes[{len(columns[0])}][4] = {{\n{rows}\n}};\n"
    )


def _codes(role: str, values: NDArray[np.float64]) -> list[int]:
    """Raw numbers of a role's signal."""
    found = default_map().find(role)
    assert found is not None
    item = found[1]
    raw = np.rint(((values - item.bias) / item.gain - item.signal.offset) / item.signal.scale)
    known = np.flatnonzero(np.isfinite(raw))
    filled = raw[known[np.maximum(np.searchsorted(known, np.arange(len(raw)), "right") - 1, 0)]]
    return [int(value) for value in filled]


def build_node(export: Path, work: Path, *options: str) -> Path:
    """Build `fcc-diagnosing` for this computer from an export and `played_codes.h` in `work`."""
    made = work / "fcc-diagnosing"
    subprocess.run(
        ["make", "-s", "-C", str(FIRMWARE), f"OUT={work}", f"EHA={export}", f"PLAYED={work}",
         f"CFLAGS={' '.join(('-O2', *options))}", str(made)],
        check=True, stdout=sys.stderr,
    )  # fmt: skip
    return made


def build_bare_node(export: Path, work: Path, *options: str) -> Path:
    """Build the node for QEMU's Cortex-M7, like `build_node`."""
    made = work / "node.elf"
    emulator = next(item for item in EMULATED if item.target == "cortex-m7")
    sources = [str(FIRMWARE / name) for name in BOARD]
    subprocess.run(
        [emulator.compiler, *WARNINGS, *find_target("cortex-m7").flags, "-ffp-contract=off",
        *options,
         f"-I{export}", f"-I{work}", *sources, str(export / "libeha.a"), *BARE,
         "-T", str(FIRMWARE / "mps2.ld"), "-lm", "-o", str(made)],
        check=True, stderr=sys.stderr,
    )  # fmt: skip
    return made


@dataclass(slots=True)
class BareNode:
    """A node in the emulator.

    Attributes
    ----------
    line : str
        Pseudo-terminal that is its serial link.
    lines : list[str]
        Lines that it has printed by semihosting so far.
    """

    line: str
    lines: list[str] = field(default_factory=list)

    @property
    def found(self) -> list[float]:
        """Severities, deviations, offsets and verdict of its last result, to the last bit."""
        results = [line for line in self.lines if line.startswith("found ")]
        words = np.array([int(word, 16) for word in results[-1].split()[1:]], dtype=np.uint64)
        numbers: list[float] = words.view(np.float64).tolist()
        return numbers


@contextmanager
def bare_node(program: Path) -> Iterator[BareNode]:
    """Run a node in the emulator while the block runs."""
    process = subprocess.Popen(
        [*MACHINE, str(program)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    first = process.stdout.readline()
    named = re.search(r"(/dev/\S+)", first)
    if named is None:
        process.kill()
        raise RuntimeError(f"{MACHINE[0]}: {first.strip()}")
    node = BareNode(named[1])
    reader = threading.Thread(target=lambda: node.lines.extend(process.stdout or ()))
    reader.start()
    try:
        yield node
    finally:
        process.kill()
        process.wait()
        reader.join()
        process.stdout.close()
