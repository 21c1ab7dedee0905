"""The test of free motion for changes: its values, its threshold, oil and supply that run."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ehadiag import CommandMode, ConfigurationError, Monitor, default_actuator
from ehadiag.compile.jit import Array2
from ehadiag.monitor.change_test import (
    CAUSES,
    GUMBEL,
    PIECE_H,
    TAIL_H,
    VOTE_CAP,
    Cause,
    Change,
    ChangeTest,
    alarm_threshold,
    span_values,
)
from ehadiag.monitor.score_bank import BANK, BANK_NAMES, BlockScore, ScoreBank
from ehadiag_tools.free_motion.motion import Motion, free_motion
from firmware_iface.recording import Environment

ACTUATOR = default_actuator()
WORN = (0.3, 0.3, 0.3)
STEADY = np.array([item.steady / item.step for item in BANK])


@pytest.mark.parametrize("hours", [2.0, 10.0, 100.0])
def test_the_threshold_is_exceeded_once_in_its_hours(hours: float) -> None:
    """By Gumbel's law of the largest value of a piece."""
    above = -math.expm1(-math.exp((GUMBEL[0] - alarm_threshold(hours)) / GUMBEL[1]))
    assert above == pytest.approx(-math.expm1(-PIECE_H / hours), rel=1e-9)


def test_the_threshold_of_few_hours_is_that_where_the_tail_begins() -> None:
    assert alarm_threshold(0.1) == alarm_threshold(TAIL_H) > 1.0


@pytest.mark.parametrize("hours", [0.0, math.nan, 1e9])
def test_hours_out_of_range_are_refused(hours: float) -> None:
    with pytest.raises(ConfigurationError, match="hours between false alarms"):
        alarm_threshold(hours)


def blocks(rng: np.random.Generator, shift: float, place: int, count: int = 20) -> list[BlockScore]:
    """Blocks of a linear model with white noise and one parameter off by some steps."""
    made = []
    for _ in range(count):
        slopes = rng.standard_normal((len(BANK), 500))
        residual = rng.standard_normal(500) + shift * slopes[place]
        made.append(BlockScore(slopes @ residual, slopes @ slopes.T, np.zeros((2, len(BANK))), 500))
    return made


def test_values_of_noise_are_no_greater_than_normal_deviates() -> None:
    rng = np.random.default_rng(1)
    values = np.array([span_values(blocks(rng, 0.0, 0), STEADY) for _ in range(200)])
    assert np.all(values.std(axis=0) < 1.2)
    assert np.all(np.abs(values.mean(axis=0)) < 0.3)


@pytest.mark.parametrize("cause", range(0, len(CAUSES), 3))
def test_what_is_off_has_the_greatest_value(cause: int) -> None:
    rng = np.random.default_rng(cause)
    values = span_values(blocks(rng, 1.0, CAUSES[cause]), STEADY)
    assert np.abs(values).argmax() == cause
    assert values[cause] > 0.0


def test_one_block_however_large_is_no_change() -> None:
    rng = np.random.default_rng(3)
    made = blocks(rng, 0.0, 2)
    made[7] = blocks(rng, 50.0, 2, 1)[0]
    assert np.abs(span_values(made, STEADY)).max() < 4.0


def test_blocks_without_information_say_nothing() -> None:
    none = BlockScore(
        np.zeros(len(BANK)), np.zeros((len(BANK), len(BANK))), np.zeros((2, len(BANK))), 500
    )
    assert not span_values([none] * 20, STEADY).any()


