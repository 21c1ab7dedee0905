"""Lays a test's frames out on its control ticks: channels, commands, what stood still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.recording import CommandMode, Samples
from firmware_iface.alignment.episodes import Episode
from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.codec.decode import DecodedTable
from firmware_iface.mapping.bus_map import BusMap

__all__ = ["CHANNEL_KEYS", "Filled", "Grid", "modes_told", "samples_of"]

CHANNEL_KEYS = ("current", "spool", "pressure", "position")
FROZEN_TICKS = 100
FROZEN_LIVELY = 0.2
"""Share of ticks, outside a frozen stretch, in which a live channel changes its code."""
LEAST_OF_A_MODE = 50
"""Commands of a mode from which on a test may have been played in it."""


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """One test's tick grid, and the rows of the table that can hold its frames.

    Attributes
    ----------
    episode : Episode
        The test.
    decoded : DecodedTable
        All frames.
    axis : TickAxis
        Their ticks.
    bus_map : BusMap
        What they mean.
    begin : int
        First row that can hold one of the test's.
    end : int
        One past the last.
    """

    episode: Episode
    decoded: DecodedTable
    axis: TickAxis
    bus_map: BusMap
    begin: int
    end: int

    def fill(self, role: str) -> Filled | None:
        """Put the values of a role on the grid; of two frames for one tick the first counts.

        Parameters
        ----------
        role : str
            As in a mapping.

        Returns
        -------
        Filled | None
            None without a frame of the role's message.
        """
        found = self.bus_map.find(role)
        tick = self.axis.ticks.get(found[0].name) if found is not None else None
        if found is None or tick is None or len(tick) == 0:
            return None
        item = self.decoded.messages[found[0].name]
        near = slice(*np.searchsorted(item.row, [self.begin, self.end]))
        at = tick[near] - self.episode.first
        value = item.values[role][near]
        usable = np.flatnonzero((at >= 0) & (at < self.episode.ticks) & np.isfinite(value))[::-1]
        at = at[usable]
        out = np.full(self.episode.ticks, np.nan)
        out[at] = value[usable]
        host = np.full(self.episode.ticks, -1, dtype=np.int64)
        host[at] = item.time_ns[near][usable]
        saturated = np.zeros(self.episode.ticks, dtype=np.bool_)
        if role in item.saturated:
            saturated[at] = item.saturated[role][near][usable]
        return Filled(out, saturated, host)


@dataclass(frozen=True, slots=True, eq=False)
class Filled:
    """A role on the grid; NaN, False and -1 where no frame brought it.

    Attributes
    ----------
    value : NDArray[np.float64]
        Shape (ticks,).
    saturated : NDArray[np.bool_]
        At the converter's end, shape (ticks,).
    host_ns : NDArray[np.int64]
        Time stamps, shape (ticks,).
    """

    value: NDArray[np.float64]
    saturated: NDArray[np.bool_]
    host_ns: NDArray[np.int64]


def samples_of(grid: Grid, mode: CommandMode | None = None) -> tuple[Samples, list[str]]:
    """Put the channels and the commands of one test on its ticks.

    Parameters
    ----------
    grid : Grid
        The test and its frames.
    mode : CommandMode | None
        Of the commands to take; None: that of most of them.

    Returns
    -------
    tuple[Samples, list[str]]
        The samples, and what a reader should know.
    """
    ticks, period = grid.episode.ticks, grid.bus_map.tick_ns
    nothing = Filled(
        np.full(ticks, np.nan), np.zeros(ticks, dtype=np.bool_), np.full(ticks, -1, dtype=np.int64)
    )
    notes: list[str] = []
    filled: dict[str, Filled] = {}
    for key in CHANNEL_KEYS:
        found = grid.fill(f"channels.{key}")
        filled[key] = found or nothing
        if found is None:
            notes.append(f"no frame brings the {key}")
            continue
        frozen = _frozen(found.value, found.saturated)
        if frozen:
            seconds = frozen * period * 1e-9
            notes.append(f"{key} stood at one code for {seconds:.3g} s though it moves elsewhere")
    mode, command, said = _command(grid, mode)
    samples = Samples(
        period_ns=period,
        mode=mode,
        current=filled["current"].value,
        spool=filled["spool"].value,
        pressure=filled["pressure"].value,
        position=filled["position"].value,
        command=command,
        saturated=np.stack([filled[key].saturated for key in CHANNEL_KEYS]),
        host_ns=filled["spool"].host_ns,
        stated=grid.bus_map.stated,
    )
    return samples, notes + said


def _frozen(value: NDArray[np.float64], saturated: NDArray[np.bool_]) -> int:
    """Length of a frozen stretch in ticks, 0 if the channel never stood still suspiciously."""
    known = np.flatnonzero(np.isfinite(value) & ~saturated)
    if len(known) == 0:
        return 0
    edges = np.flatnonzero(np.diff(value[known]) != 0.0)
    bounds = np.concatenate(([-1], edges, [len(known) - 1]))
    lengths = np.diff(bounds)
    longest = int(lengths.argmax())
    run = int(lengths[longest])
    elsewhere = len(known) - run
    span = int(known[bounds[longest + 1]] - known[bounds[longest] + 1]) + 1
    lively = elsewhere > FROZEN_TICKS and len(edges) >= FROZEN_LIVELY * elsewhere
    return span if run >= FROZEN_TICKS and lively else 0


def modes_told(grid: Grid) -> tuple[CommandMode, ...]:
    """Find the modes of a stretch's commands, each of at least a few dozens of them.

    Parameters
    ----------
    grid : Grid
        The stretch and its frames.

    Returns
    -------
    tuple[CommandMode, ...]
        Empty where no frame says a mode.
    """
    modes = grid.fill("command.mode")
    if modes is None:
        return ()
    values, count = np.unique(modes.value[np.isfinite(modes.value)], return_counts=True)
    told = {
        grid.bus_map.modes[int(value)]
        for value, times in zip(values, count, strict=True)
        if times >= LEAST_OF_A_MODE and int(value) in grid.bus_map.modes
    }
    return tuple(sorted(told))


def _command(
    grid: Grid, mode: CommandMode | None
) -> tuple[CommandMode, NDArray[np.float64], list[str]]:
    """Mode and command of a test; NaN where no frame said, or where it said another mode."""
    notes: list[str] = []
    bus_map = grid.bus_map
    mode = mode or bus_map.fixed_mode
    modes = grid.fill("command.mode")
    if modes is not None and mode is None:
        known = modes.value[np.isin(modes.value, list(bus_map.modes))]
        if len(known):
            values, count = np.unique(known, return_counts=True)
            mode = bus_map.modes[int(values[np.argmax(count)])]
    if mode is None:
        mode = CommandMode.CURRENT
        notes.append("no command says its mode; taken as a current")
    command = grid.fill(f"command.{mode.name.lower()}")
    if command is None:
        return mode, np.full(grid.episode.ticks, np.nan), [*notes, "no command frames"]
    value = command.value
    if modes is not None:
        wanted = [number for number, meaning in bus_map.modes.items() if meaning is mode]
        other = np.isfinite(modes.value) & ~np.isin(modes.value, wanted)
        if other.any():
            notes.append(f"{int(other.sum())} commands of another mode left out")
            value[other] = np.nan
    return mode, value, notes
