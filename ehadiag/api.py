"""Python interface: read recordings, simulate one, diagnose, calibrate a unit.

`import ehadiag` offers these functions. Like the command line, and unlike what lies below, this
module knows bus and simulator; it hands on and computes nothing.
"""

from __future__ import annotations

import logging
import operator
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict

import msgspec

from ehadiag.core.actuator import Actuator, actuator_toml
from ehadiag.request import Request
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import write_file
from firmware_iface.find_test import CandidateTests
from firmware_iface.recording import Recording
from firmware_iface.stored_test import StoredTest

if TYPE_CHECKING:
    from typing import Unpack

    from ehadiag.calibration.unit_models import Calibrated
    from ehadiag.identify.solvers import Solver
    from ehadiag.result import Log, Result
    from ehadiag.setup import PathLike, Setup
    from ehadiag_sim.conditions import Effects, Faults, Sensors
    from firmware_iface.bus_map import BusMap
    from firmware_iface.signals.columns import ColumnMap


def log_if_compiling(*, simulation: bool = False, identification: bool = True) -> None:
    """Compile what is needed; warnings go to standard error where logging is not set up."""
    from ehadiag.compile.libraries import compile_kernels  # noqa: PLC0415 - slow

    logger = logging.getLogger("ehadiag")
    compile_kernels(
        lambda text: logger.warning("ehadiag: %s", text),
        simulation=simulation,
        identification=identification,
    )


def checked_seed(given: int) -> int:
    """Return the seed as a plain number; ConfigurationError where it is none that is allowed."""
    try:
        seed = operator.index(given)
    except TypeError:
        seed = -1
    if not 0 <= seed < 1 << 32:
        raise ConfigurationError(f"seed {given!r}: need a whole number, 0 … 4294967295")
    return seed


RecordingSource: TypeAlias = "Recording | PathLike"
"""A recording, or the log that it is read from."""


