"""Kernels of the alignment, one at a time, at their limits."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ehadiag import CommandMode
from firmware_iface.alignment import align
from firmware_iface.alignment import grid as grid_module
from firmware_iface.alignment.align import MIN_STUCK_FRAMES
from firmware_iface.alignment.grid import (
    MIN_FROZEN_TICKS,
    GridColumn,
    RowBounds,
    TickGrid,
    samples_of,
)
from firmware_iface.alignment.ticks import TickAxis
from firmware_iface.bus_map import default_map

MS = 1_000_000
NAN = float("nan")


def axis_of(row: list[int], tick: list[int], ticks: dict[str, list[int]] | None = None) -> TickAxis:
    return TickAxis(
        ticks={name: np.array(item, dtype=np.int64) for name, item in (ticks or {}).items()},
        rows={},
        row=np.array(row, dtype=np.int64),
        tick=np.array(tick, dtype=np.int64),
        time_ns=np.array(row, dtype=np.int64) * MS,
        every={},
        turn=256,
        notes=(),
    )


def span(first: int, ticks: int, ended: int | None = None) -> Any:
    return SimpleNamespace(first=first, ticks=ticks, ended=ended)


def test_a_test_reaches_from_its_neighbour_before_to_its_neighbour_after() -> None:
    """Rows between axis frames, disorder and holes: against a search of every frame.

    No further than the word of the end where it came after the last frame.
    """
    rng = np.random.default_rng(3)
    for _ in range(1000):
        count = int(rng.integers(1, 12))
        row = np.sort(rng.choice(60, count, replace=False)).tolist()
        tick = (rng.integers(-5, 6, count) + 3 * np.arange(count)).tolist()
        first, length = int(rng.integers(-4, 36)), int(rng.integers(1, 12))
        hits = [at for at, here in enumerate(tick) if first <= here < first + length]
        begin, end = 0, 70
        if hits and hits[0] > 0:
            begin = row[hits[0] - 1] + 1
        if hits and hits[-1] + 1 < count:
            end = row[hits[-1] + 1]
        bounds = RowBounds.of(axis_of(row, tick))
        assert bounds.rows(span(first, length), 70) == (begin, end)
        ended = int(rng.integers(0, 70))
        if hits:
            end = min(end, max(ended, row[hits[-1]]) + 1)
        assert bounds.rows(span(first, length, ended), 70) == (begin, end)


def test_the_bounds_of_an_axis_are_running_extremes() -> None:
    bounds = RowBounds.of(axis_of([0, 1, 2, 3], [5, 3, 8, 7]))
    assert bounds.highest.tolist() == [5, 5, 8, 8]
    assert bounds.lowest.tolist() == [3, 3, 7, 7]


def grid(tick: list[int], value: list[float], **other: Any) -> TickGrid:
    """A test of four ticks from tick 10 on; frames of message M in every second row."""
    count = len(tick)
    item = SimpleNamespace(
        row=2 * np.arange(count),
        values={"channels.spool": np.array(value)},
        time_ns=100 + np.arange(count),
        saturated=other.get("saturated", {}),
        message=SimpleNamespace(name="M"),
    )
    return TickGrid(
        episode=span(10, 4),
        decoded=SimpleNamespace(messages={"M": item}, message_of={"channels.spool": "M"}),
        axis=axis_of([], [], other.get("ticks", {"M": tick})),
        bus_map=SimpleNamespace(),
        begin=other.get("begin", 0),
        end=other.get("end", 2 * count),
    )


def test_the_first_frame_of_a_tick_counts_and_outside_none_does() -> None:
    filled = grid([9, 10, 12, 12, 13, 14], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).fill("channels.spool")
    assert filled is not None
    np.testing.assert_array_equal(filled.value, [2.0, NAN, 3.0, 5.0])
    assert filled.host_ns.tolist() == [101, -1, 102, 104]
    assert filled.host_ns.dtype == np.int64
    assert filled.saturated.tolist() == [False] * 4
    assert filled.saturated.dtype == np.bool_


def test_a_frame_without_a_value_leaves_its_tick_to_the_next() -> None:
    flags = {"channels.spool": np.array([True, False, True])}
    filled = grid([11, 11, 13], [NAN, 4.0, 5.0], saturated=flags).fill("channels.spool")
    assert filled is not None
    np.testing.assert_array_equal(filled.value, [NAN, 4.0, NAN, 5.0])
    assert filled.host_ns.tolist() == [-1, 101, -1, 102]
    assert filled.saturated.tolist() == [False, False, False, True]


def test_only_rows_near_the_test_are_looked_at() -> None:
    filled = grid([10, 11, 12, 13], [1.0, 2.0, 3.0, 4.0], begin=2, end=6).fill("channels.spool")
    assert filled is not None
    np.testing.assert_array_equal(filled.value, [NAN, 2.0, 3.0, NAN])


def test_a_role_that_no_frame_brings_fills_nothing() -> None:
    assert grid([10], [1.0]).fill("channels.current") is None
    assert grid([10], [1.0], ticks={}).fill("channels.spool") is None
    assert grid([], [], ticks={"M": []}).fill("channels.spool") is None


def frozen(value: np.ndarray, saturated: list[int] | None = None) -> int:
    flags = np.zeros(len(value), dtype=np.bool_)
    flags[saturated or []] = True
    return grid_module._frozen(value, flags)


def stretch(before: int, still: int, after: int) -> np.ndarray:
    """A lively channel that stands still in between."""
    still_there = np.full(still - 1, before - 1.0)
    return np.concatenate([np.arange(before), still_there, -1 - np.arange(after)])


@pytest.mark.parametrize(
    ("before", "still", "after", "found"),
    [
        (60, MIN_FROZEN_TICKS, 60, MIN_FROZEN_TICKS),
        (60, MIN_FROZEN_TICKS - 1, 60, 0),
        (1, MIN_FROZEN_TICKS + 5, MIN_FROZEN_TICKS + 1, MIN_FROZEN_TICKS + 5),
        (MIN_FROZEN_TICKS + 2, MIN_FROZEN_TICKS + 5, 0, MIN_FROZEN_TICKS + 5),
        (MIN_FROZEN_TICKS + 1, MIN_FROZEN_TICKS, 0, 0),
        (1, MIN_FROZEN_TICKS, MIN_FROZEN_TICKS, 0),
        (1, MIN_FROZEN_TICKS, MIN_FROZEN_TICKS + 1, MIN_FROZEN_TICKS),
    ],
)
def test_a_channel_that_stands_still_and_moves_elsewhere(
    before: int, still: int, after: int, found: int
) -> None:
    assert frozen(stretch(before, still, after)) == found


@pytest.mark.parametrize(("every", "lively"), [(5, True), (6, False)])
def test_a_channel_that_hardly_moves_is_not_frozen(every: int, lively: bool) -> None:
    value = np.concatenate([np.arange(300) // every, np.full(120, 77.0)])
    assert (frozen(value) > 0) is lively


def test_a_stretch_may_hold_gaps_and_saturated_samples() -> None:
    value = stretch(80, 130, 80)
    value[100] = NAN
    value[110] = 7.0
    assert frozen(value, [110]) == 130
    value[79:200] = NAN
    assert frozen(value) == 0


def test_a_channel_that_never_moves_is_not_frozen() -> None:
    assert frozen(np.full(500, 3.0)) == 0
    assert frozen(np.full(500, NAN)) == 0


def commands(roles: dict[str, list[float]], fixed: CommandMode | None = None) -> Any:
    """What `_command` asks of a grid."""

    def fill(role: str) -> Any:
        return SimpleNamespace(value=np.array(roles[role])) if role in roles else None

    meanings = {1: CommandMode.CURRENT, 2: CommandMode.POSITION, 5: CommandMode.POSITION}
    return SimpleNamespace(
        fill=fill, episode=span(0, 3), bus_map=SimpleNamespace(fixed_mode=fixed, modes=meanings)
    )


def test_the_mode_that_most_commands_name_counts() -> None:
    roles = {
        "command.mode": [2.0, 1.0, 2.0, 5.0, NAN, 9.0, 9.0, 9.0],
        "command.position": [10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0],
        "command.current": [0.0] * 8,
    }
    mode, value, notes = grid_module._command(commands(roles), None)
    assert mode is CommandMode.POSITION
    np.testing.assert_array_equal(value, [10.0, NAN, 12.0, 13.0, 14.0, NAN, NAN, NAN])
    assert notes == ["4 commands of another mode left out"]


def test_commands_of_one_mode_need_no_note() -> None:
    roles = {"command.mode": [1.0, 1.0, NAN], "command.current": [1.0, 2.0, 3.0]}
    mode, value, notes = grid_module._command(commands(roles), None)
    assert (mode, value.tolist(), notes) == (CommandMode.CURRENT, [1.0, 2.0, 3.0], [])


@pytest.mark.parametrize("modes", [None, [NAN, NAN, NAN], [7.0, NAN, NAN]])
def test_commands_that_name_no_mode_are_taken_as_currents(modes: list[float] | None) -> None:
    roles = {"command.current": [1.0, 2.0, 3.0]} | ({"command.mode": modes} if modes else {})
    mode, value, notes = grid_module._command(commands(roles), None)
    assert mode is CommandMode.CURRENT
    assert notes[0] == "no command says its mode; taken as a current"
    assert value.tolist()[1:] == [2.0, 3.0]


def test_the_mapping_may_fix_the_mode() -> None:
    roles = {"command.position": [1.0, 2.0, 3.0]}
    mode, value, notes = grid_module._command(commands(roles, CommandMode.POSITION), None)
    assert (mode, value.tolist(), notes) == (CommandMode.POSITION, [1.0, 2.0, 3.0], [])


def test_a_test_without_commands_says_so() -> None:
    mode, value, notes = grid_module._command(commands({}, CommandMode.CURRENT), None)
    np.testing.assert_array_equal(value, [NAN] * 3)
    assert (mode, notes) == (CommandMode.CURRENT, ["no command frames"])


@pytest.mark.parametrize(
    ("frames", "still", "wait_ms", "noted"),
    [
        (MIN_STUCK_FRAMES + 1, MIN_STUCK_FRAMES, 1.0, MIN_STUCK_FRAMES),
        (MIN_STUCK_FRAMES + 10, MIN_STUCK_FRAMES, 1.0, MIN_STUCK_FRAMES),
        (MIN_STUCK_FRAMES + 10, MIN_STUCK_FRAMES - 1, 1.0, 0),
        (MIN_STUCK_FRAMES + 10, MIN_STUCK_FRAMES, 0.5, 0),
        (MIN_STUCK_FRAMES + 10, MIN_STUCK_FRAMES, 0.6, MIN_STUCK_FRAMES),
    ],
)
def test_a_counter_that_often_stands_still_is_noted(
    frames: int, still: int, wait_ms: float, noted: int
) -> None:
    counter = np.concatenate([np.zeros(still), np.arange(frames - still)])
    item = SimpleNamespace(
        row=np.arange(frames),
        counter=counter,
        time_ns=np.rint(np.arange(frames) * wait_ms * MS).astype(np.int64),
    )
    blind = SimpleNamespace(row=np.arange(frames), counter=None)
    decoded: Any = SimpleNamespace(messages={"blind": blind, "M": item})
    bus_map: Any = SimpleNamespace(tick_ns=MS)
    expected = [f"M: the counter stands still in {noted} frames"] if noted else []
    assert align._stuck_counters(decoded, bus_map, 0, frames) == expected
    assert align._stuck_counters(decoded, bus_map, frames - 1, frames) == []
    assert align._stuck_counters(decoded, bus_map, 0, 5) == []


def test_the_environment_is_the_median_over_the_test() -> None:
    first = SimpleNamespace(row=np.arange(3), values={"channels.spool": np.ones(3)})
    row = np.array([1, 3, 5, 7, 9])
    second = SimpleNamespace(
        message=default_map().messages["Environment"],
        row=row,
        time_ns=100_000_000 * row,
        data=np.arange(40, dtype=np.uint8).reshape(5, 8),
        counter=None,
        modulus=0,
        stream=np.zeros(5, dtype=np.int64),
        values={
            "environment.supply_pressure": np.array([1.0, 20.0, 30.0, NAN, 90.0]),
            "environment.oil_temperature": np.array([5.0, NAN, NAN, NAN, 6.0]),
        },
    )
    decoded: Any = SimpleNamespace(messages={"first": first, "second": second})
    inner, _ = align._environment(decoded, 3, 9, 0)
    assert (inner.supply_pressure, inner.return_pressure) == (25.0, None)
    assert inner.oil_temperature is None
    whole, _ = align._environment(decoded, 0, 10, 0)
    assert (whole.supply_pressure, whole.oil_temperature) == (25.0, 5.5)


def partial(roles: dict[str, list[float]], saturated: list[bool]) -> Any:
    """What `_samples` asks of a grid that brings only some of the channels."""
    count = len(next(iter(roles.values())))

    def fill(role: str) -> Any:
        if role not in roles:
            return None
        host = 50 + np.arange(count)
        return GridColumn(np.array(roles[role]), np.array(saturated), host)

    bus_map = SimpleNamespace(tick_ns=2 * MS, fixed_mode=CommandMode.CURRENT, modes={}, stated=())
    return SimpleNamespace(fill=fill, episode=span(0, count), bus_map=bus_map)


def test_channels_that_no_frame_brings_are_empty_and_noted() -> None:
    flags = [False, True, False]
    roles = {"channels.current": [1.0, 2.0, 3.0], "channels.position": [4.0, 5.0, 6.0]}
    samples, notes = samples_of(partial(roles, flags))
    assert notes == [
        "no frame brings the spool",
        "no frame brings the pressure",
        "no command frames",
    ]
    assert (samples.current.tolist(), samples.position.tolist()) == tuple(roles.values())
    for empty in (samples.spool, samples.pressure):
        assert empty.dtype == np.float64
        np.testing.assert_array_equal(empty, [NAN] * 3)
    assert samples.saturated.dtype == np.bool_
    assert samples.saturated.tolist() == [flags, [False] * 3, [False] * 3, flags]
    assert samples.host_ns.tolist() == [-1] * 3
    assert samples.host_ns.dtype == np.int64
    assert samples.period_ns == 2 * MS


def test_a_frozen_channel_is_noted_with_its_time() -> None:
    roles = {"channels.spool": stretch(100, 130, 100).tolist(), "command.current": [0.0] * 329}
    samples, notes = samples_of(partial(roles, [False] * 329))
    assert notes == [
        "no frame brings the current",
        "spool stood at one code for 0.26 s though it moves elsewhere",
        "no frame brings the pressure",
        "no frame brings the position",
    ]
    assert samples.host_ns.tolist() == list(range(50, 379))


@pytest.mark.parametrize(
    ("scale", "gain", "std"),
    [(0.1, 1.0, 0.1 / math.sqrt(12.0)), (0.1, 5.0 / 9.0, 0.5 / 9.0 / math.sqrt(12.0))],  # °C, °F
)
def test_steps_of_the_bus_are_a_standard_deviation(scale: float, gain: float, std: float) -> None:
    signal = SimpleNamespace(is_float=False, scale=scale, offset=0.0)
    names = ("oil_temperature", "supply_pressure", "return_pressure")
    roles = [
        SimpleNamespace(name=f"environment.{name}", signal=signal, gain=gain) for name in names
    ]
    item = SimpleNamespace(message=SimpleNamespace(roles=roles))
    decoded: Any = SimpleNamespace(messages={"M": item})
    assert align._rounding_std(decoded, "oil_temperature") == pytest.approx(std)
    both = align._rounding_std(decoded, "supply_pressure", "return_pressure")
    assert both == pytest.approx(math.sqrt(2.0) * std)
    signal.is_float = True
    assert align._rounding_std(decoded, "oil_temperature") == 0.0
    nothing: Any = SimpleNamespace(messages={})
    assert align._rounding_std(nothing, "oil_temperature") == 0.0
