"""Shared libraries by the C compiler of this computer, which the package itself does not bring."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from ehadiag.core.errors import InputOutputError

__all__ = ["c_compiler", "link_shared"]

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


def c_compiler() -> list[str] | None:
    """Return the command that runs the C compiler: `$CC`, else `cc`; None where there is none."""
    command = shlex.split(os.environ.get("CC") or "cc")
    return command if command and shutil.which(command[0]) else None


def link_shared(
    compiler: Sequence[str],
    name: str,
    sources: Mapping[str, bytes],
    options: Sequence[str] = (),
) -> bytes:
    """Make a shared library of C sources and object files.

    Parameters
    ----------
    compiler : Sequence[str]
        Command that runs it.
    name : str
        Of the library, by which the loader will know it.
    sources : Mapping[str, bytes]
        C sources, headers and object files by name.
    options : Sequence[str]
        For the compiler.

    Returns
    -------
    bytes
        The library.

    Raises
    ------
    InputOutputError
        The compiler failed; its first line says why.
    """
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as place:
        for file, content in sources.items():
            Path(place, file).write_bytes(content)
        parts = [file for file in sources if not file.endswith(".h")]
        command = [
            *compiler, *WARNINGS, "-O2", "-fPIC", "-shared", *options, *parts,
            "-o", name, f"-Wl,-soname,{name}", "-Wl,-z,noexecstack", "-lm",
        ]  # fmt: skip
        done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            why = (done.stderr or done.stdout).strip().splitlines() or ["no reason given"]
            raise InputOutputError(f"{compiler[0]}: {why[0]}")
        return Path(place, name).read_bytes()
