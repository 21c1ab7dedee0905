"""Free motion of the simulated actuator: twelve kinds, both modes, oil and supply that change.

The plant is the detailed simulator's, by semi-implicit steps of fixed length; the monitor's own
model moves by exact transitions between events and by collocation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, Array2, kernel
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.plant_dynamics import STATE, advance_plant
from ehadiag_sim.plant_laws import PlantCoefficients, plant_coefficients
from firmware_iface.recording import DEFAULT_SCALES, CommandMode, Environment

KINDS = (
    "hold", "steps", "ramps", "sines", "chirps", "noise", "triangles", "doublets", "stairs",
    "manoeuvres", "gusts", "dither",
)  # fmt: skip
"""Kinds of motion; a piece has one, broken by holds."""
LARGEST = {CommandMode.POSITION: 10e-3, CommandMode.CURRENT: 1.5e-3}
"""Largest command, m and A; in current mode what brings the jack back is added."""
CORNER_HZ = 2.0
"""Frequency beyond which amplitudes fall, Hz."""
CENTRING_A_M, CENTRING_S = 0.1, 0.5
"""Gain, A/m, and time constant, s, of what keeps the jack from walking off in current mode."""
STEP = 8e-6
"""Integration step, s: thirty-two times the default's; the monitor's scores are those of 1 µs."""
ENVIRONMENT_TICKS = 20
"""Ticks between two changes of oil and supply, 1."""
REPORT_TICKS = 100
"""Ticks between two messages of oil and supply, 1."""
TOLD_NOISE = (0.05e6, 0.5)
"""Noise of the told supply, Pa, and oil, K: each message has its own."""
PROBE_ERROR = (0.05e6, 1.0)
"""Standard deviation of a probe's constant error, Pa and K."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A piece of free motion, and what the unit is in it."""

    kind: str
    mode: str
    seconds: float
    faults: tuple[float, float, float]
    seed: int
    oil: float = 40.0
    """At the beginning, degC."""
    oil_rate: float = 0.0
    """K/s."""
    ripple: float = 0.0
    """Amplitude of the supply, Pa."""
    ripple_hz: float = 1.0
    change: str = ""
    """What changes: a severity, `oil`, `supply`, `load`, or a sensor's offset or gain."""
    size: float = 0.0
    """By how much; SI."""
    after: float = 60.0
    """Time of the change, s."""
    exact: bool = False
    """Whether oil and supply are told without errors."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionRecord:
    """What came over the bus."""

    rows: NDArray[np.float64]
    """Command (A or m), current (A), spool (m), pressure (Pa), position (m), shape (ticks, 5)."""
    told: NDArray[np.float64]
    """Supply less return pressure (Pa) and oil (degC) every `REPORT_TICKS`, shape (n, 2)."""

    def mean_environment(self, begin: int, end: int) -> Environment:
        """Mean of oil and supply as told between two ticks."""
        told = self.told[begin // REPORT_TICKS : max(end, begin + REPORT_TICKS) // REPORT_TICKS]
        supply, oil = told.mean(axis=0).tolist()
        return Environment(supply, 0.0, oil)


@kernel
def _move(
    state: Array, p: PlantCoefficients, substeps: int, step: float, closed: bool, law: Array,
    commands: Array, noise: Array2, lsb: Array, gains: Array, held: Array, out: Array2,
) -> None:  # fmt: skip
    """Advance some ticks; law: gain (A/m), saturation (A), resolution of commands, centring gain
    and share; held: digitised position, and mean of the true one.
    """
    for k in range(commands.shape[0]):
        wanted = commands[k]
        if not closed:
            wanted -= law[3] * held[1]
        wanted = np.round(wanted / law[2]) * law[2]
        current = law[0] * (wanted - held[0]) if closed else wanted
        current = min(max(current, -law[1]), law[1])
        advance_plant(state, p, p.GM * current, step, substeps)
        truth = (current, state[STATE.spool], state[STATE.pressure], state[STATE.jack])
        out[k, 0] = wanted
        for c in range(4):
            code = np.round(truth[c] * gains[c] / lsb[c] + noise[k, c])
            out[k, 1 + c] = min(max(code, -2048.0), 2047.0) * lsb[c]
        held[0] = out[k, 4]
        held[1] += law[4] * (state[STATE.jack] - held[1])


SENSOR_PLACES = {"current": 0, "spool": 1, "pressure": 2, "position": 3}


def free_motion(actuator: Actuator, motion: Motion, step: float = STEP) -> MotionRecord:
    """Move a simulated actuator from rest, see `Motion`."""
    mode = CommandMode[motion.mode.upper()]
    rate, closed = actuator.controller.rate, mode is CommandMode.POSITION
    rng = np.random.default_rng((motion.seed, int(mode), KINDS.index(motion.kind)))
    ticks = round(motion.seconds * rate)
    commands = np.array(random_command(rng, motion.kind, ticks, rate, LARGEST[mode]))
    lsb = np.array([channel.lsb for channel in actuator_channels(actuator)])
    substeps = math.ceil(1.0 / (rate * step) - 1e-6)
    resolution = DEFAULT_SCALES.position_step if closed else DEFAULT_SCALES.current_step
    law = np.array([
        actuator.controller.GAP, actuator.controller.IM, resolution,
        CENTRING_A_M, 1.0 / (CENTRING_S * rate),
    ])  # fmt: skip
    state, held, out = np.zeros(STATE.end), np.zeros(2), np.empty((ticks, 5))
    error = np.zeros(2) if motion.exact else np.multiply(PROBE_ERROR, rng.standard_normal(2))
    told: list[list[float]] = []
    phase = rng.uniform(0.0, 2.0 * math.pi)
    changed = round(motion.after * rate) if motion.change else ticks + 1
    for tick in range(0, ticks, ENVIRONMENT_TICKS):
        time = tick / rate
        oil = motion.oil + motion.oil_rate * time
        wave = motion.ripple * math.sin(2.0 * math.pi * motion.ripple_hz * time + phase)
        supply = actuator.servovalve.PSR + wave
        if tick % REPORT_TICKS == 0:
            noise = np.zeros(2) if motion.exact else np.multiply(TOLD_NOISE, rng.normal(size=2))
            told.append(np.add([supply, oil], error + noise).tolist())
        size = motion.size if tick >= changed else 0.0
        gains = np.ones(4)
        name, _, part = motion.change.partition("_")
        if part == "gain":
            gains[SENSOR_PLACES[name]] += size
        severities = dict(zip(("Kintas", "FSS", "FDJ"), motion.faults, strict=True))
        if motion.change in severities:
            severities[motion.change] += size
        effects = Effects(
            oil_temperature=oil + (size if motion.change == "oil" else 0.0),
            supply_pressure=supply + (size if motion.change == "supply" else 0.0),
            return_pressure=0.0,
            load=size if motion.change == "load" else 0.0,
        )
        p = plant_coefficients(actuator, Faults(**severities), effects, filter_time=0.0)
        end = min(tick + ENVIRONMENT_TICKS, ticks)
        noise = 0.5 * rng.standard_normal((end - tick, 4))
        if part == "offset":
            noise[:, SENSOR_PLACES[name]] += size / lsb[SENSOR_PLACES[name]]
        _move(
            state, p, substeps, 1.0 / (rate * substeps), closed, law, commands[tick:end], noise,
            lsb, gains, held, out[tick:end],
        )  # fmt: skip
    return MotionRecord(out, np.array(told))


def random_command(
    rng: np.random.Generator, kind: str, ticks: int, rate: float, largest: float
) -> list[float]:
    """Commands of one kind of motion, m or A, at a rate in Hz; one segment of five is a hold."""
    out: list[NDArray[np.float64]] = []
    last, length = 0.0, 0
    while length < ticks:
        count = int(rng.uniform(0.5, 6.0) * rate)
        chosen = "hold" if rng.uniform() < 0.2 else kind
        piece = np.clip(_segment(rng, chosen, count, rate, last, largest), -largest, largest)
        out.append(piece)
        last, length = float(piece[-1]), length + count
    commands: list[float] = np.concatenate(out)[:ticks].tolist()
    return commands


def _segment(  # noqa: PLR0911 - one return a kind
    rng: np.random.Generator, kind: str, count: int, rate: float, last: float, largest: float
) -> NDArray[np.float64]:
    time = np.arange(count) / rate
    share = np.arange(count) / count
    target = rng.uniform(-largest, largest)
    if kind == "hold":
        small = 0.02 * largest * rng.integers(-1, 2)
        return np.full(count, last + small)
    if kind == "steps":
        return np.full(count, target)
    if kind == "ramps":
        return np.linspace(last, target, count)
    if kind == "manoeuvres":
        return last + (target - last) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    if kind == "stairs":
        return last + (target - last) * np.floor(share * rng.integers(3, 9) + 1.0) / 9.0
    if kind == "doublets":
        width = int(rng.uniform(0.05, 0.5) * rate)
        turn = np.arange(count) // width
        return last + 0.5 * target * np.where(turn == 0, 1.0, np.where(turn == 1, -1.0, 0.0))
    if kind == "dither":
        hertz = _even_in_octaves(rng, (1.0, 15.0))
        return last + 0.03 * target * np.sin(2 * np.pi * hertz * time)
    if kind in ("sines", "triangles"):
        hertz = _even_in_octaves(rng, (0.2, 20.0 if kind == "sines" else 3.0))
        wave = np.sin(2 * np.pi * hertz * time)
        wave = wave if kind == "sines" else np.arcsin(wave) * (2.0 / np.pi)
        return last + target / (1.0 + hertz / CORNER_HZ) * wave
    if kind == "chirps":
        sweep = 0.2 * rng.uniform(5.0, 75.0) ** share
        wave = np.sin(2 * np.pi * np.cumsum(sweep) / rate)
        return last + target / (1.0 + sweep / CORNER_HZ) * wave
    hertz = _even_in_octaves(rng, (0.2, 10.0) if kind == "noise" else (0.05, 1.0))
    part, noise, value, second = 2.0 * math.pi * hertz / rate, np.empty(count), 0.0, 0.0
    for k, draw in enumerate(rng.standard_normal(count).tolist()):
        value += part * (draw - value)
        second += min(4.0 * part, 1.0) * (value - second)
        noise[k] = value if kind == "noise" else second
    size = 0.25 * largest / math.sqrt(part / (2.0 - part)) / (1.0 + hertz / CORNER_HZ)
    return last + size * (noise - noise[0])


def _even_in_octaves(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return math.exp(rng.uniform(math.log(ends[0]), math.log(ends[1])))


def random_motion(rng: np.random.Generator, number: int, seconds: float, seed: int) -> Motion:
    """Piece of healthy motion: kinds and modes in turn, all else at random."""
    a, b, c = rng.uniform(0.0, 0.7, 3).tolist()
    return Motion(
        KINDS[number // 2 % len(KINDS)],
        "position" if number % 2 else "current",
        seconds,
        (a, b, c),
        seed,
        oil=float(rng.uniform(-20.0, 100.0)),
        oil_rate=float(rng.uniform(-0.05, 0.05)),
        ripple=float(rng.uniform(0.0, 0.3e6)),
        ripple_hz=_even_in_octaves(rng, (0.1, 3.0)),
    )


def changed(motion: Motion, change: str, size: float, after: float) -> Motion:
    """The same piece with a change in it."""
    return replace(motion, change=change, size=size, after=after)
