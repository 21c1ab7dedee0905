"""Random motion of the simulated actuator in both modes, tick by tick."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import SCALES
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.recording import CommandMode
from ehadiag_sim.fcc.controller import PositionLaw
from ehadiag_sim.plant.coefficients import coefficients
from ehadiag_sim.plant.conditions import Effects, Faults, Sensors
from ehadiag_tools.free_motion.kernels import moved

__all__ = ["free_motion", "random_command"]

PIECE_S = (0.3, 4.0)
REACH = {CommandMode.POSITION: 10e-3, CommandMode.CURRENT: 1.5e-3}
"""Largest command, m and A; in current mode what brings the jack back is added."""
SINE_HZ = (0.2, 20.0)
NOISE_HZ = (0.2, 10.0)
CORNER_HZ = 2.0
"""Amplitudes fall beyond."""
CENTRING_A_M = 0.1
CENTRING_S = 0.5
"""In current mode the jack would walk off: gain and time constant of what brings it back."""
STEP = 2e-6
"""Integration step, s: errors below a sixth of the noise, at an eighth of the default's time."""


def random_command(rng: np.random.Generator, ticks: int, rate: float, reach: float) -> list[float]:
    """Return holds, steps, ramps, sines and filtered noise in random order.

    Parameters
    ----------
    rng : np.random.Generator
        Draws them.
    ticks : int
        Length.
    rate : float
        Ticks a second.
    reach : float
        Largest command either way, m or A.

    Returns
    -------
    list[float]
        Command of each tick, m or A.
    """
    out: list[NDArray[np.float64]] = []
    last, length = 0.0, 0
    while length < ticks:
        count = int(rng.uniform(*PIECE_S) * rate)
        time = np.arange(count) / rate
        target, kind = rng.uniform(-reach, reach), rng.integers(5)
        if kind == 0:
            piece = np.full(count, last)
        elif kind == 1:
            piece = np.full(count, target)
        elif kind == 2:
            piece = np.linspace(last, target, count)
        elif kind == 3:
            hertz = _even_in_octaves(rng, SINE_HZ)
            piece = last + target / (1.0 + hertz / CORNER_HZ) * np.sin(2 * np.pi * hertz * time)
        else:
            hertz = _even_in_octaves(rng, NOISE_HZ)
            share = 2.0 * math.pi * hertz / rate
            noise, value = np.empty(count), 0.0
            for k, draw in enumerate(rng.standard_normal(count).tolist()):
                value += share * (draw - value)
                noise[k] = value
            size = 0.25 * reach / math.sqrt(share / (2.0 - share)) / (1.0 + hertz / CORNER_HZ)
            piece = last + size * (noise - noise[0])
        piece = np.clip(piece, -reach, reach)
        out.append(piece)
        last, length = float(piece[-1]), length + count
    commands: list[float] = np.concatenate(out)[:ticks].tolist()
    return commands


def free_motion(
    actuator: Actuator,
    faults: Faults,
    mode: CommandMode,
    seconds: float,
    seed: int,
    step: float = STEP,
) -> NDArray[np.float64]:
    """Move a simulated actuator at random, from rest.

    Parameters
    ----------
    actuator : Actuator
        Its data.
    faults : Faults
        Its severities.
    mode : CommandMode
        What commands are.
    seconds : float
        Length.
    seed : int
        Of motion and noise.
    step : float
        Of the integration, s.

    Returns
    -------
    NDArray[np.float64]
        Shape (ticks, 5): command (A or m), current (A), spool (m), pressure (Pa), position (m).
    """
    controller, sensors = actuator.controller, Sensors()
    rate = controller.rate
    rng = np.random.default_rng((seed, int(mode)))
    commands = random_command(rng, round(seconds * rate), rate, REACH[mode])
    closed = mode is CommandMode.POSITION
    channels = actuator_channels(actuator)
    noise = np.random.default_rng(int(rng.integers(1 << 31)))
    return moved(
        np.array(commands),
        closed,
        0.0 if closed else CENTRING_A_M,
        1.0 / (CENTRING_S * rate),
        SCALES.position_step if closed else SCALES.current_step,
        PositionLaw(controller.IM, controller.GAP, controller.GAI, controller.GAD, 1.0 / rate),
        coefficients(actuator, faults, Effects()),
        sensors.noise_lsb * noise.standard_normal((len(commands) + 1, len(channels))),
        np.array([channel.lsb for channel in channels]),
        np.array([float(channel.half) for channel in channels]),
        math.ceil(1.0 / (rate * step) - 1e-6),
    )


def _even_in_octaves(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return math.exp(rng.uniform(math.log(ends[0]), math.log(ends[1])))
