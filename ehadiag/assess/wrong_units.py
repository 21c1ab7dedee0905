"""Finds a wrong unit or sign of a channel by physics.

What the channels must have to do with each other holds on any motion, whatever the faults; and none
reads many times what the actuator reaches."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CHANNELS
from ehadiag.core.conversion import reach_of
from ehadiag.core.recording import CommandMode, Samples

__all__ = ["Relation", "beyond_reach", "implausible", "relations"]

SMOOTHED_S = 0.05
"""Over which a velocity is taken."""
LEAST_FIT = 0.8
"""Correlation below which a relation says nothing of units."""
WITHIN = 0.25
"""Relative distance from what is expected that faults, load and supply make."""
MOVING = 0.005
"""m/s; slower the jack may stick."""
LEAST_MOVING = 200
"""Ticks."""
FRICTION_SPAN = (1.0, 1.2)
"""Share of the friction as new, and at the limit, between which the pressure that moves the jack
lies; viscous friction comes on top."""
BEYOND_REACH = 10.0
"""Times the actuator's reach that no sensor reads, whatever is wrong with it."""
FACTORS: tuple[tuple[float, str], ...] = (
    (-1.0, "its sign is reversed"),
    (1e-3, "a unit 1000 times larger was sent"),
    (1e3, "a unit 1000 times smaller was sent"),
    (0.1, "a unit ten times larger was sent"),
    (10.0, "a unit ten times smaller was sent"),
    (25.4, "millimetres were sent as inches"),
    (1.0 / 25.4, "inches were sent as millimetres"),
    (14.5038, "psi were sent as bar"),
    (1.0 / 14.5038, "bar were sent as psi"),
)
"""Measured over true value, and what makes that."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Relation:
    """Slope of one channel over another, as measured, over what the actuator's data say.

    Attributes
    ----------
    upper : str
        Channel whose error raises the ratio.
    lower : str
        Channel whose error lowers it.
    ratio : float
        1 where both units and signs are right.
    """

    upper: str
    lower: str
    ratio: float


def relations(samples: Samples, actuator: Actuator) -> tuple[Relation, ...]:
    """Hold the channels against each other.

    Spool over current is the torque motor's gain over the feedback wire's stiffness (PHY-4);
    velocity of the jack over spool the flow gain over its area (PHY-6, PHY-7); the current that
    of its command, or of the control law (PHY-2, PHY-3).

    Parameters
    ----------
    samples : Samples
        Any motion.
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    tuple[Relation, ...]
        Those that the motion shows.
    """
    valve, jack = actuator.servovalve, actuator.jack
    half = max(round(0.5 * SMOOTHED_S * 1e9 / samples.period_ns), 1)
    velocity = _velocity(samples.position, half, samples.period_ns * 1e-9)
    found = [
        _relation("spool", "current", samples.spool, samples.current, valve.GM / valve.KSF),
        _relation("position", "spool", velocity, _smooth(samples.spool, half), valve.GQ / jack.AJ),
    ]
    if samples.mode is CommandMode.CURRENT:
        found.append(_relation("command", "current", samples.command, samples.current, 1.0))
    elif np.isfinite(samples.command).any():
        found.append(_relation("command", "position", samples.command, samples.position, 1.0))
    return tuple(item for item in found if item is not None)


def implausible(samples: Samples, actuator: Actuator) -> tuple[str, ...]:
    """Say which channels have a wrong unit or sign.

    Parameters
    ----------
    samples : Samples
        Any motion; without one nothing is said.
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    tuple[str, ...]
        One sentence for each channel; of several explanations the one with fewest channels.
    """
    found = relations(samples, actuator)
    out = list(_explained(found))
    pressure = _pressure(samples, actuator, {item.lower for item in found})
    return (*out, *pressure)


def beyond_reach(samples: Samples, actuator: Actuator) -> list[str]:
    """Say which channels read so much that their unit or scale must be wrong.

    Parameters
    ----------
    samples : Samples
        Any motion.
    actuator : Actuator
        Data of the actuator.

    Returns
    -------
    list[str]
        One sentence for each channel.
    """
    out = []
    for channel in CHANNELS:
        values = np.abs(np.asarray(getattr(samples, channel.name)))
        values = values[np.isfinite(values)]
        reach, unit = reach_of(actuator, channel), channel.per_unit
        top = float(np.quantile(values, 0.99)) if values.size else 0.0
        if top > BEYOND_REACH * reach:
            out.append(
                f"{channel.name} reads {top / unit:.3g} {channel.unit}, the actuator reaches"
                f" {reach / unit:.3g} {channel.unit}: check unit and scale of its signal"
            )
    return out


def _explained(found: tuple[Relation, ...]) -> tuple[str, ...]:
    if all(abs(item.ratio - 1.0) <= WITHIN for item in found):
        return ()
    names = sorted({name for item in found for name in (item.upper, item.lower)})
    for count in (1, 2):
        best: tuple[float, tuple[str, ...]] | None = None
        for wrong in itertools.combinations(names, count):
            for choice in itertools.product(FACTORS, repeat=count):
                factor = {name: value for name, (value, _) in zip(wrong, choice, strict=True)}
                off = max(
                    abs(item.ratio * factor.get(item.lower, 1.0) / factor.get(item.upper, 1.0) - 1)
                    for item in found
                )
                words = tuple(
                    f"{name}: {text}, or the mapping says so"
                    for name, (_, text) in zip(wrong, choice, strict=True)
                )
                if off <= WITHIN and (best is None or off < best[0]):
                    best = (off, words)
        if best is not None:
            return best[1]
    return tuple(
        f"{item.upper} moves {item.ratio:.3g} times as much with the {item.lower} as the actuator's"
        " data say"
        for item in found
        if abs(item.ratio - 1.0) > WITHIN
    )


def _pressure(samples: Samples, actuator: Actuator, moved: set[str]) -> tuple[str, ...]:
    """Hold the pressure that moves the jack against the friction that it may have."""
    jack = actuator.jack
    half = max(round(0.5 * SMOOTHED_S * 1e9 / samples.period_ns), 1)
    velocity = _velocity(samples.position, half, samples.period_ns * 1e-9)
    known = np.isfinite(velocity) & np.isfinite(samples.pressure) & (np.abs(velocity) > MOVING)
    if known.sum() < LEAST_MOVING or "spool" not in moved:
        return ()
    force = jack.AJ * samples.pressure[known] - jack.FR
    usual = float(np.median(np.abs(force)))
    low, high = FRICTION_SPAN[0] * jack.FDJ0, FRICTION_SPAN[1] * jack.FDJ1
    ahead = float(np.mean(np.sign(force) == np.sign(velocity[known])))
    if ahead < 0.35:
        return ("pressure: its sign is reversed against the jack's motion, or the mapping says so",)
    if low <= usual <= high:
        return ()
    fits = [text for value, text in FACTORS if value > 0 and low <= usual / value <= high]
    why = " or ".join(fits) if fits else "another unit was sent"
    return (
        f"pressure: {usual:.3g} N move the jack, its friction is {jack.FDJ0:g} …"
        f" {jack.FDJ1:g} N: {why}",
    )


def _relation(upper: str, lower: str, y: Floats, x: Floats, expected: float) -> Relation | None:
    known = np.isfinite(x) & np.isfinite(y)
    if known.sum() < LEAST_MOVING:
        return None
    x, y = x[known] - x[known].mean(), y[known] - y[known].mean()
    power, other = float(x @ x), float(y @ y)
    if power == 0.0 or other == 0.0 or abs(float(x @ y)) < LEAST_FIT * np.sqrt(power * other):
        return None
    return Relation(upper, lower, float(x @ y) / power / expected)


def _velocity(position: Floats, half: int, period: float) -> Floats:
    """Mean velocity about each tick, m/s; NaN near the ends."""
    out = np.full(len(position), np.nan)
    if len(position) > 2 * half:
        out[half:-half] = (position[2 * half :] - position[: -2 * half]) / (2 * half * period)
    return out


def _smooth(values: Floats, half: int) -> Floats:
    """Mean over the same ticks, of what is there."""
    known = np.isfinite(values)
    kernel = np.ones(2 * half)
    if len(values) < len(kernel):
        return values
    total = np.convolve(np.where(known, values, 0.0), kernel, "same")
    count = np.convolve(known.astype(np.float64), kernel, "same")
    return np.where(count > half, total / np.maximum(count, 1.0), np.nan)
