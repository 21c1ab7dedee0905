"""Static libraries: the archive format of `ar` with the index that linkers look into."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["archive"]

MAGIC = b"!<arch>\n"
LONGEST_NAME = 15


def archive(name: str, content: bytes, symbols: Sequence[str]) -> bytes:
    """Make a static library of one object file, System V's format, which GNU's tools read.

    Without time, user and mode, so that the same object gives the same library.

    Parameters
    ----------
    name : str
        Of the object file, at most 15 characters.
    content : bytes
        The object file.
    symbols : Sequence[str]
        What it defines.

    Returns
    -------
    bytes
        The library.
    """
    if len(name) > LONGEST_NAME:
        raise ValueError(f"name of an archive's member too long: {name!r}")
    names = b"".join(item.encode() + b"\0" for item in symbols)
    size = 4 + 4 * len(symbols) + len(names)
    size += size % 2
    place = len(MAGIC) + 60 + size
    index = len(symbols).to_bytes(4, "big") + place.to_bytes(4, "big") * len(symbols) + names
    return MAGIC + _member("/", index.ljust(size, b"\0")) + _member(f"{name}/", content)


def _member(name: str, content: bytes) -> bytes:
    head = f"{name:<16}{0:<12}{0:<6}{0:<6}{644:<8}{len(content):<10}`\n".encode()
    return head + content + b"\n" * (len(content) % 2)
