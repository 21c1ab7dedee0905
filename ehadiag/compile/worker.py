"""The process that compiles: what it is given, and how it is run."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import msgspec

from firmware_iface.errors import ConfigurationError, EhadiagError, install_command


class PointerArgument(msgspec.Struct, frozen=True):
    """Argument of a C function whose address the kernel is given."""


class DoublesArgument(msgspec.Struct, frozen=True):
    """Argument of a C function that points to doubles, which the kernel is given as a tuple."""

    count: int
    """How many; 1: a number, not a tuple."""


class TableArgument(msgspec.Struct, frozen=True):
    """Not an argument of the C function: the kernel is given the address of constants."""

    name: str


class SlotArguments(msgspec.Struct, frozen=True):
    """The only argument of a C function that points to all of the kernel's (`ehadiag.compile.jit`).

    The result is written to the first slot.
    """


class CFunction(msgspec.Struct, frozen=True):
    """A C function, `int name(pointer, …)`, and the kernel behind it."""

    name: str
    kernel: Any
    """Decorated kernel that returns a whole number; it takes addresses, numbers and tuples of
    numbers."""
    arguments: SlotArguments | tuple[PointerArgument | DoublesArgument | TableArgument, ...]
    """In the order of the kernel's."""


class Processor(msgspec.Struct, frozen=True):
    """What code is emitted for, in LLVM's names."""

    triple: str
    """Empty: this computer."""
    cpu: str = ""
    """Processor; "host": this one."""
    features: str = ""
    """What it has beyond or less than its name says."""
    abi: str = ""
    """Calling convention, empty: the triple's."""
    shared: bool = False
    """Whether the code may be part of a shared library."""
    rounds: bool = True
    """Whether it rounds to whole numbers by an instruction. Where not, a function of the C library
    would be called, and no Arm code can hand it a number in both calling conventions."""
    roots: bool = True
    """Whether it has an instruction for the square root of doubles."""
    single: bool = False
    """Whether results are rounded to single precision, see `ehadiag.compile.object_code`."""
    fast: bool = False
    """Whether code may be large: loops are unrolled and vectorised."""


class ObjectFile(msgspec.Struct, frozen=True):
    """An object file to be made."""

    functions: Sequence[CFunction]
    """The C functions in it."""
    processor: Processor
    tables: Mapping[str, Sequence[float]] = msgspec.field(default_factory=dict)
    replaced: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Functions of one number of the C library, and the kernels that stand for them."""
    allowed: frozenset[str] = frozenset()
    """What else of the C library the code may call."""
    exact: frozenset[Any] = frozenset()
    """Kernels of which no result is rounded to single precision."""
    lanes: int = 1
    """Candidates that kernels of the model take side by side."""


GROUND_LANES = 16
"""Candidates of a block in a search, 1."""
process_lanes = GROUND_LANES
"""Lanes of the kernels that this process compiles; Python lays out the memory of blocks by it."""


BEGIN = (
    "import pickle, sys;"
    "sys.path[:] = pickle.load(sys.stdin.buffer);"
    "from ehadiag.compile import worker;"
    "worker.process_lanes = pickle.load(sys.stdin.buffer);"
    "worker.main()"
)


def object_code(*wanted: ObjectFile) -> list[bytes]:
    """Make object files in a process of their own, which translates a kernel once for all of them.

    wanted: what is to be in each; of one order of bytes, and of the same lanes. Returns the object
    files, of the formats of their targets. EhadiagError: the compiler is not installed, or has no
    such target; RuntimeError: the compiler has failed.
    """
    if find_spec("numba") is None:
        raise ConfigurationError(
            f"kernels must be compiled: needs numba: {install_command('compile')}"
        )
    import pickle  # noqa: PLC0415 - only where something is compiled
    import subprocess  # noqa: PLC0415

    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_DISABLE_JIT"}
    environment["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"  # of errors that it expects
    done = subprocess.run(
        [sys.executable, "-P", "-c", BEGIN],
        input=b"".join(map(pickle.dumps, (sys.path, wanted[0].lanes, wanted))),
        capture_output=True,
        env=environment,
        check=False,
    )
    if done.returncode != 0 or not done.stdout:
        raise RuntimeError(f"the compiler failed:\n{done.stderr.decode(errors='replace')}")
    made: list[bytes] | EhadiagError = pickle.loads(done.stdout)
    if isinstance(made, EhadiagError):
        raise made
    return made


def main() -> None:
    """Read what is wanted from standard input, write it to standard output."""
    import gc  # noqa: PLC0415 - as above
    import pickle  # noqa: PLC0415

    gc.disable()  # numba's objects live as long as the process: to look for others takes a fifth
    import ehadiag.compile.frontend  # noqa: PLC0415, F401 - first: it keeps numba from the folder
    from ehadiag.compile.object_code import emitted  # noqa: PLC0415

    wanted = pickle.load(sys.stdin.buffer)
    made: list[bytes] | EhadiagError
    try:
        made = [emitted(item) for item in wanted]
    except EhadiagError as error:
        made = error
    sys.stdout.buffer.write(pickle.dumps(made))
