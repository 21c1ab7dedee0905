"""Reading a small file that somebody else wrote: regular ones only, and never more than a limit."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of

__all__ = ["read_small_file"]


def read_small_file(path: Path, limit: int, what: str) -> bytes:
    """Read a whole file; `what` names it in errors, which never quote what is in it.

    A pipe or a device is refused at once, without waiting for its other end.

    Parameters
    ----------
    path : Path
        File to read.
    limit : int
        Most bytes that it may have.
    what : str
        Its kind, for errors.

    Returns
    -------
    bytes
        All of it.

    Raises
    ------
    InputOutputError
        It cannot be read, or is no regular file.
    ConfigurationError
        Larger than `limit` bytes.
    """
    try:
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        handle = os.open(path, flags)
        try:
            regular = stat.S_ISREG(os.fstat(handle).st_mode)
            content = _read(handle, limit + 1) if regular else b""
        finally:
            os.close(handle)
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        reason = reason_of(error)
        raise InputOutputError(f"{what} {path}: {reason}") from None
    if not regular:
        raise InputOutputError(f"{what} {path}: not a regular file")
    if len(content) > limit:
        raise ConfigurationError(f"{what} {path}: larger than {limit} bytes")
    return content


def _read(handle: int, size: int) -> bytes:
    with os.fdopen(handle, "rb", closefd=False) as file:
        return file.read(size)
