"""Runs a study: independent cases on all cores, results kept in a file, a report in Markdown.

A study is a frozen dataclass of settings for a case, a function that performs one case, and a
function that makes lines of Markdown of all records. A record holds the settings of its case and
what came of it, in plain numbers and texts, so that it fits a line of JSON.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from joblib import Parallel, delayed, parallel_config
from rich.console import Console
from rich.progress import track

from firmware_iface.errors import ConfigurationError, EhadiagError, InputOutputError, reason_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

C = TypeVar("C", bound="DataclassInstance")
"""Settings of a case."""
Record = dict[str, Any]
Options = argparse.Namespace

INTERRUPTED = 130
"""Exit code after Ctrl-C."""
SOURCES = ("ehadiag", "ehadiag_sim", "firmware_iface", "ehadiag_tools")
"""Packages on whose sources a result depends."""


@dataclass(frozen=True, slots=True)
class Study(Generic[C]):
    """One study.

    `cases` are those that the command line asks for; `perform`, a function of a module so that
    worker processes find it, performs one; `report` makes lines of Markdown of all records in the
    order of the cases. `count` is the default of `--cases`, None where their number is given;
    `counted` what that option counts. A record that `failed` makes the exit code 1. A study that
    `measures_time` of this machine performs its cases one at a time, and keeps nothing.
    """

    name: str
    summary: str
    cases: Callable[[Options], Sequence[C]]
    perform: Callable[[C], Record]
    report: Callable[[Sequence[Record], Options], Iterable[str]]
    add_options: Callable[[argparse.ArgumentParser], None] = lambda _parser: None
    count: int | None = 200
    counted: str = "random cases"
    failed: Callable[[Record], bool] = lambda _record: False
    measures_time: bool = False

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add all options of the study to a parser."""
        self.add_options(parser)
        add = parser.add_argument
        if self.count is not None:
            add("--cases", type=int, default=self.count, help=f"{self.counted} (%(default)d)")
        add("--seed", type=int, default=1, help="of what is drawn at random (%(default)d)")
        add("--output", type=Path, metavar="FILE", help="write the report there, too")
        if not self.measures_time:
            kept = Path("out") / f"{self.name}.jsonl"
            cores = os.cpu_count() or 1
            add("--jobs", type=int, default=cores, help="worker processes (%(default)d)")
            add("--resume", type=Path, metavar="FILE", default=kept,
                help="keep results there and go on from them (%(default)s)")  # fmt: skip


def run_study(study: Study[Any], options: Options) -> int:
    """Perform a study and print its report; exit code 0, 1 if it failed, or that of an error."""
    kept = None if study.measures_time else options.resume
    try:
        for name in ("cases", "jobs"):
            if getattr(options, name, 1) < 1:
                raise ConfigurationError(f"--{name}: need at least 1")
        cases = study.cases(options)
        records = perform_cases(study, cases, kept, getattr(options, "jobs", 1))
        _write_report(study.report(records, options), options.output)
        return int(any(map(study.failed, records)))
    except EhadiagError as error:
        print(f"{study.name}: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"{study.name}: {error.filename}: {reason_of(error)}", file=sys.stderr)
        return InputOutputError.exit_code
    except KeyboardInterrupt:
        where = f"; the same command goes on from {kept}" if kept else ""
        print(f"{study.name}: interrupted{where}", file=sys.stderr)
        return INTERRUPTED


def _write_report(lines: Iterable[str], output: Path | None) -> None:
    written = []
    for line in lines:
        print(line, flush=True)
        written.append(line)
    if output is not None:
        output.write_text("\n".join(written) + "\n", encoding="utf-8")


def perform_cases(
    study: Study[C], cases: Sequence[C], kept: Path | None, jobs: int
) -> list[Record]:
    """Records of all cases in their order; those that the file of results has are taken from it.

    The file has one JSON object a line: `key`, and the record. A line cut short by a kill is passed
    over. Keys hold the settings and a hash of the sources, so that results of two states of the
    code are never mixed. One job performs the cases in this process.
    """
    keys = [case_key(study.name, case) for case in cases]
    done = {} if kept is None else _read(kept)
    pending = {key: case for key, case in zip(keys, cases, strict=True) if key not in done}
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
    with parallel_config("loky", n_jobs=jobs, inner_max_num_threads=1):
        # One thread each: the workers already fill the cores.
        performed = Parallel(batch_size=1, return_as="generator_unordered")(
            delayed(_performed)(study.perform, key, case) for key, case in pending.items()
        )
    # On stderr, so that reports can be redirected; only where someone sees it.
    console = Console(file=sys.stderr)
    shown = track(
        performed, study.name, total=len(cases),
        completed=len(cases) - len(pending), console=console, transient=True,
        disable=not console.is_terminal,
    )  # fmt: skip
    with open(kept or os.devnull, "a", encoding="utf-8") as file:
        # A line cut short must not swallow the next one.
        file.write("\n" if done else "")
        for key, found in shown:
            # Through JSON, so that a record is the same before and after a resumption.
            line = json.dumps({**asdict(pending[key]), **found}, default=str)
            done[key] = json.loads(line)
            file.write(f'{{"key": "{key}", {line[1:]}\n')
            file.flush()
    return [done[key] for key in keys]


def _performed(perform: Callable[[C], Record], key: str, case: C) -> tuple[str, Record]:
    return key, perform(case)


def case_key(study: str, case: DataclassInstance) -> str:
    """Key of a case in a file of results."""
    settings = json.dumps([study, asdict(case), _source_digest()], sort_keys=True, default=str)
    return hashlib.sha256(settings.encode()).hexdigest()[:24]


@cache
def _source_digest() -> str:
    digest = hashlib.sha256()
    for package in SOURCES:
        for source in sorted(Path(str(resources.files(package))).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> dict[str, Record]:
    found: dict[str, Record] = {}
    if path.exists():
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, KeyError, AttributeError, TypeError):
                record = json.loads(line)
                found[record.pop("key")] = record
    return found


def case_of(kind: type[C], options: Options, **own: Any) -> C:
    """Case of a study: its own settings, the others are the options of their names."""
    names = {item.name for item in fields(kind)} - own.keys()
    return kind(**{name: getattr(options, name) for name in names}, **own)


def grouped(records: Iterable[Record], *names: str) -> dict[tuple[Any, ...], list[Record]]:
    """Records by their values of these names, in the order in which these come."""
    out: dict[tuple[Any, ...], list[Record]] = {}
    for record in records:
        key = tuple(tuple(v) if isinstance(v, list) else v for v in map(record.get, names))
        out.setdefault(key, []).append(record)
    return out


def markdown(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """Lines of a table."""
    yield "| " + " | ".join(headings) + " |"
    yield "|" + " --- |" * len(headings)
    for row in rows:
        yield "| " + " | ".join(map(str, row)) + " |"
