"""Runs many independent jobs on all cores, and resumes where an interrupted run stopped."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import cache
from importlib import resources
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ehadiag.core.errors import EhadiagError, InputOutputError, reason_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["carry_out", "key_of", "perform_all"]

R = TypeVar("R", bound="DataclassInstance")
"""Settings of a run."""
Worker = Callable[[R], dict[str, Any]]

STOPPED = 130
"""Exit code after Ctrl-C."""
CODE = ("ehadiag", "ehadiag_sim", "firmware_iface")
"""Packages on whose sources, those of their own packages too, a result depends."""


def carry_out(tool: str, results: Path, work: Callable[[], int | None]) -> int:
    """Exit code of a tool's work: its own, else 0, or that of an error, which stderr tells."""
    try:
        return work() or 0
    except EhadiagError as error:
        print(f"{tool}: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"{tool}: {error.filename}: {reason_of(error)}", file=sys.stderr)
        return InputOutputError.exit_code
    except KeyboardInterrupt:
        print(f"{tool}: stopped; the same command goes on from {results}", file=sys.stderr)
        return STOPPED


def perform_all(
    worker: Worker[R], runs: Sequence[R], results: Path, jobs: int, label: str
) -> list[dict[str, Any]]:
    """Records of all runs in their order; those that the results file has are taken from there.

    The file has one JSON object a line: `key`, and the record. A line cut short by a kill is
    passed over. Keys hold the settings and a hash of the sources, so that results of another
    state of the code are never mixed in.

    Raises
    ------
    InputOutputError: the results file cannot be read or written.
    """
    name = worker.__name__
    keys = [key_of(name, run) for run in runs]
    try:
        done = _read(results)
        results.parent.mkdir(parents=True, exist_ok=True)
        with results.open("a", encoding="utf-8") as file:
            # A line cut short must not swallow the next one.
            file.write("\n" if results.stat().st_size else "")
            waiting = {key: run for key, run in zip(keys, runs, strict=True) if key not in done}

            def keep(key: str, record: dict[str, Any]) -> None:
                done[key] = record
                file.write(json.dumps({"key": key, **record}) + "\n")
                file.flush()

            with _progress() as progress:
                bar = progress.add_task(label, total=len(runs), completed=len(runs) - len(waiting))
                _work(worker, waiting, jobs, keep, lambda: progress.advance(bar))
    except OSError as error:
        raise InputOutputError(f"results {results}: {reason_of(error)}") from None
    return [done[key] for key in keys]


def _work(
    worker: Worker[R],
    waiting: dict[str, R],
    jobs: int,
    keep: Callable[[str, dict[str, Any]], None],
    advance: Callable[[], None],
) -> None:
    if jobs == 1:
        for key, run in waiting.items():
            keep(key, worker(run))
            advance()
        return
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        # The workers inherit it: one thread each, they already fill the cores.
        os.environ.setdefault(name, "1")
    # "spawn": a fork of a process that shows progress in a thread may hang.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(worker, run): key for key, run in waiting.items()}
        try:
            for future in as_completed(futures):
                keep(futures[future], future.result())
                advance()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def key_of(worker: str, run: DataclassInstance) -> str:
    """Key of a run in the results file."""
    settings = json.dumps([worker, asdict(run), _code_digest()], sort_keys=True)
    return hashlib.sha256(settings.encode()).hexdigest()[:24]


@cache
def _code_digest() -> str:
    digest = hashlib.sha256()
    for package in CODE:
        for source in sorted(Path(str(resources.files(package))).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    if not path.exists():
        return found
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            record = json.loads(line)
            found[record.pop("key")] = record
        except (ValueError, KeyError, AttributeError, TypeError):
            continue
    return found


def _progress() -> Progress:
    """On stderr, so that tables can be redirected."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(file=sys.stderr),
        transient=True,
    )
