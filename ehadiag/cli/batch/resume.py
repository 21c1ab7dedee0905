"""The JSON-lines file of a call's results, which a later call can go on with."""

from __future__ import annotations

import errno
import json
import os
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple

from ehadiag.cli.batch.alone import alone_with
from ehadiag.cli.batch.job import Job
from ehadiag.core.errors import ConfigurationError, InputOutputError, reason_of
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.folder import RESULT_MODE, Folder, create_file, reopen_file
from ehadiag.facade.inputs import log_file
from ehadiag.report.origin import configuration, package

__all__ = ["Journal"]

MAX_LINE = 1 << 20
MOST_NAMED = 3
"""Reasons that are told of one result."""
WORDS = {
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
Key = tuple[int, str, int, int]
"""Place of the job that found it; path, size and time of the last change of a log."""


class _Line(NamedTuple):
    """A result that an earlier call left."""

    log: str
    failed: bool
    place: tuple[int, int]


class Journal:
    """Results on the disk, one object a line, each there before the next is come to.

    With an earlier call's file, its results stand for the logs that have not changed since, where
    all that decides them is the same: options, actuator, tests, mapping, version. All others, and
    logs that could not be read, are tried again. When the call ends, the file has one call's
    results in the order of the inputs; until then, new ones are added at its end.

    Parameters
    ----------
    name : str
        Of the file.
    jobs : Sequence[Job]
        What is wanted, of each actuator on the bus: results of other options are none of this call.
    resume : bool
        Whether the file may be there already.

    Raises
    ------
    InputOutputError
        The file is there and nobody wants to go on with it; another call uses it; it cannot be
        read or written.
    ConfigurationError
        It holds something else.
    """

    def __init__(self, name: str, jobs: Sequence[Job], *, resume: bool) -> None:
        self._name = name
        self._path = Path(name)
        self._own = [_decisive(job) for job in jobs]
        """What decides the results of each job."""
        self._others: Counter[str] = Counter()
        self._known: dict[Key, list[tuple[int, int]]] = {}
        self._order: list[tuple[int, int]] = []
        self._there: list[_Line] = []
        """What earlier calls left, in its order."""
        self._diagnosed: set[str] = set()
        self._failed: set[str] = set()
        """Logs of this call, by whether they gave a result."""
        self._held = ExitStack()
        try:
            self._held.enter_context(alone_with(self._path))
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

    def found(self, log: str, job: int) -> list[str]:
        """Return the objects of a log that an earlier call diagnosed; none where it must be now."""
        now = log_file(log)
        if now is None:
            return []
        places = self._known.get((job, now.path, now.size, now.modified_ns), [])
        return [self._line(at, size) for at, size in places]

    def add(self, line: str, job: int, *, reused: bool) -> None:
        """Write a result down, or take note of where one that was there already has its place."""
        content = line.encode() + b"\n"
        tree = json.loads(line)
        (self._failed if tree["error"] else self._diagnosed).add(_log_of(tree))
        if reused:
            log = tree["recordings"][0]["log"]
            places = self._known[job, log["path"], log["bytes"], log["modified_ns"]]
            self._order.append(places[log["result"] - 1])
            return
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

    def _is_replaced(self, item: _Line) -> bool:
        return item.log in self._diagnosed or (item.failed and item.log in self._failed)

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
        groups: dict[Key, list[tuple[int, int]]] = {}
        while line := file.readline(MAX_LINE):
            number += 1
            if not line.endswith(b"\n"):
                if len(line) == MAX_LINE:
                    raise ConfigurationError(f"results {self._name}: line {number} is none of ours")
                file.truncate(at)
                break
            tree = self._checked(line, number)
            job = self._job_of(tree)
            if job is not None and tree["error"] is None and len(tree["recordings"]) == 1:
                self._remember(groups, job, tree["recordings"][0]["log"], (at, len(line)))
            self._there.append(_Line(_log_of(tree), bool(tree["error"]), (at, len(line))))
            at += len(line)

    def _remember(
        self,
        groups: dict[Key, list[tuple[int, int]]],
        job: int,
        log: Any,
        place: tuple[int, int],
    ) -> None:
        if log is None:
            return
        key = (job, log["path"], log["bytes"], log["modified_ns"])
        if log["result"] == 1:
            groups[key] = []
        groups.setdefault(key, []).append(place)
        if len(groups[key]) == log["results"]:
            self._known[key] = groups[key]

    def _checked(self, line: bytes, number: int) -> dict[str, Any]:
        """Return an earlier result; ConfigurationError where it is none."""
        try:
            tree: dict[str, Any] = json.loads(line)
            known = tree["schema"] == "ehadiag.diagnosis/2" and "recordings" in tree
            bool(tree["error"]), _flat(tree["configuration"]), tree["package"]["version"]
        except (ValueError, KeyError, TypeError, RecursionError):
            known = False
        if not known:
            raise ConfigurationError(
                f"results {self._name}: line {number} is no object ehadiag.diagnosis/2"
            )
        return tree

    def _job_of(self, tree: dict[str, Any]) -> int | None:
        """Return the job whose result it is; None, and count why, of other options."""
        there = {
            **_flat(tree["configuration"]),
            "actuator": tree.get("actuator_sha256"),
            "version": tree["package"]["version"],
        }
        if there in self._own:
            return self._own.index(there)
        nearest = min(self._own, key=lambda own: len(_differing(own, there)))
        self._others[" and ".join(_differing(nearest, there)[:MOST_NAMED])] += 1
        return None

    def _line(self, at: int, size: int) -> str:
        self._file.seek(at)
        return self._file.read(size).decode().rstrip("\n")


def _log_of(tree: dict[str, Any]) -> str:
    """Path of the log that a result is of."""
    with suppress(KeyError, IndexError, TypeError):
        log = tree["error"]["log"] if tree["error"] else tree["recordings"][0]["log"]
        return str(log["path"])
    return os.path.abspath(str(tree.get("source")))


def _decisive(job: Job) -> dict[str, Any]:
    """All that decides a job's results, but for the logs."""
    return {
        **_flat(json.loads(json.dumps(configuration(job.asked)))),
        "actuator": fingerprint(job.actuator),
        "version": package()["version"],
    }


def _flat(configuration: dict[str, Any]) -> dict[str, Any]:
    """Of a mapping what it says counts, not where its file lies."""
    mapping = configuration["mapping"]
    return {**configuration, "mapping": mapping["sha256"]}


def _differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    keys = [key for key in (*one, *other) if one.get(key, ...) != other.get(key, ...)]
    return [WORDS.get(key, key) for key in dict.fromkeys(keys)]
