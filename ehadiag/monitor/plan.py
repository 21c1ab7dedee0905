"""Design of a monitor: thresholds of its cumulative sums, and constants for its kernels.

Upper sum S+ = max(0, S+ + z - k), lower sum S- = max(0, S- - z - k), alarm beyond h; z is the
residual in units of its noise (Page, Biometrika 41, 1954). The mean time between false alarms
follows Siegmund, Sequential Analysis, Springer 1985, section 2.6.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag.core.criteria import ANCHORING, ESTIMATION
from ehadiag.model.batch import Anchor
from ehadiag.model.laws import control_law
from ehadiag.model.plant import PlantConstants
from ehadiag.monitor.monitor_memory import MonitorSettings
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import Channels

CUSUM_COUNT = 4
"""Number of sums, 1: two channels, each with an upper and a lower one."""
MEAN_CUSUM_OVERSHOOT = 1.166
"""Mean by which a normal sum oversteps its two barriers, in deviations (Siegmund)."""
THRESHOLD_TOLERANCE = 1e-12
"""Change of the iterated threshold at convergence, 1."""
CUSUM_SHIFT_RANGE = (0.1, 5.0)
"""Range of the shift of the mean that is detected soonest, in deviations."""
FALSE_ALARM_HOURS_RANGE = (1e-4, 1e7)
"""Range of the mean time between false alarms, h."""


class CusumDesign(msgspec.Struct, frozen=True):
    """Both in units of the noise."""

    reference: float
    """k: half the shift of the mean that is to be found soonest."""
    threshold: float
    """h."""


def mean_run_length(design: CusumDesign) -> float:
    """Mean number of samples between false alarms of one sum on white noise."""
    k = design.reference
    x = 2.0 * k * (design.threshold + MEAN_CUSUM_OVERSHOOT)
    return (math.expm1(x) - x) / (2.0 * k * k)


def design_cusum(hours: float, tick: float, shift: float = 1.0) -> CusumDesign:
    """Reference value and threshold for a mean time between false alarms of all sums together, h.

    tick: s; shift: of the mean that is detected soonest, in deviations of the noise. A value out of
    its range, or a time too short for any threshold, raises ConfigurationError.
    """
    if not FALSE_ALARM_HOURS_RANGE[0] <= hours <= FALSE_ALARM_HOURS_RANGE[1]:
        raise ConfigurationError(
            f"hours between false alarms {hours:g}: need {FALSE_ALARM_HOURS_RANGE[0]:g} … 1e7"
        )
    if not CUSUM_SHIFT_RANGE[0] <= shift <= CUSUM_SHIFT_RANGE[1]:
        raise ConfigurationError(
            f"CUSUM shift {shift:g}: need {CUSUM_SHIFT_RANGE[0]:g} … {CUSUM_SHIFT_RANGE[1]:g}"
        )
    k = 0.5 * shift
    length = CUSUM_COUNT * hours * 3600.0 / tick
    # exp(x) = 2 k² length + x + 1 with x = 2 k b: the right side grows so slowly that to repeat
    # it converges.
    x = before = 0.0
    for _ in range(200):
        x, before = math.log(2.0 * k * k * length + x + 1.0), x
        if abs(x - before) < THRESHOLD_TOLERANCE:
            break
    threshold = x / (2.0 * k) - MEAN_CUSUM_OVERSHOOT
    if threshold <= 0.0:
        raise ConfigurationError(
            f"{hours:g} h between false alarms: no threshold is so low for a shift of {shift:g}"
        )
    return CusumDesign(k, threshold)


MAX_MONITOR_RESIDUAL = 4.0
"""Largest residual that counts, in deviations: one break-away at another tick gives no alarm."""
MAX_CURRENT_DEVIATION_LSB = 4.0
"""Deviation of the measured current from which a lost command has changed, LSB."""


def default_noise(channels: Channels) -> tuple[float, float]:
    """White noise of spool (m) and pressure (Pa): that of 12-bit converters, or of coarser ones."""
    return (
        ESTIMATION.noise_lsb * channels.spool.grain,
        ESTIMATION.noise_lsb * channels.pressure.grain,
    )


def default_anchor(channels: Channels) -> Anchor:
    """Re-anchoring of the modelled spool on the measured one, in the same steps."""
    grain = channels.spool.grain
    return Anchor(ANCHORING.gain, ANCHORING.small_lsb * grain, ANCHORING.large_lsb * grain)


def monitor_plan(
    actuator: Actuator,
    constants: PlantConstants,
    design: CusumDesign,
    noise: tuple[float, float] | None = None,
    anchor: Anchor | None = None,
    channels: Channels | None = None,
) -> Array:
    """Plan of a monitor, shape (MONITOR_PLAN_SIZE,), see `ehadiag.monitor.monitor_memory`.

    constants: of the unit as new, at its oil and supply; noise: standard deviation of spool (m) and
    pressure (Pa), `default_noise` unless given; anchor: re-anchoring, `default_anchor` unless
    given; channels: converters, those of the actuator's file unless given.
    """
    law = actuator.controller
    channels = channels or actuator_channels(actuator)
    noise = noise or default_noise(channels)
    anchor = anchor or default_anchor(channels)
    settings = MonitorSettings(
        plays=constants.NPL,
        closed=0.0,
        invertible=float(
            law.GAP * channels.position.lsb > 6.0 * channels.current.lsb
            and not law.GAI
            and not law.GAD
        ),
        linear=law.IM - 3.0 * channels.current.grain,
        code_position=channels.position.lsb,
        anchor_gain=anchor.gain,
        anchor_small=anchor.small,
        anchor_large=anchor.large,
        spool_weight=1.0 / noise[0],
        pressure_weight=1.0 / noise[1],
        reference=design.reference,
        threshold=design.threshold,
        limit=MAX_MONITOR_RESIDUAL,
        deviation=MAX_CURRENT_DEVIATION_LSB * channels.current.grain,
        halvings=0.0,
    )
    control = control_law(law, 1.0 / law.rate)
    return np.array([*constants, *control, *settings], dtype=np.float64)
