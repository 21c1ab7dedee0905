"""Small files of others, such as configuration: read up to a limit, and never waited for."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ehadiag.core.errors import InputOutputError

__all__ = ["read_file"]

# Else the opening of a FIFO waits for somebody who writes.
READ = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def read_file(path: Path | str, what: str, most: int) -> bytes:
    """Read up to `most` bytes of a regular file; `what` names it in errors.

    Raises
    ------
    InputOutputError: it cannot be read, or is a folder, a FIFO, a device or the like.
    """
    try:
        descriptor = os.open(path, READ)
        with open(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise InputOutputError(f"{what} {path}: not a regular file")
            return file.read(most)
    except ValueError:
        raise InputOutputError(f"{what} {str(path)!r}: not the name of a file") from None
    except OSError as error:
        raise InputOutputError(f"{what} {path}: {error.strerror or error}") from None