def test_oil_and_supply_that_run_are_those_of_a_monitor_made_for_them() -> None:
    """The state goes on: only the laws change."""
    environment = Environment(18e6, 1e6, 75.0)
    rows = free_motion(ACTUATOR, Motion("noise", "current", 1.0, WORN, 1)).rows
    made, tuned = Monitor(ACTUATOR, WORN, environment), Monitor(ACTUATOR, WORN)
    tuned.tune(environment)
    for row in rows[:500].tolist():
        made.push(tuple(row))
        tuned.push(tuple(row))
    np.testing.assert_array_equal(made.reading.predicted, tuned.reading.predicted)
    before = tuned.reading.predicted.copy()
    tuned.tune(Environment(19e6, 1e6, 20.0))
    np.testing.assert_array_equal(tuned.reading.predicted, before)


def test_a_block_is_what_its_ticks_are() -> None:
    rows = free_motion(ACTUATOR, Motion("steps", "position", 0.5, WORN, 1)).rows
    block, single = (Monitor(ACTUATOR, WORN, mode=CommandMode.POSITION) for _ in range(2))
    found = block.push_block(rows)
    for row, modelled in zip(rows.tolist(), found, strict=True):
        reading = single.push(tuple(row))
        np.testing.assert_array_equal(reading.predicted[[0, 2]], modelled[:2])
        np.testing.assert_array_equal(reading.residual, modelled[3:])


def changes_in(motion: Motion, given: tuple[float, float, float], **options: float) -> list[Cause]:
    """Likeliest causes of the changes found, the supply not stated."""
    mode = CommandMode[motion.mode.upper()]
    test = ChangeTest(ScoreBank(ACTUATOR, given, mode=mode), 1000.0, 10.0, **options)
    found = [test.push(tuple(row)) for row in free_motion(ACTUATOR, motion).rows.tolist()]
    return [item.causes[0] for item in found if item is not None and not item.repeated]


def test_a_change_is_named_with_its_size_and_an_unchanged_unit_is_silent() -> None:
    motion = Motion("gusts", "current", 22.0, WORN, 5, exact=True)
    assert changes_in(motion, WORN) == []
    (cause,) = changes_in(motion, (0.3, 0.3, 0.2))
    assert (cause.name, cause.size) == ("FDJ", pytest.approx(0.1, abs=0.02))
    assert 0.0 < cause.stderr < 0.05
    assert changes_in(motion, (0.3, 0.3, 0.2), least=0.2) == []


def test_an_offset_of_the_spool_sensor_is_no_null_bias() -> None:
    """Tried at some sizes only, a null bias explained two thirds of the residuals."""
    change = Motion("multisine", "current", 24.0, WORN, 5, exact=True, change="spool_offset",
                    size=2e-6, after=6.0)  # fmt: skip
    cause = changes_in(change, WORN)[0]
    assert (cause.name, cause.size) == ("spool_offset", pytest.approx(2e-6, rel=0.05))


def test_a_filter_that_clogs_is_found_by_the_votes_of_the_blocks_that_show_it() -> None:
    """Its values over spans stay below the threshold: most blocks show nothing of it."""
    motion = Motion("stairs", "position", 26.0, WORN, 5, exact=True)
    assert changes_in(motion, WORN) == []
    cause = changes_in(motion, (0.2, 0.3, 0.3))[0]
    assert (cause.name, cause.size) == ("Kintas", pytest.approx(0.1, abs=0.03))


class VotingBank(ScoreBank):
    """A bank whose blocks show of a cause what the command says, and of all else nothing."""

    cause, size = "Kintas", 1.0
    """What explains the blocks, and its size in steps."""
    rival, rival_gain = "", 1.0
    """What explains them, too, and how much of each."""
    telling = 1000
    """Number of the last blocks that tell one size from another."""

    def settle(self, rows: Array2) -> None:
        """Run no model."""

    def push(self, rows: Array2) -> BlockScore:
        gain = np.zeros((2, len(BANK)))
        gain[int(self.size < 0.0), BANK_NAMES.index(self.cause)] = rows[0, 0]
        return BlockScore(np.zeros(len(BANK)), np.zeros((len(BANK), len(BANK))), gain, len(rows))

    def gains(
        self, blocks: list[tuple[Array2, Environment]], trials: list[tuple[int, float]]
    ) -> Array2:
        share = {self.rival: self.rival_gain, self.cause: 1.0}
        each = [
            share.get(BANK_NAMES[place], 0.0) / (1.0 + abs(size - self.size))
            for place, size in trials
        ]
        out = np.outer(each, np.ones(len(blocks)))
        out[:, : -self.telling] = out[:, : -self.telling] > 0.0
        return out


