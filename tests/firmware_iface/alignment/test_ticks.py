"""Kernels that place frames on ticks, one at a time, at their limits.

Which message defines the ticks, and how the other messages are placed on them.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_iface import protection
from firmware_iface.alignment import ticks
from firmware_iface.alignment.ticks import STAMPS, TickAxis, place_frames
from firmware_iface.protection import COUNTERS, NO_POSITION

MS = 1_000_000


def member(
    time_ms: list[float], counter: list[int] | None = None, modulus: int = 256, first_row: int = 0
) -> Any:
    """What the kernels read of a decoded message."""
    return SimpleNamespace(
        row=first_row + np.arange(len(time_ms)),
        time_ns=np.rint(np.array(time_ms) * MS).astype(np.int64),
        counter=None if counter is None else np.array(counter),
        message=SimpleNamespace(name="M", cycle_ns=0),
        modulus=modulus,
        stream=np.zeros(len(time_ms), dtype=np.int64),
        saturated={},
        values={},
    )


def test_the_table_of_the_check_sum_is_the_polynomials() -> None:
    def divided(byte: int) -> int:
        rest = byte << 8
        for bit in range(15, 7, -1):
            if rest >> bit & 1:
                rest ^= 0x11D << (bit - 8)
        return rest

    assert protection._crc_table() == tuple(divided(byte) for byte in range(256))
    assert protection._crc_table() == protection.CRC_TABLE
    assert protection.CRC_TABLE_ARRAY.tolist() == list(protection.CRC_TABLE)
    assert not protection.CRC_TABLE_ARRAY.flags.writeable


@pytest.mark.parametrize(
    ("leap", "late", "single"),
    [
        (COUNTERS.trusted_step // 2 + 1, COUNTERS.clock_slack + 1, True),
        (COUNTERS.trusted_step // 2, COUNTERS.clock_slack + 1, False),
        (COUNTERS.trusted_step // 2 - 2, COUNTERS.clock_slack + 1, False),
        (COUNTERS.trusted_step // 2 + 1, COUNTERS.clock_slack, False),
        (100, COUNTERS.clock_slack + 1, True),
    ],
)
def test_a_counter_that_leaps_and_leaps_back_is_out_of_line(
    leap: int, late: float, single: bool
) -> None:
    jump = np.array([1, leap, 2 - leap, 1])
    # A leap backwards one step smaller than its size: both must pass the limit.
    jump[2] = -leap
    residue = np.array([0.0, -late, late, 0.0])
    assert protection._stray_frames(jump, residue, 256).tolist() == [
        False,
        False,
        single,
        False,
        False,
    ]
    assert protection._stray_frames(-jump, -residue, 256).tolist() == [
        False,
        False,
        single,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("back", "single"),
    [(-100 + COUNTERS.trusted_step, True), (-100 + COUNTERS.trusted_step + 1, False)],
)
def test_a_frame_is_out_of_line_only_if_its_neighbours_are_in_line(back: int, single: bool) -> None:
    jump = np.array([100, back])
    astray = protection._stray_frames(jump, np.array([-99.0, 99.0]), 256)
    assert astray.tolist() == [False, single, False]


def test_of_two_strange_frames_in_a_row_only_the_first_is_judged() -> None:
    jump = np.array([100, -100, 100, -99])
    residue = np.array([-99.0, 99.0, -99.0, 99.0])
    assert protection._stray_frames(jump, residue, 256).tolist() == [
        False,
        True,
        False,
        False,
        False,
    ]


def test_a_message_of_one_frame_stands_at_tick_zero() -> None:
    for count in (0, 1):
        alone, every, notes = ticks._own_ticks(member([5.0] * count, [9] * count), MS)
        assert alone.tolist() == [0] * count
        assert alone.dtype == np.int64
        assert (every, notes) == (1, ())


def test_two_frames_are_placed_by_their_counter() -> None:
    alone, every, notes = ticks._own_ticks(member([5.0, 8.0], [9, 10]), MS)
    assert (alone.tolist(), every, notes) == ([0, 3], 3, ())


def test_ticks_begin_at_the_first_frame_whatever_its_counter() -> None:
    alone, every, _ = ticks._own_ticks(member([0.0, 1.0, 2.0, 3.0], [254, 255, 0, 1]), MS)
    assert (alone.tolist(), every) == ([0, 1, 2, 3], 1)
    sparse, every, _ = ticks._own_ticks(member([0.0, 20.0, 40.0, 80.0], [7, 8, 9, 11]), MS)
    assert (sparse.tolist(), every) == ([0, 20, 40, 80], 20)


def test_a_frame_out_of_line_has_no_tick() -> None:
    counter = [*range(7, 17), 150, *range(18, 27)]
    alone, every, notes = ticks._own_ticks(member([2.0 * k for k in range(20)], counter), MS)
    assert alone[10] == NO_POSITION
    assert np.delete(alone, 10).tolist() == [*range(0, 20, 2), *range(22, 40, 2)]
    assert every == 2
    assert notes == ("1 frames with a counter out of line",)


def test_without_a_counter_time_places_frames_and_says_so() -> None:
    time = [0.3, *(float(k) for k in range(1, 200))]
    alone, every, notes = ticks._own_ticks(member(time), MS)
    assert alone.tolist() == list(range(200))
    assert every == 1
    assert notes == ("M: no counter to place samples by; host time stamps do",)


def test_frames_that_come_late_in_a_burst_go_back_to_their_ticks() -> None:
    time = [float(k) for k in range(100)]
    time[40:50] = [50.0 + 0.01 * k for k in range(10)]
    alone, _, _ = ticks._own_ticks(member(time), MS)
    assert alone.tolist() == list(range(100))


@pytest.mark.parametrize(
    ("time", "counter", "spacing"),
    [
        ([0.0, 1.0, 2.0], None, 1),
        ([0.0, 20.0, 40.0], None, 20),
        ([0.0, 0.2, 0.4], None, 0),
        ([0.0, 5.0, 10.0, 11.0], [1, 6, 11, 12], 1),
        ([0.0, 2.0, 4.0], [5, 5, 5], 2),
        ([0.0, 0.999e6, 1.998e6], None, 999_000),
        ([0.0, 1e6, 2e6], None, 1),
    ],
)
def test_ticks_between_two_frames(
    time: list[float], counter: list[int] | None, spacing: int
) -> None:
    assert ticks._frame_spacing(member(time, counter), MS) == spacing


@pytest.mark.parametrize("offset", [-0.4, 0.0, 0.1, 0.3, 0.45])
def test_the_phase_of_a_steady_stream(offset: float) -> None:
    fraction = np.arange(1300) + offset
    assert ticks._phase(fraction) == pytest.approx(np.full(1300, offset), abs=1e-9)


def test_the_phase_follows_a_drift_over_several_turns() -> None:
    drift = np.linspace(0.0, 3.0, 20_000)
    phase = ticks._phase(np.arange(20_000) + drift)
    inner = slice(500, -500)
    assert np.abs(phase[inner] - drift[inner]).max() < 0.01


def test_one_counted_message_with_a_counter_of_its_own_width() -> None:
    counter = [(k + 3) % 16 for k in range(100)]
    axis = ticks._counted_axis({"M": member([float(k) for k in range(100)], counter, 16)}, MS)
    assert axis.tick.tolist() == list(range(3, 103))
    assert axis.ticks["M"].tolist() == list(range(3, 103))
    assert (axis.turn, dict(axis.every), axis.notes) == (16, {"M": 1}, ())


def test_an_axis_tells_the_tick_of_other_frames() -> None:
    axis = TickAxis(
        ticks={},
        rows={},
        row=np.array([2, 4, 6]),
        tick=np.array([10, 11, 15]),
        time_ns=(np.array([0, 1.5, 5]) * MS).astype(np.int64),
        every={},
        turn=256,
        notes=(),
    )
    row = np.array([0, 3, 5, 9])
    time_ns = np.array([-0.5, 0.25, 2.0, 6.0]) * MS
    fraction, following = axis.at(row, time_ns.astype(np.int64), MS)
    assert fraction.tolist() == [9.5, 10.25, 11.5, 16.0]
    assert following.tolist() == [10, 11, 15, 16]


def item(
    name: str,
    time_ms: Any,
    counter: Any = None,
    *,
    role: str = "channels.spool",
    telemetry: bool = True,
    counts: bool = False,
    first_row: int = 0,
    modulus: int = 256,
) -> Any:
    """What placing reads of a decoded message; its rows are tenths of a millisecond."""
    time_ms = np.asarray(time_ms, dtype=np.float64)
    return SimpleNamespace(
        row=first_row + np.rint(time_ms * 10).astype(np.int64),
        time_ns=np.rint(time_ms * MS).astype(np.int64),
        counter=None if counter is None else np.asarray(counter, dtype=np.int64),
        modulus=0 if counter is None else modulus,
        message=SimpleNamespace(
            name=name,
            counts_ticks=counts,
            cycle_ns=0,
            roles=(SimpleNamespace(name=role),),
        ),
        saturated={"channels.spool": None} if telemetry else {},
        values={"channels.spool": np.zeros(len(time_ms))},
        stream=np.zeros(len(time_ms), dtype=np.int64),
    )


def command(time_ms: Any, counter: Any = None, **other: Any) -> Any:
    return item("command", time_ms, counter, role="command.current", telemetry=False, **other)


def placed(*items: Any) -> TickAxis:
    axis = place_frames(SimpleNamespace(messages={one.message.name: one for one in items}), MS)
    assert axis is not None
    return axis


def test_without_telemetry_there_is_no_axis() -> None:
    frames = command(np.arange(5), np.arange(5), counts=True)
    assert place_frames(SimpleNamespace(messages={"command": frames}), MS) is None
    silent = item("telemetry", [], [], counts=True)
    assert place_frames(SimpleNamespace(messages={"t": silent, "command": frames}), MS) is None


def test_counted_messages_share_the_axis_in_order_of_arrival() -> None:
    count = np.arange(6)
    telemetry = item("telemetry", count + 0.5, count + 250, counts=True)
    telemetry.counter %= 256
    sent = command(count, (count + 250) % 256, counts=True)
    axis = placed(telemetry, sent)
    assert axis.row.tolist() == [0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 55]
    assert axis.tick.tolist() == np.repeat(count + 250, 2).tolist()
    assert axis.time_ns.tolist() == (np.arange(12) * MS // 2).tolist()
    assert {name: list(tick) for name, tick in axis.ticks.items()} == {
        "telemetry": (count + 250).tolist(),
        "command": (count + 250).tolist(),
    }
    assert axis.rows["command"].tolist() == sent.row.tolist()
    assert (dict(axis.every), axis.turn) == ({"telemetry": 1, "command": 1}, 256)
    assert axis.notes == ()


def test_a_counted_frame_out_of_line_is_not_on_the_axis() -> None:
    counter = np.arange(30)
    counter[12] = 200
    axis = placed(item("telemetry", np.arange(30), counter, counts=True))
    assert axis.ticks["telemetry"][12] == NO_POSITION
    assert axis.tick.tolist() == [k for k in range(30) if k != 12]
    assert axis.row.tolist() == [10 * k for k in range(30) if k != 12]
    assert axis.time_ns.tolist() == [k * MS for k in range(30) if k != 12]


def test_counted_commands_beside_uncounted_telemetry_do_not_make_the_axis() -> None:
    sent = command(np.arange(50) + 0.2, np.arange(50) + 7, counts=True)
    axis = placed(item("telemetry", np.arange(50) + 0.7), sent)
    assert axis.tick.tolist() == list(range(50))
    assert axis.turn == 0
    assert axis.ticks["command"].tolist() == list(range(50))


def test_of_two_messages_the_one_with_more_frames_is_the_anchor() -> None:
    slow = item("slow", np.arange(0, 100, 2) + 0.3)
    fast = item("fast", np.arange(100) + 0.6)
    axis = placed(slow, fast)
    assert axis.row.tolist() == fast.row.tolist()
    assert axis.ticks["slow"].tolist() == list(range(0, 100, 2))
    assert dict(axis.every) == {"fast": 1, "slow": 2}
    assert axis.notes == tuple(
        f"{name}: no counter to place samples by; host time stamps do" for name in ("fast", "slow")
    )


def test_an_anchor_with_a_counter_of_its_own_turns_after_its_counts() -> None:
    anchor = item("telemetry", np.arange(0, 400, 4), np.arange(100) % 16, modulus=16)
    axis = placed(anchor)
    assert axis.tick.tolist() == list(range(0, 400, 4))
    assert axis.rows["telemetry"].tolist() == anchor.row.tolist()
    assert (dict(axis.every), axis.turn, axis.notes) == ({"telemetry": 4}, 64, ())


def test_an_anchor_out_of_line_leaves_the_axis_and_the_others_find_their_place() -> None:
    counter = np.arange(60) % 256
    counter[20] = 180
    sent = command(np.arange(60) - 0.3)
    axis = placed(item("telemetry", np.arange(60), counter, first_row=5), sent)
    kept = [k for k in range(60) if k != 20]
    assert axis.tick.tolist() == kept
    assert axis.row.tolist() == [5 + 10 * k for k in kept]
    assert axis.time_ns.tolist() == [k * MS for k in kept]
    assert axis.ticks["telemetry"][20] == NO_POSITION
    assert axis.ticks["command"].tolist() == list(range(60))


@pytest.mark.parametrize(
    ("ahead_ms", "first"), [(0.0, 0), (0.3, 0), (0.85, 0), (-0.05, 0), (-0.3, 1)]
)
def test_a_command_belongs_to_the_telemetry_that_follows(ahead_ms: float, first: int) -> None:
    """At the same time (less than a tenth of a tick after) it still is the same tick's."""
    sent = command(np.arange(5, 80) - ahead_ms)
    axis = placed(item("telemetry", np.arange(100)), sent)
    assert (axis.ticks["command"] - np.arange(5, 80)).tolist() == [first] * 75


