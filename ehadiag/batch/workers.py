"""The recordings that a call names, and the processes or Dask cluster that work on them."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from ehadiag.batch.result_files import is_result_table
from ehadiag.core.conventions import SIGNAL_FILE_SUFFIXES
from ehadiag.core.interruption import children_with_safe_path
from firmware_iface.errors import ConfigurationError, InputOutputError, install_command, reason_of

if TYPE_CHECKING:
    from distributed import Client

STANDARD_INPUT_NAME = "-"
MAX_LIST_BYTES = 64 << 20
"""A list of a hundred thousand long names is a tenth of it."""


class LogInput(msgspec.Struct, frozen=True):
    """One recording to diagnose."""

    name: str
    """As it was named, or as it was found."""
    why: str = ""
    """Why there is none; empty for a recording."""


def expand_logs(names: Iterable[str], report: Callable[[str], None]) -> list[LogInput]:
    """Return the recordings that arguments stand for, in their order and as often as named.

    A folder stands for all recordings in it and below, in the order of their names, but not for
    hidden ones, what lies in hidden folders or behind links, and tables and signals of results; a
    pattern (`*`, `?`, `[…]`, `**`), where there is no file of that name, for what it matches; `-`
    for the names on standard input, one a line, or ended by null characters.

    names: arguments of the command; report: takes a sentence on what of a folder is left out. A
    name that stands for no recording is in the list too, with the reason. ConfigurationError: the
    list on standard input is longer than any list of names.
    """
    return [
        item
        for name in names
        for path in (_names_on_standard_input() if name == STANDARD_INPUT_NAME else [name])
        for item in _expand_path(path, report)
    ]


def _expand_path(name: str, report: Callable[[str], None]) -> Iterator[LogInput]:
    if os.path.isdir(name):
        yield from _expand_folder(name, report)
    elif glob.has_magic(name) and not os.path.lexists(name):
        matches = sorted(glob.glob(name, recursive=True))
        for match in matches:
            if os.path.isdir(match):
                yield from _expand_folder(match, report)
            else:
                yield LogInput(match)
        if not matches:
            yield LogInput(name, f"pattern {name}: matches no file")
    else:
        yield LogInput(name)


def _expand_folder(folder: str, report: Callable[[str], None]) -> Iterator[LogInput]:
    from firmware_iface.logs.log_files import kind_of, known_suffixes  # noqa: PLC0415

    known = known_suffixes()
    links: list[str] = []
    inside = []
    closed: list[OSError] = []
    for place, folders, names in os.walk(folder, onerror=closed.append):
        folders[:] = [name for name in folders if not name.startswith(".")]
        links += [path for name in folders if os.path.islink(path := os.path.join(place, name))]
        inside += [
            os.path.join(place, name)
            for name in names
            if not name.startswith(".") and kind_of(Path(name)) in known
        ]
    ours = [name for name in inside if is_result_table(Path(name))]
    signals = [name for name in inside if name.endswith(SIGNAL_FILE_SUFFIXES)]
    for left_out, why in (
        (links, "a link to a folder is not followed, name the folder to read it"),
        (ours, "a table of results is no recording"),
        (signals, "signals of a result are no recording"),
    ):
        if left_out:
            more = f" and {len(left_out) - 1} more" if len(left_out) > 1 else ""
            report(f"folder {folder}: {why}: {min(left_out)}{more}")
    recordings = sorted(set(inside).difference(ours, signals))
    for error in closed:
        yield LogInput(error.filename, f"folder {error.filename}: {reason_of(error)}")
    if not recordings and not closed:
        yield LogInput(folder, f"folder {folder}: no recording in it ({', '.join(sorted(known))})")
    yield from map(LogInput, recordings)


def _names_on_standard_input() -> list[str]:
    """Names on standard input."""
    stream = getattr(sys.stdin, "buffer", None)
    if stream is None:  # a text put in its place
        content = sys.stdin.read(MAX_LIST_BYTES + 1)
    else:
        content = os.fsdecode(stream.read(MAX_LIST_BYTES + 1))
    if len(content) > MAX_LIST_BYTES:
        raise ConfigurationError(f"standard input: more than {MAX_LIST_BYTES} bytes of names")
    lines = content.split("\0") if "\0" in content else content.splitlines()
    return [line for line in lines if line.strip()]


Given = TypeVar("Given")
Made = TypeVar("Made")


def worker_count(count: int) -> int:
    """Return how many workers so many inputs are worth on this machine; 1: none beside this."""
    from joblib import cpu_count  # noqa: PLC0415

    # Inputs that make a worker of one's own worth its start.
    return max(1, min(int(cpu_count()), count // 8))


class Workers:
    """Processes of this machine, or those of a Dask cluster that is already there.

    A worker that dies takes nothing with it: what it had not delivered is done again, and an
    input that ends a worker twice, the second time alone, is given up.

    jobs: processes; on a cluster it has no meaning; cluster: address of the cluster's scheduler;
    None: this machine.
    """

    def __init__(self, jobs: int, cluster: str | None = None) -> None:
        self._jobs = jobs
        self._stack = ExitStack()
        self._client: Client | None = None
        self._stack.enter_context(children_with_safe_path())
        if cluster is not None:
            self._client = self._stack.enter_context(_dask_client(cluster))
            self._jobs = max(1, sum(self._client.nthreads().values()))

    @property
    def count(self) -> int:
        """Workers at the same time."""
        return self._jobs

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def over(
        self,
        work: Callable[[Given], Made],
        inputs: Sequence[Given],
        give_up: Callable[[Given], Made],
    ) -> Generator[Made, None, None]:
        """Give what the function makes of each input, in order.

        So many are under way at once that the workers are busy, and no more: memory does not grow
        with the number of inputs.

        work: function, which can be sent to another process; give_up: what stands for an input that
        ends each process which takes it.
        """
        at = 0
        while at < len(inputs):
            # Under way, or waiting for those before them.
            part = inputs[at : at + 128 * self._jobs]
            try:
                for made in self._run(work, part):
                    at += 1
                    yield made
            except BrokenExecutor:
                # One of those that were under way did it.
                for given in inputs[at : at + self._jobs]:
                    at += 1
                    yield self._alone(work, given, give_up)

    def _alone(
        self,
        work: Callable[[Given], Made],
        given: Given,
        give_up: Callable[[Given], Made],
    ) -> Made:
        try:
            (made,) = self._run(work, [given])
        except BrokenExecutor:
            return give_up(given)
        return made

    def _run(
        self, work: Callable[[Given], Made], part: Sequence[Given]
    ) -> Generator[Made, None, None]:
        if self._client is not None:
            yield from _run_on_cluster(self._client, work, part)
            return
        from joblib import Parallel, delayed, parallel_config  # noqa: PLC0415

        # One process more than none: joblib would else work in this one.
        with parallel_config("loky", n_jobs=max(self._jobs, 2), inner_max_num_threads=1):
            parallel = Parallel(return_as="generator", batch_size=1, pre_dispatch="2*n_jobs")
            with closing(parallel(delayed(work)(item) for item in part)) as made:
                yield from made


def _dask_client(address: str) -> Any:
    try:
        from distributed import Client  # noqa: PLC0415 - optional, and slow
    except ImportError:
        raise ConfigurationError(f"--cluster: needs Dask: {install_command('dask')}") from None
    try:
        return Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:  # OSError is also that nobody answers in time
        why = " ".join(str(error).split())
        raise InputOutputError(f"cluster {address}: {why or 'no scheduler answers'}") from None


def _run_on_cluster(
    client: Client, work: Callable[[Given], Made], part: Sequence[Given]
) -> Generator[Made, None, None]:
    """Run on the cluster; what a worker that dies had in hand, the scheduler gives to others."""
    from distributed.scheduler import KilledWorker  # noqa: PLC0415

    futures = client.map(work, part, pure=False)
    try:
        for future in futures:
            yield future.result()
            future.release()
    except KilledWorker as error:
        raise BrokenExecutor(str(error)) from None
    finally:
        client.cancel(futures)
