"""Study of a large health history: time and memory of the questions put to it.

Each question is a process of its own, from start to end. The history is of simulated diagnoses with
a complete result each, 50 a unit, appended by a hundred units at a time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace

import ehadiag
from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, Usage, history_entry
from ehadiag.history.store import History
from ehadiag_tools.bench import COMMAND, WATCH
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.errors import InputOutputError

DIAGNOSES = 50
"""Number of diagnoses of a unit: one every 100 h."""
UNITS = 100
"""Number of units that are appended together."""
REPEATS = 4
"""Number of times that a question is put; the first one fills the caches of the system."""
UNIT = 7
"""Serial number of the unit that is asked for."""
QUESTIONS = {
    "help": ("--help",),
    "one row": ("history", "show", "301"),
    "list of one unit": ("history", "list", "--unit", f"{UNIT}"),
    "picture of one unit": ("history", "plot", "--unit", f"{UNIT}", "--out"),
    "remaining life of one unit": ("rul", "--unit", f"{UNIT}"),
    "export of one unit": ("history", "export", "--unit", f"{UNIT}"),
}
"""Command lines by question; the picture is written beside the history."""


@dataclass(frozen=True, slots=True)
class QuestionCase:
    """A question, the number of diagnoses in the history, its folder, seed of the severities."""

    question: str
    diagnoses: int
    folder: str
    seed: int


def perform(case: QuestionCase) -> Record:
    """Put one question; the history is made where it is not there yet."""
    path = Path(case.folder) / f"{case.diagnoses}.sqlite"
    if not path.exists():
        _fill(path, case.diagnoses, case.seed)
    command = [*COMMAND, *QUESTIONS[case.question]]
    if command[-1] == "--out":
        command.append(str(path.with_suffix(".png")))
    if case.question != "help":
        command += ["--history", str(path)]
    found = []
    for _ in range(REPEATS):
        done = subprocess.run(
            [sys.executable, "-c", WATCH, *command], capture_output=True, text=True, check=False
        )
        code, *figures = map(float, done.stdout.split()[-4:])
        if code:
            raise InputOutputError(f"{' '.join(command)}: exit code {code:g}: {done.stderr}")
        found.append(figures)
    wall, processor, peak = np.median(found[1:], axis=0)
    size = path.stat().st_size / 1e6
    return {"wall_s": wall, "processor_s": processor, "peak_mb": peak / 1024.0, "size_mb": size}


def _fill(path: Path, count: int, seed: int) -> None:
    """Append diagnoses of units that wear steadily, each at its own rate."""
    result = ehadiag.diagnose(ehadiag.simulate("open", FSS=0.3))
    like = history_entry(result, Usage(), simulated=False)
    rng = np.random.default_rng(seed)
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    begin = time.monotonic()
    with History(part, create=True) as history:
        for first in range(0, count, UNITS * DIAGNOSES):
            number = min(UNITS * DIAGNOSES, count - first)
            history.append_all(list(_block(like, first // DIAGNOSES, number, rng)))
    print(f"{count} diagnoses in {time.monotonic() - begin:.0f} s", file=sys.stderr)
    part.rename(path)


def _block(like: Entry, unit: int, number: int, rng: np.random.Generator) -> Iterator[Entry]:
    tree = json.loads(like.result)
    rates = rng.uniform(0.3, 1.0, (UNITS, len(like.severities))) / DIAGNOSES
    for visit in range(DIAGNOSES):
        for place in range(number // DIAGNOSES):
            noise = rng.normal(0.0, 2e-4, len(like.severities))
            values = np.clip(rates[place] * (visit + 1) + noise, 0.0, 1.0).tolist()
            serial, hours = unit + place + 1, 100.0 * (visit + 1)
            yield replace(
                like,
                serial=serial,
                usage=Usage(hours),
                tested=f"{2000 + visit // 12}-{visit % 12 + 1:02}-01T12:00:00.000Z",
                sources=tuple(
                    replace(item, samples=f"{serial}-{visit}", sha256=None) for item in like.sources
                ),
                severities=tuple(
                    Severity(name=item.name, estimate=value, std=2e-4,
                             interval95=(max(value - 4e-4, 0.0), min(value + 4e-4, 1.0)))
                    for item, value in zip(like.severities, values, strict=True)
                ),
                result=json.dumps(tree | {"serial": serial}),
            )  # fmt: skip


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--folder", type=Path, required=True, help="for the history, 3 kB a row")


def _cases(options: Options) -> list[QuestionCase]:
    return [
        QuestionCase(name, options.cases, str(options.folder), options.seed) for name in QUESTIONS
    ]


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    yield f"{options.cases} diagnoses, {records[0]['size_mb']:.0f} MB\n"
    rows = [
        (
            item["question"], f"{item['wall_s']:.2f}", f"{item['processor_s']:.2f}",
            f"{item['peak_mb']:.0f}",
        )
        for item in records
    ]  # fmt: skip
    yield from markdown(("question", "wall, s", "processor, s", "peak memory, MB"), rows)


LARGE_HISTORY = Study(
    "large-history", "Time and memory of questions to a health history of many diagnoses.",
    _cases, perform, _report, _options, count=100_000, counted="diagnoses", measures_time=True,
)  # fmt: skip