@pytest.mark.parametrize(("late_ms", "first"), [(-0.4, 0), (0.0, 0), (0.4, 0), (0.6, 1)])
def test_other_telemetry_belongs_to_the_nearest_tick(late_ms: float, first: int) -> None:
    other = item("other", np.arange(5, 80) + late_ms)
    axis = placed(item("telemetry", np.arange(100)), other)
    assert (axis.ticks["other"] - np.arange(5, 80)).tolist() == [first] * 75


def test_other_telemetry_that_drifts_keeps_the_ticks_that_fit_its_earliest_stamps() -> None:
    count = np.arange(2000)
    axis = placed(item("telemetry", np.arange(2010)), item("other", count * (1 + 1.5 / 2000)))
    assert (axis.ticks["other"] - count).tolist() == [0] * 2000


def test_a_message_with_a_counter_of_its_own_keeps_its_gaps() -> None:
    """Its time only says where it begins; one frame that is late by ticks moves nothing."""
    numbers = np.array([*range(20), *range(25, 60)])
    time = 2.0 * numbers + 0.2
    time[30] += 5.0
    sent = command(time, numbers % 256)
    axis = placed(item("telemetry", np.arange(140)), sent)
    assert axis.every["command"] == 2
    assert axis.ticks["command"].tolist() == (2 * numbers + 1).tolist()
    assert axis.notes == ("telemetry: no counter to place samples by; host time stamps do",)


