"""Reads the numbers of a command line: each with its range, and what to write instead."""

from __future__ import annotations

import argparse
import math

from ehadiag.core.actuator import MOST_TOLERANCE

__all__ = [
    "count",
    "instant",
    "positive",
    "seed",
    "share",
    "unit_serial",
]

MOST_SERIAL = (1 << 63) - 1
"""That a history can hold."""


def positive(text: str) -> float:
    """Read a number above zero."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: need a number above 0")
    return value


def share(text: str) -> float:
    """Read a tolerance of the actuator's data."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= MOST_TOLERANCE:
        raise argparse.ArgumentTypeError(f"{text!r}: need a share, 0 … {MOST_TOLERANCE:g}")
    return value


def instant(text: str) -> float:
    """Read a number from zero on."""
    return 0.0 if text.strip() in ("0", "0.0") else positive(text)


def count(text: str) -> int:
    """Read a whole number above zero."""
    if not (text.isascii() and text.isdigit()) or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r}: need a whole number above 0")
    return int(text)


def unit_serial(text: str) -> int:
    """Read a serial number of a unit, as far as buses and histories carry them."""
    if not (text.isascii() and text.isdigit()) or len(text) > 19 or int(text) > MOST_SERIAL:
        raise argparse.ArgumentTypeError(
            f"{text!r}: a serial number is a whole number, 0 … {MOST_SERIAL}"
        )
    return int(text)


def seed(text: str) -> int:
    """Read a seed of random numbers."""
    if not (text.isascii() and text.isdigit()) or int(text) >= 1 << 32:
        raise argparse.ArgumentTypeError(f"{text!r}: a seed is a whole number, 0 … 4294967295")
    return int(text)