def votes_of(test: ChangeTest, gain: float, count: int) -> list[Change]:
    """Changes found in so many blocks of one tick with that gain."""
    found = (test.push((gain, 0.0, 0.0, 0.0, 0.0)) for _ in range(count))
    return [item for item in found if item is not None]


def test_a_voted_change_that_comes_and_goes_leaves_the_next_one_to_be_found() -> None:
    test = ChangeTest(VotingBank(ACTUATOR, WORN), 2.0, 100.0)
    first, *later = votes_of(test, 1000.0, 7200)
    assert first.causes[0].name == "Kintas"
    assert all(item.repeated for item in later)
    assert max(item.value for item in later) <= VOTE_CAP
    votes_of(test, -20.0, 60)
    assert votes_of(test, -20.0, 300) == []
    assert [item.repeated for item in votes_of(test, 1000.0, 60)][:1] == [False]


@pytest.mark.parametrize(("gain", "named"), [(1.0, {"Kintas", "load"}), (0.9, {"Kintas"})])
def test_another_cause_is_named_where_the_blocks_cannot_tell(gain: float, named: set[str]) -> None:
    """One that explains every block a little less is none, however little that is."""
    bank, test = voting()
    bank.rival, bank.rival_gain = "load", gain
    found = next(item for item in votes_of(test, 1000.0, 60) if item.causes)
    assert {item.name for item in found.causes} == named


def test_the_size_of_a_change_is_found_closer_and_closer() -> None:
    bank, test = voting()
    bank.size = 2.3
    found = next(item for item in votes_of(test, 1000.0, 60) if item.causes)
    assert found.causes[0].size == pytest.approx(0.23, rel=0.025)


def repeats(bank: VotingBank, test: ChangeTest, size: float) -> bool:
    """Whether a change of so many steps, found after three minutes without one, is a repeat."""
    votes_of(test, -20.0, 360)
    bank.size = size
    first = next(item for item in votes_of(test, 1000.0, 60) if item.causes)
    assert first.causes[0].name == bank.cause
    return first.repeated


def voting() -> tuple[VotingBank, ChangeTest]:
    bank = VotingBank(ACTUATOR, WORN)
    return bank, ChangeTest(bank, 2.0, 100.0)


def test_a_change_found_anew_within_an_hour_repeats_its_alarm() -> None:
    bank, test = voting()
    found = [repeats(bank, test, size) for size in (3.0, 3.0, 2.5, 3.5)]
    assert found == [False, True, True, True]


def test_a_change_that_has_grown_is_another_alarm() -> None:
    """One that grew fourfold within three minutes was a repeat."""
    bank, test = voting()
    assert [repeats(bank, test, size) for size in (1.0, 4.0, 4.0)] == [False, False, True]


def test_a_change_that_grows_while_it_goes_on_is_another_alarm() -> None:
    bank, test = voting()
    assert [item.repeated for item in votes_of(test, 1000.0, 120)].count(False) == 1
    bank.size = 4.0
    assert [item.repeated for item in votes_of(test, 1000.0, 240)].count(False) == 1


def test_a_change_that_one_block_shows_larger_has_not_grown() -> None:
    """A friction that went on was found at twice its size once in eight minutes."""
    bank, test = voting()
    votes_of(test, 1000.0, 120)
    bank.size, bank.telling = 4.0, 1
    later = [item for item in votes_of(test, 1000.0, 240) if item.causes]
    assert [item.causes[0].size > 0.3 for item in later] == [True] * len(later)
    assert later
    assert all(item.repeated for item in later)


