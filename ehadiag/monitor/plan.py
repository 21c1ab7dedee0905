"""What a monitor's kernels need of an actuator's data: the plan, a flat array."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import Channels
from ehadiag.core.conversion import actuator_channels
from ehadiag.model.anchor import Anchor
from ehadiag.model.control import control_law
from ehadiag.model.plant import PlantConstants
from ehadiag.monitor.cusum import CusumDesign
from ehadiag.monitor.layout import Settings

__all__ = ["monitor_plan", "usual_anchor", "usual_noise"]

NOISE_LSB = math.sqrt(0.5**2 + 1.0 / 12.0)
"""Noise of a channel (PHY-22), its converter's rounding included."""
RESIDUAL_LIMIT = 4.0
"""Noise; a residual beyond counts no more: one break-away at another tick gives no alarm."""
DEVIATION_LSB = 4.0
"""A lost command did not go on as it was where the measured current is further off."""


def usual_noise(channels: Channels) -> tuple[float, float]:
    """White noise of spool (m) and pressure (Pa): that of 12-bit converters, or of coarser ones."""
    return NOISE_LSB * channels.spool.grain, NOISE_LSB * channels.pressure.grain


def usual_anchor(channels: Channels) -> Anchor:
    """How the modelled spool is kept on the measured one, in the same steps."""
    return Anchor(0.3, 1.3 * channels.spool.grain, 6.0 * channels.spool.grain)


def monitor_plan(
    actuator: Actuator,
    constants: PlantConstants,
    design: CusumDesign,
    noise: tuple[float, float] | None = None,
    anchor: Anchor | None = None,
    channels: Channels | None = None,
) -> NDArray[np.float64]:
    """Lay out what `ehadiag.monitor.prepare` takes.

    Parameters
    ----------
    actuator : Actuator
        Of which the controller's data are taken.
    constants : PlantConstants
        Of the unit as new, at its oil and supply.
    design : CusumDesign
        Reference value and threshold of the sums.
    noise : tuple[float, float] | None
        Standard deviation of spool (m) and pressure (Pa); None: `usual_noise`.
    anchor : Anchor | None
        How the modelled spool is kept on the measured one; None: `usual_anchor`.
    channels : Channels | None
        Converters; None: those of the actuator's file.

    Returns
    -------
    NDArray[np.float64]
        Shape (PLAN_SIZE,).
    """
    law = actuator.controller
    channels = channels or actuator_channels(actuator)
    noise = noise or usual_noise(channels)
    anchor = anchor or usual_anchor(channels)
    settings = Settings(
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
        limit=RESIDUAL_LIMIT,
        deviation=DEVIATION_LSB * channels.current.grain,
    )
    control = control_law(law, 1.0 / law.rate)
    return np.array([*constants, *control, *settings], dtype=np.float64)
