"""Loads python-can for reading logs, without asammdf, which it needs for MF4 files alone.

Where asammdf is installed python-can loads it, and pandas with it, at its own import: 80 MB and a
second, whatever the kind of the log. Writers and adapters, which are not as hurried, import `can`
itself.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

__all__ = ["can_library", "mf4_library"]

MF4 = "asammdf"


def can_library() -> ModuleType:
    """Import python-can, unless it is loaded already without asammdf.

    Returns
    -------
    ModuleType
        `can`; its MF4 classes may say that asammdf is missing, see `mf4_library`.
    """
    modules: dict[str, Any] = sys.modules
    if "can" in modules or MF4 in modules:
        return importlib.import_module("can")
    modules[MF4] = None  # as if it were not installed
    try:
        return importlib.import_module("can")
    finally:
        del modules[MF4]


def mf4_library() -> ModuleType:
    """Import python-can's reader and writer of MF4 files with asammdf, where it is installed.

    Returns
    -------
    ModuleType
        `can.io.mf4`.
    """
    library = importlib.import_module("can.io.mf4")
    return library if library.asammdf else importlib.reload(library)
