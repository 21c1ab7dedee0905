"""Experiments with known truth for tests of the identification."""

from functools import lru_cache

import numpy as np
from places import LOGS

from ehadiag import CommandMode, Samples, default_actuator
from ehadiag.identify.experiment import build_experiment
from ehadiag.model.registry import FAULT_NAMES
from ehadiag.model.residual_models import model_response
from ehadiag_tools.simulator.units import damaged_unit
from firmware_iface.recording import CHANNELS, Environment
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test

PAPER_FAULTS = ((0.3, 0.3, 0.3), (0.3, 0.6, 0.3), (0.6, 0.6, 0.3), (0.6, 0.6, 0.6))


@lru_cache(maxsize=16)
def recorded(file, test):
    """Experiment of a reference recording (PHY-41; not from the project's simulator)."""
    recording = read_recording(LOGS / file)
    return build_experiment(
        recording.samples, recording.environment, resolve_test(test), default_actuator()
    )


def own_samples(faults, *, seed=0, noise_lsb=0.5, offsets_lsb=(0.0, 0.0)):
    """Open-loop test with the monitoring model as the plant: nothing is mismatched."""
    test = resolve_test("open")
    current = test.command()
    truth = model_response(damaged_unit(faults), current, 1e-3)
    rng = np.random.default_rng(seed)
    clean = (current, truth.spool, truth.pressure, truth.position)
    offsets = (0.0, *offsets_lsb, 0.0)
    seen = []
    for channel, values, offset in zip(CHANNELS, clean, offsets, strict=True):
        volts = values + channel.lsb * (offset + noise_lsb * rng.standard_normal(len(values)))
        seen.append(channel.decode(channel.encode(volts)))
    return Samples(
        period_ns=1_000_000,
        mode=CommandMode.CURRENT,
        current=seen[0],
        spool=seen[1],
        pressure=seen[2],
        position=seen[3],
        command=current,
        saturated=np.zeros((4, test.ticks), dtype=np.bool_),
        host_ns=np.arange(test.ticks, dtype=np.int64) * 1_000_000,
    )


def own_experiment(faults, **options):
    samples = own_samples(faults, **options)
    return build_experiment(samples, Environment(), resolve_test("open"), default_actuator())


def named(faults):
    """Severities by name."""
    return dict(zip(FAULT_NAMES, faults, strict=True))


NOISE = (
    CHANNELS.spool.lsb * np.sqrt(0.5**2 + 1 / 12),
    CHANNELS.pressure.lsb * np.sqrt(0.5**2 + 1 / 12),
)
