"""Files that spare a later call its work: results of a call, and the list of tests of a long log.

The results are lines of JSON, written by one call at a time, which a later one resumes. A log that
took long to read is listed from an index the next time.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from ehadiag.core.conventions import MAX_RESULT_BYTES, __version__, fingerprint, start_text
from ehadiag.records import configuration_of, log_of, package
from ehadiag.result import Configuration, ListedTest, Log, Result
from ehadiag.setup import PathLike, Progress, Setup
from firmware_iface.errors import ConfigurationError, InputOutputError, reason_of
from firmware_iface.files import RESULT_MODE, Folder, create_file, private_folder, reopen_file
from firmware_iface.recording import Recording


@contextmanager
def lock_result_file(path: Path) -> Iterator[None]:
    """Hold a file of results while the block runs, by an empty file `NAME.lock` beside it.

    The system lets go of it too where the call is killed.

    path: the file; it need not be there, but its folder must be. InputOutputError: another call
    holds it; FileNotFoundError: there is no such folder.
    """
    from filelock import FileLock, Timeout  # noqa: PLC0415 - only who writes such a file

    if not path.parent.is_dir():  # the library would make it
        raise FileNotFoundError(2, "No such file or directory")
    try:
        lock = FileLock(f"{path}.lock", timeout=0).acquire()
    except Timeout:
        raise InputOutputError(
            f"results {path}: another call is writing to it; wait for its end, or name another file"
        ) from None
    with lock:
        yield


CONFIGURATION_WORDS = {
    "levels": "level of verdicts",
    "nuisances": "choice of nuisances",
    "time_limit_s": "time limit",
    "every_test": "choice of tests (--all)",
    "tests_sha256": "test file",
    "columns_sha256": "meaning of columns",
    "start_s": "start (--start)",
    "end_s": "end (--end)",
}
"""What decides a result, where its key does not say it to people."""
LogKey = tuple[int, str, int, int]
"""Place of the setup that found it; path, size and time of the last change of a log."""


class _StoredLine(msgspec.Struct, frozen=True):
    """A result that an earlier call left."""

    log: str
    failed: bool
    place: tuple[int, int]


class ResultJournal:
    """Results on the disk, one object a line, each there before the next is come to.

    With an earlier call's file, its results stand for the logs that have not changed since, where
    all that decides them is the same: options, actuator, tests, mapping, version. All others, and
    logs that could not be read, are tried again. When the call ends, the file has one call's
    results in the order of the inputs; until then, new ones are added at its end.

    name: of the file; setups: what is wanted, of each actuator on the bus: results of other options
    are none of this call; resume: whether the file may be there already. InputOutputError: the file
    is there and nobody wants to go on with it; another call uses it; it cannot be read or written;
    ConfigurationError: it holds something else.
    """

    def __init__(self, name: str, setups: Sequence[Setup], *, resume: bool) -> None:
        self._name = name
        self._path = Path(name)
        self._own = [_decisive_of(setup) for setup in setups]
        """What decides the results of each setup."""
        self._others: Counter[str] = Counter()
        self._known: dict[LogKey, list[tuple[int, int]]] = {}
        self._order: list[tuple[int, int]] = []
        self._there: list[_StoredLine] = []
        """What earlier calls left, in its order."""
        self._diagnosed: set[str] = set()
        self._failed: set[str] = set()
        """Logs of this call, by whether they gave a result."""
        self._held = ExitStack()
        try:
            self._held.enter_context(lock_result_file(self._path))
            with self._held:  # let go where the file cannot be opened
                self._file = self._open(resume)
                self._held = self._held.pop_all()
        except FileExistsError:
            raise InputOutputError(
                f"results {name}: there is such a file; go on with it by --resume, or name another"
            ) from None
        except OSError as error:
            raise InputOutputError(f"results {name}: {reason_of(error)}") from None

    @property
    def replaced(self) -> str:
        """Say how many earlier results do not count, and why; empty where there are none."""
        if not self._others:
            return ""
        why = ", ".join(f"another {what} ({count})" for what, count in self._others.most_common())
        return (
            f"results {self._name}: {self._others.total()} of an earlier call do not count here and"
            f" are replaced by what is found now: {why}"
        )

    def found(self, log: str, place: int) -> list[Result]:
        """Return the results of a log that an earlier call found; none where it must be now.

        place: of the setup.
        """
        now = log_of(log)
        if now is None:
            return []
        places = self._known.get(_key(place, now), [])
        return [Result.from_json(self._line(at, size)) for at, size in places]

    def add(self, result: Result, place: int, *, reused: bool) -> None:
        """Write a result down, or take note of where one that was there already has its place."""
        (self._failed if result.error else self._diagnosed).add(_path_of(result))
        log = result.origins[0].log if result.origins else None
        if reused and log is not None:
            self._order.append(self._known[_key(place, log)][log.result - 1])
            return
        content = result.to_json().encode() + b"\n"
        try:
            self._file.seek(0, os.SEEK_END)
            at = self._file.tell()
            self._file.write(content)
            self._file.flush()
        except OSError as error:
            raise InputOutputError(f"results {self._name}: {reason_of(error)}") from None
        self._order.append((at, len(content)))

    def settle(self) -> None:
        """Bring the results of this call into the order of its inputs, each once as named.

        Those of other logs stay, before them, and so does what was found of a log that cannot be
        read any more.
        """
        order = [item.place for item in self._there if not self._is_replaced(item)] + self._order
        at = 0
        for start, size in order:
            if start != at:
                break
            at += size
        else:
            self._file.seek(0, os.SEEK_END)
            if at == self._file.tell():
                return
        try:
            with (
                Folder.at(self._path.parent, RESULT_MODE, follow=True) as folder,
                folder.drafted(self._path.name) as file,
            ):
                for start, size in order:
                    file.write(self._line(start, size).encode() + b"\n")
                self._file.close()  # Windows replaces no file that is open
        except OSError as error:
            raise InputOutputError(f"results {self._name}: {reason_of(error)}") from None

    def _is_replaced(self, item: _StoredLine) -> bool:
        return item.log in self._diagnosed or (item.failed and item.log in self._failed)

    def __enter__(self) -> ResultJournal:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._held.close()

    def _open(self, resume: bool) -> BinaryIO:
        if not (resume and os.path.lexists(self._path)):
            return os.fdopen(create_file(self._path), "r+b")
        try:
            file = os.fdopen(reopen_file(self._path), "r+b")
        except OSError as error:
            link = error.errno == errno.ELOOP
            why = "a link, which is not followed" if link else reason_of(error)
            raise InputOutputError(f"results {self._name}: {why}") from None
        try:
            self._index(file)
        except BaseException:
            file.close()
            raise
        return file

    def _index(self, file: BinaryIO) -> None:
        """Find what an earlier call left; what it had only begun to write is cut off."""
        at, number = 0, 0
        groups: dict[LogKey, list[tuple[int, int]]] = {}
        while line := file.readline(MAX_RESULT_BYTES):
            number += 1
            if not line.endswith(b"\n"):
                if len(line) == MAX_RESULT_BYTES:
                    raise ConfigurationError(f"results {self._name}: line {number} is none of ours")
                file.truncate(at)
                break
            result = self._checked(line, number)
            place = self._place_of(result)
            log = result.origins[0].log if len(result.origins) == 1 else None
            if place is not None and result.error is None and log is not None:
                self._remember(groups, _key(place, log), log, (at, len(line)))
            self._there.append(_StoredLine(_path_of(result), bool(result.error), (at, len(line))))
            at += len(line)

    def _remember(
        self,
        groups: dict[LogKey, list[tuple[int, int]]],
        key: LogKey,
        log: Log,
        place: tuple[int, int],
    ) -> None:
        if log.result == 1:
            groups[key] = []
        groups.setdefault(key, []).append(place)
        if len(groups[key]) == log.results:
            self._known[key] = groups[key]

    def _checked(self, line: bytes, number: int) -> Result:
        """Return an earlier result; ConfigurationError where it is none."""
        try:
            return Result.from_json(line)
        except ValueError:
            raise ConfigurationError(
                f"results {self._name}: line {number} is no object ehadiag.diagnosis/3"
            ) from None

    def _place_of(self, result: Result) -> int | None:
        """Return the place of the setup whose result it is; None, and count why, of others."""
        there = _decisive_options(
            result.configuration, result.actuator_sha256, result.package.version
        )
        if there in self._own:
            return self._own.index(there)
        nearest = min(self._own, key=lambda own: len(_differing_options(own, there)))
        self._others[" and ".join(_differing_options(nearest, there)[:3])] += 1
        return None

    def _line(self, at: int, size: int) -> str:
        self._file.seek(at)
        return self._file.read(size).decode().rstrip("\n")


def _key(place: int, log: Log) -> LogKey:
    return place, log.path, log.bytes, log.modified_ns


def _path_of(result: Result) -> str:
    """Path of the log that a result is of."""
    log = result.error.log if result.error else result.origins[0].log if result.origins else None
    return os.path.abspath(result.source) if log is None else log.path


def _decisive_of(setup: Setup) -> dict[str, Any]:
    """All that decides a setup's results, but for the logs."""
    found = configuration_of(setup.request, setup.sources)
    return _decisive_options(found, fingerprint(setup.actuator), package().version)


