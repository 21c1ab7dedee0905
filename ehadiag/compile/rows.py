"""Named tuples of numbers as parts of a flat array inside kernels, no field counted by hand."""

from __future__ import annotations

from typing import Any

from ehadiag.compile.kernels import inlined

__all__ = ["packer", "unpacker"]


def unpacker(kind: Any, start: int = 0) -> Any:
    """Compiled function of an array that makes a named tuple of the numbers from `start`.

    The compiler cannot unroll an array into a tuple; the one line that does so is made from the
    fields.

    Parameters
    ----------
    kind : type
        Named tuple whose fields are all numbers.
    start : int
        Place of its first field in the array.
    """
    numbers = ", ".join(f"row[{start + index}]" for index in range(len(kind._fields)))
    return _compiled(f"def unpack(row):\n    return kind({numbers})", "unpack", kind)


def packer(kind: Any, start: int = 0) -> Any:
    """Compiled function of an array and a named tuple that writes its numbers from `start`."""
    lines = "".join(
        f"\n    row[{start + index}] = value.{name}" for index, name in enumerate(kind._fields)
    )
    return _compiled(f"def pack(row, value):{lines}", "pack", kind)


def _compiled(source: str, name: str, kind: Any) -> Any:
    scope: dict[str, Any] = {"kind": kind}
    exec(source, scope)
    return inlined(scope[name])
