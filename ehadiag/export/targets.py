"""Target computers of an export, and the library files that are made for them.

Static libraries are written here in the format of `ar`, with the index that linkers read. Shared
libraries come from the C compiler of this computer. Object files for 32-bit Arm are marked for
either calling convention of floating-point numbers: the exported functions take pointers and
return an integer, which both pass alike (Tag_ABI_VFP_args = 3, Addenda to the ABI for the Arm
Architecture, 2.3.6); numba's compiler emits only one.
"""

from __future__ import annotations

import os
import shlex
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import msgspec
from msgspec.structs import replace

from ehadiag.compile.worker import Processor
from firmware_iface.errors import ConfigurationError, InputOutputError, install_command

AR_MAGIC = b"!<arch>\n"


def static_library(name: str, content: bytes, symbols: Sequence[str]) -> bytes:
    """Make a static library of one object file in System V's format, which GNU's tools read.

    The name has at most 15 characters; symbols are those that the object file defines. The library
    has no time, user or mode, so that the same object gives the same library.
    """
    if len(name) > 15:
        raise ValueError(f"name of an archive's member too long: {name!r}")
    names = b"".join(item.encode() + b"\0" for item in symbols)
    size = 4 + 4 * len(symbols) + len(names)
    size += size % 2
    place = len(AR_MAGIC) + 60 + size
    index = len(symbols).to_bytes(4, "big") + place.to_bytes(4, "big") * len(symbols) + names
    return AR_MAGIC + _member("/", index.ljust(size, b"\0")) + _member(f"{name}/", content)


def _member(name: str, content: bytes) -> bytes:
    head = f"{name:<16}{0:<12}{0:<6}{0:<6}{644:<8}{len(content):<10}`\n".encode()
    return head + content + b"\n" * (len(content) % 2)


ELF_32_LITTLE = b"\x7fELF\x01\x01"
ARM_ATTRIBUTES_SECTION_TYPE = 0x70000003
"""Type of the section with attributes of Arm code (SHT_ARM_ATTRIBUTES)."""
HALF_FLOAT_TAG = b"\x26\x01"
"""Tag_ABI_FP_16bit_format = IEEE: no such numbers are in the code, so that its place is free."""
EITHER_CONVENTION_TAG = b"\x1c\x03"


def mark_either_convention(code: bytes) -> bytes:
    """Mark an object file of a 32-bit Arm, of the same length; others are returned as they are.

    A file without a place for the mark is a ValueError.
    """
    if not code.startswith(ELF_32_LITTLE):
        return code
    (table,) = struct.unpack_from("<I", code, 32)
    size, count = struct.unpack_from("<HH", code, 46)
    for index in range(count):
        _, kind, _, _, start, length = struct.unpack_from("<6I", code, table + index * size)
        if kind == ARM_ATTRIBUTES_SECTION_TYPE:
            place = code.rindex(HALF_FLOAT_TAG, start, start + length)
            return code[:place] + EITHER_CONVENTION_TAG + code[place + len(EITHER_CONVENTION_TAG) :]
    return code


COMPILER_WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


def c_compiler() -> list[str] | None:
    """Return the command that runs the C compiler: `$CC`, else `cc`; None where there is none."""
    command = shlex.split(os.environ.get("CC") or "cc")
    return command if command and shutil.which(command[0]) else None


def cross_compiler(triple: str) -> list[str]:
    """Return the command that runs Zig's C compiler for a computer, in Zig's names.

    ConfigurationError: it is not installed.
    """
    if find_spec("ziglang") is None:
        raise ConfigurationError(
            f"binaries for other computers: need ziglang: {install_command('cross')}"
        )
    return [sys.executable, "-P", "-m", "ziglang", "cc", "-target", triple, "-s"]


def link_shared(
    compiler: Sequence[str],
    name: str,
    sources: Mapping[str, bytes],
    options: Sequence[str] = (),
) -> bytes:
    """Make a shared library of C sources and object files.

    compiler: command that runs it; name: of the library, by which the loader will know it; sources:
    C sources, headers and object files by name; options: for the compiler. Returns the library.
    InputOutputError: the compiler failed; its first line says why.
    """
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as place:
        for file, content in sources.items():
            Path(place, file).write_bytes(content)
        parts = [file for file in sources if not file.endswith(".h")]
        command = [
            *compiler, *COMPILER_WARNINGS, "-O2", "-fPIC", "-shared", *options, *parts,
            "-o", name, f"-Wl,-soname,{name}", "-Wl,-z,noexecstack", "-lm",
        ]  # fmt: skip
        done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            why = (done.stderr or done.stdout).strip().splitlines() or ["no reason given"]
            raise InputOutputError(f"{shlex.join(compiler)}: {why[0]}")
        return Path(place, name).read_bytes()


class Target(msgspec.Struct, frozen=True):
    """A computer, for the compiler that is in numba and for that of the user."""

    name: str
    """As the command line has it."""
    meaning: str
    """For people."""
    processor: Processor
    """For numba's compiler."""
    flags: tuple[str, ...] = ()
    """Of GCC, with which what calls the library is compiled."""


HOST = Processor("", shared=True, rounds=False)
"""Any processor of this computer's kind, by the instructions that all of them have: x86-64 without
extensions rounds by a function."""
TARGETS: tuple[Target, ...] = (
    Target("host", "any computer of this kind", HOST),
    Target(
        "host-single",
        "any computer of this kind, results rounded to single precision as on cortex-m4-single",
        replace(HOST, single=True),
    ),
    Target(
        "cortex-m7",
        "Arm Cortex-M7 with double precision, bare",
        Processor("thumbv7em-none-eabihf", "cortex-m7"),
        ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16"),
    ),
    Target(
        "cortex-m4",
        "Arm Cortex-M4F, bare; doubles in software",
        Processor("thumbv7em-none-eabihf", "cortex-m4", rounds=False, roots=False),
        ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    ),
    Target(
        "cortex-m4-single",
        "Arm Cortex-M4F, bare; arithmetic in single precision",
        Processor("thumbv7em-none-eabihf", "cortex-m4", rounds=False, single=True),
        ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    ),
    Target(
        "cortex-r5",
        "Arm Cortex-R5F, bare",
        Processor("armv7r-none-eabihf", "cortex-r5", rounds=False),
        ("-mcpu=cortex-r5", "-mfloat-abi=hard", "-mfpu=vfpv3-d16"),
    ),
    Target(
        "cortex-a53",
        "Arm Cortex-A53, 64 bits, Linux",
        Processor("aarch64-unknown-linux-gnu", "cortex-a53"),
        ("-mcpu=cortex-a53",),
    ),
    Target(
        "riscv64",
        "RISC-V RV64GC, Linux",
        Processor("riscv64-unknown-linux-gnu", "generic-rv64", "+m,+a,+f,+d,+c", "lp64d"),
        ("-march=rv64gc", "-mabi=lp64d"),
    ),
    Target(
        "powerpc-e500mc",
        "Freescale e500mc, 32 bits, big-endian, Linux",
        Processor("powerpc-unknown-linux-gnu", "e500mc", rounds=False, roots=False),
        ("-mcpu=e500mc",),
    ),
)


def find_target(name: str) -> Target:
    """Return the target of a name; an unknown one is a ConfigurationError."""
    for item in TARGETS:
        if item.name == name:
            return item
    raise ConfigurationError(
        f"target {name!r}: need one of {', '.join(item.name for item in TARGETS)}"
    )
