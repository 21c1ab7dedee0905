"""Cache folders of this user only: compiled kernels, contents of DBC files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

__all__ = ["private_folder"]


def private_folder(leaf: str) -> Path | None:
    """Return the folder `leaf` in the cache, created if need be; None if it can be had nowhere.

    In `EHADIAG_CACHE_DIR`, else the user's cache folder, else a folder of this user's own below the
    system's temporary folder.
    """
    return next((base / leaf for base in _candidates() if _usable(base / leaf)), None)


def _candidates() -> Iterator[Path]:
    if named := os.environ.get("EHADIAG_CACHE_DIR"):
        yield Path(named)
    if xdg := os.environ.get("XDG_CACHE_HOME"):
        yield Path(xdg) / "ehadiag"
    if home := os.environ.get("HOME"):
        yield Path(home) / ".cache" / "ehadiag"
    import tempfile  # noqa: PLC0415 - loads much, and is seldom needed

    owner = os.getuid() if hasattr(os, "getuid") else "user"
    yield Path(tempfile.gettempdir()) / f"ehadiag-{owner}"


def _usable(folder: Path) -> bool:
    """Create the folder; it must be writable and, as what is in it is trusted, nobody else's."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        info = folder.stat()
    except OSError:
        return False
    ours = not hasattr(os, "getuid") or info.st_uid == os.getuid()
    return ours and os.access(folder, os.W_OK)
