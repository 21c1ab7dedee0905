"""Errors that a user can fix, each with its exit code, and the text of others made fit to print."""

from __future__ import annotations

import re
import sys
from typing import ClassVar


def reason_of(error: Exception) -> str:
    """Why a file could not be used: the system's own words, without number and name.

    A name that holds a null character raises ValueError, which has none: then its text.
    """
    return getattr(error, "strerror", None) or str(error)


def install_command(extra: str) -> str:
    """Return the command that adds the packages of an optional feature to this installation.

    It names the packages themselves: right after an installation from a folder, a wheel or an
    index. The installer is the environment's own: pipx, pip, or uv where there is no pip.

    extra: name of the feature in the package's metadata.
    """
    from importlib.metadata import PackageNotFoundError, requires  # noqa: PLC0415 - 20 ms to load
    from importlib.util import find_spec  # noqa: PLC0415

    try:
        wanted = requires("ehadiag") or []
    except PackageNotFoundError:  # not installed: run from its folder
        wanted = []
    marker = re.compile(rf"""extra == ['"]{re.escape(extra)}['"]""")
    packages = [item.split(";")[0].strip() for item in wanted if marker.search(item)]
    words = " ".join(f"'{item}'" for item in packages) or f"'.[{extra}]'"
    if "pipx" in sys.prefix:
        return f"pipx inject ehadiag {words}"
    return f"{'pip' if find_spec('pip') else 'uv pip'} install {words}"


class EhadiagError(Exception):
    """Base of all errors of the package; the text is one line: what, where, how to mend."""

    exit_code: ClassVar[int] = 3


class ConfigurationError(EhadiagError):
    """Wrong usage or configuration: an option, actuator, test, DBC or mapping file."""

    exit_code: ClassVar[int] = 2


class InputOutputError(EhadiagError):
    """A file, a bus or a serial port could not be read or written."""

    exit_code: ClassVar[int] = 3


class BusLostError(InputOutputError):
    """The bus failed while it was in use."""


class NotTestedError(EhadiagError):
    """No verdict can be given: refused, aborted, data missing or unfit."""

    exit_code: ClassVar[int] = 30


FORBIDDEN_NAME_CHARACTERS = '/\\:*?"<>|'
"""The separators of paths, and what some file systems refuse."""


def printable(text: str) -> str:
    r"""Write what a terminal could take for a command as its number (`\x1b`), in one line.

    That is every control and format character, and each byte of a name that is not UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(item if item.isprintable() else _escaped(item) for item in text)


def printable_lines(text: str) -> str:
    """As `printable`, of several lines."""
    return "\n".join(printable(line) for line in text.split("\n"))


def valid_text(text: str) -> str:
    r"""Write each byte of a name that is not UTF-8 as its number (`\xff`): JSON is UTF-8."""
    return "".join(_escaped(item) if "\ud800" <= item <= "\udfff" else item for item in text)


def plain_name(text: str) -> str:
    """Make a name, such as that of a log without its suffix, the plain name of a file.

    No path, no hidden file, no option: what begins with dots or hyphens begins with `_`.
    """
    kept = "".join(
        item if item.isprintable() and item not in FORBIDDEN_NAME_CHARACTERS else "_"
        for item in text
    )
    # Room for a number and a suffix in the usual 255 bytes.
    kept = kept.encode()[:200].decode(errors="ignore").strip()
    return f"_{kept.lstrip('.-')}" if kept[:1] in ("", ".", "-") else kept


def _escaped(item: str) -> str:
    code = ord(item)
    # How Python holds the bytes of a file name that is not UTF-8.
    if code in range(0xDC80, 0xDD00):
        code -= 0xDC00
    if code <= 0xFF:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code <= 0xFFFF else f"\\U{code:08x}"
