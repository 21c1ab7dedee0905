"""Counters that stand still, and runs of frames that arrive much too late."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_iface.alignment.ticks import _counted_axis, _own_ticks, _standing
from firmware_iface.codec.protection import LONGEST_RUN, OUTSIDE, unwrap

MS = 1_000_000


def item(time_ms: list[float], counter: list[int], stream: list[int] | None = None) -> Any:
    """What placing reads of a decoded message; its rows are its milliseconds."""
    return SimpleNamespace(
        row=np.rint(np.array(time_ms) * 10).astype(np.int64),
        time_ns=np.rint(np.array(time_ms) * MS).astype(np.int64),
        counter=np.array(counter),
        message=SimpleNamespace(name="M", modulus=256),
        stream=np.array(stream or [0] * len(time_ms)),
    )


@pytest.mark.parametrize(
    ("wait_ms", "counter", "standing"),
    [
        (1.0, 7, True),
        (0.4, 7, False),  # a repeat
        (0.5, 7, False),
        (128.0, 7, False),
        (1.0, 8, False),
        (127.0, 7, True),
        (256.0, 7, False),  # a whole turn was lost
    ],
)
def test_a_counter_stands_when_time_moves_and_it_does_not(
    wait_ms: float, counter: int, standing: bool
) -> None:
    assert _standing(item([0.0, wait_ms], [7, counter]), MS).tolist() == [False, standing]


def test_multiplexed_frames_may_share_a_counter() -> None:
    frames = item([0.0, 0.6, 1.0, 1.6, 2.0, 2.6], [5, 5, 6, 6, 6, 7], [0, 1, 0, 1, 0, 1])
    assert _standing(frames, MS).tolist() == [False, False, False, False, True, False]


def test_a_stuck_counter_places_no_sample_even_when_it_looks_right() -> None:
    count = 700
    telemetry = item([k + 0.5 for k in range(count)], [min(k, 100) for k in range(count)])
    command = item([float(k) for k in range(count)], [k % 256 for k in range(count)])
    axis = _counted_axis({"telemetry": telemetry, "command": command}, MS)
    assert axis.ticks["command"].tolist() == list(range(count))
    assert axis.ticks["telemetry"].tolist() == [*range(101)] + [OUTSIDE] * (count - 101)


def test_a_message_with_a_counter_of_its_own_is_treated_alike() -> None:
    ticks, every, _ = _own_ticks(item([float(k) for k in range(60)], [*range(40), *[39] * 20]), MS)
    assert every == 1
    assert ticks.tolist() == [*range(40)] + [OUTSIDE] * 20


@pytest.mark.parametrize("run", [2, 3, LONGEST_RUN])
def test_a_short_run_that_comes_much_too_late_has_no_position(run: int) -> None:
    counter = np.arange(300) % 256
    late = slice(150, 150 + run)
    order = np.concatenate([np.r_[0:150], np.r_[150 + run : 200], np.r_[late], np.r_[200:300]])
    position, notes = unwrap(counter[order], np.arange(300) * MS, MS)
    expected = np.where((order >= 150) & (order < 150 + run), OUTSIDE, order)
    assert position.tolist() == expected.tolist()
    assert notes == (f"{run} frames with a counter out of line",)


def test_a_counter_that_starts_again_goes_on() -> None:
    counter = np.concatenate([np.arange(200), np.arange(100)])
    position, _ = unwrap(counter, np.arange(300) * MS, MS)
    assert (np.diff(position) > 0).all()
    assert (position != OUTSIDE).all()


def test_noise_ends() -> None:
    rng = np.random.default_rng(1)
    counter = rng.integers(0, 256, 20_000)
    position, _ = unwrap(counter, np.arange(20_000) * MS, MS)
    placed = position != OUTSIDE
    assert ((position[placed] - counter[placed]) % 256 == 0).all()
