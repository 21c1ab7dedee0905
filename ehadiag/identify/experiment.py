"""A recorded test prepared for identification: current, spool, pressure, and their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import PRESSURE, Channel, Channels
from ehadiag.core.conversion import conversion_of
from ehadiag.core.recording import Environment, Samples
from ehadiag.core.stored_test import StoredTest
from ehadiag.identify.commanded_current import CurrentTrace, commanded_current
from ehadiag.identify.noise import QUIET_BLOCK, noise_of_signal
from ehadiag.model.plant import PlantConstants, relative_viscosity
from ehadiag.model.unit import unit_constants

__all__ = ["Experiment", "build_experiment", "noise_is_judged_early", "share_offsets"]

DISPLACED = 0.3e6 / PRESSURE.full_scale
"""Pressure at rest, over the converter's half range, above which it is none of the sensor's
offset: 0.3 MPa of the default range."""
SETTLES_LSB, SETTLES_NOISE = 5.0, 8.0
"""Pressure of the first samples beside that of the rest's second half, in steps of the converter
and deviations of the noise, from which on nothing rested: a null bias beyond the spool's friction
moves it from the first tick on."""
LEAST_REST = 20
"""Samples at rest from which an offset is taken."""
LEAST_QUIET_BLOCKS = 20
FIRST = 10
"""Ticks in which the jack has not yet moved from its middle."""


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """One recorded test, ready for identification; arrays of shape (n,)."""

    test: StoredTest
    constants: PlantConstants
    """Of the unit as new, at the oil and supply of the test, with its calibrated effects."""
    tick: float
    """s."""
    trace: CurrentTrace
    spool: NDArray[np.float64]
    """Measured less its offset, m; NaN where missing or at the converter's end."""
    pressure: NDArray[np.float64]
    """Measured less its offset, Pa; NaN where missing or at the converter's end."""
    position: NDArray[np.float64]
    """Measured less its first samples, m; NaN where missing or at the converter's end."""
    spool_noise: float
    """Standard deviation, m."""
    pressure_noise: float
    """Standard deviation, Pa."""
    position_noise: float
    """Standard deviation, m."""
    spool_offset: float
    """Already taken off `spool`, m: its mean while the actuator rests before the test moves it."""
    pressure_offset: float
    """Already taken off `pressure`, Pa."""
    position_offset: float
    """Already taken off `position`, m."""
    rested: bool
    """Whether the actuator rested long enough before the test to show them."""
    origin: float
    """Spool position before the test, m, as the pressure at rest tells."""
    channels: Channels
    """Converters that the samples went through."""
    viscosity_std: float = 0.0
    """Relative standard deviation of the oil's viscosity that the bus's rounding leaves."""

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.spool)

    @property
    def noise(self) -> tuple[float, ...]:
        """Standard deviations of spool, pressure and position (m, Pa, m), as rows of residuals."""
        return self.spool_noise, self.pressure_noise, self.position_noise

    def with_noise(self, noise: tuple[float, ...]) -> Experiment:
        """Return the same with other standard deviations, see `noise`."""
        spool, pressure, position = noise
        return replace(self, spool_noise=spool, pressure_noise=pressure, position_noise=position)


def build_experiment(
    samples: Samples, environment: Environment, test: StoredTest, actuator: Actuator
) -> Experiment:
    """Prepare a recording for identification."""
    channels, saturated = conversion_of(samples, actuator)
    samples = replace(samples, saturated=saturated)
    spool = np.where(samples.saturated[1], np.nan, samples.spool)
    pressure = np.where(samples.saturated[2], np.nan, samples.pressure)
    position = np.where(samples.saturated[3], np.nan, samples.position)
    trace = commanded_current(samples, test, actuator.controller, channels)
    rest = _ticks_at_rest(trace.current)
    if _settles(pressure[:rest], channels.pressure):
        rest = 0
    constants = unit_constants(actuator, environment)
    spool_offset, rest_pressure = _mean(spool[:rest]), _mean(pressure[:rest])
    # What the jack's load or displaced lands ask for is no offset.
    least, most = _pressures_asked_for(constants)
    pressure_offset = rest_pressure - min(max(rest_pressure, least), most)
    origin = 0.0
    if abs(pressure_offset) > DISPLACED * channels.pressure.full_scale:
        # So much pressure is that of a spool that friction holds beside the middle.
        origin = rest_pressure / _rise_with_spool(constants) + constants.XLD
        origin = min(max(origin, -constants.XSM), constants.XSM)
        spool_offset, pressure_offset = spool_offset - origin, 0.0
    spool, pressure = spool - spool_offset, pressure - pressure_offset
    position_offset = _first(position)
    # Before the sines only, where that suffices: the same while the test still runs.
    quiet = _first_part(test) if noise_is_judged_early(test) else len(spool)
    return Experiment(
        test=test,
        constants=constants,
        tick=samples.period_ns * 1e-9,
        trace=trace,
        spool=spool,
        pressure=pressure,
        position=position - position_offset,
        spool_noise=noise_of_signal(spool[:quiet], channels.spool),
        pressure_noise=noise_of_signal(pressure[:quiet], channels.pressure),
        position_noise=noise_of_signal(position[:quiet], channels.position),
        spool_offset=spool_offset,
        pressure_offset=pressure_offset,
        position_offset=position_offset,
        rested=rest >= LEAST_REST,
        origin=origin,
        channels=channels,
        viscosity_std=_viscosity_std(environment),
    )