def _decisive_options(found: Configuration, actuator: str | None, version: str) -> dict[str, Any]:
    """All that decides results; of a mapping what it says counts, not where its file lies."""
    same = {**msgspec.structs.asdict(found), "mapping": found.mapping.sha256}
    return {**same, "actuator": actuator, "version": version}


def _differing_options(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    keys = [key for key in (*one, *other) if one.get(key, ...) != other.get(key, ...)]
    return [CONFIGURATION_WORDS.get(key, key) for key in dict.fromkeys(keys)]


INDEX_FOLDER = "test-lists"
"""Folder in the cache that holds an index for each log."""
MIN_READ_S = 0.5
"""Time of reading, s, from which on a log gets an index; below it the next reading is as fast."""
MAX_INDEXES = 1000
"""Indexes, 1, that are kept; some 200 bytes a test each, the oldest go first."""


def list_tests(
    setup: Setup, *files: PathLike, progress: Progress | None = None
) -> Iterator[ListedTest]:
    """List the tests that one recording holds.

    The list of unchanged files is taken from the cache folder where reading them took long before.

    setup: what the frames mean and which tests there are; *files: files to read; several hold one
    recording; progress: is called with the stage and the share of the file that is read. Yields
    each test, in order of time. InputOutputError: a file cannot be read; ConfigurationError: its
    kind is unknown.
    """
    name = _index_name(setup, files)
    folder = private_folder(INDEX_FOLDER)
    found = None if folder is None else _read_index(folder, name)
    if found is not None:
        yield from found
        return
    begin, tests = time.perf_counter(), []
    for number, recording in enumerate(setup.open(*files, progress=progress), start=1):
        tests.append(_listed(recording, number))
        yield tests[-1]
    # Files that changed meanwhile have another name of their index.
    if (
        folder is not None
        and time.perf_counter() - begin >= MIN_READ_S
        and name == _index_name(setup, files)
    ):
        _write_index(folder, name, tests)


def _listed(item: Recording, number: int) -> ListedTest:
    state, reason = item.outcome.state, item.outcome.reason
    outcome = None if state is None else state.name.lower()
    if state is not None and reason:
        outcome = f"{outcome} ({reason.name.lower().replace('_', ' ')})"
    return ListedTest(
        number=number,
        test=item.test_id,
        start=start_text(item.start_ns),
        length_s=None if item.samples is None else round(item.duration, 3),
        outcome=outcome,
        serial=item.serial,
        channel=item.channel,
        remarks=tuple(item.quality.refused),
    )


def _index_name(setup: Setup, files: tuple[PathLike, ...]) -> str:
    """Name of an index, of all that a list depends on: files, meaning, tests, version."""
    sources, request, budget = setup.sources, setup.request, setup.budget
    content = (
        __version__,
        [log_of(path) for path in files],
        (sources.tests_sha256, sources.columns_sha256, sources.mapping.sha256),
        fingerprint(setup.actuator.controller),
        (request.start_s, request.end_s),
        (budget.frames, budget.size, budget.held),
    )
    return fingerprint(content) + ".json"


def _read_index(folder: Folder, name: str) -> list[ListedTest] | None:
    """Return what an index holds; None without one, or where it is damaged or another user's."""
    with contextlib.suppress(OSError, msgspec.MsgspecError):
        # Some 80 000 tests.
        return msgspec.json.decode(folder.read(name, 16 << 20), type=list[ListedTest])
    return None


def _write_index(folder: Folder, name: str, tests: list[ListedTest]) -> None:
    """Keep a list, and no more lists than `MAX_INDEXES`; a full disk keeps none."""
    with contextlib.suppress(OSError):
        folder.write(name, msgspec.json.encode(tests), synced=False)
        names = folder.names()
        if len(names) > MAX_INDEXES:
            for old in sorted(names, key=folder.changed_at)[: len(names) - MAX_INDEXES]:
                folder.remove(old)