def test_a_counter_out_of_line_does_not_count_for_where_a_message_begins() -> None:
    numbers = np.arange(9)
    counter = numbers.copy()
    counter[[2, 4, 6]] = [90, 140, 200]
    axis = placed(item("telemetry", np.arange(20)), command(numbers - 0.5 + 4, counter))
    expected = numbers + 4
    assert (
        axis.ticks["command"][[0, 1, 3, 5, 7, 8]].tolist() == expected[[0, 1, 3, 5, 7, 8]].tolist()
    )
    assert axis.ticks["command"][[2, 4, 6]].tolist() == [NO_POSITION] * 3
    assert set(axis.rows) == {"telemetry", "command"}


def test_others_are_placed_by_the_telemetry_even_if_commands_share_the_axis() -> None:
    """A second command between the first one and the telemetry is of the telemetry's tick."""
    count = np.arange(30)
    telemetry = item("telemetry", count + 0.5, count, counts=True)
    sent = command(count, count, counts=True)
    second = item("second", count + 0.2, role="command.position", telemetry=False, first_row=3)
    axis = placed(telemetry, sent, second)
    assert axis.ticks["second"].tolist() == count.tolist()
    assert axis.ticks["second"].dtype == np.int64
    assert axis.rows["second"].tolist() == second.row.tolist()
    assert axis.every["second"] == 1
    assert axis.row.tolist() == sorted([*telemetry.row, *sent.row])
    assert axis.notes == ("second: no counter to place samples by; host time stamps do",)


