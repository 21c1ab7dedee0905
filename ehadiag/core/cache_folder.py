"""Cache folders of this user only: compiled kernels, contents of DBC files.

What is kept here is trusted when it is read back (compiled kernels are code), so a folder is used
only if nobody but this user and the system's administrator could have put something into it, or
something else in its place: every folder from the root on is theirs, no other user may write to it
(the shared temporary folder, where nobody may move what is another's, will do above one), and
nothing on the way is a link.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from functools import cache
from pathlib import Path

from ehadiag.core.errors import reason_of
from ehadiag.core.folder import BY_DESCRIPTOR, CACHE_MODE, OPEN_FOLDER, Folder, refuse_foreign
from ehadiag.core.printable import printable

__all__ = ["private_folder", "tell"]

FOLDER_MODE = 0o700
ADVICE = "name a folder of your own by EHADIAG_CACHE_DIR"


def private_folder(leaf: str) -> Folder | None:
    """Open the folder `leaf` in the cache, created if need be; None if it cannot be had.

    In `EHADIAG_CACHE_DIR`, else in the user's cache folder. What stands in the way is said once.
    """
    base = _base()
    if base is None:
        tell(f"no home folder is known, so that nothing is kept for the next run: {ADVICE}")
        return None
    try:
        return _open(base / leaf)
    except OSError as error:
        why = reason_of(error)
        tell(f"cache folder {base}: {why}; nothing is kept for the next run: {ADVICE}")
        return None


@cache
def tell(text: str) -> None:
    """Say once in this process that a cache does not do its work; nothing else changes."""
    import logging  # noqa: PLC0415 - loads much, and is seldom needed

    logging.getLogger("ehadiag").warning("ehadiag: %s", printable(text))


def _base() -> Path | None:
    if named := os.environ.get("EHADIAG_CACHE_DIR"):
        return Path(os.path.abspath(named))
    if (xdg := os.environ.get("XDG_CACHE_HOME")) and os.path.isabs(xdg):
        return Path(os.path.normpath(xdg), "ehadiag")
    if home := os.environ.get("HOME"):
        return Path(os.path.abspath(home), ".cache", "ehadiag")
    if local := os.environ.get("LOCALAPPDATA"):  # Windows
        return Path(local, "ehadiag")
    return None


def _open(path: Path) -> Folder:
    """Walk to the folder from the root, and look at each folder on the way.

    Raises
    ------
    OSError: it cannot be had, or others could have changed what is in it.
    """
    if not BY_DESCRIPTOR:
        path.mkdir(parents=True, exist_ok=True)
        return Folder.at(path, CACHE_MODE)
    walked = Path(path.anchor)
    at = os.open(walked, OPEN_FOLDER)
    # Where root has no number of its own (in a container without rights) it still owns the root.
    trusted = {0, os.getuid(), os.fstat(at).st_uid}
    try:
        for part in path.parts[1:]:
            _refuse_shared(os.fstat(at), trusted, walked)
            walked /= part
            inside = _step(at, part, walked)
            os.close(at)
            at = inside
        refuse_foreign(os.fstat(at), stat.S_ISDIR)
    except BaseException:
        os.close(at)
        raise
    return Folder(path, at, CACHE_MODE)


def _step(at: int, name: str, path: Path) -> int:
    """Open a folder in another, created if need be."""
    try:
        try:
            return os.open(name, OPEN_FOLDER, dir_fd=at)
        except FileNotFoundError:
            with contextlib.suppress(FileExistsError):  # another process was quicker
                os.mkdir(name, FOLDER_MODE, dir_fd=at)
            return os.open(name, OPEN_FOLDER, dir_fd=at)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EMLINK, errno.ENOTDIR):
            raise PermissionError(f"{path} is a link, or no folder") from None
        raise


def _refuse_shared(info: os.stat_result, trusted: set[int], path: Path) -> None:
    """Raise PermissionError where another user could exchange what is in a folder on the way."""
    if info.st_uid not in trusted:
        raise PermissionError(f"{path} belongs to another user")
    if info.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not info.st_mode & stat.S_ISVTX:
        raise PermissionError(f"others may write to {path}")
