"""Frames without a counter, stamped late: jitter, drift, batches, bursts, losses."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface.alignment.gaps import settle_gaps
from firmware_iface.alignment.late_stamps import place_late, spacing_of

COUNT = 4000


def stamps(
    tick: np.ndarray, seed: int, jitter: float = 0.0, drift_ppm: float = 0.0, batch: float = 0.0
) -> np.ndarray:
    """Ticks as an adapter stamps them: late by a half-normal delay, order kept, in batches."""
    rng = np.random.default_rng(seed)
    late = np.maximum.accumulate(tick + np.abs(rng.normal(0.0, jitter, len(tick))))
    if batch:
        late = np.ceil(late / batch) * batch
    late = late * (1.0 + 1e-6 * drift_ppm)
    return late - late[0]


@pytest.mark.parametrize("every", [1, 2, 20])
@pytest.mark.parametrize("drift", [-100.0, 0.0, 100.0])
@pytest.mark.parametrize("jitter", [0.0, 0.2, 0.5, 1.0])
def test_all_frames_keep_their_ticks_whatever_jitter_and_drift(
    jitter: float, drift: float, every: int
) -> None:
    tick = every * np.arange(COUNT)
    since = stamps(tick, 3, jitter, drift)
    assert spacing_of(since) == every
    found = place_late(since, every).tick
    wrong = found - found[COUNT // 2] != tick - tick[COUNT // 2]
    assert wrong.sum() == 0


@pytest.mark.parametrize("batch", [1.0, 2.5, 4.0, 16.0])
def test_batches_stamped_together_are_taken_apart(batch: float) -> None:
    tick = np.arange(COUNT)
    since = stamps(tick + 0.37, 1, 0.1, 80.0, batch)
    assert spacing_of(since) == 1
    found = place_late(since, 1).tick
    inner = slice(50, -50)
    assert np.unique(found[inner] - tick[inner]).size == 1


@pytest.mark.parametrize("seed", range(4))
def test_lost_frames_among_late_ones_shift_only_their_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tick = np.flatnonzero(rng.random(COUNT) > 0.02)
    placed = place_late(stamps(tick, seed, 1.0, 100.0), 1)
    away = placed.tick - tick
    away = away - int(np.median(away))
    assert np.abs(away).max() <= 2
    assert np.mean(away != 0) < 0.08


def test_signals_that_move_tell_where_the_gap_is() -> None:
    rng = np.random.default_rng(5)
    tick = np.flatnonzero(rng.random(COUNT) > 0.02)
    placed = place_late(stamps(tick, 5, 1.0), 1)
    signal = 300.0 * np.sin(2 * np.pi * 0.013 * tick) + rng.normal(0.0, 0.5, len(tick))
    settled = settle_gaps(placed.tick, placed.late, 1, [signal])

    def wrong(found: np.ndarray) -> int:
        away = found - tick
        return int(np.sum(away != int(np.median(away))))

    assert wrong(settled) < 0.35 * wrong(placed.tick)


def test_a_burst_of_late_frames_goes_back() -> None:
    since = np.arange(COUNT, dtype=float)
    since[1000:1200] = 1200.0
    placed = place_late(since, 1)
    assert (placed.tick == np.arange(COUNT)).all()
    assert placed.late.max() == pytest.approx(200.0, abs=0.5)


def test_the_usual_lateness_is_that_of_the_stamps() -> None:
    since = stamps(np.arange(COUNT), 2, 0.2)
    assert place_late(since, 1).usual == pytest.approx(0.4, abs=0.05)


def test_the_dbc_decides_between_spacings_that_losses_blur() -> None:
    rng = np.random.default_rng(0)
    tick = 20 * np.flatnonzero(rng.random(400) > 0.1)
    assert spacing_of(stamps(tick, 0), said=20.0) == 20
