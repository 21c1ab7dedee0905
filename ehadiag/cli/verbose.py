"""What `-v` tells on the way: versions, options, and what the libraries log."""

from __future__ import annotations

import argparse

from ehadiag.cli.output import say
from ehadiag.cli.version import versions

__all__ = ["tell_all"]


def tell_all(arguments: argparse.Namespace) -> None:
    """Say versions and options, and let what libraries log reach standard error.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.
    """
    import logging  # noqa: PLC0415 - only who wants to see it

    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")
    say(versions())
    told = {key: value for key, value in vars(arguments).items() if key not in ("run", "verbose")}
    say(", ".join(f"{key}={value!r}" for key, value in sorted(told.items())))
