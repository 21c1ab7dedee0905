"""Where the health history is: a named file, or the user's own."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["own_history"]

FILE = "history.sqlite"


def own_history() -> Path | None:
    """File of the user's own history, whether or not it exists; None where no home is known.

    In `$XDG_DATA_HOME/ehadiag`, else `~/.local/share/ehadiag`; on Windows in `%LOCALAPPDATA%`.
    """
    if (xdg := os.environ.get("XDG_DATA_HOME")) and os.path.isabs(xdg):
        return Path(xdg, "ehadiag", FILE)
    if home := os.environ.get("HOME"):
        return Path(os.path.abspath(home), ".local", "share", "ehadiag", FILE)
    if local := os.environ.get("LOCALAPPDATA"):  # Windows
        return Path(local, "ehadiag", FILE)
    return None
