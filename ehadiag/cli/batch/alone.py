"""Lets one call at a time work on a file of results."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ehadiag.core.errors import InputOutputError

__all__ = ["alone_with"]


@contextmanager
def alone_with(path: Path) -> Iterator[None]:
    """Hold a file of results while the block runs, by an empty file `NAME.lock` beside it.

    The system lets go of it too where the call is killed.

    Parameters
    ----------
    path : Path
        The file; it need not be there, but its folder must be.

    Raises
    ------
    InputOutputError
        Another call holds it.
    FileNotFoundError
        There is no such folder.
    """
    from filelock import FileLock, Timeout  # noqa: PLC0415 - only who writes such a file

    if not path.parent.is_dir():  # the library would make it
        raise FileNotFoundError(2, "No such file or directory")
    try:
        lock = FileLock(f"{path}.lock", timeout=0).acquire()
    except Timeout:
        raise InputOutputError(
            f"results {path}: another call is writing to it; wait for its end, or name another file"
        ) from None
    with lock:
        yield
