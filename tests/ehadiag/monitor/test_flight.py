"""Severities by free motion: intervals that hold the truth, none where motion does not suffice."""

from __future__ import annotations

import numpy as np
import pytest

from ehadiag import default_actuator
from ehadiag.monitor.flight import MAX_STD, PART_BLOCKS, PARTS, FlightEstimate
from ehadiag.monitor.score_bank import BANK, BlockScore, ScoreBank
from firmware_iface.recording import Environment

BANK_OF_UNIT = ScoreBank(default_actuator(), (0.3, 0.3, 0.97))
COUNT = PARTS[0] * PART_BLOCKS


def flight(
    seed: int, sizes: dict[int, float], scale: float = 1.0, count: int = COUNT
) -> FlightEstimate:
    """Blocks of a linear model, noise that lasts for ten blocks, and parameters off by steps."""
    rng, made = np.random.default_rng(seed), FlightEstimate(BANK_OF_UNIT)
    shift = np.zeros(len(BANK))
    shift[list(sizes)] = list(sizes.values())
    for block in range(count):
        if block % 10 == 0:
            lasting = rng.standard_normal(20)
        slopes = scale * np.concatenate((np.ones((len(BANK), 3)), np.eye(len(BANK))), axis=1)
        slopes = np.pad(slopes, ((0, 0), (0, 20 - slopes.shape[1])))
        residual = shift @ slopes + lasting
        score, information = slopes @ residual, slopes @ slopes.T
        made.add(BlockScore(score, information, np.zeros((2, len(BANK))), 20))
    return made


def test_intervals_hold_the_truth_though_noise_lasts() -> None:
    held = []
    for seed in range(100):
        found, why = flight(seed, {0: 0.2, 1: -0.1, 5: 0.1}).severities()
        assert why == ()
        for item, truth in zip(found, (0.32, 0.295, 0.97), strict=True):
            held.append(item.interval[0] <= truth <= item.interval[1])
    assert np.mean(held) >= 0.93


def test_a_step_down_has_its_sign() -> None:
    """Near the limit the bank steps down: half a step is less of it."""
    found, _ = flight(1, {2: 0.5}).severities()
    assert found[2].value == pytest.approx(0.97 - 0.025, abs=0.01)


def test_long_flights_take_no_more_room_and_lose_nothing() -> None:
    short, long = (
        flight(2, {1: 0.4}, count=count).severities()[0][1] for count in (COUNT, 10 * COUNT)
    )
    assert abs(long.value - 0.32) < abs(short.value - 0.32) + 0.002
    made = flight(2, {1: 0.4}, count=10 * COUNT)
    assert len(made._parts) <= PARTS[1]


def test_what_motion_does_not_show_has_no_number_and_a_reason() -> None:
    found, why = flight(3, {}, scale=0.01).severities()
    assert [item.estimate for item in found] == [None] * 3
    assert len(why) == 3
    assert why[1].startswith("this motion shows spool friction to ")
    assert float(why[1].split()[6]) > MAX_STD
    assert not found[0].shown


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (flight(4, {}, count=COUNT - PART_BLOCKS), "less than 5 min of free motion"),
        (flight(4, {1: 1.5}), "spool friction has changed by more than 0.05"),
    ],
)
def test_why_there_are_none(made: FlightEstimate, said: str) -> None:
    found, why = made.severities()
    assert why == (f"{said}: run a test",)
    assert not any(item.shown for item in found)


def test_after_an_alarm_of_something_else_there_are_none() -> None:
    made = flight(5, {})
    made.begin_anew("an alarm named load +400 ± 30 N")
    assert made.severities()[1] == ("an alarm named load +400 ± 30 N: run a test",)
    made.begin_anew()  # one of a severity
    assert made.severities()[1] == ("an alarm named load +400 ± 30 N: run a test",)


def test_blocks_before_the_oil_was_stated_are_none_of_the_estimate() -> None:
    """They are of the model's own oil: its error was taken for that of a stated one."""
    bank = ScoreBank(default_actuator(), (0.3, 0.3, 0.3))
    made = FlightEstimate(bank)
    slopes = np.eye(len(BANK), 20)
    block = BlockScore(slopes @ np.ones(20), slopes @ slopes.T, np.zeros((2, len(BANK))), 20)
    for _ in range(COUNT):
        made.add(block)
    bank.tune(Environment(oil_temperature=40.0))
    made.add(block)
    assert made.severities()[1] == ("less than 5 min of free motion: run a test",)
    bank.tune(Environment())
    made.add(block)  # less is known: all blocks stay
    assert made._blocks == 2
