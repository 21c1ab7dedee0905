"""`ehadiag diagnose --list`: one line for each test in a recording."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from ehadiag.cli.output import emit, put, rendered
from ehadiag.core.dates import start_text
from ehadiag.core.printable import printable, valid_text

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ehadiag.core.recording import Recording

__all__ = ["print_list"]

SCHEMA = "ehadiag.tests/1"
COLUMNS = ("no.", "test", "start", "length s", "outcome", "serial", "channel", "remarks")


def print_list(source: str, recordings: Iterable[Recording], *, as_json: bool) -> None:
    """Print number, test, start, length, outcome, serial number and channel of each test.

    Parameters
    ----------
    source : str
        Name of the recording.
    recordings : Iterable[Recording]
        Its tests, taken one at a time.
    as_json : bool
        One JSON object a line instead of a table.
    """
    rows = (_row(item, number) for number, item in enumerate(recordings, start=1))
    if as_json:
        for row in rows:
            put(json.dumps({"schema": SCHEMA, "source": valid_text(source), **row}))
        return
    from rich.table import Table  # noqa: PLC0415 - only who prints tables needs it

    table = Table(*COLUMNS, box=None, pad_edge=False, title=None)
    for row in rows:
        cells = (row["number"], row["test"], row["start"], row["length_s"], row["outcome"])
        remarks = "; ".join(row["remarks"])
        shown = (*cells, row["serial"], row["channel"], remarks)
        table.add_row(*("-" if cell in (None, "") else printable(str(cell)) for cell in shown))
    put(source)
    emit(rendered(lambda console: console.print(table, crop=False)))


def _row(item: Recording, number: int) -> dict[str, Any]:
    state, reason = item.outcome.state, item.outcome.reason
    outcome = None if state is None else state.name.lower()
    if state is not None and reason:
        outcome = f"{outcome} ({reason.name.lower().replace('_', ' ')})"
    return {
        "number": number,
        "test": item.test_id,
        "start": start_text(item.start_ns),
        "length_s": None if item.samples is None else round(item.duration, 3),
        "outcome": outcome,
        "serial": item.serial,
        "channel": item.channel,
        "remarks": list(item.quality.refused),
    }