def test_a_change_in_the_other_direction_is_another_alarm() -> None:
    bank, test = voting()
    bank.cause = "load"
    found = [repeats(bank, test, size) for size in (3.0, -3.0, 3.0, -3.0)]
    assert found == [False, False, True, True]


def test_an_alarm_is_repeated_for_an_hour_of_motion_whatever_repeats_it() -> None:
    """Each turn has four minutes of motion, and a silence, which does not count."""
    bank, test = voting()
    found = []
    for _ in range(18):
        found.append(repeats(bank, test, 1.0))
        votes_of(test, -20.0, 60)
        test.reset()
    assert found[:14] == [False] + [True] * 13
    assert found[14:].count(False) == 1


def test_a_cause_that_wins_two_votes_in_three_is_no_change() -> None:
    """So did a filter in hot oil whose unit had none; see `VOTE_MARGIN`."""
    test = ChangeTest(VotingBank(ACTUATOR, WORN), 2.0, 10.0)
    assert [found for _ in range(300) for gain in (1e3, 1e3, -1e3)
            if (found := votes_of(test, gain, 1))] == []  # fmt: skip


def test_votes_begin_anew_after_a_silence() -> None:
    test = ChangeTest(VotingBank(ACTUATOR, WORN), 2.0, 100.0)
    votes_of(test, 1000.0, 15)
    assert test.values[-2, 0] > 5.0
    test.reset()
    assert not test.values.any()
    assert votes_of(test, 1000.0, 15) == []


def test_blocks_vote_for_the_step_that_their_ticks_show() -> None:
    moved = free_motion(ACTUATOR, Motion("stairs", "position", 12.0, WORN, 5, exact=True)).rows
    bank = ScoreBank(ACTUATOR, (0.2, 0.3, 0.3), mode=CommandMode.POSITION)
    bank.reset(float(moved[0, 2]))
    gains = [bank.push(rows).gain for rows in moved.reshape(-1, 500, 5)]
    place = BANK_NAMES.index("Kintas")
    up, down = np.array(gains)[:, :, place].T
    assert up.max() > 70.0
    assert (up > 0.0).mean() > 0.4
    assert (down <= 0.0).mean() > 0.8


def test_a_cause_is_tried_up_to_the_bounds_of_its_effect() -> None:
    """A unit whose diagnosis had a null bias ended in an error."""
    bank = ScoreBank(ACTUATOR, WORN, effects={"null_bias": 5e-4})
    rows = free_motion(ACTUATOR, Motion("steps", "current", 2.0, WORN, 1)).rows
    blocks = [(part, Environment()) for part in rows.reshape(-1, 500, 5)]
    trials = [(BANK_NAMES.index("null_bias"), size) for size in (-5.0, 20.0)]
    less, more = bank.gains(blocks, trials)
    assert less.any()
    assert not more.any()


def test_supply_that_is_not_stated_is_no_cause_of_small_changes() -> None:
    bank = ScoreBank(ACTUATOR, WORN)
    place = BANK_NAMES.index("supply")
    bank.tune(Environment(20e6, 0.0, 40.0))
    stated = bank.steady[place]
    bank.tune(Environment(None, None, 40.0))
    assert bank.steady[place] > 10.0 * stated


@pytest.mark.parametrize(
    ("cause", "text"),
    [
        (Cause("FSS", 0.0412, 0.011), "spool friction +0.04 ± 0.01"),
        (Cause("spool_offset", 3.1e-6, 0.4e-6), "spool sensor offset +3.1 ± 0.4 µm"),
        (Cause("supply", -2.04e6, 0.3e6), "supply pressure -2.0 ± 0.3 MPa"),
        (Cause("load", 412.0, 35.0), "load +412 ± 35 N"),
    ],
)
def test_a_cause_is_a_text_with_its_error(cause: Cause, text: str) -> None:
    assert str(cause) == text
