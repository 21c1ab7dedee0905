"""Packs named tuples into flat arrays for kernels, and unpacks them, with no indices by hand."""

from __future__ import annotations

from typing import Any

from ehadiag.compile.kernels import inlined
from ehadiag.compile.vector import load, packed

__all__ = ["lane_of", "lane_packer", "lanes_of", "packer", "unpacker"]


def unpacker(kind: Any, start: int = 0) -> Any:
    """Compiled function of an array that makes a named tuple of the numbers from `start`.

    The compiler cannot unroll an array into a tuple; the one line that does so is made from the
    fields.

    Parameters
    ----------
    kind : Any
        Named tuple whose fields are all numbers.
    start : int
        Place of its first field in the array.

    Returns
    -------
    Any
        The function.
    """
    numbers = ", ".join(f"row[{start + index}]" for index in range(len(kind._fields)))
    return _compiled(f"def unpack(row):\n    return kind({numbers})", "unpack", kind)


def packer(kind: Any, start: int = 0) -> Any:
    """Compiled function of an array and a named tuple that writes its numbers from `start`."""
    lines = "".join(
        f"\n    row[{start + index}] = value.{name}" for index, name in enumerate(kind._fields)
    )
    return _compiled(f"def pack(row, value):{lines}", "pack", kind)


def lane_of(kind: Any, first: int, lanes: int) -> Any:
    """Compiled function of an array and a lane that makes a named tuple of that lane's numbers.

    The array holds rows of `lanes` numbers; the fields stand in the rows from `first`.
    """
    numbers = ", ".join(
        f"row[{(first + index) * lanes} + lane]" for index in range(len(kind._fields))
    )
    return _compiled(f"def unpack(row, lane):\n    return kind({numbers})", "unpack", kind)


def lane_packer(kind: Any, first: int, lanes: int) -> Any:
    """Compiled function of an array, a lane and a named tuple that writes the lane's numbers."""
    lines = "".join(
        f"\n    row[{(first + index) * lanes} + lane] = value.{name}"
        for index, name in enumerate(kind._fields)
    )
    return _compiled(f"def pack(row, lane, value):{lines}", "pack", kind)


def lanes_of(kind: Any, first: int, lanes: int) -> Any:
    """Compiled function of an array and a lane: a named tuple of vectors from that lane on."""
    numbers = ", ".join(
        f"load(row, {(first + index) * lanes} + lane)" for index in range(len(kind._fields))
    )
    scope: dict[str, Any] = {"kind": kind, "load": load}
    exec(f"def unpack(row, lane):\n    return kind({numbers})", scope)
    return packed(scope["unpack"])


def _compiled(source: str, name: str, kind: Any) -> Any:
    scope: dict[str, Any] = {"kind": kind}
    exec(source, scope)
    return inlined(scope[name])
