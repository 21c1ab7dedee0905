"""Lists the tests of a log; a log that took long to read is listed from an index the next time."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import msgspec

from ehadiag.core.conventions import __version__, fingerprint, start_text
from ehadiag.result import ListedTest
from ehadiag.setup import log_of
from firmware_iface.files import private_folder

if TYPE_CHECKING:
    from ehadiag.api import PathLike
    from ehadiag.setup import Progress, Setup
    from firmware_iface.files import Folder
    from firmware_iface.recording import Recording

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
