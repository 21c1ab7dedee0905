"""`ehadiag --version`: versions of all libraries that affect digits or buses."""

from __future__ import annotations

import argparse
import platform
from typing import Any, NoReturn

import ehadiag

__all__ = ["ShowVersions", "versions"]

LIBRARIES = ("numpy", "numba", "python-can")


class ShowVersions(argparse.Action):
    """Print one line and end: the package's version first, then those of Python and libraries."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        """Print and end; only who asks waits for the look-up."""
        print(versions())
        parser.exit()


def versions() -> str:
    """Return the versions of this package, of Python, and of the libraries that matter."""
    from importlib.metadata import version  # noqa: PLC0415 - reads a file for each library

    parts = [f"Python {platform.python_version()}"]
    parts += [f"{name} {version(name)}" for name in LIBRARIES]
    return f"ehadiag {ehadiag.__version__} ({', '.join(parts)})"
