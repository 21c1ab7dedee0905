"""Plays a test on the monitoring model, the jack's position fed back where the test asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.recording import CommandMode, Environment, Samples
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.experiment import Experiment, build_experiment
from ehadiag.identify.noise import TYPICAL_NOISE_LSB
from ehadiag.model.control import ControlLaw, ControlState, control, control_law
from ehadiag.monitor.monitor import Monitor, Tick

__all__ = ["Played", "play"]

NOISE_LSB = 0.5
"""Of the position that the control law works on (PHY-22)."""
SEED = 0
"""Of that noise: two tests are compared on the same."""
LOST = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Played:
    """A test as an actuator would answer it.

    Attributes
    ----------
    experiment : Experiment
        Ready for identification, its noise that of PHY-22.
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


def play(
    test: StoredTest,
    actuator: Actuator,
    severities: tuple[float, ...],
    effects: Mapping[str, float],
) -> Played:
    """Run a test from rest.

    Parameters
    ----------
    test : StoredTest
        What is played.
    actuator : Actuator
        Data of the actuator.
    severities : tuple[float, ...]
        In the order of the registry, each 0 … 1.
    effects : Mapping[str, float]
        Nuisances and errors of data by the registry's names, SI.

    Returns
    -------
    Played
        The answer, without noise but for the fed-back position.

    Raises
    ------
    ConfigurationError
        A severity or an effect out of its range.
    """
    # The control law runs here, so the monitor is told currents.
    monitor = Monitor(actuator, severities, mode=CommandMode.CURRENT, effects=effects)
    channels = actuator_channels(actuator)
    lsb = channels.position.lsb
    law = control_law(actuator.controller, 1.0 / test.rate)
    commands = test.command()
    noise = np.random.default_rng(SEED).normal(0.0, NOISE_LSB, len(commands))
    answers, seen = np.empty((len(commands), 3)), np.empty(len(commands))
    state, place = ControlState(0.0, 0.0, 0.0), 0.0
    for k, command in enumerate(commands.tolist()):
        current = command
        if test.closed_loop:
            current, state = _next_current(law, state, command - place)
        answers[k] = monitor.push(Tick(current, LOST, LOST, LOST, LOST)).predicted
        # The next tick's control law works on the digitised position (BUS-7).
        place = lsb * round(float(answers[k, 2]) / lsb + float(noise[k]))
        seen[k] = place
    experiment = build_experiment(_samples(test, commands, answers, seen), AS_FILED, test, actuator)
    noise_of = tuple(TYPICAL_NOISE_LSB * channel.grain for channel in channels[1:])
    _, pressure, travel = np.abs(answers).max(axis=0)
    rate = float(np.abs(np.diff(answers[:, 2])).max()) * test.rate
    return Played(experiment.with_noise(noise_of), float(travel), rate, float(pressure))


AS_FILED = Environment()
"""Oil and supply as the actuator file says."""


@kernel
def _next_current(law: ControlLaw, state: ControlState, error: float) -> tuple[float, ControlState]:
    return control(law, state, error)


def _samples(
    test: StoredTest,
    commands: NDArray[np.float64],
    answers: NDArray[np.float64],
    seen: NDArray[np.float64],
) -> Samples:
    """Samples without noise, but for the position that the control law saw."""
    ticks = len(commands)
    return Samples(
        period_ns=round(1e9 / test.rate),
        mode=CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT,
        current=np.full(ticks, np.nan),
        spool=answers[:, 0],
        pressure=answers[:, 1],
        position=seen,
        command=commands,
        saturated=np.zeros((len(CHANNELS), ticks), dtype=np.bool_),
        host_ns=np.full(ticks, -1, dtype=np.int64),
    )