def test_counted_telemetry_leads_even_if_other_telemetry_has_more_frames() -> None:
    counted = item("counted", np.arange(0, 60, 2) + 0.1, np.arange(5, 65, 2), counts=True)
    plain = item("plain", np.arange(60) + 0.4)
    axis = placed(counted, plain)
    assert axis.row.tolist() == counted.row.tolist()
    assert axis.ticks["plain"].tolist() == list(range(5, 65))


def test_messages_without_frames_or_without_samples_have_no_ticks() -> None:
    status = item("status", np.arange(3), role="status.state", telemetry=False)
    axis = placed(item("telemetry", np.arange(9)), command([]), status)
    assert set(axis.ticks) == set(axis.rows) == {"telemetry"}


def test_late_frames_go_back_but_no_further_than_they_must() -> None:
    tick = np.array([0, 3, 3, 3, 4, 9])
    assert ticks._undo_lateness(tick, 1).tolist() == [0, 1, 2, 3, 4, 9]
    assert ticks._undo_lateness(np.array([0, 2, 7, 8, 8, 10]), 2).tolist() == [0, 2, 4, 6, 8, 10]
    assert ticks._undo_lateness(tick, 0).tolist() == tick.tolist()


def test_time_places_frames_from_the_first_on() -> None:
    """Whatever the epoch of the host's clock."""
    times = 1.7e12 + np.arange(200)
    alone, every, _ = ticks._own_ticks(item("telemetry", times), MS)
    assert alone.tolist() == list(range(200))
    assert alone.dtype == np.int64
    assert every == 1