def _rise_with_spool(constants: PlantConstants) -> float:
    """Pressure on a jack at rest over the opening of the lands, Pa/m (PHY-6)."""
    return constants.GP / (1.0 + constants.GP / constants.GQ * constants.CLK)


def _pressures_asked_for(constants: PlantConstants) -> tuple[float, float]:
    """Least and largest pressure at rest, Pa, that a spool in its middle may leave.

    That which displaced lands ask for falls to nothing where the jack gives way; it is bounded by
    what lands of their shape open at most.
    """
    lap = abs(constants.LAP) * constants.GP / constants.PSR
    shape = 1.0 + abs(constants.LD2) + abs(constants.LD3) + lap
    lands = -_rise_with_spool(constants) * shape * constants.XLD
    load = abs(constants.FR) / constants.AJ
    return min(lands, 0.0) - load, max(lands, 0.0) + load


def _viscosity_std(environment: Environment) -> float:
    degc, std = environment.oil_temperature, environment.temperature_std
    if degc is None or std == 0.0:
        return 0.0
    return std * abs(relative_viscosity(degc + 1.0) / relative_viscosity(degc) - 1.0)


def _first_part(test: StoredTest) -> int:
    """Ticks of a test before its genetic search's window."""
    return round(min(begin for begin, _ in test.windows.refinement) * test.rate)


def noise_is_judged_early(test: StoredTest) -> bool:
    """Whether the test's first part is long enough to judge the noise by."""
    return _first_part(test) >= LEAST_QUIET_BLOCKS * QUIET_BLOCK


def _ticks_at_rest(current: NDArray[np.float64]) -> int:
    """How long the current is zero before the test moves the actuator.

    In closed loop the noise of the jack's sensor keeps the spool moving: no rest, no offset yet.
    """
    moving = np.flatnonzero(current != 0.0)
    return int(moving[0]) if moving.size else len(current)


def _settles(values: NDArray[np.float64], channel: Channel) -> bool:
    """Whether a signal that should rest begins elsewhere than it stays."""
    begin, end = values[:3], values[len(values) // 2 :]
    begin, end = begin[np.isfinite(begin)], end[np.isfinite(end)]
    if not begin.size or not end.size:
        return False
    place = np.median(end)
    noise = 1.4826 * np.median(np.abs(end - place))
    most = max(SETTLES_LSB * channel.lsb, SETTLES_NOISE * noise)
    return bool(np.median(np.abs(begin - place)) > most)


def _mean(values: NDArray[np.float64]) -> float:
    """Mean of what is there; 0 of too little."""
    seen = values[np.isfinite(values)]
    return float(seen.mean()) if seen.size >= LEAST_REST else 0.0


def _first(values: NDArray[np.float64]) -> float:
    """Mean of the first samples, before anything has moved."""
    seen = values[:FIRST][np.isfinite(values[:FIRST])]
    return float(seen.mean()) if seen.size else 0.0


def share_offsets(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Take the sensors' offsets, where one test of the actuator shows them at rest, off all."""
    resting = [item for item in experiments if item.rested]
    if not resting:
        return list(experiments)
    spool = float(np.mean([item.spool_offset for item in resting]))
    pressure = float(np.mean([item.pressure_offset for item in resting]))
    return [
        item
        if item.rested
        else replace(
            item,
            spool=item.spool - spool,
            pressure=item.pressure - pressure,
            spool_offset=spool,
            pressure_offset=pressure,
        )
        for item in experiments
    ]
