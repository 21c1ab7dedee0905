"""The flight-control computer's position controller, one tick at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import inlined_exact, kernel
from ehadiag.core.actuator import Controller

__all__ = ["ControlLaw", "ControlState", "commanded_currents", "control", "control_law"]


class ControlLaw(NamedTuple):
    """Gains of the controller (PHY-2), see `ehadiag.core.actuator.Controller`.

    Attributes
    ----------
    IM: saturation, A.
    GAP, GAI, GAD: A/m, A/(m s), A s/m.
    tick: s.
    """

    IM: float
    GAP: float
    GAI: float
    GAD: float
    tick: float


class ControlState(NamedTuple):
    """Between two ticks: integral of the error (m s), error of the tick before (m), if there was.

    Attributes
    ----------
    integral: m s.
    before: m; of no meaning until started.
    started: 0 before the first tick, then 1.
    """

    integral: float
    before: float
    started: float


def control_law(controller: Controller, tick: float) -> ControlLaw:
    """Gains of an actuator's controller, run once each `tick` (s)."""
    return ControlLaw(controller.IM, controller.GAP, controller.GAI, controller.GAD, tick)


@inlined_exact
def control(law: ControlLaw, state: ControlState, error: float) -> tuple[float, ControlState]:
    """Demanded current (A) for a position error (m).

    Cor = sat(GAP Err + GAI ∫Err + GAD dErr/dt) (PHY-2).
    """
    wanted = law.GAP * error
    if state.started != 0.0:
        wanted += law.GAD * (error - state.before) / law.tick
    trial = state.integral + error * law.tick
    wanted += law.GAI * trial
    out = min(max(wanted, -law.IM), law.IM)
    integral = state.integral
    # Conditional integration: the integral rests while it would push further into saturation.
    if wanted == out or (wanted - out) * error < 0.0:
        integral = trial
    return out, ControlState(integral, error, 1.0)


@kernel
def commanded_currents(law: ControlLaw, errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Demanded current of each tick (A) from its position error (m), both of shape (n,)."""
    out = np.empty_like(errors)
    state = ControlState(0.0, 0.0, 0.0)
    for k in range(errors.shape[0]):
        out[k], state = control(law, state, errors[k])
    return out
