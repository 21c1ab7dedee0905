"""The calls of the front door: read recordings, simulate one, diagnose, calibrate a unit."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.find_test import Sought
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest
from ehadiag.facade.compiling import log_if_compiling
from ehadiag.facade.inputs import (
    PathLike,
    log_file,
    the_actuator,
    the_bus_map,
    the_seed,
    the_test,
    the_tests,
)
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from ehadiag.assess.verdict import Levels
    from ehadiag.calibration.result import Calibrated
    from ehadiag.core.actuator import Actuator
    from ehadiag.facade.result import Result
    from ehadiag.identify.search.solvers import Solver
    from ehadiag.report.asked import LogFile
    from ehadiag_sim.plant.conditions import Effects, Faults, Sensors
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.signals.columns import ColumnMap

__all__ = ["calibrate", "diagnose", "read", "save_actuator", "simulate"]

Source: TypeAlias = Recording | PathLike
"""A recording, or the log that it is read from."""


def read(
    path: PathLike,
    *,
    mapping: BusMap | PathLike | None = None,
    dbc: PathLike | None = None,
    every: bool = False,
    sought: Sought | None = None,
    columns: ColumnMap | None = None,
) -> list[Recording]:
    """Read the recording of a test from a log.

    Parameters
    ----------
    path : PathLike
        BLF, ASC, CSV, TRC, candump's `.log`, or MF4 (needs `ehadiag[mf4]`); decoded signals as
        CSV, Parquet or MF4 (needs `ehadiag[daq]`); also packed as `.gz`.
    mapping : BusMap | PathLike | None
        Which signals of a DBC are which channels; None: the computer's own bus.
    dbc : PathLike | None
        DBC to use instead of the mapping's own.
    every : bool
        All tests in the log in order of time, not only the last complete one.
    sought : Sought | None
        What to look for where the bus does not say when which test ran; None: the stored tests
        on the reference actuator.
    columns : ColumnMap | None
        Columns of decoded signals (`firmware_iface.signals.columns.load_columns`); None: by
        their names.

    Returns
    -------
    list[Recording]
        At least one; without samples where the log has no test.

    Raises
    ------
    InputOutputError
        The log is missing, unreadable, or not what its suffix says.
    ConfigurationError
        Unknown kind of log; mapping or DBC unfit.
    """
    bus_map = the_bus_map(mapping, dbc)
    from firmware_iface.logs.any_recording import Meaning, recorded_tests  # noqa: PLC0415 - slow
    from firmware_iface.logs.reader import choose  # noqa: PLC0415 - slow

    sought = sought or Sought(the_tests(()), the_actuator(None).controller)
    found = recorded_tests([os.fspath(path)], Meaning(bus_map, columns, sought))
    return list(found) if every else [choose(found)]


def simulate(
    test: StoredTest | PathLike = "closed",
    *,
    actuator: Actuator | PathLike | None = None,
    faults: Faults | None = None,
    effects: Effects | None = None,
    sensors: Sensors | None = None,
    seed: int = 0,
    **conditions: Any,
) -> Recording:
    """Run a stored test on the detailed simulator, from rest.

    Parameters
    ----------
    test : StoredTest | PathLike
        A test, the name of a stored one, or a test file.
    actuator : Actuator | PathLike | None
        Actuator, or its file; None: the reference actuator.
    faults : Faults | None
        Severities; None: as new.
    effects : Effects | None
        What else happens to the actuator; None: nothing.
    sensors : Sensors | None
        How the converters err; None: by their usual noise.
    seed : int
        Of the converters' noise; the same seed gives the same recording.
    **conditions : Any
        Fields of these three, by name: `FSS=0.6, oil_temperature=70.0, noise_lsb=0.0`.

    Returns
    -------
    Recording
        As an acquisition without a fault would hand it over.

    Raises
    ------
    TypeError
        There is no such condition, or its object is given too.
    ConfigurationError
        A value out of its range; test and controller at different rates.
    """
    from ehadiag_sim.plant.conditions import Effects, Faults, Sensors  # noqa: PLC0415 - slow
    from ehadiag_sim.plant.simulator import simulate as run  # noqa: PLC0415

    given = {Faults: faults, Effects: effects, Sensors: sensors}
    suffered = [_merged(kind, whole, conditions) for kind, whole in given.items()]
    if conditions:
        known = ", ".join(item.name for kind in given for item in fields(kind))
        raise TypeError(f"simulate: no condition {', '.join(conditions)}; there are {known}")
    stored, seed = the_test(test), the_seed(seed)
    log_if_compiling(simulation=True, identification=False)
    done = run(the_actuator(actuator), stored, *suffered, seed=seed)
    return done.recording(f"simulated {stored.name}")


def _merged(kind: type[Any], whole: Any, conditions: dict[str, Any]) -> Any:
    """Take out of the conditions what is of this kind, and make an object of it."""
    named = {
        item.name: conditions.pop(item.name) for item in fields(kind) if item.name in conditions
    }
    if whole is None:
        return kind(**named)
    if named:
        raise TypeError(f"simulate: {', '.join(named)} beside an object {kind.__name__}")
    return whole


def diagnose(
    recordings: Source | Iterable[Source],
    *,
    actuator: Actuator | PathLike | None = None,
    test: StoredTest | PathLike | Iterable[StoredTest | PathLike] | None = None,
    levels: Levels | None = None,
    solver: Solver | str = "cga",
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
    mapping: BusMap | PathLike | None = None,
    dbc: PathLike | None = None,
) -> Result:
    """Diagnose one actuator, from one recording or from several together.

    Parameters
    ----------
    recordings : Source | Iterable[Source]
        A recording, a log, or several of them: then all are of one actuator, and there is one
        estimate from all. Of a log its last complete test is taken, see `read`.
    actuator : Actuator | PathLike | None
        Actuator, or its file; None: the reference actuator.
    test : StoredTest | PathLike | Iterable[StoredTest | PathLike] | None
        Further test that a recording may be of, besides the stored ones: a test, a name, a
        file, or several. One alone also stands for recordings whose bus carries no test number.
    levels : Levels | None
        From which severity on an actuator is degraded, or at fault; None: 0.25 and 0.75.
    solver : Solver | str
        `cga`, `pygad`, or a solver.
    seed : int
        Of the search; the same seed gives the same digits on the same machine.
    progress : Callable[[str, float], None] | None
        Called with the stage and its share done, 0 … 1.
    mapping : BusMap | PathLike | None
        Of logs, see `read`.
    dbc : PathLike | None
        Of logs, see `read`.

    Returns
    -------
    Result
        Also where no verdict can be given: it is then `NOT_TESTED`, and `reasons` say why.

    Raises
    ------
    InputOutputError
        A log or a file cannot be read.
    ConfigurationError
        A file, a name or a value is wrong; nothing to diagnose.
    """
    seed = the_seed(seed)
    chosen, (tests, default) = the_actuator(actuator), _tests(test)
    found, begin = [], time.perf_counter()
    bus_map: BusMap | None = None
    logs: list[LogFile | None] = []
    sought = Sought((default,) if default else tests, chosen.controller)
    for item in _several(recordings, Recording):
        if isinstance(item, Recording):
            found.append(item)
            logs.append(None)
            continue
        bus_map = bus_map or the_bus_map(mapping, dbc)
        found += read(item, mapping=bus_map, sought=sought)
        logs.append(log_file(item))
    if not found:
        raise ConfigurationError("nothing to diagnose: no recording and no log given")
    spent = Spent(time.perf_counter() - begin)
    from ehadiag.assess.diagnosis import diagnose as run  # noqa: PLC0415 - loads numba
    from ehadiag.assess.verdict import Levels  # noqa: PLC0415
    from ehadiag.core.fingerprint import fingerprint  # noqa: PLC0415
    from ehadiag.facade.result import Result  # noqa: PLC0415
    from ehadiag.identify.search.solvers import make_solver  # noqa: PLC0415
    from ehadiag.report.asked import Asked  # noqa: PLC0415

    made = make_solver(solver) if isinstance(solver, str) else solver
    log_if_compiling()
    diagnosis = run(
        found,
        chosen,
        tests,
        default=default,
        levels=levels,
        solver=made,
        seed=seed,
        progress=progress,
    )
    asked = Asked(
        solver=made.name,
        seed=seed,
        levels=levels or Levels(),
        mapping=None if bus_map is None else bus_map.name,
        mapping_sha256=None if bus_map is None else fingerprint(bus_map),
        mapping_file=str(mapping) if isinstance(mapping, str | os.PathLike) else None,
        tests_sha256=fingerprint(tuple(tests)),
    )
    return Result(diagnosis, asked, spent, tuple(logs))


def calibrate(
    recordings: Iterable[Source],
    *,
    actuator: Actuator | PathLike | None = None,
    test: StoredTest | PathLike | Iterable[StoredTest | PathLike] | None = None,
    compare: bool = False,
    update: bool = False,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
    mapping: BusMap | PathLike | None = None,
    dbc: PathLike | None = None,
) -> Calibrated:
    """Learn a unit from recordings of it as new.

    `diagnose(…, actuator=calibrated.actuator)` then goes by what was learned;
    `save_actuator` writes it to a file.

    Parameters
    ----------
    recordings : Iterable[Source]
        Recordings or logs of one unit as new, best of both loops; see `read`.
    actuator : Actuator | PathLike | None
        Data of its type, or their file; None: the reference actuator.
    test : StoredTest | PathLike | Iterable[StoredTest | PathLike] | None
        See `diagnose`.
    compare : bool
        Try both second stages, each with one play and with a smooth hysteresis.
    update : bool
        `actuator` is calibrated: refine it by later recordings of the unit, still healthy.
    seed : int
        The same seed gives the same digits on the same machine.
    progress : Callable[[str, float], None] | None
        Called with the stage and its share done, 0 … 1.
    mapping : BusMap | PathLike | None
        Of logs, see `read`.
    dbc : PathLike | None
        Of logs, see `read`.

    Returns
    -------
    Calibrated
        Where it is refused its `actuator` is None, and `reasons` say why.

    Raises
    ------
    InputOutputError
        A log or a file cannot be read.
    ConfigurationError
        A file, a name or a value is wrong; nothing to learn from.
    """
    seed = the_seed(seed)
    start, (tests, default) = the_actuator(actuator), _tests(test)
    found: list[Recording] = []
    for item in _several(recordings, Recording):
        found += [item] if isinstance(item, Recording) else read(item, mapping=mapping, dbc=dbc)
    if not found:
        raise ConfigurationError("nothing to learn from: no recording and no log given")
    from ehadiag.calibration.unit import calibrate as run  # noqa: PLC0415 - loads numba
    from ehadiag.calibration.unit import update as refine  # noqa: PLC0415

    log_if_compiling()
    if update:
        return refine(found, start, tests, default=default, seed=seed, progress=progress)
    return run(found, start, tests, default=default, compare=compare, seed=seed, progress=progress)


def save_actuator(actuator: Actuator, path: PathLike) -> None:
    """Write an actuator's data, with its calibration, to a file that `load_actuator` reads.

    Parameters
    ----------
    actuator : Actuator
        The data.
    path : PathLike
        File to write; one that exists is replaced.

    Raises
    ------
    InputOutputError
        It cannot be written.
    """
    from ehadiag.core.actuator_file import actuator_toml  # noqa: PLC0415 - loads tomli_w
    from ehadiag.core.folder import RESULT_MODE, Folder  # noqa: PLC0415

    try:
        target = Path(path)
        with Folder.at(target.parent, RESULT_MODE, follow=True) as folder:
            folder.write(target.name, actuator_toml(actuator))
    except OSError as error:
        raise InputOutputError(f"actuator file {path}: {reason_of(error)}") from None


def _tests(
    given: StoredTest | PathLike | Iterable[StoredTest | PathLike] | None,
) -> tuple[tuple[StoredTest, ...], StoredTest | None]:
    """Return all tests that a recording may be of, and that of recordings without a number."""
    named = [the_test(item) for item in _several(given, StoredTest)]
    return the_tests(named), named[0] if len(named) == 1 else None


def _several(given: Any, kind: type[Any]) -> list[Any]:
    """Return a list, also of one object or path, or of none."""
    if given is None:
        return []
    return [given] if isinstance(given, (kind, str, os.PathLike)) else list(given)
