"""Blocks of the actuator that a model leaves unexplained, and a spool that creeps in steps."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ehadiag import default_actuator
from ehadiag.assess.blocks import (
    BLOCKS,
    block_masks,
    pulls_of_blocks,
    unexplained_block,
    words_of_pulls,
)
from ehadiag.assess.response_checks import creep_note, spool_steps
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import parameter
from ehadiag.model.residual_models import ModelResponse
from firmware_iface.recording import CHANNELS, Channels
from firmware_iface.stored_test import resolve_test

OPEN = resolve_test("open")
NOISE = 0.14e-6


def experiment(spool, position=None, test=OPEN):
    still = np.zeros_like(spool)
    return SimpleNamespace(
        test=test,
        tick=1e-3,
        spool=spool,
        pressure=still,
        position=still if position is None else position,
        spool_noise=NOISE,
        pressure_noise=7e3,
        constants=plant_constants(default_actuator()),
        channels=Channels(*CHANNELS),
    )


def ramp(step):
    """A spool that follows the slow ramps in steps of a size, or in one jump, m."""
    slow = 30e-6 * np.interp(np.arange(OPEN.ticks) * 1e-3, [0.2, 0.7, 1.7, 2.2], [0, 1, -1, 0])
    rng = np.random.default_rng(1)
    return step * np.round(slow / step) + 0.5 * NOISE * rng.standard_normal(len(slow))


def test_steps_are_counted_with_their_sizes():
    path = np.repeat([0.0, 2e-6, 2e-6, 7e-6, 8e-6], 5)
    assert spool_steps(path, 0.5e-6) == pytest.approx([2e-6, 5e-6, 1e-6])
    assert not spool_steps(path, 6e-6).size


def test_a_spool_that_creeps_in_steps_is_named():
    note = creep_note([experiment(ramp(1.5e-6))], [ramp(20e-6)])
    assert "steps of 1.5 µm" in note
    assert "hysteresis" in note
    assert creep_note([experiment(ramp(1.5e-6))], [np.zeros(OPEN.ticks)])


def test_a_spool_that_jumps_as_the_model_does_is_not():
    assert not creep_note([experiment(ramp(20e-6))], [ramp(20e-6)])
    assert not creep_note([experiment(ramp(20e-6))], [np.zeros(OPEN.ticks)])
    assert not creep_note([experiment(ramp(1.5e-6))], [ramp(1.5e-6)])
    closed = experiment(ramp(1.5e-6), test=resolve_test("closed"))
    assert not creep_note([closed], [ramp(20e-6)])


def test_each_sample_is_of_one_block():
    slewing = np.cumsum(np.where(np.arange(400) < 200, 0.0, 5e-5))
    moving = np.where(np.arange(400) < 100, np.arange(400) * 1e-4, 1e-2)
    masks = block_masks([experiment(slewing, moving)])
    assert tuple(masks) == BLOCKS
    assert sum(mask.astype(int) for mask in masks.values()).min() == 1
    assert sum(mask.astype(int) for mask in masks.values()).max() == 1


@pytest.mark.parametrize(
    ("row", "ticks", "block"),
    [
        (0, slice(250, 350), "torque"),
        (0, slice(0, 100), "spool"),
        (1, slice(20, 80), "jack"),
        (1, slice(200, 380), "pressure"),
    ],
)
def test_the_block_with_the_residuals_is_named(row, ticks, block):
    slewing = np.cumsum(np.where(np.arange(400) < 200, 0.0, 5e-5))
    moving = np.where(np.arange(400) < 100, np.arange(400) * 1e-4, 1e-2)
    unit = experiment(slewing, moving)
    signals = [slewing.copy(), np.zeros(400)]
    signals[row][ticks] += 20.0 * (NOISE, 7e3)[row]
    model = ModelResponse(signals[0], signals[1], moving, 0)
    assert unexplained_block([unit], [model]) == block


def test_pulls_of_all_blocks_together_are_the_step():
    """A block's pull is what its residuals alone would move a severity by."""
    free = (parameter("datum_GQF"), parameter("datum_FSS0"), parameter("datum_FDJ0"))
    rng = np.random.default_rng(2)
    jacobian = rng.standard_normal((3, 2, 400))
    off = np.array([0.02, -0.5, 0.1])
    rows = jacobian.reshape(3, -1)
    refined = SimpleNamespace(
        parameters=free,
        normal=rows @ rows.T,
        information=None,
        used=np.ones((2, 400), dtype=bool),
        jacobian=jacobian,
        residuals=-np.tensordot(off, jacobian, 1),
        scale=np.ones(3),
    )
    slewing = np.cumsum(np.where(np.arange(400) < 200, 0.0, 5e-5))
    pulls = pulls_of_blocks([experiment(slewing)], refined, default_actuator())
    assert tuple(pulls) == BLOCKS
    total = {name: sum(part[name] for part in pulls.values()) for name in pulls["torque"]}
    assert total["Kintas"] == pytest.approx(-0.02 / 0.8)
    assert total["FSS"] == pytest.approx(-0.5 * 2.0 / 58.0)
    assert total["FDJ"] == pytest.approx(0.1 * 150.0 / 2850.0)
    assert words_of_pulls(pulls).startswith("not explained, in severities: torque Kintas")
