"""Recordings that carry no verdict: what the host refuses, on board too."""

from dataclasses import replace

import numpy as np
import pytest
from places import LOGS

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.channels import PRESSURE, SPOOL
from ehadiag.core.stored_test import bundled_tests
from ehadiag.export.library import rules
from ehadiag.identify.session import Nuisances
from ehadiag.model.plant import plant_constants
from ehadiag.monitor.cusum import design_cusum
from ehadiag.monitor.plan import monitor_plan
from ehadiag.onboard.kernels import begin_identification, identify_some
from ehadiag.onboard.layout import SIZE, VERDICT
from ehadiag.onboard.plausible import carries_verdict
from ehadiag.onboard.rules import with_rules
from ehadiag_tools.onboard.replay import surrounded, ticks_of
from firmware_iface.logs.reader import read_recording

ACTUATOR = default_actuator()
PLAN = with_rules(
    monitor_plan(ACTUATOR, plant_constants(ACTUATOR), design_cusum(100.0, 1e-3)), rules(ACTUATOR)
)
RECORDING = read_recording(LOGS / "paper-open-1.blf")
NOT_TESTED = 30.0


def frozen(values):
    return np.where(np.isfinite(values), values[100], np.nan)


def dead(values):
    return np.full_like(values, np.nan)


DAMAGES = {
    "spool frozen": {"spool": frozen},
    "pressure frozen": {"pressure": frozen},
    "spool dead": {"spool": dead},
    "pressure dead": {"pressure": dead},
    "spool at its converter's end": {"spool": lambda v: np.where(v > 0.2e-3, 1.0, v)},
    "pressure at its converter's end": {"pressure": lambda v: np.where(v > 1e5, 1e9, v)},
    "position at its converter's end": {"position": lambda v: np.where(v > 1e-3, 1.0, v)},
    "spool stuck half-way": {"spool": lambda v: np.where(np.arange(len(v)) < 2500, v, v[2500])},
    "pressure of the other sign": {"pressure": np.negative},
}


def damaged(damage):
    """Recording with a damaged channel, at its converter's ends where it is beyond them."""
    samples = RECORDING.samples
    changed = {name: work(getattr(samples, name)) for name, work in damage.items()}
    saturated = np.array(samples.saturated)
    for channel in (SPOOL, PRESSURE):
        if channel.name in changed:
            top = channel.full_scale - channel.lsb
            row = ("current", "spool", "pressure", "position").index(channel.name)
            saturated[row] |= np.abs(np.nan_to_num(changed[channel.name])) >= top
            changed[channel.name] = np.clip(changed[channel.name], -channel.full_scale, top)
    if "position" in changed:
        saturated[3] |= np.nan_to_num(changed["position"]) >= 1.0
    return replace(RECORDING, samples=replace(samples, saturated=saturated, **changed))


def carried(ticks, supply=2e7):
    """Whether ticks of the reference unit carry a verdict on board."""
    memory, ticks = np.zeros(SIZE), np.ascontiguousarray(ticks)
    unit = np.array(surrounded(RECORDING)._replace(supply=supply), dtype=np.float64)
    places = memory.ctypes.data, PLAN.ctypes.data
    assert begin_identification(*places, unit.ctypes.data) == 0
    return bool(carries_verdict(memory.ctypes.data, PLAN, ticks, len(ticks)))


def test_a_sound_recording_carries_a_verdict():
    assert carried(ticks_of(RECORDING))


@pytest.mark.parametrize("name", list(DAMAGES)[:-2])
def test_a_damaged_channel_carries_none(name):
    assert not carried(ticks_of(damaged(DAMAGES[name])))


def test_a_few_samples_at_the_end_do_no_harm():
    ticks = ticks_of(RECORDING)
    ticks[:100, 2] = SPOOL.full_scale
    assert carried(ticks)
    ticks[:120, 2] = SPOOL.full_scale
    assert not carried(ticks)


@pytest.mark.parametrize(("share", "carries"), [(0.51, True), (0.49, False)])
def test_without_half_the_supply_nothing_is_judged(share, carries):
    assert carried(ticks_of(RECORDING), share * ACTUATOR.servovalve.PSR) is carries


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGES)
def test_what_the_host_does_not_test_the_board_does_not_either(name):
    recording = damaged(DAMAGES[name])
    found = diagnose([recording], ACTUATOR, bundled_tests().values(), nuisances=Nuisances.NONE)
    assert found.verdict is Verdict.NOT_TESTED
    ticks = np.ascontiguousarray(ticks_of(recording))
    memory, unit = np.zeros(SIZE), np.array(surrounded(recording), dtype=np.float64)
    places = memory.ctypes.data, PLAN.ctypes.data
    assert begin_identification(*places, unit.ctypes.data) == 0
    assert identify_some(*places, ticks.ctypes.data, (float(len(ticks)), 1e9)) == 0
    assert memory[VERDICT] == NOT_TESTED
