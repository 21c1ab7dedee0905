"""Compiled integration of torque motor, spool, second stage and jack over one control tick.

Each sub-step takes flapper, spool, pressure and jack in the order of the chain. Forces that grow
with a mass's own velocity are implicit (the hydraulic ones have time constants of microseconds),
the rest is explicit; dry friction follows Borello's algorithm (model.md section 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.jit import kernel
from ehadiag_sim.coefficients import Coefficients

__all__ = ["BALL", "DXF", "DXJ", "DXS", "MOTOR", "P12", "STATES", "XF", "XJ", "XS", "step_tick"]

XF = 0
"""Flapper displacement, m."""
DXF = 1
"""Flapper velocity, m/s."""
XS = 2
"""Spool position, m."""
DXS = 3
"""Spool velocity, m/s."""
XJ = 4
"""Jack position, m."""
DXJ = 5
"""Jack velocity, m/s."""
P12 = 6
"""Differential pressure, Pa."""
MOTOR = 7
"""Current behind the torque motor's hysteresis, A."""
BALL = 8
"""Position of the feedback ball behind the backlash, m."""
STATES = 9


@kernel
def play(held: float, value: float, half_width: float) -> float:
    """Play operator: `held` follows `value` at a distance of at most `half_width`."""
    return max(value - half_width, min(value + half_width, held))


@kernel
def velocity_after(
    velocity: float,
    force: float,
    damping: float,
    mass: float,
    static: float,
    dynamic: float,
    step: float,
) -> float:
    """Velocity of a mass with dry friction after one step (Borello's algorithm).

    `force` holds everything but dry friction and the viscous force `damping·velocity`, which is
    implicit. A change of sign within the step stops at exactly zero, so that the next step
    decides between sticking and breaking away.
    """
    if velocity == 0.0:
        friction = max(-static, min(static, force))
    elif velocity > 0.0:
        friction = dynamic
    else:
        friction = -dynamic
    after = (velocity + step / mass * (force - friction)) / (1.0 + step / mass * damping)
    if velocity * after < 0.0:
        return 0.0
    return after


@kernel
def step_tick(
    state: NDArray[np.float64],
    p: Coefficients,
    current: float,
    step: float,
    substeps: int,
) -> None:
    """Advance `state` (shape (STATES,), in place) by `substeps` steps of `step` s at one current.

    `current` is the servovalve current in A that the control computer holds.
    """
    xf, dxf = state[XF], state[DXF]
    xs, dxs = state[XS], state[DXS]
    xj, dxj = state[XJ], state[DXJ]
    p12, ball = state[P12], state[BALL]
    state[MOTOR] = play(state[MOTOR], current, p.HYSTERESIS)
    torque = p.GM * state[MOTOR]
    flapper_denominator = 1.0 + step / p.JF * p.CF
    knee = p.PSR / p.GP

    for _ in range(substeps):
        dxf = (dxf + step / p.JF * (torque - p.KSF * ball - p.KF * xf)) / flapper_denominator
        xf += step * dxf
        if abs(xf) >= p.XFM:
            xf = p.XFM if xf > 0.0 else -p.XFM
            dxf = 0.0

        dxs = velocity_after(dxs, p.FORCE * xf, p.DAMPING, p.MS, p.FSS, p.FDS, step)
        xs += step * dxs
        if abs(xs) >= p.XSM:
            xs = p.XSM if xs > 0.0 else -p.XSM
            dxs = 0.0
        ball = play(ball, xs, p.BACKLASH)

        if abs(xs) <= knee:
            source = p.GP * xs
            resistance = p.GP / p.GQ
        else:
            source = p.PSR if xs > 0.0 else -p.PSR
            resistance = p.PSR / (p.GQ * abs(xs))
        g = 1.0 / (1.0 + resistance * p.CLK)
        drag = g * resistance * p.AJ
        before = dxj
        dxj = velocity_after(
            before, p.AJ * g * source - p.FR, p.AJ * drag + p.CJ, p.MJ, p.FSJ, p.FDJ, step
        )
        p12 = g * source - drag * dxj
        if abs(p12) > p.PSR:
            # A jack driven back against the valve: the pressure cannot exceed the supply.
            p12 = p.PSR if p12 > 0.0 else -p.PSR
            dxj = velocity_after(before, p.AJ * p12 - p.FR, p.CJ, p.MJ, p.FSJ, p.FDJ, step)
        xj += step * dxj
        if abs(xj) >= p.XJM:
            xj = p.XJM if xj > 0.0 else -p.XJM
            dxj = 0.0
            p12 = max(-p.PSR, min(p.PSR, g * source))

    state[XF], state[DXF] = xf, dxf
    state[XS], state[DXS] = xs, dxs
    state[XJ], state[DXJ] = xj, dxj
    state[P12], state[BALL] = p12, ball
