"""Reads the tests of a recording whatever it holds: frames or decoded signals, one file or more."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ehadiag.core.errors import ConfigurationError
from ehadiag.core.find_test import Sought
from ehadiag.core.recording import Recording
from firmware_iface.alignment.windows import recordings_of
from firmware_iface.logs.budget import Budget
from firmware_iface.logs.reader import iterate_recordings, read_frames
from firmware_iface.mapping.bus_map import BusMap
from firmware_iface.signals.columns import ColumnMap
from firmware_iface.signals.recordings import recordings_of_signals
from firmware_iface.signals.tables import holds_signals
from firmware_iface.transport.frames import FrameTable, concatenate

__all__ = ["Meaning", "recorded_tests"]


@dataclass(frozen=True, slots=True)
class Meaning:
    """What the content of recordings means.

    Attributes
    ----------
    bus_map : BusMap
        Of frames.
    columns : ColumnMap | None
        Of decoded signals; None: none are mapped, and they go by their usual names.
    sought : Sought
        What to look for where nothing says which test ran when.
    """

    bus_map: BusMap
    columns: ColumnMap | None
    sought: Sought


def recorded_tests(
    paths: Sequence[Path | str], meaning: Meaning, budget: Budget | None = None
) -> Iterator[Recording]:
    """Read the tests of one recording, in order of time.

    Parameters
    ----------
    paths : Sequence[Path | str]
        Its files: one; or several, split in time or one for each bus.
    meaning : Meaning
        Mapping and tests.
    budget : Budget | None
        What reading may cost; None: the default.

    Yields
    ------
    Recording
        Each test; one recording without samples where there is none.

    Raises
    ------
    InputOutputError
        A file cannot be read.
    ConfigurationError
        Unknown kind of log, unfit mapping, frames and signals in one recording.
    """
    budget = budget or Budget()
    mapped = meaning.columns is not None
    decoded = [holds_signals(path, mapped=mapped) for path in paths]
    if any(decoded):
        if not all(decoded):
            odd = paths[decoded.index(False)]
            raise ConfigurationError(f"log {odd}: holds frames, the others decoded signals")
        columns = meaning.columns or ColumnMap(tick_ns=meaning.bus_map.tick_ns)
        yield from recordings_of_signals(paths, columns, meaning.sought, budget)
    elif len(paths) == 1:
        yield from iterate_recordings(paths[0], meaning.bus_map, budget, meaning.sought)
    else:
        table = _merged([read_frames(path, budget) for path in paths])
        source = ", ".join(str(path) for path in paths)
        yield from recordings_of(
            [table], meaning.bus_map, source, len(table) + 1, sought=meaning.sought
        )


def _merged(tables: Sequence[FrameTable]) -> FrameTable:
    """Frames of several files in order of their stamps; each file keeps its own order at a tie.

    Loggers number the adapter channels of each file anew: the mapping's identifiers tell the
    messages apart.
    """
    whole = concatenate(tables)
    # A stamp that goes back within a file does not break the file's order.
    steady = np.concatenate([np.maximum.accumulate(table.time_ns) for table in tables])
    order = np.argsort(steady, kind="stable")
    channel = np.zeros(len(order), dtype=whole.channel.dtype)
    return replace(whole.rows(order), channel=channel)