def read(
    path: PathLike,
    *,
    mapping: BusMap | PathLike | None = None,
    dbc: PathLike | None = None,
    every: bool = False,
    candidates: CandidateTests | None = None,
    columns: ColumnMap | None = None,
) -> list[Recording]:
    """Read the recording of a test from a log.

    Parameters
    ----------
    path : PathLike
        BLF, ASC, CSV, TRC, candump's `.log`, or MF4 (needs asammdf); decoded signals as
        CSV, Parquet or MF4 (needs pandas); also packed as `.gz`.
    mapping : BusMap | PathLike | None
        Which signals of a DBC are which channels; None: the computer's own bus.
    dbc : PathLike | None
        DBC to use instead of the mapping's own.
    every : bool
        All tests in the log in order of time, not only the last complete one.
    candidates : CandidateTests | None
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
    options = {"mapping": mapping, "dbc": dbc, "every_test": every}
    objects = {"columns": columns, "candidates": candidates}
    given = {name: value for name, value in objects.items() if value is not None}
    setup = setup_for(None, options)
    return list(replace(setup, objects={**setup.objects, **given}).read(path).recordings)


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
    from ehadiag.setup import resolve_actuator, resolve_stored_test  # noqa: PLC0415
    from ehadiag_sim.conditions import Effects, Faults, Sensors  # noqa: PLC0415 - slow
    from ehadiag_sim.simulation import simulate as run  # noqa: PLC0415

    given = {Faults: faults, Effects: effects, Sensors: sensors}
    suffered = [_conditions_of(kind, whole, conditions) for kind, whole in given.items()]
    if conditions:
        known = ", ".join(item.name for kind in given for item in fields(kind))
        raise TypeError(f"simulate: no condition {', '.join(conditions)}; there are {known}")
    stored, seed = resolve_stored_test(test), checked_seed(seed)
    log_if_compiling(simulation=True, identification=False)
    done = run(resolve_actuator(actuator), stored, *suffered, seed=seed)
    return done.recording(f"simulated {stored.name}")


def _conditions_of(kind: type[Any], whole: Any, conditions: dict[str, Any]) -> Any:
    """Take out of the conditions what is of this kind, and make an object of it."""
    named = {
        item.name: conditions.pop(item.name) for item in fields(kind) if item.name in conditions
    }
    if whole is None:
        return kind(**named)
    if named:
        raise TypeError(f"simulate: {', '.join(named)} beside an object {kind.__name__}")
    return whole


class Options(TypedDict, total=False):
    """Keyword arguments of `diagnose`: the fields of `ehadiag.request.Request`."""

    test: StoredTest | PathLike | Iterable[StoredTest | PathLike] | None
    joint: bool
    every_test: bool
    merge: bool
    start_s: float | None
    end_s: float | None
    actuator: Actuator | PathLike | None
    tolerance: float | None
    mapping: BusMap | PathLike | None
    dbc: PathLike | None
    columns: ColumnMap | str | Iterable[str]
    id_offset: int | None
    log_channel: int | None
    max_frames: int
    max_log_size_MiB: float
    max_read_time_s: float
    solver: Solver | str
    nuisances: str
    seed: int
    prior: Result | PathLike | None
    advisory: float
    limit: float
    rule: str
    time_limit_s: float | None


def diagnose(
    sources: RecordingSource | Iterable[RecordingSource] | None = None,
    *,
    request: Request | None = None,
    progress: Callable[[str, float], None] | None = None,
    **options: Unpack[Options],
) -> Result:
    """Diagnose one actuator, from one recording or from several together.

    Parameters
    ----------
    sources : RecordingSource | Iterable[RecordingSource] | None
        A recording, a log, or several of them: then all are of one actuator, and there is one
        estimate from all. Of a log its last complete test is taken, or with `every_test` all; with
        `merge` several logs hold one recording. None: the logs of the request.
    request : Request | None
        What is asked for; None: the usual.
    progress : Callable[[str, float], None] | None
        Called with the stage and its share done, 0 … 1.
    **options : Unpack[Options]
        Fields of the request, by name; they go before those of `request`. `actuator`, `test`,
        `mapping`, `columns`, `solver` and `prior` may be objects.

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
    TypeError
        There is no such option.
    """
    setup = setup_for(request, options)
    named = setup.request.logs if sources is None else _as_list(sources, Recording)
    found: list[Recording] = []
    logs: list[Log | None] = []
    begin = time.perf_counter()
    paths = [os.fspath(item) for item in named if not isinstance(item, Recording)]
    if setup.request.merge and paths:
        named = [item for item in named if isinstance(item, Recording)]
        reading = setup.read(*paths)
        for recording, log in reading.each():
            found.append(recording)
            logs.append(log)
    for item in named:
        if isinstance(item, Recording):
            found.append(item)
            logs.append(None)
        else:
            for recording, log in setup.read(item).each():
                found.append(recording)
                logs.append(log)
    if not found:
        raise ConfigurationError("nothing to diagnose: no recording and no log given")
    read_s = time.perf_counter() - begin if paths else 0.0
    log_if_compiling()
    return setup.diagnose(found, files=paths, logs=logs, read_s=read_s, progress=progress)


def diagnose_many(
    logs: Iterable[PathLike],
    *,
    request: Request | None = None,
    progress: Callable[[str, float], None] | None = None,
    **options: Unpack[Options],
) -> Iterator[Result]:
    """Diagnose each log by itself, one after the other.

    Parameters
    ----------
    logs : Iterable[PathLike]
        Of any actuators.
    request : Request | None
        See `diagnose`.
    progress : Callable[[str, float], None] | None
        See `diagnose`.
    **options : Unpack[Options]
        See `diagnose`.

    Yields
    ------
    Result
        One of each log, with `every_test` of each test in it; where a log cannot be read it has an
        `error`, and the next one follows.

    Raises
    ------
    ConfigurationError
        A file, a name or a value is wrong.
    TypeError
        There is no such option.
    """
    setup = setup_for(request, options)
    log_if_compiling()
    for log in logs:
        yield from setup.each(os.fspath(log), progress=progress)


def setup_for(request: Request | None, options: Mapping[str, Any]) -> Setup:
    """Tell names, which a request has, from objects, which stand beside it."""
    from ehadiag.setup import Setup  # noqa: PLC0415

    given: dict[str, Any] = dict(options)
    known = Request.__struct_fields__
    if unknown := given.keys() - set(known):
        raise TypeError(f"no option {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    objects: dict[str, Any] = {}
    if "test" in given:
        tests = _as_list(given["test"], StoredTest)
        given["test"] = tuple(
            item.name if isinstance(item, StoredTest) else os.fspath(item) for item in tests
        )
        if any(isinstance(item, StoredTest) for item in tests):
            objects["test"] = tests
    for name in ("actuator", "mapping", "columns", "solver", "prior"):
        value = given.get(name)
        plain = value is None or isinstance(value, str | os.PathLike | list | tuple)
        if not plain:
            objects[name] = given.pop(name)
    fields = {} if request is None else msgspec.structs.asdict(request)
    return Setup(Request(**{**fields, **given}), objects)


def calibrate(
    recordings: Iterable[RecordingSource],
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
    recordings : Iterable[RecordingSource]
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
    options = {"actuator": actuator, "test": test, "seed": seed, "mapping": mapping, "dbc": dbc}
    setup = setup_for(None, options)
    found: list[Recording] = []
    for item in _as_list(recordings, Recording):
        found += [item] if isinstance(item, Recording) else setup.read(item).recordings
    if not found:
        raise ConfigurationError("nothing to learn from: no recording and no log given")
    from ehadiag.calibration.calibrate_unit import calibrate as run  # noqa: PLC0415 - loads kernels
    from ehadiag.calibration.calibrate_unit import update_calibration as refine  # noqa: PLC0415

    log_if_compiling()
    learn = refine if update else partial(run, compare=compare)
    return learn(
        found,
        setup.actuator,
        setup.tests,
        default=setup.default,
        seed=setup.request.seed,
        progress=progress,
    )


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
    write_file(Path(path), actuator_toml(actuator), "actuator file")


def _as_list(given: Any, kind: type[Any]) -> list[Any]:
    """Return a list, also of one object or path, or of none."""
    if given is None:
        return []
    return [given] if isinstance(given, (kind, str, os.PathLike)) else list(given)
