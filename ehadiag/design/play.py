"""Plays a test on the monitoring model, the jack's position fed back where the test asks for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CHANNELS, POSITION, PRESSURE, SPOOL
from ehadiag.core.recording import CommandMode, Environment, Samples
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.noise import TYPICAL_NOISE_LSB
from ehadiag.monitor.monitor import Monitor, Tick

__all__ = ["Played", "play"]

NOISE_LSB = 0.5
"""Of the position that the control law works on (PHY-22)."""
SEED = 0
LOST = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Played:
    """A test as an actuator would answer it.

    Attributes
    ----------
    experiment : Experiment
        Ready for identification, with the noise of PHY-22.
    travel : float
        Largest distance of the jack from its middle, m.
    rate : float
        Largest speed of the jack, m/s.
    pressure : float
        Largest differential pressure, Pa.
    """

    experiment: Experiment
    travel: float
    rate: float
    pressure: float


def play(test: StoredTest, actuator: Actuator, severities: tuple[float, ...]) -> Played:
    """Run a test from rest; the noise of the fed-back position is the same at every call.

    Parameters
    ----------
    test : StoredTest
    actuator : Actuator
    severities : tuple of float
        In the order of the registry, each 0 … 1.
    """
    mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
    monitor = Monitor(actuator, severities, mode=mode)
    commands = test.command()
    noise = np.random.default_rng(SEED).normal(0.0, NOISE_LSB, len(commands))
    answers = np.empty((len(commands), 3))
    seen = np.empty(len(commands))
    for k, command in enumerate(commands):
        # The position goes into the control law of the next tick (BUS-7), and nowhere else.
        before = seen[k - 1] if k else 0.0
        answers[k] = monitor.push(Tick(float(command), LOST, LOST, LOST, before)).predicted
        seen[k] = POSITION.lsb * np.round(answers[k, 2] / POSITION.lsb + noise[k])
    experiment = build_experiment(
        _samples(test, mode, commands, answers, seen), Environment(), test, actuator
    )
    usual = tuple(TYPICAL_NOISE_LSB * channel.lsb for channel in (SPOOL, PRESSURE, POSITION))
    spool, pressure, position = np.abs(answers).max(axis=0)
    speed = np.abs(np.diff(answers[:, 2])).max() * test.rate
    del spool
    return Played(experiment.with_noise(usual), float(position), float(speed), float(pressure))
