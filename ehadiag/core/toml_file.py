"""Reads TOML configuration files into checked, frozen structures."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from ehadiag.core.errors import ConfigurationError
from ehadiag.core.small_file import read_small_file

__all__ = ["MAX_BYTES", "decode_toml", "read_toml"]

MAX_BYTES = 256 << 10
"""Largest configuration file that is read; configuration is untrusted input."""
MAX_DOTS = 50
"""In a line, besides those of numbers: the parser's work grows with the square of a key's parts."""
NUMBER = re.compile(rb"\d\.\d[\d_]*(?:[eE][+-]?\d+)?(?=[\s,\]}]|$)")
PLACE = re.compile(r"\(at line (\d+), column (\d+)\)$")

T = TypeVar("T")


def read_toml(path: Path, kind: type[T], what: str) -> T:
    """Read a TOML file into a msgspec structure.

    Parameters
    ----------
    path : Path
        File to read.
    kind : type[T]
        Structure that it is checked against.
    what : str
        Name of the kind of file, for errors.

    Returns
    -------
    T
        The content.

    Raises
    ------
    InputOutputError
        The file cannot be read, or is no regular file.
    ConfigurationError
        Too large, not TOML, or not what `kind` demands.
    """
    return decode_toml(read_small_file(path, MAX_BYTES, what), kind, f"{what} {path}")


def decode_toml(text: bytes, kind: type[T], where: str) -> T:
    """Decode TOML bytes into `kind`; `where` begins each error text."""
    if len(text) > MAX_BYTES:
        raise ConfigurationError(f"{where}: larger than {MAX_BYTES} bytes, not a configuration")
    if any(line.count(b".") > MAX_DOTS for line in NUMBER.sub(b"", text).split(b"\n")):
        raise ConfigurationError(f"{where}: a line with more than {MAX_DOTS} dots, besides numbers")
    try:
        tree = tomllib.loads(text.decode("utf-8"))
        _refuse_non_finite(tree, where, "$")
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{where}: {_one_line(error)}") from None
    except (ValueError, RecursionError) as error:  # a number may have too many digits
        raise ConfigurationError(f"{where}: not valid TOML{_place(error)}") from None


def _refuse_non_finite(node: Any, where: str, at: str) -> None:
    if isinstance(node, dict):
        for key, value in node.items():
            _refuse_non_finite(value, where, f"{at}.{key}")
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _refuse_non_finite(value, where, f"{at}[{index}]")
    elif isinstance(node, float) and not math.isfinite(node):
        raise ConfigurationError(f"{where}: a finite number is needed at {at}, not {node}")


def _place(error: Exception) -> str:
    """Where the parser stumbled, without a word of what stands there: it may be any file."""
    found = PLACE.search(str(error))
    return f" at line {found[1]}, column {found[2]}" if found else ""


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
