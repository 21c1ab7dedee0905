"""Errors that a user can fix, each with its exit code."""

from __future__ import annotations

from typing import ClassVar


def reason_of(error: Exception) -> str:
    """Why a file could not be used: the system's own words, without number and name.

    A name that holds a null character raises ValueError, which has none: then its text.
    """
    return getattr(error, "strerror", None) or str(error)


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
