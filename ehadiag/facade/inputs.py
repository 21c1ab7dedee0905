"""What files, names and objects that a caller gives stand for: actuator, tests, mapping."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, TypeAlias

from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.stored_test import StoredTest, bundled_tests, resolve_test
from ehadiag.report.asked import LogFile

if TYPE_CHECKING:
    from firmware_iface.mapping.bus_map import BusMap

__all__ = [
    "PathLike",
    "log_file",
    "the_actuator",
    "the_bus_map",
    "the_seed",
    "the_test",
    "the_tests",
]

PathLike: TypeAlias = str | os.PathLike[str]


def log_file(log: PathLike) -> LogFile | None:
    """What can be said of a log without reading it; None where there is none."""
    try:
        info = os.stat(log)
    except (OSError, ValueError):
        return None
    return LogFile(os.path.abspath(os.fspath(log)), info.st_size, info.st_mtime_ns)


def the_actuator(given: Actuator | PathLike | None) -> Actuator:
    """Return the actuator itself, or that of a file (`load_actuator`); None: the reference."""
    if given is None:
        return default_actuator()
    return given if isinstance(given, Actuator) else load_actuator(os.fspath(given))


def the_seed(given: int) -> int:
    """Return the seed as a plain number; ConfigurationError where it is none that is allowed."""
    try:
        seed = operator.index(given)
    except TypeError:
        seed = -1
    if not 0 <= seed < 1 << 32:
        raise ConfigurationError(f"seed {given!r}: need a whole number, 0 … 4294967295")
    return seed


def the_test(given: StoredTest | PathLike) -> StoredTest:
    """Return the test itself, the stored one of that name, or that of a file (`resolve_test`)."""
    return given if isinstance(given, StoredTest) else resolve_test(os.fspath(given))


def the_tests(given: Iterable[StoredTest | PathLike]) -> tuple[StoredTest, ...]:
    """Return the stored tests and the given ones; of one number the one given last."""
    tests = {test.id: test for test in bundled_tests().values()}
    for item in given:
        test = the_test(item)
        tests[test.id] = test
    return tuple(tests.values())


def the_bus_map(mapping: BusMap | PathLike | None, dbc: PathLike | None) -> BusMap:
    """Return the meaning of the bus's frames (`load_map`); None: of the computer's own bus.

    Parameters
    ----------
    mapping : BusMap | PathLike | None
        The meaning itself, or a mapping file.
    dbc : PathLike | None
        DBC to use instead of the mapping file's own; without a mapping file, one with the default
        names.

    Returns
    -------
    BusMap
        What each signal is.

    Raises
    ------
    ConfigurationError
        A DBC beside a meaning, or one of other names without a mapping file.
    """
    from firmware_iface.mapping.bus_map import default_map, load_map  # noqa: PLC0415

    other = None if dbc is None else os.fspath(dbc)
    if isinstance(mapping, str | os.PathLike):
        return load_map(os.fspath(mapping), other)
    if mapping is None:
        return default_map(other)
    if other is not None:
        raise ConfigurationError("dbc: the meaning of the frames is given already")
    return mapping
