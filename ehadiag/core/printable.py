"""Text of others (file names, names in DBC and actuator files) made fit for a terminal and JSON."""

from __future__ import annotations

__all__ = ["plain_name", "printable", "printable_lines", "valid_text"]

LONGEST_NAME = 200
"""Bytes: room for a number and a suffix in the usual 255."""
NOT_IN_NAMES = '/\\:*?"<>|'
"""The separators of paths, and what some file systems refuse."""
ESCAPED_BYTES = range(0xDC80, 0xDD00)
"""How Python holds the bytes of a file name that is not UTF-8."""


def printable(text: str) -> str:
    r"""Write what a terminal could take for a command as its number (`\x1b`), in one line.

    That is every control and format character, and each byte of a name that is not UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(item if item.isprintable() else _number(item) for item in text)


def printable_lines(text: str) -> str:
    """As `printable`, of several lines."""
    return "\n".join(printable(line) for line in text.split("\n"))


def valid_text(text: str) -> str:
    r"""Write each byte of a name that is not UTF-8 as its number (`\xff`): JSON is UTF-8."""
    return "".join(_number(item) if "\ud800" <= item <= "\udfff" else item for item in text)


def plain_name(text: str) -> str:
    """Make a name, such as that of a log without its suffix, the plain name of a file.

    No path, no hidden file, no option: what begins with dots or hyphens begins with `_`.
    """
    kept = "".join(
        item if item.isprintable() and item not in NOT_IN_NAMES else "_" for item in text
    )
    kept = kept.encode()[:LONGEST_NAME].decode(errors="ignore").strip()
    return f"_{kept.lstrip('.-')}" if kept[:1] in ("", ".", "-") else kept


def _number(item: str) -> str:
    code = ord(item)
    if code in ESCAPED_BYTES:
        code -= 0xDC00
    if code <= 0xFF:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code <= 0xFFFF else f"\\U{code:08x}"
