"""What a monitor's kernels need of an actuator's data: the plan, a flat array."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import CURRENT, POSITION, PRESSURE, SPOOL
from ehadiag.model.anchor import Anchor
from ehadiag.model.control import ControlLaw
from ehadiag.model.plant import PlantConstants
from ehadiag.monitor.cusum import CusumDesign
from ehadiag.monitor.layout import Settings

__all__ = ["ANCHOR", "NOISE", "monitor_plan"]

NOISE_LSB = math.sqrt(0.5**2 + 1.0 / 12.0)
"""Noise of a channel (PHY-22), its converter's rounding included."""
NOISE = (NOISE_LSB * SPOOL.lsb, NOISE_LSB * PRESSURE.lsb)
"""Of spool (m) and pressure (Pa), white."""
ANCHOR = Anchor(0.3, 1.3 * SPOOL.lsb, 6.0 * SPOOL.lsb)
RESIDUAL_LIMIT = 4.0
"""Noise; a residual beyond counts no more: one break-away at another tick gives no alarm."""
DEVIATION_LSB = 4.0
"""A lost command did not go on as it was where the measured current is further off."""


def monitor_plan(
    actuator: Actuator,
    constants: PlantConstants,
    design: CusumDesign,
    noise: tuple[float, float] = NOISE,
    anchor: Anchor = ANCHOR,
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
    noise : tuple[float, float]
        Standard deviation of spool (m) and pressure (Pa).
    anchor : Anchor
        How the modelled spool is kept on the measured one.

    Returns
    -------
    NDArray[np.float64]
        Shape (PLAN_SIZE,).
    """
    law = actuator.controller
    settings = Settings(
        plays=constants.NPL,
        closed=0.0,
        invertible=float(
            law.GAP * POSITION.lsb > 6.0 * CURRENT.lsb and not law.GAI and not law.GAD
        ),
        linear=law.IM - 3.0 * CURRENT.lsb,
        code_position=POSITION.lsb,
        anchor_gain=anchor.gain,
        anchor_small=anchor.small,
        anchor_large=anchor.large,
        spool_weight=1.0 / noise[0],
        pressure_weight=1.0 / noise[1],
        reference=design.reference,
        threshold=design.threshold,
        limit=RESIDUAL_LIMIT,
        deviation=DEVIATION_LSB * CURRENT.lsb,
    )
    control = ControlLaw(law.IM, law.GAP, law.GAI, law.GAD, 1.0 / law.rate)
    return np.array([*constants, *control, *settings], dtype=np.float64)