def test_the_phase_is_that_of_blocks_and_between_their_middles() -> None:
    count = 2 * STAMPS.phase_block + 100
    offset = np.repeat([0.1, 0.3, 0.2], [STAMPS.phase_block, STAMPS.phase_block, 100])
    phase = ticks._phase(np.arange(count) + offset)
    middles = [0.5 * STAMPS.phase_block, 1.5 * STAMPS.phase_block, 2 * STAMPS.phase_block + 50]
    assert phase == pytest.approx(np.interp(np.arange(count), middles, [0.1, 0.3, 0.2]), abs=1e-9)


def test_the_phase_of_a_block_is_the_mean_of_its_frames() -> None:
    fraction = np.arange(4) + np.array([0.2, 0.3, 0.2, 0.3])
    assert ticks._phase(fraction) == pytest.approx([0.25] * 4, abs=1e-9)


def test_of_moving_and_standing_frames_only_the_moving_have_a_position() -> None:
    counter, time = np.array([3, 4, 4, 5]), np.array([0, 1, 2, 3]) * MS
    moving = np.array([True, True, False, True])
    position, notes = ticks._unwrap(counter, time, moving, MS, 256)
    assert (position.tolist(), notes) == ([3, 4, NO_POSITION, 5], ())
    turned, _ = ticks._unwrap(np.array([15, 15, 1]), time[:3], moving[[0, 2, 1]], MS, 16)
    assert turned.tolist() == [15, NO_POSITION, 17]
